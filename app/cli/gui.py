"""`dragrig gui`."""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.cli import options

if TYPE_CHECKING:
    from dragrig.engine_host.messages import RigTerms


@click.command("gui")
@click.argument("lab", required=False, type=click.Path(path_type=Path))
@options.rig
@options.pace
@click.pass_context
def command(
    ctx: click.Context,
    lab: Path | None,
    rig: str | None,
    model: str | None,
    backend: str | None,
    double: bool,
    assignments: tuple[str, ...],
    pace: options.Pace | None,
) -> None:
    """Show the window: run plans, look at runs, diagnose campaigns.

    LAB is a lab folder; the one that the working folder is in unless given. Which rig the window is for, simulated or
    hardware, is chosen here and holds for as long as it is open. The engine runs in a process of its own: when the
    window is closed or dies, the stage is stopped and the run finished.
    """
    from dragrig.config.errors import SettingsError
    from dragrig.config.lab import RIG_FILE, rig_file_of
    from dragrig.engine_host.messages import RigTerms

    if lab is not None and not (lab / RIG_FILE).is_file():
        raise SettingsError(f"{lab}: is no lab folder, it holds no {RIG_FILE}; make one with dragrig init {lab}.")
    rig_file = rig_file_of(lab or Path.cwd())
    meant = Path(rig) if rig is not None else rig_file
    terms = RigTerms(meant, model, backend, double, assignments, pace)
    ctx.exit(_show(terms, rig_file.parent if rig_file is not None else None))


def _show(terms: "RigTerms", lab: Path | None) -> int:
    from dragrig.config.errors import SettingsError

    try:
        from dragrig.window.application import show
    except ImportError as error:
        raise SettingsError(_what_lacks(error)) from error
    if sys.platform == "linux" and not any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM"))):
        raise SettingsError(
            "gui: there is no screen here, neither DISPLAY nor WAYLAND_DISPLAY is set; sit at the machine itself, or "
            "connect with ssh -X."
        )
    return show(terms, lab)


def _what_lacks(error: ImportError) -> str:
    """Say which package a window needs that is not there."""
    if error.name is not None and error.name.split(".")[0] in {"PySide6", "shiboken6", "pyqtgraph"}:
        return "gui: the window needs PySide6 and pyqtgraph; install them with pip install 'dragrig[gui]'."
    return f"gui: a library of the system that Qt needs is not there ({error}); the README names the packages."
