"""Load, filter, tabulate, compare, export and import runs, and tabulate the friction model's predictions."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, time
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

from dragrig import analysis, present
from dragrig.analysis import (
    ColumnMap,
    ComparedSide,
    Comparison,
    CsvStyle,
    ExportFormat,
    ImportedRun,
    ImportSettings,
    Progress,
    SavgolSettings,
    as_frame,
    compare_sides,
    comparison_frame,
    default_filter_settings,
    export_campaign,
    export_run,
    filter_file,
    filter_run,
    import_file,
    model_side,
    no_progress,
    parse_map,
    pooled_rows,
    side_from_path,
    side_from_runs,
    table_row,
    write_export,
)
from dragrig.catalogue import ask_runs
from dragrig.config import (
    AnalysisError,
    Capsule,
    EffectSettings,
    FrictionModelSettings,
    RunFileError,
    SettingsError,
    Specimen,
    Table,
    data_root_of,
    find_settings,
    merge_tables,
    parse,
    read_toml,
    refuse_unknown,
)
from dragrig.present import unused_path, write_text
from dragrig.rig import Campaign, Run, mark_bad, read_campaign, read_info, read_mark, read_run, unmark, write_note
from dragrig.run_inputs import require_run_files, run_files
from dragrig.run_listing import RunListing, RunQuery
from dragrig.setup import friction_model, resolve_rig, with_effects

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

AnswerT = TypeVar("AnswerT")
ExportFormatName = Literal["csv", "parquet", "mat", "npz", "tdms", "eln"]


def load(path: str | Path) -> Run:
    """Read a run file whole.

    Raises
    ------
    RunFileError
        When it is missing, a folder, foreign, damaged, or of a newer format.

    Examples
    --------
    >>> import dragrig
    >>> run = dragrig.load("20260504-091500-drag-000.h5")  # doctest: +SKIP
    >>> run.trace.force.mean(), run.info.header.protocol["speed_mm_s"]  # doctest: +SKIP
    """
    if Path(path).is_dir():
        raise RunFileError(f"{path}: is a folder; dragrig.campaign(…) reads its runs, dragrig.table(…) measures them.")
    return read_run(Path(path))


def campaign(folder: str | Path) -> Campaign:
    """Read the attributes of every run file of a folder; `campaign(folder).good` leaves out those marked bad.

    Raises
    ------
    RunFileError
        When there is no such folder, or it holds no runs.
    """
    found = read_campaign(Path(folder))
    if not (found.runs or found.unreadable or found.recordings):
        require_run_files(found.folder)
    return found


def ask_lab(
    folder: Path | None,
    question: Callable[[RunListing], AnswerT],
    *,
    remark: Callable[[str], None] = print,
    progress: Progress = no_progress,
    rebuild: bool = False,
) -> AnswerT:
    """Answer a question about the runs of a folder that holds some, by default the lab's data root.

    The arguments and errors are those of `ask_runs`; a folder without runs is a `RunFileError` too.
    """
    root = folder or data_root_of(Path.cwd()) or resolve_rig().data_root

    def answer(listing: RunListing) -> AnswerT:
        if not listing.folders():
            raise RunFileError(f"{root}: holds no campaign; name the folder that does.")
        return question(listing)

    return ask_runs(root, answer, remark=remark, progress=progress, rebuild=rebuild)


def find(
    folder: str | Path | None = None,
    *,
    specimen: str = "",
    kind: str = "",
    operator: str = "",
    since: str | datetime = "",
    until: str | datetime = "",
    bad: bool | None = None,
) -> tuple[Path, ...]:
    """Find runs in all campaigns in a folder and below it.

    Parameters
    ----------
    folder
        By default the lab's data root.
    specimen, kind, operator
        Name or id; kind of run, or `sentinel`; part of the name.
    since, until
        Begun at this time or later, and earlier: a moment, or `2026-05-04`, a day with all of its hours.
    bad
        Whether they are marked bad (default: either).

    Returns
    -------
    The run files, which `load`, `table` and `mark` take.

    Raises
    ------
    RunFileError
        When there is no such folder, or it holds no campaign.
    SettingsError
        For a time that is none.

    Examples
    --------
    >>> import dragrig
    >>> [dragrig.load(file) for file in dragrig.find(specimen="P7", kind="drag")]  # doctest: +SKIP
    """
    query = run_query(specimen, kind, operator, since, until, bad)
    found = ask_lab(None if folder is None else Path(folder), lambda listing: listing.found(query))
    return tuple(parent / name for parent, names in found.items() for name in names)


def run_query(
    specimen: str, kind: str, operator: str, since: str | datetime, until: str | datetime, bad: bool | None
) -> RunQuery:
    """Return a query of times as typed, of which a day holds all of its hours; raises `SettingsError`."""
    return RunQuery(specimen, kind, operator, _moment(since, time.min), _moment(until, time.max), bad)


def _moment(text: str | datetime, of_day: time) -> datetime | None:
    """Return a moment with its offset, of a date alone the given time; None for an empty text."""
    if not text:
        return None
    try:
        moment = text if isinstance(text, datetime) else datetime.fromisoformat(text)
        if isinstance(text, str) and len(text) <= len("2026-05-04"):
            moment = datetime.combine(moment, of_day)
        return moment if moment.tzinfo is not None else moment.astimezone()
    except (ValueError, OverflowError, OSError):  # also of a year for which the local offset is not known
        raise SettingsError(f"{text} is no date; write it as 2026-05-04 or 2026-05-04T09:15.") from None


def mark(
    runs: str | Path | Iterable[str | Path], *, bad: str | None = None, good: bool = False, note: str | None = None
) -> tuple[Path, ...]:
    """Mark runs as bad, remove the mark, or write a note on them, all beside their files.

    Parameters
    ----------
    runs
        Run files, patterns and campaigns' folders.
    bad
        Why the runs must not be used.
    good
        Whether the mark is removed.
    note
        In place of an earlier one; an empty one removes it.

    Returns
    -------
    The run files.

    Raises
    ------
    RunFileError
        When one of them is no run; none is marked then.
    SettingsError, OutputError
        When nothing is said of the runs, or both good and bad; when the folder refuses.

    Examples
    --------
    >>> import dragrig
    >>> dragrig.mark("runs/first/*-drag-003.h5", bad="capsule turned")  # doctest: +SKIP
    """
    if (good and bad is not None) or not (good or bad is not None or note is not None):
        raise SettingsError("runs are marked either bad, with a reason, or good, or get a note; say which.")
    paths = run_files([runs] if isinstance(runs, str | Path) else tuple(runs))
    for path in paths:
        read_info(path)  # nothing is marked unless all files are runs
    for path in paths:
        if bad is not None:
            mark_bad(path, bad)
        elif good:
            unmark(path)
        if note is not None:
            write_note(path, note)
    return paths


def show(run: str | Path, *, filtered: bool = True, motor_force: bool = False) -> "Figure":
    """Draw a run file, or for a campaign's folder an overview of its runs.

    Parameters
    ----------
    filtered, motor_force
        As of `Run.plot`.

    Raises
    ------
    RunFileError
        When there is no run to draw, or it cannot be read.

    Examples
    --------
    >>> import dragrig
    >>> dragrig.show("runs/first").savefig("first.pdf")  # doctest: +SKIP
    """
    path = Path(run)
    if path.is_dir():
        paths = run_files([path])
        marked = [each for each in paths if read_mark(each) is not None]
        return present.campaign_figure((read_run(each) for each in paths), path.resolve().name, marked)
    mark = read_mark(path)
    reason = None if mark is None else mark.reason
    return present.run_figure(read_run(path), filtered=filtered, motor_force=motor_force, bad_reason=reason)


def filter_settings(
    sample_rate_hz: float, window_s: float | None, window_samples: int | None, order: int | None, derivative: int
) -> SavgolSettings:
    """Return a filter's settings, with the default window and order at this rate.

    Raises
    ------
    AnalysisError
        When they contradict each other.
    """
    default = default_filter_settings(sample_rate_hz)
    if window_s is None and window_samples is None:
        window_s, window_samples = default.window_s, default.window_samples
    return SavgolSettings(window_s, window_samples, default.order if order is None else order, derivative)


def filter(  # noqa: A001  # the word that people look for
    run: Run | str | Path,
    *,
    window_s: float | None = None,
    window_samples: int | None = None,
    order: int | None = None,
    derivative: int = 0,
) -> Run:
    """Smooth every force of a run with a Savitzky–Golay filter, and compute the speed from its position.

    Parameters
    ----------
    run
        A run in memory, which is not changed; or a run file, in which the result is stored beside the raw trace.
    window_s, window_samples
        Length of the window, one of the two (default: 0.05 s).
    order
        Order of the polynomial (default: 3).
    derivative
        0 smooths the forces, k gives their k-th time derivative.

    Returns
    -------
    The run with its `filtered` trace: `filtered.channels["force"]`, `["speed"]`, …, shape `(N,)` each.

    Raises
    ------
    AnalysisError
        When the window does not suit the order, the rate or the run.
    RunFileError, OutputError
        When the file cannot be read or replaced.

    Examples
    --------
    >>> import dragrig
    >>> drag, back = dragrig.simulate("drag")
    >>> smooth = dragrig.filter(drag, window_s=0.1).filtered.channels["force"]
    """
    if isinstance(run, Run):
        settings = filter_settings(run.trace.sample_rate_hz, window_s, window_samples, order, derivative)
        return replace(run, filtered=filter_run(run, settings).trace)
    path = Path(run)
    rate = read_info(path).header.sample_rate_hz
    filter_file(path, filter_settings(rate, window_s, window_samples, order, derivative))
    return read_run(path)


def table(runs: str | Path | Iterable[Run] | Iterable[str | Path]) -> "pd.DataFrame":
    """Tabulate a campaign, one row per run: kind, speed, steady force and its standard error, checks, ….

    `steady_force_mN` is as recorded, `steady_above_rest_mN` with the force at rest taken off; `…_error_mN` are standard
    errors.

    Parameters
    ----------
    runs
        A campaign's folder, the folders of several, or runs in memory.

    Raises
    ------
    RunFileError
        When there is no such folder, or it holds no runs.

    Examples
    --------
    >>> import dragrig
    >>> frame = dragrig.table(dragrig.simulate("drag"))
    >>> frame[["kind", "speed_mm_s", "steady_force_mN", "steady_force_error_mN"]]  # doctest: +SKIP
    """
    given = (runs,) if isinstance(runs, str | Path) else tuple(runs)
    in_memory = tuple(table_row(run) for run in given if isinstance(run, Run))
    folders = tuple(Path(folder) for folder in given if not isinstance(folder, Run))
    measured = pooled_rows(folders) if folders else ()
    if folders and not measured:
        require_run_files(folders[0])
    return as_frame((*in_memory, *measured))


def export(
    run: Run | str | Path,
    to: str | Path,
    *,
    format: ExportFormatName = "csv",  # noqa: A002  # as on the command line
    decimal: str = ".",
    delimiter: str = "",
    licence: str = "",
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write runs for other programs; as `eln`, a campaign as one archive for electronic laboratory notebooks.

    Parameters
    ----------
    run
        A run in memory, a run file, or a campaign's folder (runs marked bad are left out, or marked in an archive).
    to
        A file, or a folder; for the runs of a campaign a folder.
    decimal, delimiter
        Of CSV: `.` or `,`; default delimiter: comma, or semicolon with decimal commas.
    licence
        Of an archive: name or web address of the licence of its data.

    Returns
    -------
    The files written.

    Raises
    ------
    OutputError
        When a file exists, or the folder cannot be written.
    RunFileError, AnalysisError
        When the run cannot be read, or decimal mark and delimiter are the same.

    Examples
    --------
    >>> import dragrig
    >>> dragrig.export("runs/first", "csv", decimal=",", delimiter=";")  # doctest: +SKIP
    """
    if format == "eln":
        from dragrig.api.eln import write_eln

        if isinstance(run, Run):
            raise RunFileError(f"{run!r}: an archive holds a whole campaign; give its folder.")
        return (write_eln(Path(run), Path(to), licence, overwrite=overwrite),)
    kind, style = ExportFormat(format), CsvStyle(decimal, delimiter)
    if isinstance(run, Run):
        return (write_export(run, Path(to), kind, style, overwrite=overwrite),)
    if Path(run).is_dir():
        return export_campaign(Path(run), Path(to), kind, style, overwrite=overwrite)
    return (export_run(Path(run), Path(to), kind, style, overwrite=overwrite),)


def model(
    speeds_mm_s: Sequence[float] = (0.5, 1, 2, 5, 10, 15, 20, 30, 40, 50, 60),
    *,
    model: str | Path | FrictionModelSettings = "paper",
    effects: Sequence[str | EffectSettings] = (),
    capsule: str | Path = "drag",
    specimen: str | Path = "jejunum",
) -> "pd.DataFrame":
    """Tabulate the steady sliding forces that the friction model predicts.

    Parameters
    ----------
    effects
        Effects added to those of the model, each as `stribeck:ratio=0.4,speed_mm_s=2`.

    Returns
    -------
    Columns speed_mm_s, f_e_mN (environmental resistance), f_v_mN (viscous), f_c_mN (Coulomb), total_mN; with effects
    also effects_mN, the force they add on the last half of a drag of 40 mm.

    Raises
    ------
    SettingsError
        For a speed that is not positive, or unknown names.

    Examples
    --------
    >>> import dragrig
    >>> dragrig.model([1, 10]).round(1)  # doctest: +SKIP
    """
    import pandas as pd

    from dragrig.sim_backend.friction import steady_forces

    settings = with_effects(friction_model(model), effects)
    body = find_settings(Capsule, "capsule", str(capsule))
    thickness = find_settings(Specimen, "specimen", str(specimen)).wall_thickness_mm
    forces = steady_forces(speeds_mm_s, settings, body, thickness)
    frame = pd.DataFrame(
        {
            "speed_mm_s": forces.speed_mm_s,
            "f_e_mN": forces.f_e,
            "f_v_mN": forces.f_v,
            "f_c_mN": forces.f_c,
            "total_mN": forces.total,
        }
    )
    if settings.effects:
        from dragrig.sim_backend.devices import steady_effect_forces

        frame.insert(4, "effects_mN", steady_effect_forces(forces.speed_mm_s, settings, body, thickness))
        frame["total_mN"] += frame["effects_mN"]
    return frame


def import_settings(
    assignments: Sequence[str], values: Mapping[str, object], file: str | Path | None = None
) -> ImportSettings:
    """Return the settings of an import.

    Parameters
    ----------
    assignments
        Column and unit of each quantity, as `force=Load:N`.
    values
        Further keys of `ImportSettings`, as `decimal` or `sample_rate_hz`.
    file
        TOML file with the same keys, which the other arguments override.

    Raises
    ------
    SettingsError, ImportDataError
        For a key, a value or an assignment that is not allowed.
    """
    base: Table = read_toml(Path(file)) if file is not None else {}
    columns: ColumnMap = parse_map(assignments)
    changes: Table = {**values, "columns": columns.model_dump(exclude_none=True, exclude_unset=True)}
    return parse(ImportSettings, merge_tables(base, changes), str(file) if file is not None else "import")


def next_run_order(folder: Path) -> int:
    """Return the order of the next run of a folder."""
    return read_campaign(folder).next_order


def import_run(
    path: str | Path,
    to: str | Path,
    columns: Mapping[str, str] | None = None,
    *,
    settings: str | Path | None = None,
    **options: object,
) -> ImportedRun:
    """Convert a foreign measurement (CSV and other text, MAT, Parquet, TDMS, NPZ) into a run file.

    Parameters
    ----------
    to
        The run file to write, or a folder in which it gets its default name.
    columns
        Column and unit of each quantity: `{"time": "t:s", "force": "Load:N"}`; an export of this software needs none.
    settings
        TOML file with the same keys, for recurring measurements.
    options
        Further settings: `decimal`, `delimiter`, `encoding`, `sample_rate_hz`, `resample_hz`, `kind`, …. In a
        folder, `order` continues that of its runs.

    Raises
    ------
    ImportDataError
        When the file does not suit the settings.
    OutputError
        When the target exists or cannot be written.
    SettingsError
        For a value that is not allowed.
    TypeError
        For a setting that is none.

    Examples
    --------
    >>> import dragrig
    >>> dragrig.import_run("old.csv", "runs", {"time": "1:s", "force": "Load:N"}, decimal=",")  # doctest: +SKIP
    """
    target = Path(to)
    return import_file(Path(path), target, _import_settings_of(target, columns, settings, options))


def import_runs(
    path: str | Path,
    folder: str | Path,
    columns: Mapping[str, str] | None = None,
    *,
    settings: str | Path | None = None,
    **options: object,
) -> tuple[ImportedRun, ...]:
    """Convert a foreign measurement of several recordings into a run file for each: sheets, groups, trials, cycles.

    Parameters and errors are those of `import_run`.
    """
    target = Path(folder)
    return analysis.import_runs(Path(path), target, _import_settings_of(target, columns, settings, options))


def _import_settings_of(
    target: Path, columns: Mapping[str, str] | None, settings: str | Path | None, options: dict[str, object]
) -> ImportSettings:
    refuse_unknown(options, ImportSettings.model_fields.keys() - {"columns"})
    if target.is_dir():
        options.setdefault("order", next_run_order(target))
    return import_settings([f"{name}={source}" for name, source in (columns or {}).items()], options, settings)


Comparable = str | Path | Run | Iterable[Run]
"""A campaign's folder, a run file, a run in memory, or several."""


def _no_formula(cell: object) -> object:
    """Have a spreadsheet show a formula as text: names of files may begin with an equals sign."""
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(("=", "+", "-", "@")) else cell


COMPARISON_TABLE = "comparison.csv"


def compare(
    a: Comparable,
    b: Comparable | None = None,
    *,
    model: str | Path | FrictionModelSettings | None = None,
    effects: Sequence[str | EffectSettings] = (),
    specimen: str | None = None,
    progress: Progress = no_progress,
) -> Comparison:
    """Compare two campaigns, two runs, or either with the friction model, run by run.

    Runs are paired by their conditions (kind, speed, strain, direction, capsule, fixture), repeats in order. Runs that
    are marked bad or did not end as planned are left out, unless the file itself is named.

    Parameters
    ----------
    a, b
        A campaign's folder, a run file, or runs in memory; all differences are B − A.
    model
        In place of `b`, a friction model: every run of `a` is simulated again on its own recorded motion, noise-free.
    effects
        Effects added to those of the model, each as `stribeck:ratio=0.4,speed_mm_s=2`.
    specimen
        Name or id of the specimen, on each side that holds several (default: all).

    Returns
    -------
    `pairs` with their measures, traces and phases; `groups`, the largest differences first; runs without a partner with
    the reason; `sentences` that summarise.

    Raises
    ------
    AnalysisError
        When no run has a partner, or both are the same campaign or run.
    RunFileError, SettingsError
        When a file, a folder or the model cannot be read.

    Examples
    --------
    >>> import dragrig
    >>> slow, fast = (dragrig.simulate("drag", assignments=[f"model.mucus_scale={k}", "way_back=stay"]) for k in (1, 9))
    >>> comparison = dragrig.compare(slow, fast)
    >>> comparison.groups[0].measure, comparison.groups[0].verdict.value
    ('steady force', 'differs')
    """
    if model is None and effects:
        raise AnalysisError("Effects belong to a model; name the model too.")
    if (b is None) == (model is None):
        raise AnalysisError("A comparison takes either a second campaign or a model.")
    if isinstance(a, str | Path) and isinstance(b, str | Path) and Path(a).resolve() == Path(b).resolve():
        raise AnalysisError(f"{a} and {b}: are the same; name another campaign or run to compare with.")
    first = _comparison_side(a, specimen, "A")
    if b is not None:
        return compare_sides(first, _comparison_side(b, specimen, "B"), progress)
    name = model.name if isinstance(model, FrictionModelSettings) else Path(str(model)).stem
    settings = with_effects(friction_model(model or name), effects)
    return compare_sides(first, model_side(first, settings, name), progress)


def write_comparison(
    comparison: Comparison, folder: Path, *, overwrite: bool = False, progress: Progress = no_progress
) -> Iterator[Path]:
    """Write the table as CSV, the figures of its page, and a picture of each pair with overlapping traces.

    Yields
    ------
    Each file as it is written; an existing name gets a number unless `overwrite`.

    Raises
    ------
    OutputError
        When the folder cannot be written.
    RunFileError
        When a run cannot be read.
    """
    from dragrig.present import make_folder, save_figure_in, save_figures

    drawable = [pair for pair in comparison.pairs if pair.phases]
    total = len(drawable) + 1
    progress(0, total)
    make_folder(folder)
    yield from save_figures(present.comparison_document(comparison), folder, overwrite=overwrite)
    table = folder / COMPARISON_TABLE
    if not overwrite:
        table = unused_path(table, table.suffix)
    frame = comparison_frame(comparison).map(_no_formula)
    yield write_text(frame.to_csv(index=False, lineterminator="\n"), table, overwrite=overwrite)
    names = comparison.a.name, comparison.b.name
    for done, pair in enumerate(drawable, start=1):
        progress(done, total)
        yield save_figure_in(folder, f"{Path(pair.a.file).stem}", present.comparison_figure(pair, names), overwrite)
    progress(total, total)


def _comparison_side(runs: Comparable, specimen: str | None, name: str) -> ComparedSide:
    if isinstance(runs, Run):
        return side_from_runs([runs], name)
    if not isinstance(runs, str | Path):
        return side_from_runs(runs, name)
    run_files([runs])
    return side_from_path(Path(runs), specimen)
