"""The picture of where a gap is."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.text import Text

from dragrig.analysis.gap.diagnosis import GapLocation
from dragrig.analysis.gap.excess import ResidualBlocks
from dragrig.analysis.gap.localise import localise
from dragrig.present.diagnosis_figures import location_figure
from dragrig.present.document import PALE, VERMILLION
from dragrig.present.files import save_figure
from dragrig.rig.profile import FloatArray, Phase
from property_tests import thorough
from residuals import Planted, campaign


def fast(first: ResidualBlocks) -> FloatArray:
    under_way = (first.phase != Phase.REST) & (first.phase != Phase.HOLD)
    return np.asarray(-30.0 * under_way * (first.kind == "drag") * (first.speed_mm_s > 25.0))


def everything(first: ResidualBlocks) -> FloatArray:
    return 500.0 * (1 + np.sin(first.time_s) + first.strain) * (first.phase != Phase.REST)


@cache
def located(planted: Planted | None) -> GapLocation:
    return localise(campaign(1) if planted is None else campaign(1, planted))


def drawn(planted: Planted | None) -> Figure:
    return location_figure(located(planted), "a campaign with a rather long name, " * 6)


def texts(figure: Figure) -> list[Text]:
    assert isinstance(figure.canvas, FigureCanvasAgg)
    figure.canvas.draw()
    result = list(figure.texts)
    for axes in figure.axes:
        result += [
            axes.xaxis.label,
            axes.yaxis.label,
            *(get_child for get_child in axes.get_children() if isinstance(get_child, Text)),
        ]
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            result += [tick.label1 for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
    return [label for label in result if label.get_text().strip() and label.get_visible()]


def panel(figure: Figure, title: str) -> Axes:
    return next(axes for axes in figure.axes if axes.get_title(loc="left").startswith(title))


@pytest.mark.parametrize("planted", [thorough(fast), everything, thorough(None)])
def test_every_word_is_inside_and_none_lies_on_another(planted: Planted | None) -> None:
    figure = drawn(planted)
    page = figure.bbox
    boxes = [(text.get_text(), text.get_window_extent()) for text in texts(figure)]
    for words, box in boxes:
        assert box.x0 >= page.x0, words
        assert box.x1 <= page.x1, words
        assert box.y0 >= page.y0, words
        assert box.y1 <= page.y1, words
    for number, (words, box) in enumerate(boxes):
        for others, second in boxes[number + 1 :]:
            apart = box.x1 <= second.x0 or second.x1 <= box.x0 or box.y1 <= second.y0 or second.y1 <= box.y0
            assert apart, (words, others)


def test_the_bins_that_have_most_stand_out() -> None:
    result, figure = located(fast), drawn(fast)
    axes = panel(figure, "Speed")
    colours = [patch.get_facecolor() for patch in axes.patches]
    levels = [entry.low for entry in result.location("speed_mm_s").bins]
    assert [colour == to_rgba(VERMILLION) for colour in colours] == [
        level is not None and level >= 30.0 for level in levels
    ]
    assert {patch.get_facecolor() for patch in panel(figure, "Session").patches} == {to_rgba(PALE)}
    assert "30 to 60" in axes.get_xlabel()


def test_without_a_gap_it_says_so() -> None:
    figure = drawn(None)
    message = [text.get_text() for text in texts(figure)]
    assert "Means over blocks: nothing beyond noise and scatter of repeats" in message
    assert message.count("no excess here") == 5


@pytest.mark.thorough
def test_it_is_the_same_picture_each_time(tmp_path: Path) -> None:
    first, second = (save_figure(drawn(fast), tmp_path / f"{name}.png").read_bytes() for name in "ab")
    assert first == second
