"""Foreign measurements in, run files out."""

import hashlib
import json
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from uuid import uuid4

from dragrig.analysis.importing.foreign import ForeignTable
from dragrig.analysis.importing.mapping import ImportSettings
from dragrig.analysis.importing.measurement import Measurement, measurement_of
from dragrig.analysis.importing.restoring import restore
from dragrig.analysis.importing.sources import read_foreign
from dragrig.analysis.importing.timebase import IMPORT_EVENT
from dragrig.config.errors import OutputError
from dragrig.rig.runfile.model import Attribute, Event, RunHeader

UNKNOWN = float("nan")
LONGEST_PREAMBLE = 4000


@dataclass(frozen=True, slots=True)
class Imported:
    """The run file that was written, and what is to be said of it."""

    path: Path
    samples: int
    sample_rate_hz: float
    events: tuple[Event, ...]


def import_file(path: Path, target: Path, settings: ImportSettings | None = None) -> Imported:
    """Turn a foreign measurement into a run file.

    A file that this software exported comes back as the run it was; for every other file a column map
    is needed. `force` and `motor_force` are stored in mN. A quantity of another kind becomes one by a
    stated factor only (a friction coefficient by the normal load it belongs to, `Friction:1*1000` for
    1 N; a current by the motor's constant, `Iq:A*40000`); the column itself is then kept beside it, in its
    own unit, and an event says so.

    Parameters
    ----------
    target
        A run file to be, or a folder in which it gets its usual name.

    Raises
    ------
    ImportDataError
        When the file does not hold what the settings say.
    OutputError
        When something stands at the target already, or it cannot be written.
    """
    from dragrig.rig.runfile import run_file_name, write_run

    settings = settings or ImportSettings()
    table = read_foreign(path, settings)
    if table.export and not settings.columns.mapped():
        back = restore(table)
        where = _where(target, run_file_name(back.header.start_time, back.header.kind, back.header.order))
        written = write_run(
            where, back.header, back.columns, events=back.events, status=back.status, reason=back.reason,
            end_time=back.end_time, checks=back.checks,
        )  # fmt: skip
        return Imported(written, table.rows, back.header.sample_rate_hz, back.events)
    measured = measurement_of(table, settings)
    header, events = _header(path, table, settings, measured)
    where = _where(target, run_file_name(header.start_time, header.kind, header.order))
    written = write_run(where, header, measured.columns, events=events)
    return Imported(written, len(measured.columns["time"]), measured.sample_rate_hz, events)


def _where(target: Path, name: str) -> Path:
    found = target / name if target.is_dir() else target
    if found.suffix != ".h5":
        raise OutputError(f"{found}: is not a name for a run file; let it end in .h5, or give a folder that exists.")
    return found


def _header(
    path: Path, table: ForeignTable, settings: ImportSettings, measured: Measurement
) -> tuple[RunHeader, tuple[Event, ...]]:
    events = list(measured.events)
    start_time = settings.start_time
    if start_time is None:
        start_time = datetime.fromtimestamp(path.stat().st_mtime, UTC)
        events.insert(0, Event(0.0, IMPORT_EVENT, "start time not known: when the file was last changed"))
    entry: dict[str, Attribute] = {
        "software": f"dragrig {version('dragrig')}",
        "operator": settings.operator,
        "note": settings.note,
        "origin_mm": measured.origin_mm,
        "import_source": path.name,
        "import_sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "import_columns": json.dumps(dict(measured.sources), ensure_ascii=False),
        "import_settings": settings.model_dump_json(exclude_defaults=True),
        "import_time_origin_s": measured.time_origin_s,
        "import_preamble": "\n".join(table.preamble)[:LONGEST_PREAMBLE],
    }
    header = RunHeader(
        run_id=str(uuid4()),
        start_time=start_time,
        order=settings.order,
        backend="external",
        kind=settings.kind,
        sample_rate_hz=measured.sample_rate_hz,
        channels=measured.channels,
        entry={key: value for key, value in entry.items() if value != ""},
        protocol=dict(settings.protocol),
        capsule={"diameter_mm": UNKNOWN, "length_mm": UNKNOWN, "mass_g": UNKNOWN, "contact_angle_deg": UNKNOWN},
        specimen={"name": settings.specimen or path.stem, "wall_thickness_mm": UNKNOWN, "fixture": "none"},
    )
    return header, tuple(events)
