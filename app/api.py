"""What people type they can also call: the functions behind `import dragrig`."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from dragrig import backends
from dragrig.rig.preflight import Preflight, preflight
from dragrig.setup import PlanLike, resolve

Assignments = Mapping[str, object] | Sequence[str]


def check(
    plan: PlanLike,
    *,
    rig: str | Path | None = None,
    specimen: str | Path | None = None,
    model: str | Path | None = None,
    capsule: str | Path | None = None,
    backend: str | None = None,
    assignments: Sequence[str] = (),
    out: Path | None = None,
) -> Preflight:
    """Say what a plan would do and what forbids it; nothing moves.

    Parameters
    ----------
    plan
        A shipped plan's name, a file, a `Plan`, or a protocol.
    rig, specimen, model, capsule
        A file or a shipped name each.
    assignments
        Changes as on the command line, `["speed_mm_s=5", "rig.stage.highest_mm=120"]`.
    out
        Folder whose free space counts; the rig's data root unless given.

    Raises
    ------
    SettingsError, PlanError
        For settings that cannot be used at all.

    Examples
    --------
    >>> import dragrig
    >>> dragrig.check("drag").findings
    ()
    """
    setup = resolve(
        plan, rig=rig, specimen=specimen, model=model, capsule=capsule, backend=backend, assignments=assignments
    )
    backends.find(setup.backend)
    return preflight(setup.programme(), setup.rig, setup.limits, out or setup.data_root, setup.plan_source)
