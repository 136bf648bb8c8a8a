"""The drive, its port, and what powers it."""
