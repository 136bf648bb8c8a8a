"""Identified relaxations: each run with its fit and what the fit leaves, and the elements against strain."""

import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis.identification.maxwell.residuals import RunResiduals, residuals
from dragrig.analysis.identification.noise import estimate_noise
from dragrig.analysis.identification.results import Relaxation, RelaxationFit
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.config.errors import AnalysisError
from dragrig.figures.envelope import envelope, gap_after
from dragrig.figures.header import headline
from dragrig.figures.panels import Place, add_panel, label_y, plain_log_x
from dragrig.figures.strain_laws import draw_laws
from dragrig.figures.style import BLACK, GREY, PALE, SMALL_PT, TEXT_PT, VERMILLION, drawing, new_figure

MOST_COLUMNS = 4
LEFT_IN, RIGHT_IN, WIDTH_IN, BETWEEN_IN = 1.15, 0.45, 15.0, 0.3
LAWS_IN, LAWS_FOOT_IN = 2.5, 0.85
RESIDUAL_IN, FORCE_IN, HEAD_IN = 1.6, 2.9, 1.55
LEAST_RESIDUAL = 4.0
RUNS_FOOT_IN = LAWS_FOOT_IN + LAWS_IN + 1.75


def relaxation_fit_figure(relaxation: Relaxation, selection: Selection) -> Figure:
    """Draw identified relaxations.

    Above, for up to four runs of different strain, the measured force, the fit and its whitened residuals against the
    time since the ramp began; below, the five elements against strain beside Table 1 and Eq. 14.

    Raises
    ------
    AnalysisError
        Where there is no relaxation run.
    """
    chosen = _few(relaxation)
    if not chosen:
        raise AnalysisError("There is no relaxation run to draw; name a campaign that has some")
    experiments = {one.file: one for one in selection.of_kind("relaxation")}
    noise = estimate_noise(experiments.values(), "force")
    with drawing():
        figure = new_figure(WIDTH_IN, RUNS_FOOT_IN + RESIDUAL_IN + 0.15 + FORCE_IN + HEAD_IN)
        headline(figure, LEFT_IN, f"Five elements from relaxation · {selection.specimen}", _subtitle(relaxation))
        width = (WIDTH_IN - LEFT_IN - RIGHT_IN - (MOST_COLUMNS - 1) * BETWEEN_IN) / MOST_COLUMNS
        forces: list[Axes] = []
        left_overs: list[Axes] = []
        drawn: list[RunResiduals] = []
        for column, fit in enumerate(chosen):
            left = LEFT_IN + column * (width + BETWEEN_IN)
            above = Place(left, RUNS_FOOT_IN + RESIDUAL_IN + 0.15, width, FORCE_IN)
            forces.append(add_panel(figure, above, share_y=forces[0] if forces else None))
            below = Place(left, RUNS_FOOT_IN, width, RESIDUAL_IN)
            left_overs.append(add_panel(figure, below, forces[-1], left_overs[0] if left_overs else None))
            found = residuals(fit, experiments[fit.file], noise) if fit.elements else None
            drawn += [found] if found else []
            _run(forces[-1], left_overs[-1], fit, experiments[fit.file], found)
        for axes in (*forces[1:], *left_overs[1:]):
            axes.tick_params(labelleft=False)
        label_y(forces[0], "Force (mN)")
        label_y(left_overs[0], "Residual (σ)")
        _scale(forces, left_overs[0], drawn)
        if not drawn:
            left_overs[0].set_yticks([])
        laws = Place(LEFT_IN, LAWS_FOOT_IN, WIDTH_IN - LEFT_IN - RIGHT_IN, LAWS_IN)
        draw_laws(figure, laws, relaxation.fits, relaxation.laws)
        return figure


def _few(relaxation: Relaxation) -> list[RelaxationFit]:
    """Return the fits to draw, one for each strain where there are enough, spread over the strains."""
    rising = sorted(relaxation.fits, key=lambda fit: (not fit.elements, fit.shear_strain))
    by_strain = {round(fit.shear_strain, 2): fit for fit in reversed(rising)}
    fits = sorted(by_strain.values(), key=lambda fit: fit.shear_strain)
    if len(fits) > MOST_COLUMNS:
        fits = [fits[round(place)] for place in np.linspace(0, len(fits) - 1, MOST_COLUMNS)]
    return fits


def _subtitle(relaxation: Relaxation) -> str:
    identified = sum(bool(fit.elements) for fit in relaxation.fits)
    total = len(relaxation.fits)
    runs = f"{total} run{'' if total == 1 else 's'}"
    told = runs if identified == total else f"{identified} of {runs} identified"
    if not identified:
        return f"{told}  ·  grey: measured"
    return f"{told}  ·  grey: measured  ·  orange: spring and two Maxwell branches, driven through the measured ramp"


def _run(force: Axes, left_over: Axes, fit: RelaxationFit, experiment: Experiment, found: RunResiduals | None) -> None:
    begin = found.ramp_s[0] if found else _first_motion(experiment)
    _measured(force, experiment, begin)
    title = f"{100 * fit.shear_strain:g} % strain"
    force.set_title(title, loc="left", fontsize=TEXT_PT, fontweight="bold", color=BLACK)
    force.tick_params(labelbottom=False)
    left_over.set_xlabel("Time since the ramp began (s)")
    if found is None:
        words = textwrap.fill(f"no numbers: {fit.remark}", 34)
        left_over.grid(visible=False)
        left_over.text(0.5, 0.5, words, transform=left_over.transAxes, ha="center", va="center", fontsize=SMALL_PT)
        return
    force.plot(found.time_s - begin, found.predicted_mN, color=VERMILLION, linewidth=1.8)
    force.text(0.97, 0.98, _times(fit), transform=force.transAxes, ha="right", va="top", fontsize=SMALL_PT)
    shown = found.middle_s > begin
    left_over.axhspan(-2, 2, color=PALE, alpha=0.35, linewidth=0, zorder=0)
    left_over.plot(found.middle_s[shown] - begin, found.whitened[shown], ".", color=BLACK, markersize=4)
    left_over.text(0.03, 0.97, _verdict(fit), transform=left_over.transAxes, va="top", fontsize=SMALL_PT, color=GREY)


def _measured(force: Axes, experiment: Experiment, begin_s: float) -> None:
    trace, time = experiment.run.trace, experiment.time_s
    after = np.flatnonzero(time > begin_s)
    since = time[after] - begin_s
    gap = gap_after(time, trace.sample_rate_hz)[after[:-1]]
    values = np.where(experiment.valid[after], np.asarray(trace.force, dtype=np.float64)[after], np.nan)
    log_time, value = envelope(np.log10(since), values, gap)
    plain_log_x(force, float(since[0]), float(since[-1]))
    force.plot(10**log_time, value, color=PALE, linewidth=5.0)


def _scale(forces: Sequence[Axes], left_over: Axes, found: Sequence[RunResiduals]) -> None:
    """Give all columns one range, with room for words along the upper edges."""
    low = min(axes.dataLim.ymin for axes in forces)
    high = max(axes.dataLim.ymax for axes in forces)
    forces[0].set_ylim(low - 0.04 * (high - low), high + 0.16 * (high - low))
    largest = max((float(np.abs(one.whitened).max()) for one in found), default=0.0)
    furthest = max(LEAST_RESIDUAL, 1.05 * largest)
    left_over.set_ylim(-furthest, 1.45 * furthest)


def _first_motion(experiment: Experiment) -> float:
    moving = np.flatnonzero(experiment.motion.signs)
    return float(experiment.motion.breaks_s[moving[0]]) if moving.size else 0.0


def _times(fit: RelaxationFit) -> str:
    fast, slow = (f"{1e3 * one.value:.3g} ms" if one.value < 0.1 else f"{one.value:.3g} s" for one in fit.times)
    return f"τ₁ {fast}\nτ₂ {slow}"


def _verdict(fit: RelaxationFit) -> str:
    per_degree = (fit.chi2 or 0.0) / max(fit.degrees, 1)
    told = f"χ²/ν {per_degree:.3g}" if per_degree < 1000 else f"χ²/ν {per_degree:.0f}"
    if fit.test is None or fit.test.suffices is None:
        return told
    return f"{told} · five suffice" if fit.test.suffices else f"{told} · a third branch shows"
