"""Two campaigns, two runs, or a campaign and the friction model, side by side; and its files for a person."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from dragrig.analysis.comparison.compare import compare_sides
from dragrig.analysis.comparison.frame import as_frame
from dragrig.analysis.comparison.results import Comparison, Side
from dragrig.analysis.comparison.sources import side_of, side_of_model, side_of_runs
from dragrig.analysis.progress import Progress, silent
from dragrig.config.effects import EffectSettings
from dragrig.config.errors import AnalysisError, OutputError
from dragrig.config.library import find
from dragrig.config.model import FrictionModelSettings
from dragrig.inputs import run_files
from dragrig.rig.runfile.model import Run
from dragrig.rigs import with_effects

Comparable = str | Path | Run | Iterable[Run]
"""A campaign's folder, a run file, a run in memory, or several."""
TABLE, OVERVIEW = "comparison.csv", "overview.png"


def compare(
    a: Comparable,
    b: Comparable | None = None,
    *,
    model: str | Path | FrictionModelSettings | None = None,
    effects: Sequence[str | EffectSettings] = (),
    specimen: str | None = None,
    progress: Progress = silent,
) -> Comparison:
    """Compare two campaigns, two runs, or either with the friction model: the plain look before a diagnosis.

    Runs are paired by what was done in them (kind, speed, strain, way, capsule, fixture), repeats in order. Runs that
    are marked bad or did not end as planned are left out, unless the file itself is named.

    Parameters
    ----------
    a, b
        A campaign's folder, a run file, or runs in memory; all differences are B − A.
    model
        In place of `b`, a friction model: every run of `a` is simulated again on its own recorded motion, noise-free.
    effects
        What the model has beside its own, each as `stribeck:ratio=0.4,speed_mm_s=2`.
    specimen
        Name or id of the specimen that is meant, on each side that holds several; all of them unless given.

    Returns
    -------
    `pairs` with their measures, traces and phases; `groups`, the largest differences first; runs without a partner
    and why; `sentences` for a person.

    Raises
    ------
    AnalysisError
        When no run of one has a partner in the other.
    RunFileError, SettingsError
        When a file, a folder or the model cannot be read.

    Examples
    --------
    >>> import dragrig
    >>> slow, fast = (dragrig.simulate("drag", assignments=[f"model.mucus_scale={k}", "way_back=stay"]) for k in (1, 3))
    >>> found = dragrig.compare(slow, fast)
    >>> found.groups[0].measure, found.groups[0].verdict.value
    ('steady force', 'differs')
    """
    if model is None and effects:
        raise AnalysisError("Effects belong to a model; name the model too.")
    if (b is None) == (model is None):
        raise AnalysisError("A comparison takes a second campaign or a model; give one of the two.")
    first = _side(a, specimen, "A")
    if b is not None:
        return compare_sides(first, _side(b, specimen, "B"), progress)
    if isinstance(model, FrictionModelSettings):
        settings, name = model, model.name
    else:
        settings, name = find(FrictionModelSettings, "model", str(model)), Path(str(model)).stem
    return compare_sides(first, side_of_model(first, with_effects(settings, effects), name), progress)


def write(
    comparison: Comparison, folder: Path, *, overwrite: bool = False, progress: Progress = silent
) -> Iterator[Path]:
    """Write the table as CSV, the overview, and a picture of each pair whose traces can be laid over each other.

    Yields
    ------
    Each file as it is written; a name that is taken gets a number unless `overwrite`.

    Raises
    ------
    OutputError
        When the folder refuses.
    RunFileError
        When a run cannot be read any more.
    """
    from dragrig.figures import comparison_figure, comparison_overview, save_in

    drawable = [pair for pair in comparison.pairs if pair.phases]
    total = len(drawable) + 1
    progress(0, total)
    yield save_in(folder, OVERVIEW, comparison_overview(comparison), overwrite)
    yield _save_table(comparison, folder, overwrite=overwrite)
    names = comparison.a.name, comparison.b.name
    for done, pair in enumerate(drawable, start=1):
        progress(done, total)
        yield save_in(folder, f"{Path(pair.a.file).stem}.png", comparison_figure(pair, names), overwrite)
    progress(total, total)


def folder_for(comparison: Comparison, a: str | Path) -> Path:
    """Return a new folder's name for a comparison: beside the runs of A."""
    beside = Path(a) if Path(a).is_dir() else Path(a).parent
    other = comparison.b.name.removesuffix(".h5").replace(" ", "-")
    return beside / f"compared-with-{other}"


def _side(given: Comparable, specimen: str | None, name: str) -> Side:
    if isinstance(given, Run):
        return side_of_runs([given], name)
    if not isinstance(given, str | Path):
        return side_of_runs(given, name)
    run_files([given])
    return side_of(Path(given), specimen)


def _save_table(comparison: Comparison, folder: Path, *, overwrite: bool) -> Path:
    path = folder / TABLE
    number = 1
    while path.exists() and not overwrite:
        number += 1
        path = folder / f"{Path(TABLE).stem}-{number}{Path(TABLE).suffix}"
    text = as_frame(comparison).to_csv(index=False, lineterminator="\n")
    try:
        path.write_text(text, "utf-8", newline="\n")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose a folder that can.") from error
    return path
