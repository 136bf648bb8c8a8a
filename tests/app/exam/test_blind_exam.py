"""An exam of the diagnosis: balanced cases, sealed answers, what is kept, what is said of it."""

import json
import multiprocessing
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from hashlib import sha256
from pathlib import Path
from shutil import copy2, copytree

import psutil
import pytest

from clusters import dask_cluster
from dragrig.cli import main
from dragrig.config.errors import AnalysisError, OutputError, SettingsError
from dragrig.exam.blind_exam import (
    BlindExam,
    CampaignOrder,
    draw_cases,
    gap_blind,
    open_exam_folder,
    seal_answers,
    simulate_campaign,
    write_json,
)
from dragrig.exam.examinee import BlindDiagnosis, BlindTask, diagnose_blind
from dragrig.present.numbers import to_json_value
from dragrig.sim_backend.blind import CATALOGUE, parallel_session, write_campaign
from driving import until
from exam_pieces import diagnosis_killed_once, quick_diagnosis
from exams import StoppedError, make_campaigns
from hidden import thinned
from loaded_processes import loaded_processes
from property_tests import thorough

SEED = 611_203
"""Of the short exam; it was drawn once, and nothing was adjusted to it."""


@pytest.fixture(scope="module", autouse=True)
def starting_at_once() -> Iterator[None]:
    """Start workers of a process that has loaded what they need."""
    with loaded_processes():
        yield


def test_the_mix_is_balanced() -> None:
    cases = draw_cases(240, 5)
    kinds = Counter(case.kind for case in cases)
    assert [kinds[kind] for kind in ("full", "third", "tenth", "none", "outside")] == [96, 36, 24, 24, 24]
    assert kinds["pair"] + kinds["rough"] + kinds["rough none"] == 36
    singles = Counter(case.effects[0] for case in cases if case.kind in {"full", "third", "tenth", "rough"})
    assert set(singles) == set(CATALOGUE)
    assert max(singles.values()) - min(singles.values()) <= 3
    assert len({case.seed for case in cases}) == len(cases)
    assert draw_cases(240, 5) == cases
    assert draw_cases(240, 6) != cases


def test_who_diagnoses_does_not_load_the_plant() -> None:
    code = "import sys, dragrig.exam.examinee as one; one.diagnose_blind(one.BlindTask(one.Path('gone')));" + (
        "print([name for name in sys.modules if name.startswith(('dragrig.sim_backend.blind', 'dragrig.exam.blind'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_answers_are_sealed_and_a_changed_plant_is_noticed(tmp_path: Path) -> None:
    planned = draw_cases(3, 8)
    with open_exam_folder(tmp_path / "exam", 3, 8, "exam") as folder:
        digest = seal_answers(folder, planned)
        assert seal_answers(folder, planned) == digest
        assert not (folder.root / "answers.json").exists()
        with pytest.raises(AnalysisError, match="other answers than were sealed"):
            seal_answers(folder, draw_cases(3, 9))


def test_a_campaign_is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    [case] = draw_cases(1, 8)
    order = CampaignOrder(case, tmp_path / "campaigns" / "0001", tmp_path / "fresh" / "0001")
    simulate_campaign(order)
    assert len(list(order.campaign.glob("*.h5"))) >= 27
    assert sorted(path.name for path in tmp_path.rglob("0001*")) == ["0001", "0001"]
    before = {path: path.stat().st_mtime_ns for path in order.campaign.iterdir()}
    simulate_campaign(order)
    assert {path: path.stat().st_mtime_ns for path in order.campaign.iterdir()} == before
    assert [path.name for path in (tmp_path / "campaigns").iterdir()] == ["0001"]


def test_a_folder_of_another_exam_or_of_something_else_is_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "exam"
    busy = pytest.raises(OutputError, match="another program uses it")
    with open_exam_folder(out, 12, 3, "exam"), busy, open_exam_folder(out, 12, 3, "exam"):
        pass
    with pytest.raises(SettingsError, match="exam of 12 cases with seed 3; give --cases 12 --seed 3"):
        gap_blind(13, 3, out)
    assert main(["gap", "blind", "--cases", "12", "--seed", "4", "--out", str(out)]) == 2
    assert "holds an exam of 12 cases with seed 3" in capsys.readouterr().err
    (tmp_path / "precious.txt").write_text("mine", "utf-8")
    with pytest.raises(OutputError, match="no exam; name an empty or a new folder"):
        gap_blind(12, 3, tmp_path)


@pytest.mark.parametrize(
    ("arguments", "answer"),
    [
        (["--cases", "0"], "at least one case"),
        (["--seed", "-1"], "whole number from 0 on"),
        (["--workers", "0"], "at least one worker"),
        (["--workers", "2", "--scheduler", "tcp://127.0.0.1:1"], "give one"),
        (["--scheduler", "tcp://127.0.0.1:1"], "needs --out"),
        (["--report", "gone/report.html"], "there is no folder gone"),
    ],
)
def test_what_cannot_be_asked_for_is_told(
    arguments: list[str], answer: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["gap", "blind", *arguments]) == 2
    assert answer in capsys.readouterr().err


def report_text(exam: BlindExam) -> str:
    document = dict(exam.document())
    document.pop("timings_s")
    return json.dumps(to_json_value(document))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, BlindExam]:
    """An exam of two cases that nothing disturbed, of few runs, quickly diagnosed."""
    out = tmp_path_factory.mktemp("exams") / "whole"
    make_few_runs(out, 2, 5)
    return out, gap_blind(2, 5, out, workers=2, sizes=False, diagnose=quick_diagnosis)


def make_few_runs(out: Path, cases: int, seed: int, *sessions: str) -> None:
    """Make few runs of each campaign beforehand: what an exam finds it does not simulate."""
    with open_exam_folder(out, cases, seed, "exam"):
        for case in draw_cases(cases, seed):
            for part in sessions or ("campaigns", "fresh"):
                whole = parallel_session(case.secret, "fresh") if part == "fresh" else case.secret
                write_campaign(thinned(whole, 6), out / part / case.name)


def run_digests(exam: Path) -> dict[str, str]:
    return {path.relative_to(exam).as_posix(): sha256(path.read_bytes()).hexdigest() for path in exam.glob("*/*/*.h5")}


def stopped_midway(out: Path, diagnose: Callable[[BlindTask], BlindDiagnosis]) -> BlindExam:
    """Hold an exam of two cases that is stopped once its first diagnosis is kept, and goes on."""
    calls: list[tuple[int, int]] = []

    def stop_after_a_diagnosis(done: int, of: int) -> None:
        calls.append((done, of))
        if (out / "said").is_dir():
            raise StoppedError

    with pytest.raises(StoppedError):
        gap_blind(2, 5, out, workers=1, sizes=False, diagnose=diagnose, progress=stop_after_a_diagnosis)
    [path] = (out / "said").glob("*.json")
    before = path.stat().st_mtime_ns
    assert not (out / "answers.json").exists()
    again = gap_blind(2, 5, out, workers=1, sizes=False, diagnose=diagnose)
    assert path.stat().st_mtime_ns == before
    assert calls[0][1] == calls[-1][1]
    return again


def test_two_exams_with_one_seed_are_the_same_though_one_was_stopped_midway(
    whole: tuple[Path, BlindExam], tmp_path: Path
) -> None:
    out, exam = whole
    make_few_runs(tmp_path / "stopped", 2, 5)
    assert report_text(stopped_midway(tmp_path / "stopped", quick_diagnosis)) == report_text(exam)
    assert run_digests(tmp_path / "stopped") == run_digests(out)
    text = (out / "answers.json").read_bytes()
    assert (out / "answers.sha256").read_text("utf-8").split()[0] == sha256(text).hexdigest()
    assert exam.answers_sha256 == sha256(text).hexdigest()
    kept_score = json.loads((out / "score.json").read_text("utf-8"))
    assert kept_score == json.loads(json.dumps(to_json_value(exam.document())))


@pytest.mark.thorough
def test_two_real_exams_with_one_seed_are_the_same_though_one_was_stopped_midway(tmp_path: Path) -> None:
    made = make_campaigns(2, 5, tmp_path / "whole", workers=2)
    assert make_campaigns(2, 5, tmp_path / "stopped", workers=1) == made
    assert len(made) > 80
    exam = gap_blind(2, 5, tmp_path / "whole", workers=2, sizes=False)
    assert report_text(stopped_midway(tmp_path / "stopped", diagnose_blind)) == report_text(exam)


@pytest.mark.parametrize("on_a_cluster", [False, thorough(True)], ids=["processes", "cluster"])
def test_an_exam_whose_worker_is_killed_while_it_diagnoses_is_the_same_exam(
    on_a_cluster: bool, whole: tuple[Path, BlindExam], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # On a busy machine a cluster's processes take long to start.
    monkeypatch.setattr("dragrig.parallel.CLUSTER_TIMEOUT_S", 100)
    out = tmp_path / "killed"
    for part in ("campaigns", "fresh"):
        copytree(whole[0] / part, out / part)
    copy2(whole[0] / "exam.json", out)
    with dask_cluster() if on_a_cluster else nullcontext() as scheduler:
        exam = gap_blind(
            2, 5, out, workers=None if on_a_cluster else 1, scheduler=scheduler, sizes=False,
            diagnose=diagnosis_killed_once,
        )  # fmt: skip
    assert psutil.pid_exists(int(out.with_suffix(".killed").read_text("utf-8"))) is False
    assert report_text(exam) == report_text(whole[1])


def frozen_while_it_writes(exam: int, out: Path) -> psutil.Process:
    """Stop the worker of an exam's process, and leave it so, while there is a folder that it has begun."""
    deadline = time.monotonic() + 600
    while time.monotonic() < deadline:
        if unfinished(out):
            [worker] = [child for child in psutil.Process(exam).children() if "spawn_main" in " ".join(child.cmdline())]
            worker.suspend()
            if unfinished(out):
                return worker
            worker.resume()
        time.sleep(0.005)
    raise AssertionError("no campaign was begun")


def unfinished(out: Path) -> list[Path]:
    return [*out.glob("campaigns/.0001-*"), *out.glob("fresh/.0001-*")]


def test_what_a_killed_worker_had_begun_to_write_is_cleared_once_the_exam_goes_on(tmp_path: Path) -> None:
    out, [case] = tmp_path / "exam", draw_cases(1, 5)
    order = CampaignOrder(case, out / "campaigns" / case.name, out / "fresh" / case.name)
    worker = multiprocessing.get_context("spawn").Process(target=simulate_campaign, args=(order,))
    with open_exam_folder(out, 1, 5, "exam"):
        worker.start()
        until(lambda: bool(unfinished(out)))
        worker.kill()
        worker.join()
    [begun] = unfinished(out)
    others = [begun.with_name(".mine"), begun.with_name(".0002-mine.begun")]
    for path in others:
        path.mkdir()
    make_few_runs(out, 1, 5)
    gap_blind(1, 5, out, workers=1, sizes=False, diagnose=quick_diagnosis)
    assert unfinished(out) == []
    assert all(path.is_dir() for path in others)


@pytest.mark.thorough
def test_what_a_killed_exam_had_begun_to_write_is_cleared_once_it_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "exam"
    make_few_runs(out, 1, 5, "fresh")
    arguments = ["gap", "blind", "--cases", "1", "--seed", "5", "--workers", "1", "--quiet", "--out", str(out)]
    with subprocess.Popen([sys.executable, "-m", "dragrig", *arguments]) as exam:
        worker = frozen_while_it_writes(exam.pid, out)
        begun = unfinished(out)
        assert main(arguments) == 2
        assert "another program uses it" in capsys.readouterr().err
        assert unfinished(out) == begun
        exam.kill()
        worker.kill()
        psutil.wait_procs([worker])
    others = [begun[0].with_name(".mine"), begun[0].with_name(".0002-mine.begun")]
    for path in others:
        path.mkdir()

    def stop_when_made(done: int, of: int) -> None:
        raise StoppedError

    with pytest.raises(StoppedError):
        gap_blind(1, 5, out, workers=1, sizes=False, progress=stop_when_made)
    assert unfinished(out) == []
    assert all(path.is_dir() for path in others)
    assert len(list((out / "campaigns" / "0001").glob("*.h5"))) >= 27


@pytest.mark.thorough
def test_what_a_killed_worker_had_begun_to_write_is_cleared_by_its_exam(tmp_path: Path) -> None:
    out = tmp_path / "exam"
    make_few_runs(out, 1, 5, "fresh")
    [case] = draw_cases(1, 5)
    with open_exam_folder(out, 1, 5, "exam") as folder:
        first = {"hypothesis": "+".join(case.effects), "probability": 0.9}
        write_json(folder.result("said", case.name), {"verdict": "effect", "effects": case.effects, "ranking": [first]})
        write_json(folder.result("amounts", case.name), {"d": 30.0})
    arguments = ["gap", "blind", "--cases", "1", "--seed", "5", "--workers", "1", "--quiet", "--out", str(out)]
    with subprocess.Popen([sys.executable, "-m", "dragrig", *arguments], stdout=subprocess.DEVNULL) as exam:
        frozen_while_it_writes(exam.pid, out).kill()
        assert exam.wait() == 0
    assert unfinished(out) == []
    assert len(list((out / "campaigns" / "0001").glob("*.h5"))) >= 27


@pytest.mark.thorough
def test_the_diagnosis_is_as_right_as_it_was() -> None:
    """A short exam. Where 93 % of verdicts are right, one such exam in a hundred and twenty has fewer than 9 of 12."""
    exam = gap_blind(12, SEED, workers=2, sizes=False)
    score = exam.score
    assert exam.failed == {}
    assert len(score.missed) <= 3
    assert score["all, wrong above 0.8"].held <= 1
    assert score["full size, right name"].held >= 3
    assert score.calibration.brier_skill > 0.5
    assert score.promises.kept.held >= 0.6 * score.promises.kept.count > 0


def test_the_command_prints_what_the_exam_says_and_writes_its_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An exam that was held already, as its folder has it."""
    out, message = tmp_path / "exam", {"timings_s": {}}
    planned = draw_cases(2, 5)
    with open_exam_folder(out, 2, 5, "exam") as folder:
        seal_answers(folder, planned)
        for case in planned:
            for place in (folder.campaign(case.name), folder.fresh(case.name)):
                place.mkdir(parents=True)
            verdict = "effect" if len(case.effects) == 1 else "no_gap"
            first = {"hypothesis": "+".join(case.effects) or "no_gap", "probability": 0.9}
            write_json(
                folder.result("said", case.name),
                {**message, "verdict": verdict, "effects": case.effects, "ranking": [first]},
            )
            write_json(folder.result("amounts", case.name), {"d": 30.0})
        write_json(folder.result("said", "0002"), {"failed": "it broke"})
    report = tmp_path / "exam.html"
    arguments = ["gap", "blind", "--cases", "2", "--seed", "5", "--out", str(out), "--quiet"]
    assert main([*arguments, "--report", str(report)]) == 2
    output = capsys.readouterr()
    assert "1 of 1 verdicts are right" in output.out
    assert "1 of 2 campaigns were not diagnosed; of 0002: it broke" in output.err
    assert "verdicts are right" in report.read_text("utf-8")
    assert main([*arguments, "--json"]) == 2
    document = json.loads(capsys.readouterr().out)
    assert document["failed"] == {"0002": "it broke"}
    assert document["rates"][0]["name"] == "full size, right name"
    text = (out / "answers.json").read_bytes()
    assert document["answers_sha256"] == sha256(text).hexdigest()
