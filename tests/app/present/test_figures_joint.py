"""The picture of a joint fit."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.identification.identification import JointFit, ParameterEstimate, RunResidual
from dragrig.present.identification_figures import JOINT_MAX_RUNS, joint_fit_figure
from property_tests import thorough

STIFFNESS = ParameterEstimate("stiffness_scale", "1", 1.05, 0.03, (0.99, 1.11), (0.75, 1.34), 0.8)
ANGLE = ParameterEstimate("contact_angle_offset_deg", "deg", -0.2, 0.1, (-0.4, 0.0), (-1.4, 1.4), 0.8)
SHOWN = ParameterEstimate("e1_shown", "1", 1.016, 0.009, (0.999, 1.034), (0.7, 1.4), 0.9)


def run(file: str, chi2: float = 1.0, channel: str = "force") -> RunResidual:
    return RunResidual(file, "drag", channel, 300, chi2, 1.0, Estimate(0.0, 0.1), {})


def fit(*runs: RunResidual, parameters: tuple[ParameterEstimate, ...] = (STIFFNESS, ANGLE)) -> JointFit:
    correlation = np.eye(len(parameters))
    return JointFit("capsule", parameters, (SHOWN,), correlation, runs or (run("a.h5"),), 300, 300, 0.5, True, 2)


def words(figure: Figure) -> list[Text]:
    """Return every text that is drawn; ticks beyond an axis are not."""
    assert isinstance(figure.canvas, FigureCanvasAgg)
    figure.canvas.draw()
    result = list(figure.texts)
    for axes in figure.axes:
        result += [
            *axes.texts,
            axes.xaxis.label,
            *(get_child for get_child in axes.get_children() if isinstance(get_child, Text)),
        ]
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            result += [tick.label1 for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
    return [fromkey for fromkey in dict.fromkeys(result) if fromkey.get_text().strip()]


def panel(figure: Figure, title: str) -> Axes:
    return next(axes for axes in figure.axes if title in axes.get_title(loc="left"))


def names(axes: Axes) -> list[str]:
    return [get_yticklabel.get_text() for get_yticklabel in axes.get_yticklabels()]


LONG = "2026-05-04-a-campaign-with-a-name-that-never-comes-to-an-end-at-least-not-soon"


@pytest.mark.parametrize(
    "drawn",
    [
        thorough(fit()),
        fit(*(run(f"{LONG}-{number:03d}-drag.h5") for number in range(34))),
        fit(run("a.h5", 4020.0), run("b.h5", 0.01)),
        fit(parameters=tuple(replace(STIFFNESS, name=f"{LONG}_{number}", unit="mN·s/mm") for number in range(3))),
        thorough(replace(fit(), combinations=(), converged=False)),
        thorough(replace(fit(), p_value=1e-9)),
    ],
    ids=["plain", "many runs, long names", "large and small", "long parameters", "not converged", "unexplained"],
)
def test_every_word_stays_on_the_page_and_clear_of_the_others(drawn: JointFit) -> None:
    figure = joint_fit_figure(drawn)
    boxes = [word.get_window_extent() for word in words(figure)]
    page = figure.bbox
    for box in boxes:
        assert page.x0 <= box.x0 < box.x1 <= page.x1
        assert page.y0 <= box.y0 < box.y1 <= page.y1
    for place, box in enumerate(boxes):
        for second in boxes[place + 1 :]:
            apart = max(box.x0, second.x0) - min(box.x1, second.x1), max(box.y0, second.y0) - min(box.y1, second.y1)
            assert max(apart) > -3.0


def test_parameters_stand_where_their_priors_have_them() -> None:
    axes = panel(joint_fit_figure(fit()), "before")
    middles = [line.get_xdata()[0] for line in axes.lines if line.get_marker() == "o"]
    nominal = np.sqrt(0.75 * 1.34)
    log_sd = np.log(1.34 / 0.75) / (2 * 1.96)
    assert middles == pytest.approx([np.log(1.05 / nominal) / log_sd, -0.2 / (1.4 / 1.96)], rel=1e-3)
    assert names(axes) == ["wall stiffness ×", "contact angle offset"]


def test_what_lies_far_outside_is_pointed_at() -> None:
    far = replace(STIFFNESS, value=9.0, interval=(8.9, 9.1))
    axes = panel(joint_fit_figure(fit(parameters=(far, ANGLE))), "before")
    arrows = [line for line in axes.lines if line.get_marker() == ">"]
    assert [line.get_xdata()[0] for line in arrows] == [axes.get_xlim()[1]]


def dots(axes: Axes) -> int:
    return sum(line.get_marker() == "o" for line in axes.lines)


def test_no_number_stands_where_runs_say_nothing() -> None:
    unknown = replace(ANGLE, learnt=0.05)
    axes = panel(joint_fit_figure(fit(parameters=(STIFFNESS, unknown))), "before")
    assert [text.get_text() for text in axes.texts] == ["1.050 ± 0.030", "not determined"]
    assert dots(axes) == 1


def test_no_interval_stands_where_the_fit_did_not_converge() -> None:
    axes = panel(joint_fit_figure(replace(fit(), converged=False)), "before")
    assert [text.get_text() for text in axes.texts] == ["1.05", "−0.2 °"]
    assert dots(axes) == 2
    assert all(np.ptp(line.get_xdata()) == 0 for line in axes.lines)


def test_runs_that_are_left_badly_are_shown_on_a_scale_for_all() -> None:
    axes = panel(joint_fit_figure(fit(run("a.h5", 4020.0), run("b.h5", 1.0))), "each run")
    assert axes.get_xscale() == "log"
    assert "1000" in [get_xticklabel.get_text() for get_xticklabel in axes.get_xticklabels()]
    assert names(axes) == ["a", "b"]


def test_of_very_many_runs_those_are_shown_that_are_left_worst() -> None:
    runs = [run(f"{number:03d}.h5", 1.0 + number / 100) for number in range(3 * JOINT_MAX_RUNS)]
    figure = joint_fit_figure(fit(*runs))
    assert names(panel(figure, "each run")) == [entry.file.removesuffix(".h5") for entry in runs[-JOINT_MAX_RUNS:]]
    assert any(
        f"{3 * JOINT_MAX_RUNS} runs, the {JOINT_MAX_RUNS} with the largest" in text.get_text() for text in figure.texts
    )


def test_channels_are_named_where_there_are_several() -> None:
    figure = joint_fit_figure(fit(run("a.h5"), run("a.h5", channel="motor_force")))
    assert names(panel(figure, "each run")) == ["a force", "a motor_force"]
    assert any(text.get_text().endswith("1 run") for text in figure.texts)
