"""Import of a foreign measurement into a run file."""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from uuid import uuid4

import numpy as np

from dragrig.analysis import SOURCE_KEY, START_UNKNOWN_KEY, ImportSettings, printable
from dragrig.analysis.importing.conversion import (
    SPEED_WINDOW_S,
    ConvertedMeasurement,
    convert_table,
    motion_stretches,
    recordings,
)
from dragrig.analysis.importing.exports import PreparedRun, read_export, restore_run
from dragrig.analysis.importing.foreign import ForeignTable
from dragrig.analysis.importing.readers import read_foreign
from dragrig.analysis.importing.time_grid import import_event
from dragrig.config import Capsule, Fixture, ImportDataError, OutputError, Specimen, find_settings, suggestion
from dragrig.rig import (
    PARAMETERS_OF_KIND,
    Attribute,
    Phase,
    RunEvent,
    RunHeader,
    protocol_kinds,
)

CAPSULE_SIZES = ("diameter_mm", "length_mm", "mass_g", "contact_angle_deg")
UNKNOWN_SIZE = float("nan")
MAX_PREAMBLE_CHARS = 4000


@dataclass(frozen=True, slots=True)
class ImportedRun:
    """The run file that was written, and the events in it."""

    path: Path
    samples: int
    sample_rate_hz: float
    events: tuple[RunEvent, ...]


def import_file(path: Path, target: Path, settings: ImportSettings | None = None) -> ImportedRun:
    """Turn a foreign measurement into a run file.

    A file that this software exported comes back as the run it was, or as the part that was exported; every other
    file needs a column map, unless its column names say quantity and unit. `force` and `motor_force` are stored in
    mN. A column of another quantity becomes one of them by a stated factor only (a friction coefficient by the normal
    load, `Friction:1*1000` for 1 N; a current by the motor's constant, `Iq:A*40000`); the column itself is then stored
    too, in its own unit, and an event says so.

    Parameters
    ----------
    target
        The run file to write, or a folder in which it gets its default name.

    Raises
    ------
    ImportDataError
        When the file does not suit the settings.
    OutputError
        When the target exists already, or cannot be written.
    """
    runs = _prepared_runs(path, settings or ImportSettings())
    if len(runs) > 1:
        names = ", ".join(dict.fromkeys(repr(run.header.entry.get("import_table", "")) for run in runs))
        raise ImportDataError(
            f"{path}: holds {len(runs)} runs (tables: {names}); name one with table, or take all with import_runs."
        )
    return _write(runs[0], target)


def import_runs(path: Path, folder: Path, settings: ImportSettings) -> tuple[ImportedRun, ...]:
    """Turn a foreign measurement into run files: one for each of its tables with the same columns.

    A table whose clock begins anew, and with `split_at` a long record, becomes several. The orders of the runs count
    from that of the settings on. Nothing is written before all can be. Raises as `import_file`.
    """
    return tuple(_write(run, folder) for run in _prepared_runs(path, settings))


def _write(run: PreparedRun, target: Path) -> ImportedRun:
    from dragrig.rig import write_run

    events = (*map(import_event, run.remarks), *run.events)
    path = _run_file_path(target, run.header)
    written = write_run(path, run.header, run.columns, events=events, ending=run.ending)
    return ImportedRun(written, len(run.columns["time"]), run.header.sample_rate_hz, events)


def _prepared_runs(path: Path, settings: ImportSettings) -> tuple[PreparedRun, ...]:
    if not settings.columns.mapped() and (exported := read_export(path)) is not None:
        run = restore_run(exported)
        if stated := ", ".join(sorted(set(settings.model_dump(exclude_defaults=True)) - {"order"})):
            unused = f"not used, as an export comes back as it was: {stated}; map its columns to use them"
            run = replace(run, remarks=(unused, *run.remarks))
        return (run,)
    if settings.kind not in (kinds := protocol_kinds()):
        raise ImportDataError(f"{path}: {settings.kind} is no kind of run; {suggestion(settings.kind, tuple(kinds))}")
    tables, runs = read_foreign(path, settings), list[PreparedRun]()
    for table in tables:
        for recording in recordings(table, settings):
            spans = motion_stretches(recording, settings) if settings.split_at else ((settings.from_s, settings.to_s),)
            for from_s, to_s in spans:
                order = settings.order + len(runs)
                part = settings.model_copy(update={"from_s": from_s, "to_s": to_s, "order": order})
                is_titled = len(tables) > 1 and not re.fullmatch(r"block \d+", table.name)
                # The name of a file need not be text.
                specimen = printable(f"{path.stem}, {table.name}" if is_titled else path.stem)
                runs.append(_prepared_run(path, recording, part, specimen))
    return tuple(runs)


def _prepared_run(path: Path, table: ForeignTable, settings: ImportSettings, specimen: str) -> PreparedRun:
    measured = convert_table(table, settings)
    header, events = _run_header(path, table, settings, measured, specimen)
    missing = [key for key in PARAMETERS_OF_KIND.get(header.kind, ()) if key not in header.protocol]
    if missing:
        stated = " ".join(f"--set {key}=…" for key in missing)
        raise ImportDataError(
            f"{path}: leave the kind out, or state {stated}: a run of kind {header.kind} needs {', '.join(missing)}, "
            "which its positions do not show (no single move at one speed between standstills)."
        )
    return PreparedRun(header, measured.columns, events)


def _run_file_path(target: Path, header: RunHeader) -> Path:
    from dragrig.rig import run_file_name

    path = target / run_file_name(header.start_time, header.kind, header.order) if target.is_dir() else target
    if path.suffix != ".h5":
        raise OutputError(f"{path}: a run file's name must end in .h5; rename it, or give a folder that exists.")
    return path


def _run_header(
    path: Path, table: ForeignTable, settings: ImportSettings, measured: ConvertedMeasurement, specimen: str
) -> tuple[RunHeader, tuple[RunEvent, ...]]:
    events = measured.events
    start_time = settings.start_time or measured.begins_at or datetime.fromtimestamp(path.stat().st_mtime, UTC)
    start_time += timedelta(seconds=measured.skipped_s)
    undated: dict[str, Attribute] = {}
    if settings.start_time is None and measured.begins_at is None:
        unknown = "start time not known (--start-time states it): the file's date stands in its place, no session clock"
        events = (import_event(unknown), *events)
        undated = {START_UNKNOWN_KEY: True}
    capsule, known_specimen, fixture = _stated_circumstances(settings, specimen)
    shown = _shown_protocol(settings.kind, measured, known_specimen)
    protocol = {**{key: value for key, value in shown.items() if key not in settings.protocol}, **settings.protocol}
    if derived := [f"{key} = {shown[key]:g}" for key in shown if isfinite(shown[key]) and key not in settings.protocol]:
        events = (*events, import_event(f"by the position: {', '.join(derived)}"))
    if fixture is not settings.fixture:
        events = (*events, import_event(f"fixture {fixture}, as runs of this kind have"))
    entry: dict[str, Attribute] = {
        "software": f"dragrig {version('dragrig')}",
        "operator": settings.operator,
        "note": settings.note,
        "origin_mm": measured.origin_mm,
        "import_source": printable(path.name),
        "import_table": table.name,
        SOURCE_KEY: hashlib.sha256(path.read_bytes()).hexdigest(),
        "import_columns": json.dumps(dict(measured.sources), ensure_ascii=False),
        "import_settings": settings.model_dump_json(exclude_defaults=True),
        "import_time_origin_s": measured.time_origin_s,
        **({} if settings.insertion_dwell_s is None else {"insertion_dwell_s": settings.insertion_dwell_s}),
        **undated,
        "import_preamble": "\n".join(table.preamble)[:MAX_PREAMBLE_CHARS],
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
        protocol=protocol,
        capsule=capsule,
        specimen={**known_specimen, "fixture": (fixture or Fixture.NONE).value},
    )
    return header, events


def _stated_circumstances(
    settings: ImportSettings, default_name: str
) -> tuple[dict[str, Attribute], dict[str, Attribute], Fixture | None]:
    """Return the stated facts of capsule, specimen and fixture; sizes that nobody stated are NaN.

    Raises `SettingsError` for a capsule or specimen that cannot be found.
    """
    capsule: dict[str, Attribute] = dict.fromkeys(CAPSULE_SIZES, UNKNOWN_SIZE)
    fixture = settings.fixture
    if settings.capsule:
        capsule = find_settings(Capsule, "capsule", settings.capsule).model_dump(mode="json")
        protocol = protocol_kinds().get(settings.kind)
        fixture = protocol.fixture if fixture is None and protocol is not None else fixture
    specimen: dict[str, Attribute] = {"name": settings.specimen or default_name, "wall_thickness_mm": UNKNOWN_SIZE}
    if settings.specimen.endswith(".toml"):
        stated = find_settings(Specimen, "specimen", settings.specimen).model_dump(mode="json", exclude_none=True)
        specimen = {key: value for key, value in stated.items() if value != ""}
    if settings.wall_thickness_mm is not None:
        specimen["wall_thickness_mm"] = settings.wall_thickness_mm
    return capsule, specimen, fixture


def _shown_protocol(kind: str, measured: ConvertedMeasurement, specimen: Mapping[str, Attribute]) -> dict[str, float]:
    """Return the parameters that runs of a kind must state, as the measured motion shows them; empty without one.

    Speed and acceleration are rounded to three digits, so that repeats at one set speed stay together.
    """
    wanted = PARAMETERS_OF_KIND.get(kind, ())
    phase, position = measured.columns["phase"], np.asarray(measured.columns["position"], dtype=np.float64)
    time = np.asarray(measured.columns["time"], dtype=np.float64)
    steady = np.flatnonzero(phase == int(Phase.STEADY))
    ramp = np.flatnonzero(phase == int(Phase.ACCELERATE))
    if not wanted or len(steady) < 2 or len(steady) == len(phase):
        return {}
    speed = float(np.polyfit(time[steady], position[steady], 1)[0])
    period = 1 / measured.sample_rate_hz
    ramp_s = max(len(ramp), 1) * period
    first, last = max(int((phase == int(Phase.REST)).sum()) - 1, 0), len(phase) - int((phase == int(Phase.HOLD)).sum())
    travel = float(position[min(last, len(phase) - 1)] - position[first])
    rest_s, hold_s = (float((phase == int(at)).sum()) * period for at in (Phase.REST, Phase.HOLD))
    # The speed is smoothed over a window, which hides how steep a shorter ramp is.
    accel = abs(speed) / ramp_s if ramp_s > 3 * SPEED_WINDOW_S else UNKNOWN_SIZE
    rounded_speed, rounded_accel = (float(f"{value:.3g}") for value in (abs(speed), accel))
    wall_mm = specimen["wall_thickness_mm"]
    strain = abs(travel) / wall_mm if isinstance(wall_mm, float) and isfinite(wall_mm) else None
    shown = {
        "speed_mm_s": rounded_speed,
        "ramp_speed_mm_s": rounded_speed,
        "accel_mm_s2": rounded_accel,
        "ramp_accel_mm_s2": rounded_accel,
        "travel_mm": round(travel, 3),
        "rest_s": round(rest_s, 6),
        "hold_s": round(hold_s, 6),
        **({} if strain is None else {"shear_strain": float(f"{strain:.3g}")}),
    }
    return {key: shown[key] for key in wanted if key in shown}
