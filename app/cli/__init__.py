"""The command line: `dragrig COMMAND`.

`commands` lists every command with the module and attribute that hold it and loads none of them. Modules here print;
the work of a command is in `dragrig` and below.
"""

from collections.abc import Sequence

from dragrig.cli.commands import dragrig_group
from dragrig.cli.console import run_command_line


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line, `sys.argv` unless given, and return its exit code."""
    return run_command_line(dragrig_group, arguments)
