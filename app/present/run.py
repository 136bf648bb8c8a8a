"""A run laid out for a reader: measures, checks, events, settings; and what several run files contain."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, Final

from dragrig import present
from dragrig.analysis import RunMeasures, measure, minutes_since_excision, range_text, value_with_error
from dragrig.present import (
    Code,
    Column,
    Document,
    Facts,
    Field,
    Figure,
    FormattedNumber,
    Section,
    Table,
    Text,
    attributes_json,
    decimals,
    duration_text,
    run_problem,
    run_title,
    shortest,
    size_text,
)
from dragrig.rig import Attribute, Run, RunEvent, RunInfo

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

GENERAL: Final = shortest()
UNIT_SUFFIXES: Final = {
    "_mN_s_mm": "mN·s/mm", "_mm_s2": "mm/s²", "_mm_s": "mm/s", "_per_mm": "per mm", "_mm2": "mm²", "_mm": "mm",
    "_um": "µm", "_uV": "µV", "_N_per_A": "N per A", "_per_s": "1/s", "_ns": "ns", "_s": "s", "_mN": "mN", "_N": "N",
    "_hz": "Hz", "_g": "g", "_mb": "MB", "_days": "days", "_degC": "°C", "_deg": "°", "_kPa": "kPa",
}  # fmt: skip
"""Endings of names and the units that they stand for, longer ones first."""

_ATTRIBUTE_LABELS: Final = {
    "accel": "acceleration",
    "mass": "mass",
    "rest": "rest before",
    "hold": "hold after",
    "command_t0_uncertainty": "start of the command uncertain by",
}

_TIME_FORMAT: Final = "%Y-%m-%d %H:%M:%S %z"


def attribute_texts(values: Mapping[str, Attribute]) -> dict[str, str]:
    """Return attributes as a person reads them: `speed_mm_s = 5.0` as "speed": "5 mm/s"."""
    return {_attribute_label(name): _attribute_text(name, value) for name, value in values.items() if value != ""}


def check_texts(checks: Mapping[str, Attribute]) -> dict[str, str]:
    """Return what was checked right after the run."""
    apart = {"slip_time_s", "following_error_mm", "encoder_mismatch_mm", "encoder_mismatch_allowed_mm"}
    shown = {key: value for key, value in checks.items() if key not in apart}
    texts = attribute_texts(
        {key: float(f"{value:.3g}") if isinstance(value, float) else value for key, value in shown.items()}
    )
    following, slip = checks.get("following_error_mm"), checks.get("slip_time_s")
    if isinstance(following, int | float):
        texts["largest following error"] = f"{1000 * following:.1f} µm"
    off, allowed = checks.get("encoder_mismatch_mm"), checks.get("encoder_mismatch_allowed_mm")
    if isinstance(off, int | float) and isinstance(allowed, int | float):
        texts["encoder against drive"] = f"{1000 * off:+.0f} µm, up to {1000 * allowed:.0f} allowed"
    if isinstance(slip, int | float):
        texts["slip during the hold"] = f"at {slip:.1f} s" if slip >= 0 else "none seen"
    return texts


def specimen_texts(info: RunInfo) -> dict[str, str]:
    """Return what is known of the specimen, and how old it was when the run began."""
    minutes = minutes_since_excision(info)
    age = {} if minutes is None else {"since excision": f"{minutes:.0f} min"}
    return {**attribute_texts(info.header.specimen), **age}


def recording_texts(info: RunInfo) -> dict[str, str]:
    """Return when, by whom and with what a run was recorded."""
    header, entry = info.header, info.header.entry
    texts = {
        "Run": header.run_id,
        "Began": f"{header.start_time:{_TIME_FORMAT}}",
        "Ended": "" if info.end_time is None else f"{info.end_time:{_TIME_FORMAT}}",
        "Operator": str(entry.get("operator", "")),
        "Note": str(entry.get("note", "")),
        "Plan": str(entry.get("plan", "")),
        "Samples": f"{info.samples} at {GENERAL(header.sample_rate_hz)} Hz",
        "Channels": ", ".join(f"{channel.name} ({channel.units})" for channel in header.channels),
        "Software": str(entry.get("software", "")),
        "SHA-256 of the samples": info.raw_sha256,
    }
    return {name: value for name, value in texts.items() if value}


def further_attribute_texts(info: RunInfo) -> dict[str, str]:
    """Return what else the file's header holds."""
    shown, known = {"operator", "note", "plan", "software"}, ("command_t0_uncertainty_s", 0.0)
    entry = info.header.entry.items()
    return attribute_texts({key: value for key, value in entry if key not in shown and (key, value) != known})


def _attribute_label(name: str) -> str:
    ending = _unit_suffix(name)
    bare = name.removesuffix(ending)
    return _ATTRIBUTE_LABELS.get(bare, bare.replace("_", " "))


def _attribute_text(name: str, value: Attribute) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    if not isfinite(value):
        return "unknown"
    unit = UNIT_SUFFIXES.get(_unit_suffix(name), "")
    number = str(value) if isinstance(value, int) else GENERAL(value)
    if name == "shear_strain":
        return f"{GENERAL(100 * value)} %"
    return f"{number}{'' if unit == '°' else ' '}{unit}".rstrip()


def _unit_suffix(name: str) -> str:
    return next((suffix for suffix in UNIT_SUFFIXES if name.endswith(suffix) and name != suffix[1:]), "")


def run_document(run: Run, bad_reason: str | None = None) -> Document:
    """Lay out a run; `bad_reason` is why it was marked bad, None for one that was not."""
    info, header = run.info, run.info.header
    problem = run_problem(info, bad_reason)
    drawing = run_drawing(info, lambda: present.run_figure(run, bad_reason=bad_reason))
    measures = measure(run)
    return Document(
        title=run_title(info),
        answer=f"{run_title(info)}: {_main_force_text(measures)}.",
        source=info.path.name,
        badges=(header.backend,),
        problem=f"Not a good run: {problem}" if problem else "",
        sections=(
            Section("measures", "Measures", (drawing, measures_table(measures))),
            Section("checks", "Checked right after the run", (Facts(check_texts(info.checks)),)),
            Section("events", "Events", (_event_table(run.events),)),
            Section(
                "settings",
                "Settings",
                (
                    Section("recorded", "Recorded", (Facts(recording_texts(info)),)),
                    Section("protocol", f"Protocol: {info.kind}", (Facts(attribute_texts(header.protocol)),)),
                    Section("capsule", "Capsule", (Facts(attribute_texts(header.capsule)),)),
                    Section("specimen", "Specimen", (Facts(specimen_texts(info)),)),
                    Section("further", "Further", (Facts(further_attribute_texts(info)),)),
                    Section(
                        "all-settings",
                        "All settings of the session, as `dragrig run` takes them from this file",
                        (Code(header.settings_toml),),
                        collapsed=True,
                    ),
                ),
            ),
        ),
    )


def _main_force_text(measures: RunMeasures) -> str:
    """Return the steady force with its interval, above that at rest if that is known; else peak and hold."""
    steady, above_rest = measures.steady_force, measures.steady_above_rest
    if steady.value is not None:
        shown, zero = (steady, "as recorded") if above_rest.value is None else (above_rest, "above rest")
        interval = range_text(shown.interval, shown.standard_error)
        force = value_with_error(shown.value, shown.standard_error)
        return f"steady force {force} mN {zero}" + (f" (95 %: {interval} mN)" if interval else "")
    ends = {"peak": measures.peak_force, "at the end of the hold": measures.hold_force}
    known = [f"{name} {value_with_error(end.value, end.standard_error)} mN" for name, end in ends.items() if end.value]
    return f"no steady force; {', '.join(known)}" if known else f"no steady force, for {steady.reason}"


@dataclass(frozen=True, slots=True)
class InspectedFile:
    """A run file without its samples."""

    info: RunInfo
    bad_reason: str | None = None
    """Why the run is marked bad; None for one that is not."""
    note: str = ""
    """The note written on it since."""
    intact: bool | None = None
    """Whether the samples match their checksum; None where that was not tested."""


def files_document(files: Sequence[InspectedFile]) -> Document:
    """Lay out what run files contain: all of a single one, and a line for each of several."""
    data = [_file_json(file) for file in files]
    if len(files) == 1:
        name = str(files[0].info.path)
        return Document(title=name, sections=(Section("file", "", (Facts(_file_texts(files[0])),)),), data=data)
    shown = ("run", "start", "samples", "marked bad", "noted", "checksum")
    texts = [_file_texts(file) for file in files]
    known = [name for name in shown if any(text[name] for text in texts)]
    rows = tuple((str(file.info.path), *map(text.get, known)) for file, text in zip(files, texts, strict=True))
    table = Table("files", "", (Column("file", "file"), *(Column(name, name) for name in known)), rows)
    hint = Text(f"`dragrig info {files[0].info.path}` shows all of one.") if files else Text("")
    return Document(title=f"{len(files)} run files", sections=(Section("files", "", (table, hint)),), data=data)


def _file_texts(file: InspectedFile) -> dict[str, str]:
    info, header = file.info, file.info.header
    duration, size = duration_text(info.samples / header.sample_rate_hz), size_text(info.path.stat().st_size)
    reason = f" ({info.reason})" if info.reason else ""
    groups = {
        "protocol": attribute_texts(header.protocol),
        "capsule": attribute_texts(header.capsule),
        "specimen": specimen_texts(info),
        "checks": check_texts(info.checks),
        "further": further_attribute_texts(info),
    }
    return {
        "run": f"{info.kind}, {info.status.value}{reason}",
        "marked bad": file.bad_reason or "",
        "noted": file.note,
        "checksum": "" if file.intact is None else "matches" if file.intact else "missing, or the samples differ",
        "start": f"{header.start_time:{_TIME_FORMAT}}, order {header.order}, {header.backend}",
        "samples": f"{info.samples} at {GENERAL(header.sample_rate_hz)} Hz, {duration}, {size}",
        "channels": ", ".join(f"{channel.name} [{channel.units}]" for channel in header.channels),
        **{name: ", ".join(f"{key} {text}" for key, text in texts.items()) for name, texts in groups.items()},
    }


def _file_json(file: InspectedFile) -> dict[str, object]:
    info, header = file.info, file.info.header
    return {
        **attributes_json(
            info, "kind", "status", "reason", "end_time", "samples", "checks", "format_version", path="file"
        ),
        **attributes_json(file, "intact", bad_reason="bad"),
        "noted": file.note or None,
        **attributes_json(header, "run_id", "start_time", "order", "backend", "sample_rate_hz"),
        "duration_s": info.samples / header.sample_rate_hz,
        "channels": {channel.name: channel.units for channel in header.channels},
        **attributes_json(header, "entry", "protocol", "capsule", "specimen"),
    }


def run_drawing(info: RunInfo, drawing: "Callable[[], MatplotlibFigure] | str", name: str = "run") -> Figure:
    """Return the figure of a run: force over position and speed."""
    return Figure(
        name,
        f"{run_title(info)}: force, position and speed against time, with the phases of the motion.",
        "Force as recorded (light) and filtered, position beside its command, and speed; the phases of the motion are "
        "shaded. A dashed line is the steady force as recorded, its ± one standard error.",
        drawing,
    )


def measures_table(measures: RunMeasures) -> Table:
    """Tabulate the measures of a run with their standard errors, or why they are missing."""
    peak = "" if measures.peak_time_s is None else f"at {measures.peak_time_s:.3f} s"
    rows = (
        ("steady force", measures.steady_force, "mN", f"mean over {measures.steady_from}, as recorded"),
        ("steady − rest", measures.steady_above_rest, "mN", "the steady force, that at rest taken off"),
        ("force at rest", measures.rest_offset, "mN", "mean before the motion"),
        ("peak force", measures.peak_force, "mN", peak),
        ("force at the end of the hold", measures.hold_force, "mN", "mean"),
        ("speed", measures.speed, "mm/s", "slope of the position in the steady phase"),
    )
    return Table.of(
        "measures",
        "",
        rows,
        Field("quantity", "quantity", lambda row: row[0]),
        Field(
            "value",
            "value ± standard error",
            lambda row: FormattedNumber.with_error(row[1].value, row[1].standard_error),
        ),
        Field("interval_95", "95 % interval", lambda row: range_text(row[1].interval, row[1].standard_error)),
        Field("unit", "unit", lambda row: row[2]),
        Field("remark", "how", lambda row: row[1].reason or row[3]),
    )


def _event_table(events: tuple[RunEvent, ...]) -> Table:
    return Table.of(
        "events",
        "By the clock of the run",
        events,
        Field("time_s", "time, s", lambda event: event.time_s, decimals(3)),
        Field("kind", "event", lambda event: event.kind),
        Field("message", "message", lambda event: event.message),
    )
