"""dragrig: runs a linear-motor drag tester, real or simulated, and makes sense of what it records."""

__version__ = "0.1.0"
