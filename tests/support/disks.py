"""Mounting, which only root on Linux may do."""

import os
import subprocess


def is_root() -> bool:
    return hasattr(os, "geteuid") and os.geteuid() == 0


def mounted(*options: str) -> bool:
    return subprocess.run(["mount", *options], capture_output=True, check=False).returncode == 0
