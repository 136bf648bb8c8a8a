"""The command line: `dragrig COMMAND`, one module of this package per command.

A command's module is named after it (with an underscore where Python needs one) and calls its click command
`command`. Only what a command prints is its business; what it does is in `dragrig.api` and below.
"""

from collections.abc import Sequence

from dragrig.cli.console import exit_code_of
from dragrig.cli.lazy import group


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line, `sys.argv` unless given, and return its exit code."""
    return exit_code_of(group, arguments)
