"""What pictures are built of: envelopes, labels kept apart, phases, files."""

import threading
from itertools import combinations, pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import scipy.optimize  # noqa: F401  # loaded here, so that no example pays for it
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.text import Text

from dragrig.config.errors import OutputError
from dragrig.present.drawing import CurveLabel, figure_style, label_curves, new_figure, spread_labels, text_width_in
from dragrig.present.files import save_figure, save_figure_in
from dragrig.present.run_figures import (
    ENVELOPE_COLUMNS,
    gaps_after_samples,
    merge_ramp,
    min_max_envelope,
    phase_intervals,
)


def time_axis(samples: int, rate_hz: float = 1000.0) -> np.ndarray:
    return np.arange(samples) / rate_hz


@given(arrays(np.float64, st.integers(1, 3000), elements=st.floats(-1e6, 1e6)), st.integers(1, 400))
def test_an_envelope_keeps_every_columns_extremes(value: np.ndarray, columns: int) -> None:
    time = time_axis(value.size)
    t, y = min_max_envelope(time, value, gaps_after_samples(time, 1000.0), columns)
    assert y.min() == value.min()
    assert y.max() == value.max()
    assert (np.diff(t) >= 0).all()
    assert t.size <= max(4 * columns, 2 * columns + 2)
    edges = np.linspace(time[0], time[-1], columns, endpoint=False)
    for low, high in zip(edges, [*edges[1:], np.inf], strict=True):
        inside, remaining = value[(time >= low) & (time < high)], y[(t >= low) & (t < high)]
        assert inside.size == 0 or (remaining.min(), remaining.max()) == (inside.min(), inside.max())


@given(st.sets(st.integers(1, 9999), max_size=30), st.sets(st.integers(0, 9999), max_size=30))
def test_an_envelope_is_broken_at_gaps_and_where_the_trace_is_not_finite(gaps: set[int], holes: set[int]) -> None:
    time = time_axis(10_000)
    for start in gaps:
        time[start:] += 0.5
    value = np.ones(10_000)
    value[list(holes)] = np.nan
    t, y = min_max_envelope(time, value, gaps_after_samples(time, 1000.0), 50)
    pieces = np.split(t, np.flatnonzero(np.isnan(y)))
    for piece in pieces:
        steady = piece[1:] if np.isnan(y[np.searchsorted(t, piece[0])]) else piece
        first, last = steady[0], steady[-1]
        inside = (time >= first) & (time <= last)
        assert np.isfinite(value[inside]).all()
        assert (np.diff(time[inside]) < 0.4).all()


def test_ten_million_samples_become_a_line_that_a_picture_can_hold() -> None:
    value = np.sin(np.linspace(0, 60, 10_000_000, dtype=np.float32))
    value[7_654_321] = 5.0
    time = time_axis(value.size, 250_000.0)
    t, y = min_max_envelope(time, value, gaps_after_samples(time, 250_000.0))
    assert t.size <= 2 * ENVELOPE_COLUMNS
    assert y.max() == 5.0


def test_irregular_samples_are_not_taken_for_gaps() -> None:
    time = np.cumsum(np.random.default_rng(0).uniform(0.12, 0.17, 500))
    assert not gaps_after_samples(time, 7.0).any()
    time[300:] += 1.0
    assert np.flatnonzero(gaps_after_samples(time, 7.0)).tolist() == [299]


@given(st.lists(st.tuples(st.floats(0, 10), st.floats(0.1, 1)), min_size=1, max_size=9))
def test_spread_labels_never_overlap_and_stay_inside(wanted: list[tuple[float, float]]) -> None:
    centres, widths = zip(*sorted(wanted), strict=True)
    placed = spread_labels(centres, widths, 0.0, 10.0)
    width = np.array(widths)
    assert (np.diff(placed) >= (width[1:] + width[:-1]) / 2 - 1e-9).all()
    assert placed[0] - width[0] / 2 >= -1e-9
    assert placed[-1] + width[-1] / 2 <= 10 + 1e-9


def test_labels_that_have_room_stay_where_they_are() -> None:
    assert spread_labels([1.0, 5.0, 9.0], [1.0, 1.0, 1.0], 0.0, 10.0).tolist() == [1.0, 5.0, 9.0]


def test_names_of_curves_that_lie_close_stay_apart_beside_the_axes() -> None:
    with figure_style():
        figure = new_figure(5, 3, "a title longer than the figure is wide " * 3, "subtitle", "problem", "simulated")
        axes = figure.add_subplot(ylim=(0, 1))
        label_curves(axes, [CurveLabel(value, f"{value} mm/s", "black") for value in (0.50, 0.51, 0.02, 0.52)])
        figure.draw_without_rendering()
        names = {text.get_text(): Text.get_window_extent(text) for text in axes.texts}
        header = [Text.get_window_extent(text) for text in figure.texts]
    boxes = [names[f"{value} mm/s"] for value in (0.02, 0.5, 0.51, 0.52)]
    assert all(upper.y0 >= lower.y1 for lower, upper in pairwise(boxes))
    assert all(axes.bbox.x1 < box.x0 and box.x1 < figure.bbox.x1 for box in boxes)
    assert max(box.y1 for box in boxes) < min(box.y0 for box in header)
    assert not any(upper.overlaps(lower) for upper, lower in combinations(header, 2))


def test_phases_end_where_the_next_begins_and_a_ramp_is_one() -> None:
    time = np.arange(10.0)
    phase = np.array([0, 0, 1, 2, 2, 3, 4, 4, 4, 4], dtype=np.uint8)
    parts = phase_intervals(time, phase)
    assert [(part.name, part.start_s, part.end_s) for part in parts] == [
        ("rest", 0.0, 2.0),
        ("accelerate", 2.0, 3.0),
        ("steady", 3.0, 5.0),
        ("decelerate", 5.0, 6.0),
        ("hold", 6.0, 9.0),
    ]
    assert [(entry.name, entry.start_s, entry.end_s) for entry in merge_ramp(parts)] == [
        ("rest", 0.0, 2.0),
        ("ramp", 2.0, 6.0),
        ("hold", 6.0, 9.0),
    ]


def test_text_is_measured_as_it_is_drawn() -> None:
    with figure_style():
        figure = new_figure(6, 2)
        text = figure.text(0.1, 0.5, "decelerate", fontsize=12)
        drawn = text.get_window_extent().width / figure.dpi
    assert text_width_in("decelerate", 12) == pytest.approx(drawn, rel=0.05)
    assert text_width_in(" ", 12) == 0.0


def test_drawing_leaves_the_callers_settings_alone() -> None:
    before = dict(mpl.rcParams)
    with figure_style():
        assert mpl.rcParams["font.size"] != before["font.size"]
    assert dict(mpl.rcParams) == before
    with pytest.raises(OutputError), figure_style():
        raise OutputError("the disk is full")
    assert dict(mpl.rcParams) == before


def test_two_threads_draw_one_after_the_other() -> None:
    before = dict(mpl.rcParams)
    first_is_in, first_may_go, second_is_in = threading.Event(), threading.Event(), threading.Event()

    def first() -> None:
        with figure_style():
            first_is_in.set()
            first_may_go.wait(600)

    def second() -> None:
        first_is_in.wait(600)
        with figure_style():
            second_is_in.set()

    threads = [threading.Thread(target=first), threading.Thread(target=second)]
    for thread in threads:
        thread.start()
    assert first_is_in.wait(600)
    assert not second_is_in.wait(0.1)
    first_may_go.set()
    for thread in threads:
        thread.join(600)
    assert second_is_in.is_set()
    assert dict(mpl.rcParams) == before


@pytest.mark.parametrize("ending", [".png", ".svg"])
def test_the_same_picture_is_the_same_bytes(tmp_path: Path, ending: str) -> None:
    def picture() -> bytes:
        with figure_style():
            figure = new_figure(4, 3)
            axes = figure.add_subplot()
            axes.plot([1, 2], [3, 4])
            axes.fill_between([1, 2], [3, 4], hatch="//")
            axes.set_xlabel("Time (s)")
        return save_figure(figure, tmp_path / f"one{ending}", overwrite=True).read_bytes()

    first = picture()
    assert first == picture()
    assert b"dc:date" not in first if ending == ".svg" else first.startswith(b"\x89PNG")


def test_a_picture_that_is_there_is_not_written_over_unless_told(tmp_path: Path) -> None:
    figure = new_figure(2, 2)
    path = tmp_path / "mine.png"
    path.write_bytes(b"precious")
    with pytest.raises(OutputError, match=r"mine\.png: is there already"):
        save_figure(figure, path)
    assert path.read_bytes() == b"precious"
    assert save_figure(figure, path, overwrite=True).read_bytes() != b"precious"


def test_a_name_that_nobody_chose_gives_way(tmp_path: Path) -> None:
    figure = new_figure(2, 2)
    made = [save_figure_in(tmp_path / "new" / "folder", "run", figure).name for _ in range(3)]
    assert made == ["run.png", "run-2.png", "run-3.png"]
    assert save_figure_in(tmp_path / "new" / "folder", "run", figure, overwrite=True).name == "run.png"


@pytest.mark.parametrize("name", ["picture.gif", "picture"])
def test_an_unknown_ending_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputError, match=r"\.png, \.svg, \.pdf"):
        save_figure(new_figure(2, 2), tmp_path / name)


def test_a_failed_save_leaves_nothing_behind(tmp_path: Path) -> None:
    figure = new_figure(2, 2)
    with pytest.raises(OutputError, match="cannot be written"):
        save_figure(figure, tmp_path / "missing" / "picture.png")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file"):
        save_figure_in(tmp_path / "file", "picture", figure)
    (tmp_path / "taken.png").mkdir()
    with pytest.raises(OutputError, match=r"cannot be written|it is a folder: choose another name"):
        save_figure(figure, tmp_path / "taken.png", overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "taken.png"]
