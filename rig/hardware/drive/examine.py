"""A look at the drive while nothing moves."""

from collections.abc import Iterator

from dragrig.config.errors import DeviceError, plain
from dragrig.config.rig import RigSettings
from dragrig.rig.backend import Finding
from dragrig.rig.devices import Stage
from dragrig.rig.hardware.drive.link import DriveLink
from dragrig.rig.hardware.drive.parameters import write_safeguards, write_travel


def examine(stage: Stage, link: DriveLink, rig: RigSettings) -> Iterator[Finding]:
    """Ask how the drive is, and have it keep and repeat its limits."""
    state = stage.state()
    homed = f"homed, at {state.position_mm:g} mm" if state.homed else "not homed yet"
    answers = f"answers on {link.port} within {1000 * link.round_trip_s:.1f} ms; {homed}"
    yield Finding("drive", state.fault is None, answers if state.fault is None else state.fault.message)
    try:
        write_safeguards(link, rig)
        if state.homed:
            write_travel(link, stage.limits)
    except DeviceError as error:
        yield Finding("drive's limits", False, plain(error))
        return
    limits, drive = stage.limits, rig.hardware.drive
    travel = f"{limits.lowest_mm:g} to {limits.highest_mm:g} mm" if state.homed else "travel is set once it is homed"
    yield Finding(
        "drive's limits",
        True,
        f"keeps {drive.thrust_limit_N:g} N, {travel}, and stops after {drive.silence_s:g} s of silence",
    )
