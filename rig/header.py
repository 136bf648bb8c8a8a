"""What a run file says before its first sample."""

from collections.abc import Mapping
from functools import cache
from importlib.metadata import version

from dragrig.config.base import Settings
from dragrig.rig.backend import Backend
from dragrig.rig.devices import Acquisition
from dragrig.rig.programme import PlannedRun
from dragrig.rig.record import SessionRecord
from dragrig.rig.runfile.model import Attribute, RunHeader


def header_of(
    run: PlannedRun,
    acquisition: Acquisition,
    record: SessionRecord,
    backend: Backend,
    settings_toml: str,
    facts: Mapping[str, Attribute],
) -> RunHeader:
    """Gather the header of a run about to be made.

    Parameters
    ----------
    settings_toml
        The session's record as text, written once for all its runs.
    facts
        Further attributes of `/entry`.
    """
    now = backend.clock.now()
    entry: dict[str, Attribute] = {
        "software": software(),
        "plan": record.plan.name,
        "plan_run": run.index,
        "origin_mm": backend.stage.state().position_mm,
        "insertion_dwell_s": acquisition.insertion_dwell_s,
        "operator": record.operator,
        "note": "; ".join(part for part in (record.note, run.note) if part),
        "calibration_id": record.calibration_id,
        "encoder_calibration_id": record.encoder_calibration_id,
        **({"double": record.backend} if record.double else {}),
        **({"contact_mm": record.contact_mm} if record.contact_mm is not None else {}),
        **({"way_back_of": run.follows} if run.follows >= 0 else {}),
        **backend.description(),
        **facts,
    }
    return RunHeader(
        run_id=acquisition.run_id,
        start_time=now,
        order=acquisition.order,
        backend=backend.name,
        kind=run.protocol.kind,
        sample_rate_hz=backend.sampler.sample_rate_hz,
        channels=backend.sampler.channels,
        entry={key: value for key, value in entry.items() if value != ""},
        protocol={key: value for key, value in run.protocol.attributes().items() if key != "kind"},
        capsule=_plain(run.capsule),
        specimen={**_plain(run.specimen), "fixture": acquisition.fixture.value},
        settings_toml=f"# run {run.index} of this session, order {acquisition.order}\n{settings_toml}",
    )


@cache
def software() -> str:
    """Return name and version of this software."""
    return f"dragrig {version('dragrig')}"


def _plain(settings: Settings) -> dict[str, Attribute]:
    values = settings.model_dump(mode="json", exclude_none=True)
    return {key: value for key, value in values.items() if value != ""}
