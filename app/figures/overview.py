"""The picture of a whole comparison: steady force against speed of both sides, and by what they differ."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis.comparison.measured import Verdict
from dragrig.analysis.comparison.results import Comparison, GroupDifference, Pair
from dragrig.analysis.estimates import NORMAL_95
from dragrig.figures.campaign import LOOKS
from dragrig.figures.columns import FOOT_IN, LEFT_IN, RIGHT_IN
from dragrig.figures.header import fitting, header_in, headline, write_badge, write_trouble
from dragrig.figures.labels import EndLabel, label_ends
from dragrig.figures.panels import Place, add_panel, fit_y, height_in, label_y, plain_log_x, width_in
from dragrig.figures.style import BLUE, GREY, PURPLE, SMALL_PT, TEXT_PT, VERMILLION, drawing, new_figure, text_width_in

WIDTH_IN, TALL_IN = 14.0, 7.0
HEADING_IN = 0.5
LABELS_IN = 1.3
SIDES = (BLUE, VERMILLION)
SHIFT = 1.02
"""B's points stand this factor beside A's on the speed axis, so that neither hides the other."""
MEASURES = {"peak": ("v", PURPLE, -1.5), "hold": ("D", BLUE, 1.5)}
"""Marker, colour and place beside the strain [%]."""


def comparison_overview(comparison: Comparison) -> Figure:
    """Draw steady force against speed of both sides with its errors, and B − A by kind, speed and strain.

    Bars hold 95 %: of noise in the left panel, of noise and run-to-run scatter in the others.
    """
    with drawing():
        trouble = _trouble(comparison)
        figure = new_figure(WIDTH_IN, header_in(trouble) + HEADING_IN + TALL_IN + FOOT_IN)
        title = fitting(f"A: {comparison.a.name}  ·  B: {comparison.b.name}", 1.6 * TEXT_PT, WIDTH_IN - LEFT_IN - 2.5)
        headline(figure, LEFT_IN, title, fitting(_subtitle(comparison), SMALL_PT, WIDTH_IN - LEFT_IN - RIGHT_IN))
        write_trouble(figure, LEFT_IN, trouble)
        write_badge(figure, _backends(comparison))
        drawn = [draw for draw, has in _PANELS if has(comparison)]
        for draw, place in zip(drawn, _places(len(drawn)), strict=True):
            draw(add_panel(figure, place), comparison)
        if not drawn:
            figure.text(0.5, 0.45, "no steady, peak or hold force to be compared", ha="center", color=GREY)
        return figure


def _places(count: int) -> tuple[Place, ...]:
    room = WIDTH_IN - LEFT_IN - RIGHT_IN - LABELS_IN
    half = (room - LABELS_IN - LEFT_IN) / 2
    right = LEFT_IN + half + LABELS_IN + LEFT_IN
    low = (TALL_IN - FOOT_IN - HEADING_IN) / 2
    if count <= 1:
        return (Place(LEFT_IN, FOOT_IN, room, TALL_IN),)[:count]
    left = Place(LEFT_IN, FOOT_IN, half, TALL_IN)
    if count == 2:
        return left, Place(right, FOOT_IN, half, TALL_IN)
    return left, Place(right, FOOT_IN + TALL_IN - low, half, low), Place(right, FOOT_IN, half, low)


def _sliding(comparison: Comparison) -> list[Pair]:
    """Pairs with a steady force of both at a known speed, of the kinds that have a look of their own."""
    return [
        pair
        for pair in comparison.pairs
        if pair.condition.kind in LOOKS
        and pair.condition.speed_mm_s
        and any(None not in one.compared for one in pair.main)
    ]


def _steady(axes: Axes, comparison: Comparison) -> None:
    labels: list[EndLabel] = []
    shown = [np.zeros(1)]
    pairs = _sliding(comparison)
    for kind, (_, marker) in LOOKS.items():
        mine = [pair for pair in pairs if pair.condition.kind == kind]
        for side, colour in enumerate(SIDES):
            speed = np.array([pair.condition.speed_mm_s for pair in mine], dtype=float)
            force = np.array([pair.main[0].compared[side] for pair in mine], dtype=float)
            errors = [(pair.main[0].a, pair.main[0].b)[side].standard_error or 0.0 for pair in mine]
            half = NORMAL_95 * np.array(errors, dtype=float)
            if not mine:
                continue
            levels = np.unique(speed)
            means = [float(force[speed == level].mean()) for level in levels]
            axes.plot(levels, means, color=colour, linewidth=1.4, alpha=0.6, linestyle="--" if side else "-")
            axes.errorbar(
                speed * SHIFT ** (2 * side - 1), force, yerr=half, fmt=marker, color=colour, markersize=8, capsize=3,
                markerfacecolor="white" if side else colour, markeredgecolor=colour if side else "white",
            )  # fmt: skip
            shown += [force - half, force + half]
            labels.append(EndLabel(means[-1], f"{'AB'[side]} {_word(kind)}", colour))
    _speeds(axes, [pair.condition.speed_mm_s or 1.0 for pair in pairs])
    fit_y(axes, shown, 1.0)
    label_y(axes, "Force (mN)")
    _heading(axes, "Steady force", "A filled, B open; bars 95 %, noise")
    label_ends(axes, labels)


def _apart(axes: Axes, comparison: Comparison) -> None:
    labels, shown = [], [np.zeros(1)]
    groups = [one for one in comparison.groups if one.condition.kind in LOOKS and one.condition.speed_mm_s]
    for kind, (colour, marker) in LOOKS.items():
        mine = sorted(
            (one for one in groups if one.condition.kind == kind), key=lambda one: one.condition.speed_mm_s or 0.0
        )
        if not mine:
            continue
        speed = np.array([one.condition.speed_mm_s for one in mine], dtype=float)
        shown += _differences(axes, speed, mine, colour, marker, percent=False)
        labels.append(EndLabel(mine[-1].value, _word(kind), colour))
    axes.axhline(0.0, color=GREY, linewidth=1.0, zorder=1)
    _speeds(axes, [one.condition.speed_mm_s or 1.0 for one in groups])
    fit_y(axes, shown, 1.0)
    label_y(axes, "B − A (mN)")
    _heading(axes, "Difference of steady forces", "filled: beyond scatter; bars 95 %")
    label_ends(axes, labels)


def _relaxations(axes: Axes, comparison: Comparison) -> None:
    labels, shown = [], [np.zeros(1)]
    groups = [one for one in comparison.groups if one.condition.shear_strain is not None and one.relative is not None]
    for measure, (marker, colour, beside) in MEASURES.items():
        mine = sorted(
            (one for one in groups if one.measure == measure), key=lambda one: one.condition.shear_strain or 0.0
        )
        if not mine:
            continue
        strain = 100 * np.array([one.condition.shear_strain for one in mine], dtype=float)
        shown += _differences(axes, strain + beside, mine, colour, marker, percent=True)
        labels.append(EndLabel(100 * (mine[-1].relative or 0.0), measure, colour))
    axes.axhline(0.0, color=GREY, linewidth=1.0, zorder=1)
    axes.margins(x=0.08)
    fit_y(axes, shown, 1.0)
    axes.set_xlabel("Shear strain (%)")
    label_y(axes, "B over A (%)")
    _heading(axes, "Difference of relaxations", "filled: beyond scatter; bars 95 %")
    label_ends(axes, labels)


def _differences(
    axes: Axes, x: np.ndarray, groups: Sequence[GroupDifference], colour: str, marker: str, *, percent: bool
) -> list[np.ndarray]:
    scale = np.array([100 / abs(one.a) if percent else 1.0 for one in groups])
    value = scale * np.array([one.value for one in groups])
    half = scale * NORMAL_95 * np.array([one.error for one in groups])
    axes.plot(x, value, color=colour, linewidth=1.2, alpha=0.5)
    axes.errorbar(x, value, yerr=half, fmt="none", color=colour, capsize=3)
    for at, mean, one in zip(x, value, groups, strict=True):
        beyond = one.verdict is Verdict.BEYOND
        axes.plot(
            at, mean, marker, color=colour, markersize=8,
            markerfacecolor=colour if beyond else "white", markeredgecolor="white" if beyond else colour,
        )  # fmt: skip
    return [value - half, value + half]


_PANELS: tuple[tuple[Callable[[Axes, Comparison], None], Callable[[Comparison], bool]], ...] = (
    (_steady, lambda one: bool(_sliding(one))),
    (_apart, lambda one: bool(_sliding(one))),
    (_relaxations, lambda one: any(group.condition.shear_strain is not None for group in one.groups)),
)


def _speeds(axes: Axes, speeds: Sequence[float]) -> None:
    middle = float(np.sqrt(min(speeds) * max(speeds)))
    half = max(1.3 * max(speeds) / middle, float(np.sqrt(10.0)))
    plain_log_x(axes, middle / half, middle * half)
    axes.set_xlabel("Speed (mm/s)")


def _word(kind: str) -> str:
    return "Coulomb" if kind == "coulomb" else kind


def _heading(axes: Axes, text: str, remark: str) -> None:
    y = 1 + 0.13 / height_in(axes)
    axes.text(0.0, y, text, transform=axes.transAxes, fontsize=TEXT_PT, fontweight="bold")
    after = 1.1 * text_width_in(text, TEXT_PT) + 0.25
    axes.text(after / width_in(axes), y, remark, transform=axes.transAxes, fontsize=SMALL_PT, color=GREY)


def _subtitle(comparison: Comparison) -> str:
    count = len(comparison.pairs)
    beyond = sum(pair.verdict is Verdict.BEYOND for pair in comparison.pairs)
    return f"{count} pair{'' if count == 1 else 's'} of runs, {beyond} of them differ by more than noise and scatter"


def _trouble(comparison: Comparison) -> str:
    alone = len(comparison.alone_a) + len(comparison.alone_b)
    left_out = len(comparison.a.left_out) + len(comparison.b.left_out)
    said = [f"{alone} runs have no partner"] if alone else []
    said += [f"{left_out} runs are left out"] if left_out else []
    return "; ".join((*said, *comparison.remarks))


def _backends(comparison: Comparison) -> str:
    found = [pair.a.info.header.backend for pair in comparison.pairs]
    found += ["model" if pair.b_is_model else pair.b.info.header.backend for pair in comparison.pairs]
    return " / ".join(dict.fromkeys(found))
