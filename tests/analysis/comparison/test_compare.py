"""Two campaigns side by side, or a campaign and the friction model."""

import json
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from uuid import uuid4

import h5py
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.text import Text

import dragrig
from dragrig.analysis.comparison.compare import PairingCandidate, pair_runs
from dragrig.analysis.comparison.comparison import (
    Comparison,
    DifferenceVerdict,
    MeasureDifference,
    RunCondition,
    RunPair,
    align_runs,
    comparison_frame,
    run_condition,
    start_of_motion,
)
from dragrig.cli import main
from dragrig.config.errors import AnalysisError, RunFileError
from dragrig.present.campaign_figures import comparison_figure, comparison_speed_figure
from dragrig.present.comparison import comparison_document
from dragrig.rig import mark_bad
from dragrig.rig.protocols.kinds import MotionProtocol
from dragrig.rig.runfile import read_run
from dragrig.rig.runfile.model import Run, RunStatus
from places import CAMPAIGN, copied_runs
from property_tests import thorough
from true_model import TRUE_MODEL


@cache
def made(plan: str, *assignments: str) -> tuple[Run, ...]:
    runs = dragrig.simulate(plan, assignments=["rig.sampling.rate_hz=500", *assignments])
    return tuple(run for run in runs if run.info.kind != "return")


BY_HAND = ("way_back=by_hand",)
"""Without the ways back, which are half of the runs."""


def drag(*assignments: str) -> Run:
    return made("drag", "speed_mm_s=10", "travel_mm=20", *assignments)[0]


@cache
def practice_against(model: str) -> Comparison:
    return dragrig.compare(CAMPAIGN, model=model)


def measure(pair: RunPair, name: str) -> MeasureDifference:
    return next(difference for difference in pair.differences if difference.measure == name)


def with_force(run: Run, change: Callable[[np.ndarray], np.ndarray]) -> Run:
    force = np.asarray(change(np.asarray(run.trace.force, dtype=float).copy()))
    return replace(run, trace=replace(run.trace, channels={**run.trace.channels, "force": force}))


def beyond(result: Comparison) -> list[str]:
    return [
        f"{group.condition}, {group.measure}" for group in result.groups if group.verdict is DifferenceVerdict.BEYOND
    ]


conditions = st.builds(
    RunCondition,
    kind=st.sampled_from(["drag", "blank"]),
    signal=st.just("force"),
    fixture=st.sampled_from(["foam", "none"]),
    speed_mm_s=st.sampled_from([5.0, 5.01, 20.0]),
    shear_strain=st.none(),
    travel_mm=st.sampled_from([-40.0, 40.0]),
    capsule=st.just((12.9, 15.2, 50.1, 60.0)),
)
candidates = st.lists(st.builds(PairingCandidate, st.text(max_size=3), conditions, st.sampled_from("xy")), max_size=8)


@given(candidates, candidates)
def test_pairs_hold_equal_runs_each_once_and_leave_none_that_could_be_paired(
    a: list[PairingCandidate], b: list[PairingCandidate]
) -> None:
    result = pair_runs(a, b)
    firsts, seconds = [entry for entry, _ in result.pairs], [second for _, second in result.pairs]
    assert len(set(firsts)) == len(firsts)
    assert len(set(seconds)) == len(seconds)
    assert all(not a[entry].condition.differs_from(b[second].condition) for entry, second in result.pairs)
    assert (len(result.alone_a), len(result.alone_b)) == (len(a) - len(firsts), len(b) - len(seconds))
    lone_a = [entry for at, entry in enumerate(a) if at not in firsts]
    lone_b = [entry for at, entry in enumerate(b) if at not in seconds]
    assert all(run_a.condition.differs_from(run_b.condition) for run_a in lone_a for run_b in lone_b)


def test_repeats_are_paired_in_order_and_the_reason_of_a_lone_run_is_said() -> None:
    base = run_condition(drag())
    slow, back = replace(base, speed_mm_s=1.0), replace(base, travel_mm=-20.0)
    a = [PairingCandidate(name, condition, "s") for name, condition in (("a1", base), ("a2", base), ("a3", slow))]
    b = [
        PairingCandidate(name, condition, "s")
        for name, condition in (("b1", base), ("b2", base), ("b3", base), ("b4", back))
    ]
    result = pair_runs(a, b)
    assert result.pairs == ((0, 0), (1, 1))
    assert "1 against 10 mm/s" in result.alone_a[0].reason
    assert "A has only 2 runs like it" in result.alone_b[0].reason
    assert "-20 against 20 mm of travel" in result.alone_b[1].reason


def test_equal_specimens_do_not_differ_and_more_friction_shows_where_there_is_friction() -> None:
    calm = made("demo", "rig.simulated.seed=1", *BY_HAND)
    again = dragrig.compare(calm, made("demo", "rig.simulated.seed=2", *BY_HAND))
    assert len(again.pairs) == len(calm)
    assert len(beyond(again)) <= 1
    rough = made("demo", "rig.simulated.seed=2", "model.friction_coefficient=0.11", *BY_HAND)
    comparison = dragrig.compare(calm, rough)
    kinds = {line.split(",")[0].split(" at")[0] for line in beyond(comparison)}
    assert kinds == {"coulomb", "drag"}
    assert all(group.value > 0 for group in comparison.groups if group.verdict is DifferenceVerdict.BEYOND)
    assert comparison.groups[0].condition.kind == "coulomb"
    assert [group.times_error for group in comparison.groups] == sorted(
        (group.times_error for group in comparison.groups), reverse=True
    )
    assert any("Coulomb, steady force: B is above A" in sentence for sentence in comparison.sentences)


def test_runs_are_aligned_on_their_motion_and_the_faster_one_is_interpolated() -> None:
    early, late = drag(), drag("rest_s=1.7303", "rig.sampling.rate_hz=1250", "rig.simulated.seed=5")
    (pair,) = dragrig.compare(early, late).pairs
    assert pair.shift_s == pytest.approx(-0.7303, abs=2e-4)
    assert any("A was sampled at 500 Hz and B at 1250 Hz: B is interpolated" in remark for remark in pair.remarks)
    assert any("rest 1 against 1.73 s" in remark for remark in pair.remarks)
    # Shifted by one sample, 60 mN of start-up would differ by tens of millinewtons.
    unlike = next(phase for phase in pair.phases if phase.phase == "accelerate")
    assert abs(unlike.largest_mN) < 10
    overlay = pair.overlay()
    assert overlay.time_s.size == pytest.approx(early.trace.time.size, abs=2)
    assert np.nanmax(np.abs(overlay.position_b - overlay.position_a)) < 0.003


@given(st.floats(-0.02, 0.02))
def test_a_clock_that_is_off_is_found(off: float) -> None:
    run = drag()
    moved = replace(run, trace=replace(run.trace, time=run.trace.time + off))
    assert align_runs(run, moved).shift_s == pytest.approx(-off, abs=1e-6)


def test_a_zero_is_taken_off_where_the_rest_shows_it_and_only_there() -> None:
    for plan, taken_off in (("blank", True), ("coulomb", True), ("drag", False)):
        (run,) = made(plan, "speed_mm_s=40", "way_back=stay")
        (pair,) = dragrig.compare(run, with_force(run, lambda force: force + 50.0)).pairs
        steady = measure(pair, "steady force")
        assert steady.value == pytest.approx(0.0 if taken_off else 50.0, abs=1e-3)
        assert (steady.zeros is not None) is taken_off
        assert pair.phases[-1].rms_mN == pytest.approx(0.0 if taken_off else 50.0, abs=1e-3)
    assert measure(pair, "above rest").value == pytest.approx(0.0, abs=1e-3)


def test_position_against_command_is_told_of_each() -> None:
    run = drag()
    late = np.interp(run.trace.time - 0.005, run.trace.time, run.trace.position)
    lagging = replace(run, trace=replace(run.trace, channels={**run.trace.channels, "position": late}))
    comparison = dragrig.compare(run, lagging)
    motion = comparison.pairs[0].motion
    assert motion.b is not None
    assert motion.b.lag_s == pytest.approx(0.005, rel=0.01)
    assert motion.b.largest_mm == pytest.approx(-0.05, rel=0.1)
    assert any("Motion of B" in sentence and "5.0 ms late" in sentence for sentence in comparison.sentences)
    assert comparison.pairs[0].shift_s == pytest.approx(-0.005, abs=1e-4)


def test_the_true_model_explains_a_foreign_campaign_and_the_papers_does_not() -> None:
    right = dragrig.compare(CAMPAIGN, model=TRUE_MODEL)
    assert right.b.is_model
    assert len(right.pairs) == len(list(CAMPAIGN.glob("*.h5")))
    assert len(beyond(right)) <= 1
    assert all(pair.motion.b is None for pair in right.pairs)
    wrong = practice_against("paper")
    assert len(beyond(wrong)) > 5
    assert max(group.times_error for group in wrong.groups) > 2 * max(group.times_error for group in right.groups)


def test_bad_aborted_and_unreadable_runs_are_left_out_with_the_reason(tmp_path: Path) -> None:
    first, folder = (copied_runs(tmp_path / name, "005-blank.h5", "010-drag.h5") for name in "ab")
    mark_bad(folder / "010-drag.h5", "capsule slipped")
    (folder / "999-drag.h5").write_bytes(b"no run")
    comparison = dragrig.compare(first, folder)
    reasons = {exclusion.item: exclusion.reason for exclusion in comparison.b.left_out}
    assert "capsule slipped" in reasons["010-drag.h5"]
    assert "999-drag.h5" in reasons
    assert [exclusion.item for exclusion in comparison.alone_a] == ["010-drag.h5"]
    named = dragrig.compare(CAMPAIGN / "010-drag.h5", folder / "010-drag.h5")
    assert "B: it is marked bad: capsule slipped" in named.pairs[0].remarks
    run = drag()
    aborted = replace(run, info=replace(run.info, status=RunStatus.ABORTED, reason="Ctrl-C"))
    partly = dragrig.compare([run, drag("rig.simulated.seed=4")], [aborted, run])
    assert [exclusion.reason for exclusion in partly.b.left_out] == ["it is aborted, not complete (Ctrl-C)"]
    assert len(partly.pairs) == len(partly.alone_a) == 1


def test_missing_numbers_leave_out_what_needs_them_and_nothing_else() -> None:
    run = drag()

    def spoil(force: np.ndarray) -> np.ndarray:
        force[1200:1210] = np.nan
        return force

    (pair,) = dragrig.compare(run, with_force(run, spoil)).pairs
    assert measure(pair, "steady force").value is None
    assert "NaN" in measure(pair, "steady force").reason
    assert measure(pair, "rest").value == 0
    assert pair.verdict is DifferenceVerdict.UNKNOWN
    assert pair.phases[-1].rms_mN == pytest.approx(0, abs=0.5)
    assert any("10 samples are missing" in remark for remark in pair.remarks)
    empty = with_force(run, lambda force: np.full_like(force, np.nan))
    with pytest.raises(AnalysisError, match="none of its samples is a number"):
        dragrig.compare(run, empty)
    nowhere = {**run.trace.channels, "position": np.full(run.trace.time.size, np.nan)}
    lost = replace(run, trace=replace(run.trace, channels=nowhere))
    assert start_of_motion(lost) == pytest.approx(1.0, abs=0.01)
    assert dragrig.compare(run, lost).pairs[0].phases


def test_the_same_campaign_twice_and_several_specimens_are_said(tmp_path: Path) -> None:
    few, copy = (copied_runs(tmp_path / name, "005-blank.h5", "010-drag.h5", "014-drag.h5") for name in ("few", "copy"))
    with pytest.raises(AnalysisError, match="are the same; name another"):
        dragrig.compare(few, few / ".." / "few")
    comparison = dragrig.compare(few, copy)
    assert any("compared with itself" in remark for remark in comparison.remarks)
    assert not beyond(comparison)
    assert all(group.value == 0 for group in comparison.groups)
    run, second = drag(), drag("specimen.name=other")
    mixed = dragrig.compare([run, second], [second])
    assert [pair.a.info.header.specimen["name"] for pair in mixed.pairs] == ["other"]
    assert any("A holds runs of several specimens: jejunum, other" in remark for remark in mixed.remarks)
    assert any("different specimens" in remark for remark in dragrig.compare(run, second).remarks)


@pytest.mark.parametrize(
    ("factors", "headline"),
    [
        (
            {2: 1.5, 5: 1.4},
            r"Drag, steady force: B is above A up to 5 mm/s, by up to [\d.]+ mN \(\+\d+ %\); from 10 mm/s on they agr",
        ),
        (
            {20: 0.5},
            r"Drag, steady force: up to 10 mm/s they agree; B is below A from 20 mm/s on, by [\d.]+ mN \(-\d+ %\)\.",
        ),
        thorough({2: 1.5, 5: 1.5, 10: 1.5, 20: 1.5}, r"Drag, steady force: B is above A from 2 to 20 mm/s, by up to "),
        thorough({2: 1.5, 10: 0.5}, r"Drag, steady force: B is above or below A in 2 of 4 conditions, by up to "),
    ],
)
def test_the_headline_is_where_the_sides_differ_and_how_many_would_by_chance(
    factors: Mapping[float, float], headline: str
) -> None:
    runs = [drag(f"speed_mm_s={speed}") for speed in (2, 5, 10, 20)]
    speeds = {run.info.header.run_id: run.info.header.protocol["speed_mm_s"] for run in runs}
    changed = [with_force(run, partial(np.multiply, factors.get(speeds[run.info.header.run_id], 1.0))) for run in runs]
    comparison = dragrig.compare(runs, changed)
    assert re.match(headline, comparison.sentences[1])
    assert comparison.sentences[1].endswith(f"({len(factors)} of 4 differ{'s' * (len(factors) == 1)}.)")
    assert dragrig.compare(runs, runs[:]).sentences[1].startswith("A and B agree: none of 4 forces differs")


def test_motions_of_several_strokes_have_no_steady_force_and_are_paired_by_their_strokes() -> None:
    there_and_back = ({"travel_mm": 10, "speed_mm_s": 10}, {"travel_mm": -10, "speed_mm_s": 10})
    run, same, other = (
        dragrig.simulate(MotionProtocol(strokes=strokes))[0]
        for strokes in (there_and_back, there_and_back, there_and_back[:1])
    )
    comparison = dragrig.compare(run, same)
    assert [str(pair.condition) for pair in comparison.pairs] == ["motion"]
    assert comparison.groups == ()
    assert comparison.pairs[0].phases
    with pytest.raises(AnalysisError, match="strokes"):
        dragrig.compare(run, other)


def test_an_altered_copy_and_opposite_directions_are_said() -> None:
    run = drag("speed_mm_s=20")
    altered = dragrig.compare([run], [with_force(run, lambda force: 0.5 * force)])
    assert any("one is an altered copy" in remark for remark in altered.remarks)
    assert not any("compared with itself" in remark for remark in altered.remarks)
    back = replace(run, trace=replace(run.trace, channels={**run.trace.channels, "position": -run.trace.position}))
    turned = dragrig.compare([run], [back])
    assert any("move in opposite directions" in remark for remark in turned.remarks)


def test_what_cannot_be_compared_is_refused_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(RunFileError, match="holds no run files"):
        dragrig.compare(CAMPAIGN, tmp_path)
    with pytest.raises(RunFileError, match="no such file or folder"):
        dragrig.compare(CAMPAIGN, tmp_path / "nowhere")
    with pytest.raises(AnalysisError, match="B has no drag run"):
        dragrig.compare(CAMPAIGN / "010-drag.h5", CAMPAIGN / "005-blank.h5")
    with pytest.raises(AnalysisError, match="either a second campaign"):
        dragrig.compare(CAMPAIGN)
    both = tmp_path / "both"
    for name in ("one", "two"):
        both.mkdir(exist_ok=True)
        with h5py.File(shutil.copy(CAMPAIGN / "005-blank.h5", both / f"{name}.h5"), "r+") as file:
            file["entry/specimen"].attrs["name"] = name
            file["entry/run" if "entry/run" in file else "entry"].attrs["run_id"] = str(uuid4())
    with pytest.raises(AnalysisError, match="has no run of specimen 'x', only of one, two"):
        dragrig.compare(both, CAMPAIGN, specimen="x")
    assert dragrig.compare(both, model="paper", specimen="two").a.specimens == ("two",)


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text)]


def test_pictures_show_both_sides() -> None:
    comparison = practice_against("paper")
    for pair in comparison.pairs:
        if pair.condition.kind in {"drag", "relaxation"} and pair.a.file in {"001-relaxation.h5", "010-drag.h5"}:
            figure = comparison_figure(pair, ("practice", "model paper"))
            labels = [line.get_label() for line in figure.axes[0].lines]
            assert {"A raw", "A", "B"} <= set(labels)
            assert figure.axes[1].get_xlabel() or figure.axes[-1].get_xlabel()
    assert {"A drag", "B drag", "B − A (mN)"} <= set(texts(comparison_speed_figure(comparison)))
    alone = dragrig.compare(CAMPAIGN / "001-relaxation.h5", model="paper")
    assert [figure.name for figure in comparison_document(alone).figures()] == []


def test_the_command_prints_writes_changes_no_run_and_ends_well_when_they_differ(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    copied_runs(tmp_path / "a", "005-blank.h5", "010-drag.h5")
    copied_runs(tmp_path / "b", "005-blank.h5", "010-drag.h5", "014-drag.h5")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.h5")}
    files = set(tmp_path.rglob("*"))
    assert main(["compare", "a", "b"]) == 0
    assert set(tmp_path.rglob("*")) == files  # nobody asked for pictures
    out = capsys.readouterr().out
    assert re.search(r"B +014-drag\.h5 +A has no drag at 60 mm/s like it", out)
    assert "2 pairs of runs, A from a, B from b; without a partner: 1 of B." in out
    folder = tmp_path / "c"
    assert main(["compare", "a", "b", "--out", "c"]) == 0
    assert "2 pictures of pairs in c" in capsys.readouterr().out
    written = {path.name for path in folder.iterdir()}
    assert written == {"005-blank.png", "010-drag.png", "comparison.csv", "steady-force.png"}
    frame = pd.read_csv(folder / "comparison.csv")
    assert list(frame.columns) == list(comparison_frame(dragrig.compare("a", "b")).columns)
    assert main(["compare", "a/010-drag.h5", "--model", "table1", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["pairs"][0]["verdict"] == "differs"
    assert answer["conditions"][0]["b_minus_a_mN"] < 0
    assert main(["compare", "a", "b", "--model", "paper"]) == 2
    assert "either a second campaign" in capsys.readouterr().err
    assert main(["compare", "a", "--model", "papr"]) == 2
    assert "did you mean paper?" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.h5")} == before
    assert read_run(tmp_path / "a" / "010-drag.h5").filtered is None
