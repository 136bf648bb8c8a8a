"""The exam from sealing the answers to its score: simulate, diagnose, open the answers, evaluate, score.

The answers follow from the seed and are on no disk while campaigns are diagnosed: only their hash is written
beforehand, and they themselves once every campaign has been diagnosed. This module knows the blind plant; the process
that diagnoses (`examinee`) does not load it.
"""

import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from statistics import median
from tempfile import mkdtemp
from time import perf_counter
from typing import TypeVar

from dragrig.analysis import Progress, no_progress
from dragrig.config import AnalysisError, OutputError, SettingsError
from dragrig.exam.examinee import BlindDiagnosis, BlindTask, diagnose_blind, evaluate_blind
from dragrig.exam.hidden_cases import (
    EXAM_MIX,
    LEARNING_MIX,
    MIXES,
    WRITTEN_PLANT,
    HiddenCase,
    draw_cases,
    hidden_amounts,
)
from dragrig.parallel import open_executor, parallel_map, worker_count
from dragrig.present import attributes_json, score_json, to_json_value
from dragrig.scoring import ExamScore, score_exam
from dragrig.sim_backend.blind import PLANTS, true_answer, write_campaign

UNFINISHED_SUFFIX = ".begun"
"""Suffix of the hidden folder in which an unfinished campaign is written."""


@dataclass(frozen=True, slots=True)
class CampaignOrder:
    """A campaign to simulate into a folder, and a fresh session of the same specimen into another."""

    case: HiddenCase
    campaign: Path
    fresh: Path


def simulate_campaign(order: CampaignOrder) -> None:
    """Simulate the campaigns that do not exist yet; a folder exists with all its runs or not at all.

    Raises
    ------
    OSError
        When a file cannot be written.
    """
    secret = order.case.secret
    for folder, runs in ((order.campaign, None), (order.fresh, "fresh")):
        if folder.is_dir():
            continue
        folder.parent.mkdir(parents=True, exist_ok=True)
        unfinished = Path(mkdtemp(prefix=f".{folder.name}-", suffix=UNFINISHED_SUFFIX, dir=folder.parent))
        try:
            write_campaign(secret, unfinished, runs=runs)
            unfinished.chmod(0o755)
            unfinished.rename(folder)
        except OSError:
            if not folder.is_dir():  # else another worker had the same task and was first
                raise
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)


def remove_unfinished(orders: Iterable[CampaignOrder]) -> None:
    """Remove the remains of killed workers; no other program may work in the exam's folder."""
    for folder in chain.from_iterable((order.campaign, order.fresh) for order in orders):
        for unfinished in folder.parent.glob(f".{folder.name}-*{UNFINISHED_SUFFIX}"):
            shutil.rmtree(unfinished, ignore_errors=True)


EXAM_FILE, SEAL_FILE, ANSWERS_FILE = "exam.json", "answers.sha256", "answers.json"
EXAM_FORMAT, EXAM_VERSION = "dragrig-blind", 1


@dataclass(frozen=True, slots=True)
class ExamFolder:
    """Paths of an exam."""

    root: Path

    def campaign(self, name: str) -> Path:
        """Return the folder of a campaign's runs."""
        return self.root / "campaigns" / name

    def fresh(self, name: str) -> Path:
        """Return the folder of runs of the same specimen at other speeds and strains."""
        return self.root / "fresh" / name

    def result(self, kind: str, name: str) -> Path:
        """Return the file of a campaign's result of a kind.

        `said`: its diagnosis; `withheld`: that without the true effect; `achieved`: the amended model's evaluation on
        fresh runs; `amounts`: the hidden effects' d′ and the plant's own budget.
        """
        return self.root / kind / f"{name}.json"

    def model(self, name: str) -> Path:
        """Return the file of the amended model."""
        return self.root / "said" / f"{name}.toml"


@contextmanager
def open_exam_folder(out: Path, cases: int, seed: int, mix: str, plant: str = WRITTEN_PLANT) -> Iterator[ExamFolder]:
    """Lock and yield an exam's folder: a new one, or one started with the same numbers.

    Raises
    ------
    SettingsError
        When it holds an exam with other numbers.
    OutputError
        When it holds something else, cannot be written, or another program uses it.
    """
    from filelock import FileLock, Timeout

    try:
        out.mkdir(parents=True, exist_ok=True)
        existing = _read_exam_numbers(out)
        if existing is None and any(path.name != ".lock" for path in out.iterdir()):
            raise OutputError(f"{out}: holds something that is no exam; name an empty or a new folder.")
        if existing is not None and existing != (cases, seed, mix, plant):
            options = f"--cases {existing[0]} --seed {existing[1]} --mix {existing[2]} --plant {existing[3]}"
            raise SettingsError(
                f"{out}: holds an exam of {existing[0]} cases with seed {existing[1]}; give {options} to continue "
                "it, or name another folder."
            )
        with FileLock(out / ".lock", timeout=0):
            numbers = {"cases": cases, "seed": seed, "mix": mix, "plant": plant}
            write_json(out / EXAM_FILE, {"format": EXAM_FORMAT, "version": EXAM_VERSION, **numbers})
            yield ExamFolder(out)
    except Timeout as error:
        raise OutputError(f"{out}: another program uses it; wait for it, or name another folder.") from error
    except OSError as error:
        place = error.filename or out
        raise OutputError(f"{place}: cannot be written ({error.strerror}); name another folder.") from error


def _read_exam_numbers(out: Path) -> tuple[int, int, str, str] | None:
    """Return number of cases, seed, mix and plant of the exam in a folder; None where there is none."""
    try:
        exam = json.loads((out / EXAM_FILE).read_text("utf-8"))
        return int(exam["cases"]), int(exam["seed"]), str(exam["mix"]), str(exam.get("plant", WRITTEN_PLANT))
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise OutputError(f"{out / EXAM_FILE}: is not what an exam writes; name another folder.") from error


def seal_answers(folder: ExamFolder, planned: Sequence[HiddenCase]) -> str:
    """Write the hash of the answers where it does not exist, and return it.

    Raises
    ------
    AnalysisError
        When another hash exists.
    """
    digest = hashlib.sha256(_answers_json(planned).encode()).hexdigest()
    path = folder.root / SEAL_FILE
    if not path.exists():
        _replace_file(path, f"{digest}  {ANSWERS_FILE}\n")
    elif path.read_text("utf-8").split()[:1] != [digest]:
        raise AnalysisError(
            f"{path}: the plant gives other answers than were sealed, so it was changed meanwhile; start again in "
            "another folder."
        )
    return digest


def open_answers(folder: ExamFolder, planned: Sequence[HiddenCase]) -> Mapping[str, Mapping[str, object]]:
    """Write and return the answers by the campaigns' names; raises `AnalysisError` when others were sealed."""
    seal_answers(folder, planned)
    text = _answers_json(planned)
    _replace_file(folder.root / ANSWERS_FILE, text)
    answers: Mapping[str, Mapping[str, object]] = json.loads(text)
    return answers


def _answers_json(planned: Sequence[HiddenCase]) -> str:
    return json.dumps({case.name: {"case": case.kind, **true_answer(case.secret)} for case in planned}, indent=1)


def write_json(path: Path, document: object) -> None:
    """Write JSON to a file atomically."""
    _replace_file(path, json.dumps(to_json_value(document), indent=1, allow_nan=False) + "\n")


def _replace_file(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.begun")
    partial.write_text(text, "utf-8", newline="\n")
    partial.replace(path)


def read_json(path: Path) -> Mapping[str, object]:
    """Return the content that `write_json` wrote."""
    content: Mapping[str, object] = json.loads(path.read_text("utf-8"))
    return content


@dataclass(frozen=True, slots=True)
class BlindExam:
    """The result of an exam."""

    cases: int
    seed: int
    """`cases`, `seed`: number of campaigns, and their seed."""
    answers_sha256: str
    """Hash of the answers, written before any campaign."""
    score: ExamScore
    failed: Mapping[str, str] = field(default_factory=dict)
    """Why campaigns were not diagnosed, by their names; they are not in the score."""
    timings_s: Mapping[str, float] = field(default_factory=dict)
    """Of this call; the only part that differs between two exams with the same seed."""
    plant: str = WRITTEN_PLANT
    """The plant of the campaigns: `written` or `drawn`."""

    def document(self) -> Mapping[str, object]:
        """Return the result as JSON."""
        return {
            "format": EXAM_FORMAT,
            "version": EXAM_VERSION,
            **attributes_json(self, "cases", "seed", "plant", "answers_sha256"),
            **score_json(self.score),
            "failed": dict(self.failed),
            "timings_s": {name: round(seconds, 3) for name, seconds in self.timings_s.items()},
        }


TaskT = TypeVar("TaskT")
R = TypeVar("R")
SIMULATE_COST_S, DIAGNOSE_COST_S, D_PRIME_COST_S, EVALUATE_COST_S = 1, 15, 10, 4
"""Rough duration of a task of each kind, the weights of the progress."""


def gap_blind(
    cases: int = 100,
    seed: int = 1,
    out: str | Path | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    kind: str = EXAM_MIX,
    plant: str = WRITTEN_PLANT,
    without_true: bool = False,
    sizes: bool = True,
    diagnose: Callable[[BlindTask], BlindDiagnosis] = diagnose_blind,
    progress: Progress = no_progress,
) -> BlindExam:
    """Examine the gap diagnosis on campaigns of the blind plant, whose hidden effects it cannot know.

    The hash of the answers is written first. Then campaigns are simulated and diagnosed, each by a process that gets
    its folder alone. Then the answers are opened, the amended models evaluated on fresh runs, and everything scored.

    Parameters
    ----------
    cases, seed
        Number of campaigns, and their seed.
    out
        Folder of the exam, which a second call with the same numbers continues (default: a temporary one).
    workers
        Number of processes (default: as many as there are cores).
    scheduler
        Address of a Dask cluster to use in their place; its workers must see `out`, which is then needed.
    kind
        Mix of campaigns: `exam`; `learning`, which has more hard cases; `conditions`, of which a third is incomplete,
        of another programme, noise or specimen, or has a nominal model that is off; or `motion`, in which every stage
        moves as drives do.
    plant
        `written`, whose effects have forms that are written down, or `drawn`, whose laws are drawn at random; its
        mix is `conditions` or `motion`.
    without_true
        Whether campaigns with one effect are diagnosed again without it.
    sizes
        Whether d′ of single effects is computed, which takes almost as long as a diagnosis; without it the score has no
        detection against size.
    diagnose
        Who is examined: a function that other processes can load.

    Raises
    ------
    SettingsError
        When a number is not valid, the folder holds another exam, or the cluster cannot be used.
    OutputError
        When the folder cannot be used.
    AnalysisError
        When no campaign was diagnosed, or the plant changed since the answers were sealed.
    WorkerError
        When processes end before the work is done; finished work stays in `out`.

    Examples
    --------
    >>> import dragrig
    >>> exam = dragrig.gap_blind(40, seed=7, out="exam")  # doctest: +SKIP
    >>> exam.score["full size, right name"].share  # doctest: +SKIP
    """
    if cases < 1:
        raise SettingsError(f"--cases {cases}: an exam has at least one case.")
    if seed < 0:
        raise SettingsError(f"--seed {seed}: is a whole number from 0 on.")
    if kind not in MIXES:
        raise SettingsError(f"--mix {kind}: there is {', '.join(MIXES)}.")
    if plant not in PLANTS:
        raise SettingsError(f"--plant {plant}: there is {' and '.join(PLANTS)}.")
    if plant != WRITTEN_PLANT and kind == LEARNING_MIX:
        raise SettingsError(f"--mix {kind}: the plant {plant} judges, and nothing is learnt from it; leave one out.")
    worker_count(workers, scheduler)
    if scheduler is not None and out is None:
        raise SettingsError(f"--scheduler {scheduler}: needs --out, a folder that the cluster's workers see too.")
    start = perf_counter()
    place = tempfile.TemporaryDirectory(prefix="dragrig-blind-") if out is None else nullcontext(str(out))
    with place as root, open_exam_folder(Path(root).absolute(), cases, seed, kind, plant) as folder:
        planned, meter = draw_cases(cases, seed, kind, plant), _WeightedProgress(progress)
        exam = _RunningExam(folder, planned, workers, scheduler, diagnose, meter)
        digest, diagnoses = exam.run(without_true=without_true, sizes=sizes)
        score, failed = exam.score(diagnoses, without_true=without_true)
        timings_s = {**_median_timings(diagnoses.values()), "this call": perf_counter() - start}
        result = BlindExam(cases, seed, digest, score, failed, timings_s, plant)
        write_json(folder.root / "score.json", result.document())
    return result


class _WeightedProgress:
    """Progress over tasks of several kinds."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self._done, self._of = progress, 0, 0

    def expect(self, weight: int, tasks: int) -> None:
        self._of += weight * tasks

    def advance(self, weight: int, tasks: int = 1) -> None:
        for _ in range(tasks):
            self._done += weight
            self._progress(self._done, self._of)


@dataclass(frozen=True, slots=True)
class _RunningExam:
    folder: ExamFolder
    cases: Sequence[HiddenCase]
    workers: int | None
    scheduler: str | None
    diagnose: Callable[[BlindTask], BlindDiagnosis]
    meter: _WeightedProgress

    def run(self, *, without_true: bool, sizes: bool) -> tuple[str, Mapping[str, Mapping[str, object]]]:
        """Do the open tasks; return the hash of the answers, and the diagnoses by the campaigns' names."""
        folder, names = self.folder, [case.name for case in self.cases]
        single = [case for case in self.cases if case.single] if without_true else []
        measured = [case for case in self.cases if sizes and (case.single or case.plant != WRITTEN_PLANT)]
        orders = {
            CampaignOrder(case, folder.campaign(case.name), folder.fresh(case.name)): case.name for case in self.cases
        }
        to_simulate = {o: name for o, name in orders.items() if not (o.campaign.is_dir() and o.fresh.is_dir())}
        to_diagnose = self._missing("said", {BlindTask(folder.campaign(name)): name for name in names})
        to_repeat = self._missing(
            "withheld", {BlindTask(folder.campaign(case.name), case.effects): case.name for case in single}
        )
        to_measure = self._missing("amounts", {case: case.name for case in measured})
        self.meter.expect(SIMULATE_COST_S, len(to_simulate))
        self.meter.expect(DIAGNOSE_COST_S, len(to_diagnose) + len(to_repeat))
        self.meter.expect(D_PRIME_COST_S, len(to_measure))
        self.meter.expect(EVALUATE_COST_S, len(names))
        digest = seal_answers(folder, self.cases)
        # Workers may have been killed in an earlier call, and in this one.
        remove_unfinished(orders)
        self._map(SIMULATE_COST_S, simulate_campaign, to_simulate)
        remove_unfinished(orders)
        self._map(DIAGNOSE_COST_S, self.diagnose, to_diagnose, partial(self._store_diagnosis, "said"))
        open_answers(folder, self.cases)
        self._evaluate_models()
        self._map(DIAGNOSE_COST_S, self.diagnose, to_repeat, partial(self._store_diagnosis, "withheld"))
        self._map(D_PRIME_COST_S, hidden_amounts, to_measure, partial(self._store, "amounts"))
        return digest, {name: read_json(folder.result("said", name)) for name in names}

    def score(
        self, diagnoses: Mapping[str, Mapping[str, object]], *, without_true: bool
    ) -> tuple[ExamScore, Mapping[str, str]]:
        """Return the score, and why campaigns were not diagnosed, by their names."""
        folder = self.folder
        failed = {name: str(diagnosis["failed"]) for name, diagnosis in diagnoses.items() if "failed" in diagnosis}
        if len(failed) == len(diagnoses):
            name, reason = next(iter(failed.items()))
            raise AnalysisError(f"no campaign was diagnosed; of {name}: {reason}.")
        answers = open_answers(folder, self.cases)
        d_primes = self._existing("amounts", "d")
        score = score_exam(
            [(name, answers[name], diagnosis) for name, diagnosis in diagnoses.items() if name not in failed],
            withheld=self._existing("withheld", "verdict") if without_true else {},
            achieved=self._existing("achieved", "shrink"),
            amounts={name: float(str(content["d"])) for name, content in d_primes.items()},
            budgets=self._existing("amounts", "budget"),
        )
        return score, failed

    def _map(
        self,
        weight: int,
        function: Callable[[TaskT], R],
        tasks: Mapping[TaskT, str],
        store: Callable[[str, R], None] = lambda _name, _result: None,
    ) -> None:
        """Work on tasks, each of the campaign of that name, and store their results as they come."""
        if not tasks:
            return

        def finished(task: TaskT, result: R) -> None:
            store(tasks[task], result)
            self.meter.advance(weight)

        with open_executor(self.workers, self.scheduler, tasks=len(tasks), own_process=True) as executor:
            parallel_map(executor, function, list(tasks), finished)

    def _missing(self, kind: str, tasks: Mapping[TaskT, str]) -> Mapping[TaskT, str]:
        """Return the tasks whose result of a kind is not there yet."""
        return {task: name for task, name in tasks.items() if not self.folder.result(kind, name).exists()}

    def _store(self, kind: str, name: str, result: Mapping[str, object]) -> None:
        write_json(self.folder.result(kind, name), result)

    def _store_diagnosis(self, kind: str, name: str, diagnosis: BlindDiagnosis) -> None:
        """Store the model before the diagnosis, so that a stored diagnosis always has its model."""
        if diagnosis.model is not None and kind == "said":
            self.folder.model(name).parent.mkdir(parents=True, exist_ok=True)
            self.folder.model(name).write_text(diagnosis.model, "utf-8", newline="\n")
        self._store(kind, name, diagnosis.json_or_failure())

    def _evaluate_models(self) -> None:
        """Evaluate amended models on fresh runs."""
        folder = self.folder
        with_model = [case.name for case in self.cases if folder.model(case.name).exists()]
        tasks = self._missing("achieved", {(folder.model(name), folder.fresh(name)): name for name in with_model})
        self._map(EVALUATE_COST_S, evaluate_blind, tasks, partial(self._store, "achieved"))
        self.meter.advance(EVALUATE_COST_S, len(self.cases) - len(tasks))

    def _existing(self, kind: str, key: str) -> dict[str, Mapping[str, object]]:
        """Return the contents of the files that exist and have a key, by the campaigns' names."""
        paths = {case.name: self.folder.result(kind, case.name) for case in self.cases}
        contents = {name: read_json(path) for name, path in paths.items() if path.exists()}
        return {name: content for name, content in contents.items() if key in content}


def _median_timings(diagnoses: Iterable[Mapping[str, object]]) -> dict[str, float]:
    timings = [diagnosis["timings_s"] for diagnosis in diagnoses if "timings_s" in diagnosis]
    totals = [sum(float(str(seconds)) for seconds in parts.values()) for parts in timings if isinstance(parts, Mapping)]
    return {"diagnosis (median)": median(totals)} if totals else {}
