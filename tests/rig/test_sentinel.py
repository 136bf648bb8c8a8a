"""Sentinels: where a plan has them, what they say of the specimen, who decides when it drifted, what is recorded."""

from collections.abc import Sequence
from pathlib import Path

import pytest
from click.testing import CliRunner

import dragrig
from dragrig.analysis.measures import table_rows
from dragrig.cli.commands import dragrig_group
from dragrig.config.errors import DragrigError, PlanError
from dragrig.config.plan import Plan, SentinelSettings
from dragrig.config.settings import parse
from dragrig.config.specimen import Specimen
from dragrig.rig.operator import Answer, NullOperator, Prompt
from dragrig.rig.programme import Programme, build_programme
from dragrig.rig.runfile import read_campaign, read_note
from dragrig.rig.runfile.model import RunStatus
from dragrig.rig.sentinel import Drift, SteadyForce
from dragrig.run_listing import RunQuery

pytestmark = pytest.mark.usefixtures("finished_here")

DRAG: dict[str, object] = {"kind": "drag", "speed_mm_s": 20.0, "travel_mm": 20.0, "hold_s": 0.5, "wait_s": 1}
WATCH: dict[str, object] = {**DRAG, "speed_mm_s": 10.0}
ALWAYS_DRIFTED = 1e-6


def plan_of(sentinel: dict[str, object], *steps: dict[str, object]) -> Plan:
    return parse(Plan, {"name": "watched", "sentinel": {**WATCH, **sentinel}, "steps": list(steps)}, "p.toml")


def laid_out(sentinel: dict[str, object], *steps: dict[str, object]) -> Programme:
    return build_programme(plan_of(sentinel, *steps), Specimen(name="jejunum"), 40.0, "p.toml")


def order_of(programme: Programme) -> str:
    """S for a sentinel, the first letter of its kind for any other run; without return strokes."""
    return "".join("S" if run.sentinel else run.protocol.kind[0] for run in programme.runs if run.follows < 0)


class Decides(NullOperator):
    """Answers the questions after sentinels from a list, then goes on; says done to anything else."""

    attended = True

    def __init__(self, *answers: Answer) -> None:
        self.answers = list(answers)
        self.asked: list[str] = []
        self.told: list[Drift] = []

    def ask(self, prompt: Prompt) -> Answer:
        if not prompt.can_measure:
            return Answer.DONE
        self.asked.append(prompt.text)
        return self.answers.pop(0) if self.answers else Answer.DONE

    def sentinel_compared(self, drift: Drift) -> None:
        self.told.append(drift)


@pytest.mark.parametrize(
    ("every", "steps", "runs"),
    [
        (0, [{**DRAG, "repeats": 4}], "SddddS"),
        (2, [{**DRAG, "repeats": 5}], "SddSddSdS"),
        (3, [{**DRAG, "repeats": 2}, {**DRAG, "repeats": 2, "order": "random"}], "SdddSdS"),
        # Capsules are not changed for it.
        (1, [{"kind": "relaxation", "shear_strain": 1}, DRAG, {"kind": "blank", "speed_mm_s": 20}], "rSdSb"),
        # Nothing comes between a run and one that begins at its end.
        (1, [{**DRAG, "travel_mm": [20, -20], "way_back": "stay"}], "SddS"),
        (1, [{**DRAG, "way_back": "by_hand", "repeats": 2}], "SdSdS"),
    ],
)
def test_sentinels_come_first_last_and_after_every_so_many_runs(
    every: int, steps: list[dict[str, object]], runs: str
) -> None:
    programme = laid_out({"every": every}, *steps)
    assert order_of(programme) == runs
    assert [run.index for run in programme.runs] == list(range(len(programme.runs)))
    for run, after in zip(programme.runs, programme.runs[1:], strict=False):
        assert not run.sentinel or (after.follows == run.index and after.end_mm == pytest.approx(run.start_mm))


def test_the_first_sentinel_asks_what_its_step_prepares_and_a_return_by_hand_comes_before_it() -> None:
    programme = laid_out({"every": 1}, {**DRAG, "way_back": "by_hand", "repeats": 2, "prompt": "fit"})
    prompts = [run.prompt for run in programme.runs if run.follows < 0]
    assert prompts == ["fit", "", "Return the capsule to its start by hand, outside the gut", "", ""]


@pytest.mark.parametrize(
    ("sentinel", "words"),
    [
        ({"speed_mm_s": [5, 10]}, "is 2 runs"),
        ({"capsule": "smooth"}, "no step has capsule smooth, gut on foam mounted"),
        ({"evry": 3}, "did you mean every?"),
        ({"fixture": "none"}, "without sliding"),
    ],
)
def test_a_sentinel_that_cannot_be_is_refused_in_a_sentence(sentinel: dict[str, object], words: str) -> None:
    with pytest.raises(PlanError, match=words.replace("?", r"\?")) as refused:
        laid_out(sentinel, DRAG)
    assert "p.toml: sentinel" in str(refused.value)


def test_a_plan_with_a_sentinel_counts_its_runs_before_anything_moves(tmp_path: Path) -> None:
    checked = dragrig.check(plan_of({"every": 2}, {**DRAG, "repeats": 3}))
    assert len(checked.previews) == 12
    plain = dragrig.check(parse(Plan, {"name": "plain", "steps": [{**DRAG, "repeats": 3}]}, "p.toml"))
    assert checked.duration_s > plain.duration_s + 3 * 4
    file = tmp_path / "p.toml"
    file.write_text(
        'name = "p"\n[sentinel]\nspeed_mm_s = 10\n[[steps]]\nkind = "drag"\nspeed_mm_s = 20\n', encoding="utf-8"
    )
    shown = CliRunner().invoke(dragrig_group, ["check", str(file)]).output
    assert "6 runs, 2 of them sentinels" in shown
    assert shown.count("sentinel drag 10 mm/s") == 2


@pytest.mark.parametrize(
    ("settings", "percent", "error_mN", "asks"),
    [
        ({}, 9.0, 0.1, False),
        ({}, -11.0, 0.1, True),
        ({"drift_percent": 20.0}, -11.0, 0.1, False),
        ({"drift_errors": 3.0}, 9.0, 1.0, True),
        ({"drift_errors": 3.0}, 9.0, 4.0, False),
        ({"drift_errors": 3.0, "drift_percent": 10.0}, 9.0, 1.0, False),
    ],
)
def test_a_drift_is_judged_by_the_bounds_that_are_given(
    settings: dict[str, float], percent: float, error_mN: float, *, asks: bool
) -> None:
    first, later = SteadyForce(0, 100.0, error_mN), SteadyForce(7, 100.0 + percent, error_mN)
    drift = Drift(later, first, parse(SentinelSettings, settings, "p.toml").bounds)
    assert drift.percent == pytest.approx(percent)
    assert drift.error_percent == pytest.approx(error_mN * (1 + (1 + percent / 100) ** 2) ** 0.5)
    assert drift.needs_decision is asks
    assert ("beyond" in str(drift)) is asks


def test_what_cannot_be_measured_is_asked_about() -> None:
    lost = SteadyForce(7, None, reason="12 samples are clipped")
    assert Drift(lost, SteadyForce(0, 100.0, 1.0), SentinelSettings().bounds).needs_decision
    assert Drift(lost, None, SentinelSettings().bounds).needs_decision
    assert "12 samples are clipped" in str(Drift(lost, None, SentinelSettings().bounds))


def made(folder: Path, person: NullOperator | None, sentinel: dict[str, object], repeats: int = 3) -> dragrig.Made:
    plan = plan_of({"every": 2, **sentinel}, {**DRAG, "repeats": repeats})
    return dragrig.run(plan, out=folder, person=person, assignments=["rig.sampling.rate_hz=200"])


def sentinels(folder: Path) -> Sequence[str]:
    return [row.file for row in table_rows(folder) if row.role == "sentinel"]


def test_a_drifted_sentinel_is_measured_once_more_and_then_the_operator_decides(tmp_path: Path) -> None:
    person = Decides(Answer.MEASURE, Answer.DONE, Answer.DONE)
    result = made(tmp_path / "c", person, {"every": 1, "drift_percent": ALWAYS_DRIFTED}, repeats=2)
    assert result.session.status is RunStatus.COMPLETE
    assert len(person.asked) == 3
    assert [drift.measured.order for drift in person.told] == [0, 4, 6, 10]
    assert {drift.reference.order for drift in person.told if drift.reference} == {0}
    campaign = read_campaign(tmp_path / "c")
    by_order = {run.header.order: run for run in campaign.runs}
    assert [order for order, run in sorted(by_order.items()) if run.is_sentinel] == [0, 4, 6, 10]
    assert not campaign.marks
    assert len(RunQuery(kind="sentinel").of(campaign)) == 4
    assert len(RunQuery(kind="drag").of(campaign)) > 4
    assert "measured once more, decided by the operator" in read_note(by_order[4].path)
    assert "go on, decided by the operator" in read_note(by_order[6].path)
    # What was known of the specimen when a run began stands in its file.
    after = by_order[8].header.entry
    assert after["sentinel_run"] == 6
    assert after["sentinel_drift_percent"] == pytest.approx(person.told[2].percent)
    assert after["sentinel_decision"] == "go on, decided by the operator"
    assert "sentinel_decision" not in by_order[2].header.entry


@pytest.mark.thorough
def test_within_its_bound_nobody_is_asked(tmp_path: Path) -> None:
    person = Decides()
    made(tmp_path / "c", person, {"drift_percent": 60.0}, repeats=1)
    assert not person.asked
    assert len(person.told) == 2
    assert [row.role for row in table_rows(tmp_path / "c")].count("sentinel") == 2
    assert len(RunQuery(kind="sentinel").of(read_campaign(tmp_path / "c"))) == 2
    assert len(RunQuery(kind="drag").of(read_campaign(tmp_path / "c"))) > 2


def test_the_operator_may_end_and_a_resumed_campaign_asks_again_and_keeps_its_reference(tmp_path: Path) -> None:
    folder = tmp_path / "c"
    ended = made(folder, Decides(Answer.ABORT), {"every": 1, "drift_percent": ALWAYS_DRIFTED}, repeats=2)
    assert (ended.session.status, ended.session.reason) == (RunStatus.ABORTED, "ended after a sentinel")
    person = Decides()
    assert dragrig.resume(folder, person=person).session.status is RunStatus.COMPLETE
    assert len(person.asked) == 2
    assert "Sentinel, run 4" in person.asked[0]
    assert "from run 0" in person.asked[1]
    assert len(sentinels(folder)) == 3


def test_yes_goes_on_says_so_and_records_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    keys = "".join(f"{key} = {value!r}\n".replace("'", '"') for key, value in DRAG.items())
    text = f'name = "p"\n[sentinel]\n{keys}drift_percent = {ALWAYS_DRIFTED}\n[[steps]]\n{keys}'
    Path("p.toml").write_text(text, encoding="utf-8")
    result = CliRunner().invoke(dragrig_group, ["run", "p.toml", "--yes", "--out", "c"])
    assert result.exit_code == 0, result.output
    assert "--yes goes on" in result.stderr
    last = [run for run in read_campaign(Path("c")).runs if run.is_sentinel][-1]
    assert "go on, nobody was asked (--yes)" in read_note(last.path)


def test_a_plan_keeps_its_sentinel_where_it_is_written_and_edited() -> None:
    from dragrig.views import form_from_plan

    plan = plan_of({"every": 2}, DRAG)
    form = form_from_plan(plan, "p.toml")
    assert form.filled([step.values for step in form.groups]) == plan
    assert build_programme(plan, Specimen(name="g"), 40.0, "p.toml").runs[0].sentinel
    with pytest.raises(DragrigError):
        plan_of({"drift_percent": -1}, DRAG)
