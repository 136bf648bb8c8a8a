"""Compare two campaigns, two runs, or measured runs with the friction model; write table and pictures."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from dragrig.analysis.comparison.compare import compare_sides
from dragrig.analysis.comparison.comparison import ComparedSide, Comparison, comparison_frame
from dragrig.analysis.comparison.sides import model_side, side_from_path, side_from_runs
from dragrig.analysis.computation import Progress, no_progress
from dragrig.config.errors import AnalysisError
from dragrig.config.friction_model import EffectSettings, FrictionModelSettings
from dragrig.present.files import unused_path, write_text
from dragrig.rig.runfile.model import Run
from dragrig.run_inputs import run_files
from dragrig.setup import friction_model, with_effects

Comparable = str | Path | Run | Iterable[Run]
"""A campaign's folder, a run file, a run in memory, or several."""
COMPARISON_TABLE, COMPARISON_OVERVIEW = "comparison.csv", "overview.png"


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
        When no run has a partner.
    RunFileError, SettingsError
        When a file, a folder or the model cannot be read.

    Examples
    --------
    >>> import dragrig
    >>> slow, fast = (dragrig.simulate("drag", assignments=[f"model.mucus_scale={k}", "way_back=stay"]) for k in (1, 3))
    >>> comparison = dragrig.compare(slow, fast)
    >>> comparison.groups[0].measure, comparison.groups[0].verdict.value
    ('steady force', 'differs')
    """
    if model is None and effects:
        raise AnalysisError("Effects belong to a model; name the model too.")
    if (b is None) == (model is None):
        raise AnalysisError("A comparison takes a second campaign or a model; give one of the two.")
    first = _comparison_side(a, specimen, "A")
    if b is not None:
        return compare_sides(first, _comparison_side(b, specimen, "B"), progress)
    name = model.name if isinstance(model, FrictionModelSettings) else Path(str(model)).stem
    settings = with_effects(friction_model(model or name), effects)
    return compare_sides(first, model_side(first, settings, name), progress)


def write_comparison(
    comparison: Comparison, folder: Path, *, overwrite: bool = False, progress: Progress = no_progress
) -> Iterator[Path]:
    """Write the table as CSV, the overview, and a picture of each pair with overlapping traces.

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
    from dragrig.present.campaign_figures import comparison_figure, comparison_overview_figure
    from dragrig.present.files import save_figure_in

    drawable = [pair for pair in comparison.pairs if pair.phases]
    total = len(drawable) + 1
    progress(0, total)
    yield save_figure_in(folder, COMPARISON_OVERVIEW, comparison_overview_figure(comparison), overwrite)
    table = folder / COMPARISON_TABLE
    if not overwrite:
        table = unused_path(table, table.suffix)
    yield write_text(comparison_frame(comparison).to_csv(index=False, lineterminator="\n"), table, overwrite=overwrite)
    names = comparison.a.name, comparison.b.name
    for done, pair in enumerate(drawable, start=1):
        progress(done, total)
        yield save_figure_in(folder, f"{Path(pair.a.file).stem}.png", comparison_figure(pair, names), overwrite)
    progress(total, total)


def comparison_folder(comparison: Comparison, a: str | Path) -> Path:
    """Return the default folder of a comparison, beside the runs of A."""
    beside = Path(a) if Path(a).is_dir() else Path(a).parent
    b_name = comparison.b.name.removesuffix(".h5").replace(" ", "-")
    return beside / f"compared-with-{b_name}"


def _comparison_side(runs: Comparable, specimen: str | None, name: str) -> ComparedSide:
    if isinstance(runs, Run):
        return side_from_runs([runs], name)
    if not isinstance(runs, str | Path):
        return side_from_runs(runs, name)
    run_files([runs])
    return side_from_path(Path(runs), specimen)
