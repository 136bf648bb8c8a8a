"""The exam from sealing the answers to its score: simulate, diagnose, open the answers, evaluate, score."""

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import TypeVar

from dragrig.analysis.computation import Progress, no_progress
from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.exam.blind_campaigns import (
    EXAM_FORMAT,
    EXAM_MIX,
    EXAM_VERSION,
    MIXES,
    CampaignOrder,
    ExamFolder,
    HiddenCase,
    draw_cases,
    hidden_d_prime,
    open_answers,
    open_exam_folder,
    read_json,
    remove_unfinished,
    seal_answers,
    simulate_campaign,
    write_json,
)
from dragrig.exam.examinee import BlindDiagnosis, BlindTask, diagnose_blind, evaluate_blind
from dragrig.parallel import open_executor, parallel_map, worker_count
from dragrig.present.exam import score_json
from dragrig.scoring import ExamScore, score_exam


@dataclass(frozen=True, slots=True)
class BlindExam:
    """The result of an exam.

    Attributes
    ----------
    cases, seed
        Number of campaigns, and their seed.
    answers_sha256
        Hash of the answers, written before any campaign.
    failed
        Why campaigns were not diagnosed, by their names; they are not in the score.
    timings_s
        Of this call; the only part that differs between two exams with the same seed.
    """

    cases: int
    seed: int
    answers_sha256: str
    score: ExamScore
    failed: Mapping[str, str] = field(default_factory=dict)
    timings_s: Mapping[str, float] = field(default_factory=dict)

    def document(self) -> Mapping[str, object]:
        """Return the result as JSON."""
        return {
            "format": EXAM_FORMAT,
            "version": EXAM_VERSION,
            "cases": self.cases,
            "seed": self.seed,
            "answers_sha256": self.answers_sha256,
            **score_json(self.score),
            "failed": dict(self.failed),
            "timings_s": {name: round(seconds, 3) for name, seconds in self.timings_s.items()},
        }


def save_exam_report(exam: BlindExam, path: Path, *, overwrite: bool = False) -> Path:
    """Write an exam as one HTML file with its pictures inside; raises `OutputError` as `write_text`."""
    from dragrig.present.exam import exam_document
    from dragrig.present.files import write_text
    from dragrig.present.html_page import render_page

    document = exam_document(exam.score, exam.cases, exam.seed, exam.answers_sha256)
    return write_text(render_page(document), path, overwrite=overwrite)


TaskT = TypeVar("TaskT")
R = TypeVar("R")
SIMULATE_COST_S, DIAGNOSE_COST_S, D_PRIME_COST_S, EVALUATE_COST_S = 2, 5, 4, 1
"""Rough duration of a task of each kind, the weights of the progress."""


def gap_blind(
    cases: int = 100,
    seed: int = 1,
    out: str | Path | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    kind: str = EXAM_MIX,
    without_true: bool = False,
    sizes: bool = True,
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
        Mix of campaigns: `exam`, or `learning`, which has more hard cases.
    without_true
        Whether campaigns with one effect are diagnosed again without it.
    sizes
        Whether d′ of single effects is computed, which takes almost as long as a diagnosis; without it the score has no
        detection against size.

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
        raise SettingsError(f"--mix {kind}: there is {' and '.join(MIXES)}.")
    worker_count(workers, scheduler)
    if scheduler is not None and out is None:
        raise SettingsError(f"--scheduler {scheduler}: needs --out, a folder that the cluster's workers see too.")
    start = perf_counter()
    place = tempfile.TemporaryDirectory(prefix="dragrig-blind-") if out is None else nullcontext(str(out))
    with place as root, open_exam_folder(Path(root).absolute(), cases, seed, kind) as folder:
        exam = _RunningExam(folder, draw_cases(cases, seed, kind), workers, scheduler, _WeightedProgress(progress))
        digest, diagnoses = exam.run(without_true=without_true, sizes=sizes)
        score, failed = exam.score(diagnoses, without_true=without_true)
        timings_s = {**_median_timings(diagnoses.values()), "this call": perf_counter() - start}
        result = BlindExam(cases, seed, digest, score, failed, timings_s)
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
    meter: _WeightedProgress

    def run(self, *, without_true: bool, sizes: bool) -> tuple[str, Mapping[str, Mapping[str, object]]]:
        """Do what is not done yet; return the hash of the answers, and the diagnoses by the campaigns' names."""
        folder, names = self.folder, [case.name for case in self.cases]
        single = [case for case in self.cases if case.single]
        orders = [CampaignOrder(case, folder.campaign(case.name), folder.fresh(case.name)) for case in self.cases]
        to_simulate = [order for order in orders if not (order.campaign.is_dir() and order.fresh.is_dir())]
        to_diagnose = {
            BlindTask(folder.campaign(name)): name for name in names if not folder.diagnosis_file(name).exists()
        }
        to_repeat = {
            BlindTask(folder.campaign(case.name), case.effects): case.name
            for case in single
            if without_true and not folder.withheld(case.name).exists()
        }
        to_measure = [case for case in single if sizes and not folder.amount(case.name).exists()]
        self.meter.expect(SIMULATE_COST_S, len(to_simulate))
        self.meter.expect(DIAGNOSE_COST_S, len(to_diagnose) + len(to_repeat))
        self.meter.expect(D_PRIME_COST_S, len(to_measure))
        self.meter.expect(EVALUATE_COST_S, len(names))
        digest = seal_answers(folder, self.cases)
        # Workers may have been killed in an earlier call, and in this one.
        for order in orders:
            remove_unfinished(order)
        self._map(SIMULATE_COST_S, simulate_campaign, to_simulate)
        for order in orders:
            remove_unfinished(order)
        self._map(
            DIAGNOSE_COST_S, diagnose_blind, to_diagnose, lambda task, result: self._store(to_diagnose[task], result)
        )
        open_answers(folder, self.cases)
        self._evaluate_models()
        self._map(
            DIAGNOSE_COST_S,
            diagnose_blind,
            to_repeat,
            lambda task, result: write_json(folder.withheld(to_repeat[task]), result.json_or_failure()),
        )
        self._map(
            D_PRIME_COST_S,
            hidden_d_prime,
            to_measure,
            lambda case, d_prime: write_json(folder.amount(case.name), {"d": d_prime}),
        )
        return digest, {name: read_json(folder.diagnosis_file(name)) for name in names}

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
        d_primes = self._existing(folder.amount, "d")
        score = score_exam(
            [(name, answers[name], diagnosis) for name, diagnosis in diagnoses.items() if name not in failed],
            withheld=self._existing(folder.withheld, "verdict") if without_true else {},
            achieved=self._existing(folder.achieved, "shrink"),
            amounts={name: float(str(content["d"])) for name, content in d_primes.items()},
        )
        return score, failed

    def _map(
        self,
        weight: int,
        function: Callable[[TaskT], R],
        tasks: Iterable[TaskT],
        store: Callable[[TaskT, R], None] | None = None,
    ) -> None:
        waiting = list(tasks)
        if not waiting:
            return

        def finished(task: TaskT, result: R) -> None:
            if store is not None:
                store(task, result)
            self.meter.advance(weight)

        with open_executor(self.workers, self.scheduler, tasks=len(waiting), own_process=True) as executor:
            parallel_map(executor, function, waiting, finished)

    def _store(self, name: str, diagnosis: BlindDiagnosis) -> None:
        """Store the model before the diagnosis, so that a stored diagnosis always has its model."""
        if diagnosis.model is not None:
            self.folder.model(name).parent.mkdir(parents=True, exist_ok=True)
            self.folder.model(name).write_text(diagnosis.model, "utf-8", newline="\n")
        write_json(self.folder.diagnosis_file(name), diagnosis.json_or_failure())

    def _evaluate_models(self) -> None:
        """Evaluate amended models on fresh runs."""
        folder = self.folder
        names = {
            (folder.model(case.name), folder.fresh(case.name)): case.name
            for case in self.cases
            if folder.model(case.name).exists() and not folder.achieved(case.name).exists()
        }
        self._map(
            EVALUATE_COST_S,
            evaluate_blind,
            names,
            lambda task, reduction: write_json(folder.achieved(names[task]), reduction),
        )
        self.meter.advance(EVALUATE_COST_S, len(self.cases) - len(names))

    def _existing(self, path_of: Callable[[str], Path], key: str) -> dict[str, Mapping[str, object]]:
        """Return the contents of the files that exist and have a key, by the campaigns' names."""
        paths = {case.name: path_of(case.name) for case in self.cases}
        contents = {name: read_json(path) for name, path in paths.items() if path.exists()}
        return {name: content for name, content in contents.items() if key in content}


def _median_timings(diagnoses: Iterable[Mapping[str, object]]) -> dict[str, float]:
    timings = [diagnosis["timings_s"] for diagnosis in diagnoses if "timings_s" in diagnosis]
    totals = [sum(float(str(seconds)) for seconds in parts.values()) for parts in timings if isinstance(parts, Mapping)]
    return {"diagnosis (median)": median(totals)} if totals else {}
