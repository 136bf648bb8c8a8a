"""Names of curves, written where the curves end."""

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes

from dragrig.figures.panels import height_in, width_in
from dragrig.figures.placement import spread
from dragrig.figures.style import TEXT_PT

_LINE_IN = 0.24


@dataclass(frozen=True, slots=True)
class EndLabel:
    """A name, the value that it stands beside, and its colour; `math` lets `$…$` be set as a formula."""

    value: float
    text: str
    colour: str
    math: bool = False


def label_ends(axes: Axes, labels: Sequence[EndLabel], size_pt: float = TEXT_PT) -> None:
    """Write names along the right edge of the axes, each as near its value as the others let it be."""
    low, high = axes.get_ylim()
    wide, tall = width_in(axes), height_in(axes)
    rising = sorted(labels, key=lambda label: label.value)
    wanted = [(label.value - low) / (high - low) * tall for label in rising]
    places = spread(wanted, [_LINE_IN] * len(rising), 0.0, tall)
    for label, value, place in zip(rising, wanted, places, strict=True):
        moved = abs(place - value) > 0.03
        axes.annotate(
            label.text,
            xy=(1.0, value / tall),
            xytext=(1 + (0.32 if moved else 0.12) / wide, place / tall),
            xycoords="axes fraction",
            va="center",
            fontsize=size_pt,
            color=label.colour,
            annotation_clip=False,
            parse_math=label.math,
            arrowprops=_leader(label.colour) if moved else None,
        )


def _leader(colour: str) -> dict[str, object]:
    """Return a line that begins at the left edge of its name, so that it crosses no other's."""
    return {"arrowstyle": "-", "color": colour, "linewidth": 0.8, "relpos": (0, 0.5), "shrinkA": 1, "shrinkB": 2}
