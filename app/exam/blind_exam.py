"""The exam from sealing the answers to its score: simulate, diagnose, open the answers, evaluate, score."""

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
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
    """An exam that was held.

    Attributes
    ----------
    cases, seed
        What it was drawn from.
    answers_sha256
        The seal.
    score
        How often the diagnosis was right.
    failed
        Why campaigns were not diagnosed, by their names; they are not in the score.
    timings_s
        Of this call; the only part that differs between two exams with one seed.
    """

    cases: int
    seed: int
    answers_sha256: str
    score: ExamScore
    failed: Mapping[str, str] = field(default_factory=dict)
    timings_s: Mapping[str, float] = field(default_factory=dict)

    def document(self) -> Mapping[str, object]:
        """Return all that the exam says as JSON."""
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
    """Write an exam as one HTML file with its pictures inside; raises `OutputError` as `diagnosing.save_report`."""
    from dragrig.present.exam import exam_page
    from dragrig.present.files import write_text

    return write_text(exam_page(exam.score, exam.cases, exam.seed, exam.answers_sha256), path, overwrite=overwrite)


TaskT = TypeVar("TaskT")
R = TypeVar("R")
SIMULATE_COST_S, DIAGNOSE_COST_S, D_PRIME_COST_S, EVALUATE_COST_S = 2, 5, 4, 1
"""How long a piece of each kind takes, roughly, in seconds; what is left is told by these."""


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

    The hash of the answers is written first. Then campaigns are made and diagnosed, each by a process that is given
    its folder alone. Then the answers are opened, the amended models tried on fresh runs, and all of it scored.

    Parameters
    ----------
    cases, seed
        How many campaigns, and what they are drawn from.
    out
        Folder in which everything is kept; a second call with the same numbers goes on where the first was stopped. A
        temporary one unless given.
    workers
        Processes that share the campaigns; as many as there are cores unless given.
    scheduler
        Address of a Dask cluster that does the work in their place; its workers must see `out`, which must be given.
    kind
        Which mix of campaigns: `exam`, or `learning`, which has more of what is hard.
    without_true
        Whether campaigns with one effect are diagnosed again without it.
    sizes
        Whether d′ of single effects is measured, which takes almost as long as a diagnosis; without it the score has no
        detection against size.

    Raises
    ------
    SettingsError
        When the numbers are none, the folder holds another exam, or the cluster cannot be used.
    OutputError
        When the folder cannot be used.
    AnalysisError
        When no campaign was diagnosed, or the plant was changed since the answers were sealed.
    WorkerError
        When processes end before the work is done; what was done is kept in `out`.

    Examples
    --------
    >>> import dragrig
    >>> exam = dragrig.gap_blind(40, seed=7, out="exam")  # doctest: +SKIP
    >>> exam.score["full size, right name"].share  # doctest: +SKIP
    """
    if cases < 1:
        raise SettingsError(f"--cases {cases}: an exam has one case at least.")
    if seed < 0:
        raise SettingsError(f"--seed {seed}: is a whole number from 0 on.")
    if kind not in MIXES:
        raise SettingsError(f"--mix {kind}: there is {' and '.join(MIXES)}.")
    worker_count(workers, scheduler)
    if scheduler is not None and out is None:
        raise SettingsError(f"--scheduler {scheduler}: needs --out, a folder that the cluster's workers see too.")
    began = perf_counter()
    place = tempfile.TemporaryDirectory(prefix="dragrig-blind-") if out is None else nullcontext(str(out))
    with place as root, open_exam_folder(Path(root).absolute(), cases, seed, kind) as folder:
        planned = draw_cases(cases, seed, kind)
        held = _RunningExam(folder, planned, workers, scheduler, _WeightedProgress(progress))
        exam = held.through(cases, seed, without_true=without_true, sizes=sizes)
        timings = {**exam.timings_s, "this call": perf_counter() - began}
        exam = BlindExam(cases, seed, exam.answers_sha256, exam.score, exam.failed, timings)
        write_json(folder.root / "score.json", exam.document())
    return exam


class _WeightedProgress:
    """Progress over pieces of several kinds."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self._done, self._of = progress, 0, 0

    def expect(self, weight: int, pieces: int) -> None:
        self._of += weight * pieces

    def advance(self, weight: int) -> None:
        self._done += weight
        self._progress(self._done, self._of)


@dataclass(frozen=True, slots=True)
class _RunningExam:
    folder: ExamFolder
    planned: Sequence[HiddenCase]
    workers: int | None
    scheduler: str | None
    meter: _WeightedProgress

    def through(self, cases: int, seed: int, *, without_true: bool, sizes: bool) -> BlindExam:
        """Do what is not done yet, and score."""
        folder, single = self.folder, [one for one in self.planned if one.single]
        orders = [CampaignOrder(one, folder.campaign(one.name), folder.fresh(one.name)) for one in self.planned]
        unmade = [one for one in orders if not (one.campaign.is_dir() and one.fresh.is_dir())]
        asked = {folder.campaign(one.name): one.name for one in self.planned if not folder.said(one.name).exists()}
        again = {
            BlindTask(folder.campaign(one.name), one.effects): one.name
            for one in single
            if without_true and not folder.withheld(one.name).exists()
        }
        unmeasured = [one for one in single if sizes and not folder.amount(one.name).exists()]
        for weight, pieces in (
            (SIMULATE_COST_S, unmade),
            (DIAGNOSE_COST_S, asked),
            (DIAGNOSE_COST_S, again),
            (D_PRIME_COST_S, unmeasured),
        ):
            self.meter.expect(weight, len(pieces))
        self.meter.expect(EVALUATE_COST_S, len(self.planned))
        digest = seal_answers(folder, self.planned)
        # Workers may have been killed in an earlier call, and in this one.
        for order in orders:
            remove_unfinished(order)
        self._spread(SIMULATE_COST_S, simulate_campaign, unmade)
        for order in orders:
            remove_unfinished(order)
        questions = [BlindTask(one) for one in asked]
        self._spread(
            DIAGNOSE_COST_S, diagnose_blind, questions, lambda one, said: self._keep(asked[one.campaign], said)
        )
        answers = open_answers(folder, self.planned)
        self._evaluate()
        self._spread(
            DIAGNOSE_COST_S,
            diagnose_blind,
            again,
            lambda one, said: write_json(folder.withheld(again[one]), _diagnosis_or_failure(said)),
        )
        self._spread(
            D_PRIME_COST_S,
            hidden_d_prime,
            unmeasured,
            lambda one, found: write_json(folder.amount(one.name), {"d": found}),
        )
        return self._scored(cases, seed, digest, answers, without_true=without_true)

    def _spread(
        self,
        weight: int,
        function: Callable[[TaskT], R],
        pieces: Iterable[TaskT],
        keep: Callable[[TaskT, R], None] | None = None,
    ) -> None:
        waiting = list(pieces)
        if not waiting:
            return

        def finished(piece: TaskT, result: R) -> None:
            if keep is not None:
                keep(piece, result)
            self.meter.advance(weight)

        with open_executor(self.workers, self.scheduler, tasks=len(waiting), own_process=True) as executor:
            parallel_map(executor, function, waiting, finished)

    def _keep(self, name: str, said: BlindDiagnosis) -> None:
        """Keep a diagnosis; the model first, so that it is there when the diagnosis is."""
        if said.model is not None:
            self.folder.model(name).parent.mkdir(parents=True, exist_ok=True)
            self.folder.model(name).write_text(said.model, "utf-8", newline="\n")
        write_json(self.folder.said(name), _diagnosis_or_failure(said))

    def _evaluate(self) -> None:
        """Try amended models on fresh runs."""
        folder = self.folder
        names = {
            (folder.model(one.name), folder.fresh(one.name)): one.name
            for one in self.planned
            if folder.model(one.name).exists() and not folder.achieved(one.name).exists()
        }
        self._spread(
            EVALUATE_COST_S, evaluate_blind, names, lambda one, found: write_json(folder.achieved(names[one]), found)
        )
        for _ in range(len(self.planned) - len(names)):
            self.meter.advance(EVALUATE_COST_S)

    def _scored(
        self,
        cases: int,
        seed: int,
        digest: str,
        answers: Mapping[str, Mapping[str, object]],
        *,
        without_true: bool,
    ) -> BlindExam:
        folder = self.folder
        said = {one.name: read_json(folder.said(one.name)) for one in self.planned}
        failed = {name: str(one["failed"]) for name, one in said.items() if "failed" in one}
        if len(failed) == len(said):
            name, reason = next(iter(failed.items()))
            raise AnalysisError(f"no campaign was diagnosed; of {name} it is said: {reason}.")
        found = score_exam(
            [(name, answers[name], one) for name, one in said.items() if name not in failed],
            withheld=self._there(folder.withheld, "verdict") if without_true else {},
            achieved=self._there(folder.achieved, "shrink"),
            amounts={name: float(str(one["d"])) for name, one in self._there(folder.amount, "d").items()},
        )
        return BlindExam(cases, seed, digest, found, failed, _median_timings(said))

    def _there(self, place: Callable[[str], Path], key: str) -> dict[str, Mapping[str, object]]:
        """Return the files that are there and have a key, by the campaigns' names."""
        known = {one.name: read_json(place(one.name)) for one in self.planned if place(one.name).exists()}
        return {name: one for name, one in known.items() if key in one}


def _diagnosis_or_failure(said: BlindDiagnosis) -> Mapping[str, object]:
    return said.document or {"failed": said.why_not}


def _median_timings(said: Mapping[str, Mapping[str, object]]) -> dict[str, float]:
    """Return the median of the time that a diagnosis took."""
    from statistics import median

    known = [one["timings_s"] for one in said.values() if "timings_s" in one]
    seconds = [sum(float(str(each)) for each in one.values()) for one in known if isinstance(one, Mapping)]
    return {"diagnosis (median)": median(seconds)} if seconds else {}
