"""`dragrig gap settle`: one campaign of batches, each with its reason, that goes on after a kill and ends for one."""

import json
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dragrig
from diagnoses import STRIBECK
from dragrig.analysis.gap import Batch, Ending, OpenCauses, SettleRecord, plan_of_next_runs
from dragrig.analysis.gap.candidate_runs import ExperimentBudget, greedy_search, short_grid
from dragrig.analysis.gap.diagnosis import NextExperiment, NextRun
from dragrig.analysis.gap.information import bits_to_change
from dragrig.analysis.gap.settling import SETTLE_FILE, batch_budget, ending_of
from dragrig.api import (
    SettleHands,
    after_diagnosis,
    lacks_runs,
    mirrored_decisions,
    read_settle_record,
    settle_request,
    take_up_settling,
)
from dragrig.api.settle import write_settle_record
from dragrig.cli import main
from dragrig.config import Plan, PlanStep, Specimen, to_toml
from dragrig.config.errors import OutputError, PlanError, RunFileError, SettingsError
from dragrig.engine_host import RigSelection, SessionFinished, SessionJob
from dragrig.present import settlement_document
from dragrig.present.numbers import to_json_value
from dragrig.present.terminal import document_text
from dragrig.rig import mark_bad
from dragrig.rig.runfile.campaigns import read_campaign, read_session_records
from dragrig.session_state import session_lock
from dragrig.setup import create_lab, resolve
from ending import kill
from engine_clients import listening
from loaded_processes import loaded_processes
from rig_faults import Person
from settled import EFFECT, FIRST, HANDS_MIN, MINUTES, begun_loop

pytestmark = pytest.mark.usefixtures("finished_here")
INTERPRETER = sys.executable
SURE = OpenCauses({"stribeck": 0.99}, 0.0, 0.97, 0.1)
SPECIMEN = Specimen(name="jejunum")
BEGUN = datetime(2026, 5, 4, 9, 30, tzinfo=UTC)
DRAG = {"kind": "drag", "wait_s": 5.0, "speed_mm_s": 5.0, "travel_mm": 20.0}


def test_a_batch_is_made_in_its_campaign_and_its_diagnosis_ends_the_loop(tmp_path: Path, shared_folder: Path) -> None:
    lab = Path(shutil.copytree(begun_loop(shared_folder).parent, tmp_path / "lab"))
    folder, record = lab / "c", read_settle_record(lab / "c")
    _, batch = record.batches
    assert batch.reason
    assert batch.runs
    assert (len(record.steps), record.ending) == (1, None)
    assert record.planned_min <= MINUTES
    assert read_settle_record(lab / "mirror" / "c") == record
    assert lacks_runs(folder, record)
    dragrig.run(batch.plan, append=folder, note=batch.reason, rig=lab / "rig.toml").session.require()
    assert not lacks_runs(folder, record)
    more = NextExperiment((NextRun(PlanStep.model_validate(DRAG), 1.0, 0.1),), 9, "Because.")
    ended = after_diagnosis(folder, record, replace(STRIBECK, open_causes=SURE, next_experiment=more))
    assert (ended.ending, ended.batches) == (Ending.TIME, record.batches)
    assert [step.spent_min for step in ended.steps] == sorted(step.spent_min for step in ended.steps)
    kinds = [run.protocol.kind for plan in (FIRST, batch.plan) for run in resolve(plan).programme().runs]
    assert sorted(run.kind for run in read_campaign(folder).runs) == sorted(kinds)
    assert SettleRecord.model_validate_json(ended.model_dump_json()) == ended
    document = settlement_document(ended, STRIBECK)
    assert batch.reason.split(" best ")[0].split(",")[0] in document_text(document)
    assert json.loads(json.dumps(to_json_value(document.data)))["settle"]["batches"][0]["plan"]["name"] == "few"


@pytest.mark.thorough
def test_one_campaign_holds_all_batches_and_every_decision(tmp_path: Path, shared_folder: Path) -> None:
    lab = Path(shutil.copytree(begun_loop(shared_folder).parent, tmp_path / "lab"))
    mirror = lab / "mirror"
    settled = dragrig.gap_settle_resume(lab / "c", hands=SettleHands(mirror=mirror))
    record = read_settle_record(settled.folder)
    assert record == settled.record
    assert len(record.batches) == len(record.steps) > 1
    assert record.ending is not None
    assert record.planned_min <= MINUTES
    spent = [step.spent_min for step in record.steps]
    assert spent == sorted(spent)
    assert all(batch.reason and batch.runs for batch in record.batches[1:])
    runs = read_campaign(settled.folder).runs
    assert len({run.header.order for run in runs}) == len(runs)
    assert sum(run.kind != "return" for run in runs) == record.steps[-1].runs
    assert len(read_session_records(settled.folder)[0]) == len(record.batches)
    assert {run.header.specimen["name"] for run in runs} == {runs[0].header.specimen["name"]}
    assert SettleRecord.model_validate_json(record.model_dump_json()) == record
    assert read_settle_record(mirror / "c") == record
    assert {path.name for path in settled.folder.glob("*.h5")} < {path.name for path in (mirror / "c").iterdir()}
    document = settlement_document(settled.record, settled.diagnosed.result)
    said = document_text(document)
    assert str(settled.record.steps[-1].runs) in document.lead[0]
    for batch in settled.record.batches[1:]:
        assert batch.reason.split(" best ")[0].split(",")[0] in said
    assert "probabilities" in [figure.name for figure in document.figures()]
    assert json.loads(json.dumps(to_json_value(document.data)))["settle"]["batches"][0]["plan"]["name"] == "few"


@pytest.mark.thorough
def test_a_killed_loop_goes_on_where_it_was(tmp_path: Path, shared_folder: Path) -> None:
    folder = Path(shutil.copytree(begun_loop(shared_folder), tmp_path / "killed"))
    command = [INTERPRETER, "-m", "dragrig", "gap", "settle", "--resume", str(folder), "--yes"]
    loop = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    # Killed once the second batch has a run, while it is made or just after.
    first = len(resolve(FIRST, backend="simulated").programme().runs)
    while len([file for file in folder.glob("*.h5") if ".recording" not in file.name]) <= first:
        assert loop.poll() is None
        time.sleep(0.02)
    kill(loop.pid)
    loop.wait()
    before = read_settle_record(folder)
    assert before.ending is None
    assert len(before.batches) == 2
    gone_on = dragrig.gap_settle_resume(folder)
    record = gone_on.record
    assert record.batches[: len(before.batches)] == before.batches
    assert record.steps[: len(before.steps)] == before.steps
    assert record.ending is not None
    complete = [run for run in read_campaign(folder).good if run.kind != "return" and run.status.value == "complete"]
    assert len(complete) == record.steps[-1].runs
    planned = [resolve(batch.plan, backend="simulated").programme().runs for batch in record.batches]
    assert len(complete) == sum(run.protocol.kind != "return" for runs in planned for run in runs)
    assert len({run.header.order for run in complete}) == len(complete)


def decided(minutes: float) -> SettleRecord:
    """Return the decisions of a loop that has just begun, by its rig time."""
    return SettleRecord(
        plan="few", begun_at=BEGUN, minutes=minutes, until=0.95, batches=(Batch(plan=FIRST, minutes=1.0),)
    )


def test_a_batch_is_not_made_again_where_a_person_went_on_with_another_plan(tmp_path: Path) -> None:
    short = Plan.model_validate({"name": "short", "steps": [{**DRAG, "travel_mm": 5.0}]})
    folder, then = tmp_path / "c", short.model_copy(update={"name": "short-then-1"})
    rarely = ("rig.sampling.rate_hz=200",)
    dragrig.run(short, out=folder, backend="simulated", assignments=rarely)
    record = decided(MINUTES).model_copy(
        update={"batches": (Batch(plan=short, minutes=1.0), Batch(plan=then, minutes=1.0))}
    )
    write_settle_record(folder, record)
    assert lacks_runs(folder, record)
    dragrig.run(then, append=folder, backend="simulated", assignments=rarely)
    assert not lacks_runs(folder, record)
    other = short.model_copy(update={"name": "another"})
    dragrig.run(other, append=folder, backend="simulated", assignments=rarely)
    assert not lacks_runs(folder, record)


def test_decisions_go_to_the_mirror_each_time_and_a_lost_mirror_stops_nothing(tmp_path: Path) -> None:
    folder, mirror, told = tmp_path / "c", tmp_path / "mirror", list[str]()
    for made in (folder, mirror):
        made.mkdir()
    with mirrored_decisions(folder, mirror, told.append) as write:
        for minutes in (10.0, 20.0):
            write(decided(minutes))
            while not (mirror / "c" / SETTLE_FILE).exists() or read_settle_record(mirror / "c") != decided(minutes):
                assert told == []
                time.sleep(0.005)
        mirror.rename(tmp_path / "away")
        write(decided(30.0))
    assert read_settle_record(folder) == decided(30.0)
    assert read_settle_record(tmp_path / "away" / "c") == decided(20.0)
    assert all(sentence.startswith(f"NOT MIRRORED: {SETTLE_FILE} is not in") for sentence in told)
    assert "there is no such folder" in told[-1]
    assert not mirror.exists()


def test_decisions_of_another_loop_in_the_mirror_are_left(tmp_path: Path) -> None:
    folder, told = tmp_path / "c", list[str]()
    other = decided(10.0).model_copy(update={"begun_at": BEGUN - timedelta(days=1)})
    for made in (folder, tmp_path / "mirror" / "c"):
        made.mkdir(parents=True)
    (tmp_path / "mirror" / "c" / SETTLE_FILE).write_text(other.model_dump_json(), "utf-8")
    with mirrored_decisions(folder, tmp_path / "mirror", told.append) as write:
        write(decided(20.0))
    assert read_settle_record(tmp_path / "mirror" / "c") == other
    assert "a file of this name is there and differs" in told[-1]


def test_a_loop_that_never_begins_leaves_nothing_in_campaign_or_mirror(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dragrig.session_state.LOCK_TIMEOUT_S", 0.1)
    folder, mirror = tmp_path / "c", tmp_path / "mirror"
    for made in (folder, mirror):
        made.mkdir()
    with session_lock(folder), pytest.raises(OutputError, match="another session"):
        dragrig.gap_settle(FIRST, minutes=MINUTES, out=folder, hands=SettleHands(mirror=mirror))
    assert not (folder / SETTLE_FILE).exists()
    assert list(mirror.iterdir()) == []
    told: list[str] = []
    hands = SettleHands(mirror=tmp_path / "none", tell=told.append)
    with pytest.raises(OutputError, match="there is no such folder; make it"):
        dragrig.gap_settle(FIRST, minutes=MINUTES, out=tmp_path / "d", hands=hands)
    assert not (tmp_path / "d").exists()
    assert told == []


def test_it_ends_for_the_reason_that_is_told() -> None:
    sure = replace(STRIBECK, open_causes=SURE)
    doubtful = replace(sure, open_causes=replace(SURE, surest=0.7))
    step = PlanStep.model_validate(DRAG)
    advised = replace(doubtful, next_experiment=NextExperiment((NextRun(step, 1.0, 0.1),), 9, "Because."))
    probability = max(entry.probability for entry in sure.ranking)
    assert ending_of(sure, min(0.95, probability), 10.0) is Ending.SETTLED
    assert ending_of(replace(doubtful, next_experiment=None), probability, 10.0) is Ending.NO_RUN
    assert ending_of(advised, 0.95, 0.1) is Ending.TIME
    assert ending_of(advised, 0.95, 10.0) is None


def test_a_batch_never_takes_more_than_is_left() -> None:
    assert batch_budget(20.0, None).minutes == pytest.approx(10.0)
    assert batch_budget(3.0, None).minutes == pytest.approx(3.0)
    assert batch_budget(-1.0, None).minutes == 0.0


def test_hands_are_asked_for_only_where_something_else_must_be_mounted() -> None:
    blank = PlanStep(kind="blank", parameters={"speed_mm_s": 40.0, "travel_mm": 40.0})
    experiment = NextExperiment(
        (NextRun(blank, 1.0, 0.2), NextRun(PlanStep.model_validate(DRAG), 1.0, 0.1)), 9, "Because."
    )
    on_foam = plan_of_next_runs(experiment, mounted="drag")
    assert [step.kind for step in on_foam.steps] == ["drag", "blank"]
    assert [bool(step.prompt) for step in on_foam.steps] == [False, True]
    assert [bool(step.prompt) for step in plan_of_next_runs(experiment).steps] == [True, True]


def test_what_cannot_be_settled_is_refused_before_anything_moves(tmp_path: Path) -> None:
    folder = tmp_path / "none"
    with pytest.raises(PlanError, match="more than the 1 minutes given"):
        dragrig.gap_settle(FIRST, minutes=1.0, out=folder)
    with pytest.raises(SettingsError, match=r"until 1\.2"):
        dragrig.gap_settle(FIRST, until=1.2, out=folder)
    with pytest.raises(SettingsError, match="minutes"):
        dragrig.gap_settle(FIRST, minutes=float("nan"), out=folder)
    for hands_min in (-1.0, float("nan"), float("inf")):
        with pytest.raises(SettingsError, match="hands"):
            dragrig.gap_settle(FIRST, hands_min=hands_min, out=folder)
        with pytest.raises(SettingsError, match="hands"):
            dragrig.gap_next("drag", hands_min=hands_min)
    assert not folder.exists()
    made = tmp_path / "made"
    dragrig.simulate(Plan.model_validate({"name": "short", "steps": [DRAG]}), out=made)
    (made / SETTLE_FILE).write_text("decided", "utf-8")
    with pytest.raises(OutputError):
        dragrig.gap_settle(FIRST, minutes=MINUTES, out=made)
    assert (made / SETTLE_FILE).read_text("utf-8") == "decided"
    tmp_path.joinpath("plain").mkdir()
    with pytest.raises(RunFileError, match=SETTLE_FILE):
        dragrig.gap_settle_resume(tmp_path / "plain")
    (tmp_path / "plain" / SETTLE_FILE).write_text("{}", "utf-8")
    with pytest.raises(RunFileError, match="cannot be read"):
        dragrig.gap_settle_resume(tmp_path / "plain")


PATIENT = (
    *("rig.stage.start_mm=5", "rig.hardware.drive.homing_speed_mm_s=50"),
    *("rig.guard.following_error_mm=100", "rig.guard.encoder_silent_mm=100", "rig.guard.stale_data_s=5"),
    *("rig.hardware.card.buffer_s=20", "rig.hardware.hang_s=5"),
    *("rig.hardware.drive.reply_s=2", "rig.hardware.drive.silence_s=5"),
)
"""A rig that waits as long as may be set, for a busy machine is no fault."""


@pytest.fixture(scope="module")
def on_the_double(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign of a run on the double of the real rig, one of whose two drags is missing, with decisions in it."""
    lab = tmp_path_factory.mktemp("lab")
    create_lab(lab)
    drag = {**DRAG, "wait_s": 0.0, "speed_mm_s": [20.0, 10.0], "travel_mm": 2.0, "way_back": "stay"}
    plan = Plan.model_validate({"name": "short", "steps": [drag]})
    made = dragrig.run(
        plan,
        out=lab / "c",
        person=Person(),
        pace=5.0,
        rig=lab / "rig.toml",
        backend="hardware",
        double=True,
        assignments=PATIENT,
    )
    made.session.require()
    mark_bad(made.files[-1], "slipped")
    write_settle_record(lab / "c", take_up_settling(lab / "c", 20.0))
    return made.folder


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_no_other_backend_goes_on_with_a_campaign(on_the_double: Path) -> None:
    before = contents(on_the_double)
    with (
        loaded_processes(),
        listening(RigSelection(rig=on_the_double.parent / "rig.toml", backend="simulated")) as host,
    ):
        for words, job in (
            ("made on the double of hardware; open the window for that", SessionJob(1, "", resume=on_the_double)),
            (
                "made on the double of hardware, not on simulated; start a campaign of its own",
                SessionJob(2, Plan.model_validate({"name": "more", "steps": [DRAG]}), append=on_the_double),
            ),
        ):
            host.client.ask(job)
            ended = host.until(SessionFinished)
            assert isinstance(ended, SessionFinished)
            assert ended.status is None
            assert words in ended.reason
    assert contents(on_the_double) == before


@pytest.mark.parametrize(
    "other", [("--backend", "simulated"), ("--double",), ("--rig", "my.toml"), ("--set", "rig.x=1")]
)
def test_the_command_goes_on_with_the_rig_of_the_campaign_alone(
    other: tuple[str, ...], on_the_double: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(on_the_double)
    assert main(["gap", "settle", "--resume", str(on_the_double), "--yes", *other]) == 2
    assert "--resume goes on as it began: only --minutes may be changed" in capsys.readouterr().err
    assert contents(on_the_double) == before


@dataclass(frozen=True)
class Told:
    """A question of which every run tells a number of bits of its own."""

    open_bits: float = 10.0
    bits: float = 0.0
    bits_to_change: float = 0.0

    def with_run(self, observation: float) -> "Told":
        return replace(self, bits=self.bits + observation)

    def about(self, before: "Told") -> tuple[str, ...]:
        return ()


@pytest.mark.parametrize(("hands_min", "first"), [(0.0, "blank"), (2.0, "blank"), (60.0, "drag")])
def test_the_more_a_change_costs_the_more_a_run_must_tell_that_needs_one(hands_min: float, first: str) -> None:
    blank = next(run for run in short_grid(SPECIMEN) if run.step.kind == "blank")
    drag = next(run for run in short_grid(SPECIMEN) if run.step.kind == "drag")
    candidates = [(drag, 0.1 * drag.minutes), (blank, 0.1 * (blank.minutes + 3.0))]
    budget = ExperimentBudget(runs=1, mounted="drag", hands_min=hands_min)
    assert [run.step.kind for run in greedy_search(Told(), candidates, budget)] == [first]


@pytest.mark.parametrize(("sure", "worth"), [(0.5, True), (0.9, True), (0.97, False), (1.0, False)])
def test_no_run_is_worth_its_time_where_a_dozen_would_hardly_change_the_answer(sure: float, worth: bool) -> None:
    """Each run tells 0.006 bit: enough together to doubt what is 90 % sure, and not what is 97 % sure."""
    question = Told(bits_to_change=bits_to_change([1.0 - sure, sure]))
    candidates = [(run, 0.006) for run in short_grid(SPECIMEN)]
    assert bool(greedy_search(question, candidates, ExperimentBudget(runs=1))) is worth


@given(st.lists(st.floats(1e-3, 1.0), min_size=2, max_size=5), st.lists(st.floats(1e-3, 1.0), min_size=5, max_size=5))
def test_no_outcome_changes_an_answer_with_less_information_than_that(weights: list[float], after: list[float]) -> None:
    before, now = (np.array(values) / sum(values) for values in (weights, after[: len(weights)]))
    if np.argmax(now) != np.argmax(before):
        assert now @ np.log2(now / before) >= bits_to_change(before.tolist()) - 1e-9


@pytest.mark.thorough
def test_the_command_takes_the_cost_of_hands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan, folder = tmp_path / "few.toml", tmp_path / "c"
    plan.write_text(to_toml(FIRST), "utf-8")
    # No time is left after the first runs, so that hardly any next ones are weighed.
    words = ["--minutes", "1.2", "--hands", "7", "--effect", EFFECT, "--out", str(folder), "--yes", "--json"]
    assert main(["gap", "settle", str(plan), *words]) == 0
    assert json.loads(capsys.readouterr().out)["settle"]["hands_min"] == 7.0
    assert read_settle_record(folder).hands_min == 7.0


def test_the_cost_of_hands_is_kept_and_holds_when_the_loop_goes_on(
    tmp_path: Path, shared_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(shutil.copytree(begun_loop(shared_folder), tmp_path / "c"))
    record = read_settle_record(folder)
    budget = settle_request(folder, record).next_runs
    assert budget is not None
    assert (record.hands_min, budget.hands_min) == (HANDS_MIN, HANDS_MIN)
    assert main(["gap", "settle", "--resume", str(folder), "--hands", "1"]) == 2
    assert "only --minutes may be changed" in capsys.readouterr().err
    older = json.loads((folder / SETTLE_FILE).read_text("utf-8"))
    del older["hands_min"]
    (folder / SETTLE_FILE).write_text(json.dumps(older), "utf-8")
    assert read_settle_record(folder).hands_min == 2.0


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["first", "--resume", "there"],
        ["--resume", "there", "--until", "0.9"],
        ["first", "--until", "2"],
        ["first", "--hands", "-1"],
        ["first", "--hands", "nan"],
    ],
)
def test_the_command_refuses_what_makes_no_sense(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gap", "settle", *arguments]) == 2
    assert "Traceback" not in capsys.readouterr().err
