"""What commands find by a Dask cluster is what they find by processes of their own, though a worker is killed at it."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from clusters import dask_cluster, wait_for_workers, worker_killed_at_its_second
from dragrig.analysis.gap.features import CALIBRATION_FILE as CALIBRATION
from dragrig.cli import main
from dragrig.exam.blind_exam import draw_cases, open_exam_folder, write_json
from dragrig.exam.examinee import diagnose_blind
from exams import make_campaigns
from places import CAMPAIGN, ROOT

pytestmark = pytest.mark.thorough
SHIPPED = ROOT / "config" / "files"
CASES, SEED = 3, 5


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    with dask_cluster() as address:
        wait_for_workers(address, 2)
        yield address


@pytest.fixture
def campaigns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return two campaigns, the second without its relaxation, and an empty folder between them.

    Files with a model and a calibration are beside them, in a folder that no worker works in.
    """
    shutil.copytree(CAMPAIGN, tmp_path / "first")
    shutil.copytree(CAMPAIGN, tmp_path / "second")
    (tmp_path / "second" / "001-relaxation.h5").unlink()
    (tmp_path / "empty").mkdir()
    shutil.copy(SHIPPED / "models" / "paper.toml", tmp_path / "mine.toml")
    shutil.copy(CALIBRATION, tmp_path / "learnt.json")
    monkeypatch.chdir(tmp_path)
    return ["first", "empty", "second"]


def json_answers(command: list[str], capsys: pytest.CaptureFixture[str], code: int) -> list[dict[str, object]]:
    """Return what a command says of each campaign for programs, less how long it took."""
    assert main([*command, "--json", "--quiet"]) == code
    documents = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    for document in documents:
        document.pop("timings_s", None)
    return documents


def files_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize(
    "command",
    [
        ["gap", "diagnose", "--nominal", "mine.toml", "--calibration", "learnt.json"],
        ["identify", "--model", "mine.toml"],
    ],
    ids=["diagnose", "identify"],
)
def test_a_cluster_says_the_same_of_campaigns_as_workers_do(
    command: list[str], cluster: str, campaigns: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [*command, *campaigns]
    here = json_answers([*arguments, "--workers", "1"], capsys, 2)
    assert [(row["source"], "error" in row) for row in here] == [("first", False), ("empty", True), ("second", False)]
    assert json_answers([*arguments, "--scheduler", cluster], capsys, 2) == here


def score_in(exam: Path) -> dict[str, object]:
    """Return an exam's score, less how long it took."""
    score: dict[str, object] = json.loads((exam / "score.json").read_text("utf-8"))
    del score["timings_s"]
    return score


def test_an_exam_whose_worker_is_killed_while_it_diagnoses_is_the_same_exam(
    cluster: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    for out in (here, there):
        # To measure how large the hidden effects are takes as long as to diagnose, and is kept as any other part.
        with open_exam_folder(out, CASES, SEED, "exam") as folder:
            for case in draw_cases(CASES, SEED):
                write_json(folder.result("amounts", case.name), {"d": 30.0})
    assert make_campaigns(CASES, SEED, there, scheduler=cluster) == make_campaigns(CASES, SEED, here, workers=2)
    arguments = ["gap", "blind", "--cases", str(CASES), "--seed", str(SEED), "--quiet", "--out"]
    assert main([*arguments, str(here), "--workers", "2"]) == 0
    output_here = capsys.readouterr().out

    def stored_count() -> int:
        return len(list((there / "said").glob("*.json")))

    with worker_killed_at_its_second(diagnose_blind, cluster, stored_count) as watched:
        assert main([*arguments, str(there), "--scheduler", cluster]) == 0
    assert watched.killed
    assert 1 <= watched.kept < CASES
    assert capsys.readouterr().out == output_here
    assert score_in(there) == score_in(here)
    assert files_in(there) == files_in(here)
    # A campaign is diagnosed, and its model, where one was amended, tried on fresh runs.
    pieces = CASES + len(list((there / "said").glob("*.toml")))
    assert len(watched.finished) == len(set(watched.finished)) == pieces
