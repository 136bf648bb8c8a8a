"""What people type they can also call: the functions behind `import dragrig`."""

from dragrig.campaigns import Made
from dragrig.measuring import check, resume, run, simulate

__all__ = ["Made", "check", "resume", "run", "simulate"]
