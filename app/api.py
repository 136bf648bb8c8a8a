"""What people type they can also call: the functions behind `import dragrig`."""

from collections.abc import Sequence
from pathlib import Path

from dragrig import backends
from dragrig.rig.memory import MemoryStore
from dragrig.rig.preflight import Preflight, preflight
from dragrig.rig.runfile.model import Run
from dragrig.sessions import Terms, carry_out
from dragrig.setup import PlanLike, resolve


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


def simulate(
    plan: PlanLike,
    *,
    rig: str | Path | None = None,
    specimen: str | Path | None = None,
    model: str | Path | None = None,
    capsule: str | Path | None = None,
    assignments: Sequence[str] = (),
) -> tuple[Run, ...]:
    """Carry out a plan on the simulated rig, in memory, with every prompt answered done.

    Parameters
    ----------
    plan
        A shipped plan's name, a file, a `Plan`, or a protocol, as `Drag(speed_mm_s=5)`.

    Returns
    -------
    The runs in the order they were made, ways back included.

    Raises
    ------
    SettingsError, PlanError
        For settings that cannot be used.
    TrippedError, DeviceError
        When the session ended early.

    Examples
    --------
    >>> import dragrig
    >>> drag, back = dragrig.simulate("drag", assignments=["speed_mm_s=10"])
    >>> drag.trace.force.shape
    (8025,)
    """
    setup = resolve(
        plan, rig=rig, specimen=specimen, model=model, capsule=capsule, backend="simulated", assignments=assignments
    )
    store = MemoryStore()
    carry_out(setup, lambda _record: store, Terms(Path())).require()
    return tuple(store.runs)
