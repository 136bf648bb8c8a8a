"""Pictures of runs and campaigns, and the command that draws them."""

import io
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Annotation, Text
from matplotlib.transforms import Bbox

import dragrig
from dragrig.analysis import value_with_error
from dragrig.cli import main
from dragrig.cli.commands import dragrig_group
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.settings import find_settings
from dragrig.config.specimen import Capsule
from dragrig.present.campaign_figures import campaign_figure
from dragrig.present.drawing import DPI, SMALL_PT, figure_style, lay_out, new_figure, shortened_to_width
from dragrig.present.identification_figures import wall_figure
from dragrig.present.model_figures import forces_figure, skew_figure
from dragrig.present.run_figures import WIDTH_IN, run_figure
from dragrig.rig import mark_bad
from dragrig.rig.profile import Phase
from dragrig.rig.runfile import read_run
from dragrig.rig.runfile.model import FilteredTrace, Run, RunEvent, RunStatus
from places import CAMPAIGN, copied_runs
from property_tests import thorough


@pytest.fixture(scope="module")
def drag() -> Run:
    return dragrig.simulate("drag", assignments=["speed_mm_s=10", "travel_mm=20"])[0]


@pytest.fixture(scope="module")
def figure(drag: Run) -> Figure:
    """Its figure, for all who only look at it."""
    return run_figure(drag)


@pytest.fixture(scope="module")
def relaxation() -> Run:
    return dragrig.simulate("relaxation", assignments=["shear_strain=1.0"])[0]


def panel(figure: Figure, label: str) -> Axes:
    return next(axes for axes in figure.axes if axes.get_ylabel() == label)


def line(axes: Axes, word: str) -> tuple[np.ndarray, np.ndarray]:
    (result,) = [artist for artist in axes.lines if str(artist.get_label()).startswith(word)]
    return np.asarray(result.get_xdata(), dtype=float), np.asarray(result.get_ydata(), dtype=float)


def texts(figure: Figure) -> list[str]:
    return [label.get_text() for label in figure.findobj(Text) if label.get_text()]


def legend_words(axes: Axes) -> list[str]:
    legend = axes.get_legend()
    return [] if legend is None else [text.get_text() for text in legend.get_texts()]


def drawn(figure: Figure, dpi: float = DPI / 3) -> bytes:
    content = io.BytesIO()
    with figure_style():
        lay_out(figure)
        figure.savefig(content, format="png", dpi=dpi)
    return content.getvalue()


def without(run: Run, lost: Sequence[slice]) -> Run:
    keep = np.ones(run.trace.time.size, dtype=bool)
    for entry in lost:
        keep[entry] = False
    trace = run.trace
    return replace(
        run,
        trace=replace(
            trace,
            time=trace.time[keep],
            command=trace.command[keep],
            phase=trace.phase[keep],
            channels={name: values[keep] for name, values in trace.channels.items()},
        ),
    )


def first(run: Run, samples: int) -> Run:
    return without(run, [slice(samples, None)])


def test_the_raw_force_is_drawn_as_recorded_and_the_filtered_one_over_it(drag: Run, figure: Figure) -> None:
    axes = panel(figure, "Force (mN)")
    time, raw = line(axes, "raw")
    np.testing.assert_array_equal(time, drag.trace.time)
    np.testing.assert_array_equal(raw, drag.trace.force)
    time, smooth = line(axes, "filtered")
    steady = (time > 2) & (time < 2.8)
    assert smooth[steady].std() < 0.6 * raw[steady].std()
    assert smooth[steady].mean() == pytest.approx(raw[steady].mean(), abs=0.2)
    assert legend_words(axes)[:2] == ["raw", "filtered by Savitzky–Golay, 51 ms, order 3"]


def test_what_the_filter_stored_is_what_is_shown(drag: Run) -> None:
    ones = np.ones(drag.trace.time.size)
    stored = FilteredTrace(
        drag.trace.time, {"force": ones, "speed": 3 * ones}, {"window_s": 0.2, "order": 2}, {"force": "mN"}
    )
    figure = run_figure(replace(drag, filtered=stored))
    np.testing.assert_array_equal(line(panel(figure, "Force (mN)"), "filtered")[1], ones)
    np.testing.assert_array_equal(line(panel(figure, "Speed (mm/s)"), "measured")[1], 3 * ones)
    assert "filtered by Savitzky–Golay, 0.2 s, order 2" in texts(figure)
    derivative = replace(stored, units={"force": "mN/s^1"})
    shown = line(panel(run_figure(replace(drag, filtered=derivative)), "Force (mN)"), "filtered")[1]
    assert shown.max() > 50


def test_the_filtered_force_can_be_left_out(drag: Run) -> None:
    figure = run_figure(drag, filtered=False)
    assert not any("filtered" in text for text in texts(figure))
    assert line(panel(figure, "Speed (mm/s)"), "measured")[1].max() > 9


def test_position_speed_and_set_speed(drag: Run, figure: Figure) -> None:
    begun = drag.info.header.entry["origin_mm"]
    assert begun == 40.0
    np.testing.assert_array_equal(line(panel(figure, "Position (mm)"), "encoder")[1], drag.trace.position + begun)
    time, speed = line(panel(figure, "Speed (mm/s)"), "measured")
    assert speed[(time > 1.5) & (time < 2.5)] == pytest.approx(10, abs=0.05)
    during, wanted = line(panel(figure, "Speed (mm/s)"), "set")
    np.testing.assert_array_equal(during, drag.trace.time[drag.trace.phase == Phase.STEADY])
    assert (wanted == 10).all()
    assert "set 10 mm/s" in texts(figure)


def test_the_way_back_has_a_negative_speed() -> None:
    back = dragrig.simulate("drag", assignments=["speed_mm_s=20", "travel_mm=10"])[1]
    figure = run_figure(back)
    assert np.nanmin(line(panel(figure, "Speed (mm/s)"), "set")[1]) < 0
    assert any(text.startswith("set −") for text in texts(figure))


def test_every_phase_is_named_and_shaded(figure: Figure) -> None:
    assert {"rest", "accelerate", "steady", "decelerate", "hold"} <= set(texts(figure))
    axes = panel(figure, "Force (mN)")
    tops = [path.get_extents().y1 for collection in axes.collections for path in collection.get_paths()]
    assert [top == 1.0 for top in tops].count(True) == 5, "in the panel"
    assert [top > 1.0 for top in tops].count(True) == 5, "in the band above it"


def test_the_motor_force_is_drawn_on_demand(drag: Run, figure: Figure) -> None:
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert "Motor force (mN)" not in labels
    axes = panel(run_figure(drag, motor_force=True), "Motor force (mN)")
    np.testing.assert_array_equal(line(axes, "raw")[1], drag.trace.channels["motor_force"])


def test_a_run_of_the_stage_alone_shows_the_motor_force(drag: Run) -> None:
    channels = {name: values for name, values in drag.trace.channels.items() if name != "force"}
    alone = replace(drag, trace=replace(drag.trace, signal="motor_force", channels=channels))
    axes = panel(run_figure(alone, motor_force=True), "Motor force (mN)")
    np.testing.assert_array_equal(line(axes, "raw")[1], channels["motor_force"])


def test_lost_samples_break_every_line_and_are_named(drag: Run) -> None:
    gappy = without(drag, [slice(1500, 1800)])
    figure = run_figure(gappy)
    for label, word in (("Force (mN)", "raw"), ("Force (mN)", "filtered"), ("Position (mm)", "encoder")):
        time, value = line(panel(figure, label), word)
        broken = np.flatnonzero(np.isnan(value))
        assert broken.size == 1
        assert 1.49 < time[broken[0] - 1] <= 1.5
        assert 1.8 <= time[broken[0] + 1] < 1.81
    assert "gap 0.3 s" in texts(figure)


def test_missing_values_break_the_line(drag: Run) -> None:
    force = drag.trace.force.copy()
    force[2000:2100] = np.nan
    holed = replace(drag, trace=replace(drag.trace, channels={**drag.trace.channels, "force": force}))
    _, raw = line(panel(run_figure(holed), "Force (mN)"), "raw")
    assert np.isnan(raw).sum() == 1
    assert np.isfinite(raw).sum() == force.size - 100


def test_a_trip_is_marked_and_the_status_says_why(drag: Run) -> None:
    tripped = replace(
        drag,
        events=(*drag.events, RunEvent(0.0, "import", "no command"), RunEvent(1.6, "trip", "force: 1200 mN")),
        info=replace(drag.info, status=RunStatus.TRIPPED, reason="force: 1200 mN " + "and so on " * 30),
    )
    figure = run_figure(tripped)
    shown = texts(figure)
    assert "trip" in shown
    assert not {"start", "phase", "import"} & set(shown)
    status = next(text for text in figure.texts if text.get_text().startswith("tripped: force: 1200 mN"))
    assert status.get_window_extent().x1 < WIDTH_IN * figure.dpi


def test_header_says_what_it_is_where_it_came_from_and_that_it_is_bad(drag: Run) -> None:
    shown = texts(run_figure(drag, bad_reason="gut slipped"))
    assert "Drag at 10 mm/s · jejunum" in shown
    assert "SIMULATED" in shown
    assert "marked bad: gut slipped" in shown
    (subtitle,) = [text for text in shown if drag.info.header.run_id[:8] in text and "complete" in text]
    assert f"{drag.info.header.start_time:%Y-%m-%d %H:%M:%S}" in subtitle


def test_words_of_a_person_are_not_read_as_formulas(drag: Run) -> None:
    header = replace(drag.info.header, specimen={**drag.info.header.specimen, "name": "a_b$^{ 空肠"})
    figure = run_figure(replace(drag, info=replace(drag.info, header=header)), bad_reason="cost $5 and $\\frac$")
    assert drawn(figure)


def test_a_relaxation_shows_its_ramp_and_the_time_since(relaxation: Run) -> None:
    figure = run_figure(relaxation)
    force = [axes for axes in figure.axes if axes.get_ylabel() == "Force (mN)"]
    whole, since, ramp = force
    begin, end = (float(relaxation.trace.time[relaxation.trace.phase == phase][0]) for phase in (1, 4))
    assert since.get_xscale() == "log"
    assert since.get_xlim()[0] <= 2e-3
    time, value = line(since, "raw")
    assert value[0] == pytest.approx(relaxation.trace.force[relaxation.trace.time > end][0])
    assert time[-1] == pytest.approx(relaxation.trace.time[-1] - end)
    low, high = ramp.get_xlim()
    assert low < begin < end < high
    assert high - low < 4 * (end - begin)
    assert whole.get_xlim()[1] > 20
    assert "ramp" in texts(figure)
    assert "Relaxation at 100 % shear strain · jejunum" in texts(figure)


def test_the_steady_level_stands_where_the_runs_measure_says(drag: Run, figure: Figure) -> None:
    time, level = line(panel(figure, "Force (mN)"), "steady")
    assert level[0] == level[1]
    inside = (drag.trace.time >= time[0]) & (drag.trace.time <= time[1])
    assert level[0] == pytest.approx(drag.trace.force[inside].mean(), abs=0.05)


def test_a_bracket_stands_between_rest_and_steady_sliding(drag: Run, figure: Figure) -> None:
    rest = drag.trace.force[drag.trace.phase == Phase.REST].mean()
    _, level = line(panel(figure, "Force (mN)"), "steady")
    arrows = [one for one in panel(figure, "Force (mN)").texts if isinstance(one, Annotation) and not one.get_text()]
    assert [sorted([one.xy[1], one.xyann[1]]) for one in arrows] == [pytest.approx([rest, level[0]], abs=0.05)]
    (told,) = [text for text in texts(figure) if text.startswith("steady − rest ")]
    assert float(told.split()[3]) == pytest.approx(level[0] - rest, abs=0.1)


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (113.2444, 0.213, "113.24 ± 0.21"),
        (113.2444, 13.1, "113 ± 13"),
        (0.5, 0.0012, "0.5000 ± 0.0012"),
        (-1.404, 0.57, "−1.40 ± 0.57"),
        (40.07, None, "40.07"),
        (40.07, 0.0, "40.07"),
        (0.49999999999, 4.9e-10, "0.5"),
        (19.99981, 1e-7, "19.99981"),
        (3e-13, 1.4e-14, "3.0e−13 ± 1.4e−14"),
        (-0.001, 0.21, "0.00 ± 0.21"),
    ],
)
def test_a_value_has_as_many_digits_as_its_error(value: float, error: float | None, text: str) -> None:
    assert value_with_error(value, error) == text


DRAWN = ("008-coulomb.h5",)
"""Runs of the other kinds are drawn below."""


@pytest.mark.parametrize(
    "name", [*DRAWN, *(thorough(path.name) for path in sorted(CAMPAIGN.glob("*.h5")) if path.name not in DRAWN)]
)
def test_every_practice_file_draws(name: str) -> None:
    assert drawn(run_figure(read_run(CAMPAIGN / name))).startswith(b"\x89PNG")


@pytest.mark.parametrize("samples", [0, thorough(1), thorough(2), thorough(60)])
def test_a_run_cut_short_draws(drag: Run, relaxation: Run, samples: int) -> None:
    for run in (drag, relaxation):
        short = replace(first(run, samples), events=())
        assert drawn(run_figure(short, motor_force=True))
    if samples == 0:
        assert "no samples" in texts(run_figure(short))


def test_a_run_without_one_valid_force_says_so(drag: Run) -> None:
    nothing = np.full(drag.trace.time.size, np.nan)
    figure = run_figure(replace(drag, trace=replace(drag.trace, channels={**drag.trace.channels, "force": nothing})))
    assert "no samples" in texts(figure)


def test_a_run_of_a_thousand_gaps_and_phases_draws_and_counts_them(drag: Run) -> None:
    gappy = without(drag, [slice(at, at + 2) for at in range(5, 5000, 5)])
    phase = (np.arange(gappy.trace.time.size) // 3 % 5).astype(np.uint8)
    gappy = replace(gappy, trace=replace(gappy.trace, phase=phase))
    figure = run_figure(gappy)
    assert any("999 gaps, 2 s missing" in text for text in texts(figure))
    assert drawn(figure)


def test_a_million_samples_are_drawn_as_some_thousands_and_lose_no_peak(drag: Run) -> None:
    repeats = 1_000_000 // drag.trace.time.size
    size = repeats * drag.trace.time.size
    force = np.tile(drag.trace.force, repeats)
    force[765_432] = 4000.0
    long = replace(
        drag,
        trace=replace(
            drag.trace,
            time=np.arange(size) / 1000.0,
            command=np.tile(drag.trace.command, repeats),
            phase=np.tile(drag.trace.phase, repeats),
            channels={"force": force, "position": np.tile(drag.trace.position, repeats)},
        ),
    )
    figure = run_figure(long)
    assert drawn(figure)
    t, raw = line(panel(figure, "Force (mN)"), "raw")
    assert raw.max() == 4000.0
    assert t.size < 10_000


def test_the_same_run_is_the_same_picture(drag: Run, figure: Figure) -> None:
    assert drawn(run_figure(drag)) == drawn(figure)


def test_the_solver_of_the_layout_may_round_as_it_likes(monkeypatch: pytest.MonkeyPatch) -> None:
    """It adds up in the order of addresses in memory, so its last digits differ from one figure to the next."""
    solve, rounding = ConstrainedLayoutEngine.execute, np.random.default_rng(1)

    def solve_otherwise(engine: ConstrainedLayoutEngine, figure: Figure) -> None:
        solve(engine, figure)
        for axes in figure.axes:
            points = axes.get_position(original=True).get_points()
            axes.set_position(Bbox(points * (1 + 1e-15 * rounding.integers(-9, 10, points.shape))))
            axes.set_in_layout(True)

    def places() -> tuple[tuple[float, ...], ...]:
        with figure_style():
            figure = new_figure(4.0, 2.0)
            figure.subplots(1, 2)
            lay_out(figure)
        return tuple(axes.get_position().bounds for axes in figure.axes)

    plain = places()
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", solve_otherwise)
    assert {places() for _ in range(6)} == {plain}


def full_picture(name: str, drag: Run, relaxation: Run) -> Figure:
    """Return a picture on which much is written."""
    model, capsule = FrictionModelSettings(), find_settings(Capsule, "capsule", "drag")
    match name:
        case "relaxation":
            return run_figure(relaxation, motor_force=True)
        case "gaps":
            gappy = without(drag, [slice(at, at + 20) for at in range(500, 5000, 200)])
            return run_figure(gappy, motor_force=True)
        case "campaign":
            return campaign_figure([drag, relaxation, read_run(CAMPAIGN / "008-coulomb.h5")], "mixed")
        case "forces":
            return forces_figure(model, capsule, 2.5, (0.01, 300.0))
        case "skew":
            return skew_figure(model, capsule, 2.5, (0.5, 0.6, 0.7, 100.0))
        case _:
            return wall_figure()


@pytest.mark.parametrize(
    "name", ["gaps", "campaign", *(thorough(name) for name in ("relaxation", "forces", "skew", "wall"))]
)
def test_nothing_on_a_picture_is_cut_off_and_no_label_covers_another(name: str, drag: Run, relaxation: Run) -> None:
    figure = full_picture(name, drag, relaxation)
    with figure_style():
        lay_out(figure)
        everything = figure.get_tightbbox()
        labels = [*figure.texts, *(text for axes in figure.axes for text in axes.texts)]
        boxes = [Text.get_window_extent(text) for text in labels]  # without the line that an annotation has
    width, height = figure.get_size_inches()
    assert everything.x0 >= 0
    assert everything.y0 >= 0
    assert everything.x1 <= width
    assert everything.y1 <= height
    for place, (text, box) in enumerate(zip(labels, boxes, strict=True)):
        covered = [label.get_text() for label, area in zip(labels[:place], boxes, strict=False) if box.overlaps(area)]
        assert not [second for second in covered if second], text


def test_a_sentence_is_cut_to_the_room_it_has() -> None:
    with figure_style():
        new_figure(4, 3)
        assert shortened_to_width("short", SMALL_PT, 5.0) == "short"
        cut = shortened_to_width("long " * 100, SMALL_PT, 5.0)
    assert cut.endswith("…")
    assert 20 < len(cut) < 120


def test_a_campaign_shows_each_kind_and_leaves_out_what_is_bad(tmp_path: Path) -> None:
    runs = [read_run(path) for path in sorted(CAMPAIGN.glob("*.h5"))]
    drags = [run for run in runs if run.info.kind == "drag"]
    figure = campaign_figure(runs, "practice", bad=[drags[0].info.path])
    shown = texts(figure)
    assert {"Campaign · practice", "Steady force", "Relaxation", "Drag along the way", "Coulomb", "blank"} <= set(shown)
    assert "1 of them ended early or are marked bad, and are not drawn" in shown
    steady = figure.axes[0]
    assert steady.get_xscale() == "log"
    assert len(drags) - 1 in {len(line.get_xdata()) for line in steady.lines}
    means = [len(container.lines[0].get_xdata()) for container in steady.containers]
    assert len({run.info.header.protocol["speed_mm_s"] for run in drags[1:]}) in means
    assert drawn(campaign_figure([], ""))
    assert drawn(campaign_figure(runs[:1]))


def invoke(*arguments: str) -> str:
    done = CliRunner().invoke(dragrig_group, ["show", *arguments], catch_exceptions=False, standalone_mode=False)
    assert done.exit_code == 0
    return done.stdout


def test_show_says_where_each_picture_is_and_writes_over_none(tmp_path: Path) -> None:
    run = Path(shutil.copy(CAMPAIGN / "005-blank.h5", tmp_path / "mine.h5"))
    before = run.read_bytes()
    assert invoke(str(run)).splitlines() == [str(tmp_path / "mine.png")]
    assert invoke(str(run)).splitlines() == [str(tmp_path / "mine-2.png")]
    mark_bad(run, "slipped")
    assert invoke(str(run), "--overwrite").splitlines() == [str(tmp_path / "mine.png")]
    assert (tmp_path / "mine.png").read_bytes() != (tmp_path / "mine-2.png").read_bytes()
    assert run.read_bytes() == before


def test_show_draws_the_overview_of_a_folder_and_the_runs_that_are_named(tmp_path: Path) -> None:
    folder = copied_runs(tmp_path / "camp", "005-blank.h5")
    (overview,) = json.loads(invoke(str(folder), "--json", "--out", str(tmp_path / "alone")))
    assert Path(overview["picture"]).name == "camp.png"
    answer = json.loads(invoke(str(folder), str(folder / "*.h5"), "--json", "--out", str(tmp_path / "out")))
    assert [Path(row["source"]).name for row in answer] == ["005-blank.h5", "camp"]
    assert all(Path(row["picture"]).read_bytes().startswith(b"\x89PNG") for row in answer)
    assert {path.name for path in folder.iterdir()} == {"005-blank.h5"}


def test_show_to_a_named_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, picture = str(CAMPAIGN / "005-blank.h5"), tmp_path / "picture.svg"
    assert main(["show", run, "--out", str(picture), "--no-filtered"]) == 0
    assert picture.read_text("utf-8").startswith("<?xml")
    assert main(["show", run, "--out", str(picture)]) == 2
    assert main(["show", run, str(CAMPAIGN / "014-drag.h5"), "--out", str(tmp_path / "two.png")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert "is there already" in lines[0]
    assert "2 pictures do not fit into" in lines[1]
    assert len(lines) == 2


def test_runs_in_a_folder_that_takes_no_files_are_drawn_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, close_folder: Callable[[Path], None]
) -> None:
    folder = tmp_path / "archive"
    folder.mkdir()
    shutil.copy(CAMPAIGN / "005-blank.h5", folder)
    close_folder(folder)
    monkeypatch.chdir(tmp_path)
    assert invoke(str(folder / "005-blank.h5")).strip() == "005-blank.png"


def test_a_damaged_run_does_not_keep_the_others_from_being_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = Path(shutil.copy(CAMPAIGN / "005-blank.h5", tmp_path / "2.h5"))
    (tmp_path / "1.h5").write_bytes(whole.read_bytes()[:9000])
    assert main(["show", str(tmp_path / "*.h5")]) == 2
    assert (tmp_path / "2.png").is_file()
    output = capsys.readouterr()
    assert "2.png" in output.out
    assert "1.h5" in output.err


def test_what_is_no_run_file_is_refused_in_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "text.h5"
    path.write_text("no run")
    assert main(["show", str(path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert list(tmp_path.iterdir()) == [path]


def test_samples_on_their_own_are_seen_and_a_crowd_of_gaps_is_summed_up(drag: Run) -> None:
    keep = np.zeros(drag.trace.time.size, dtype=bool)
    keep[:1000:10] = True
    keep[1000:] = True
    sparse = without(drag, [slice(at, at + 1) for at in np.flatnonzero(~keep)])
    figure = run_figure(sparse)
    dots = [
        artist
        for artist in panel(figure, "Force (mN)").lines
        if artist.get_marker() == "." and artist.get_color() != "k"
    ]
    assert max(len(dot.get_xdata()) for dot in dots) == 100
    assert "100 gaps, 0.9 s missing" in texts(figure)


def test_only_steady_sliding_has_a_steady_level(drag: Run, figure: Figure) -> None:
    second = replace(drag, info=replace(drag.info, header=replace(drag.info.header, kind="motion")))
    assert not any(text.startswith("steady ") for text in texts(run_figure(second)))
    assert any(text.startswith("steady ") for text in texts(figure))
