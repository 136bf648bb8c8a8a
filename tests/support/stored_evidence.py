"""Evidence of hidden campaigns, as `python bench/replay.py make` keeps it, and what the diagnosis judges from it anew.

A file is JSON lines, compressed by xz. The first line says format, version, seed, number of campaigns of each plant and
the command. Every other line is a campaign: `name`; `answer`, what was hidden, as in an exam's `answers.json`; and
either `failed`, why it was not diagnosed, or what the judging takes:

* `inputs`: the decision inputs, as `evidence` in a gap report, without the competition's probabilities;
* `causes`: kind of each cause that competed, by its name;
* `sets`: the likely sets of causes, each with the numbers of its causes in `causes`, and last the log of its evidence
  against no cause, averaged over scales and moments;
* `gap_over_floor`, `place_p`: the gap over the floor of its noise (null where nothing can be held out), and the p-value
  of its place, where no effect was named; and `budget`, cause and share of each part, where nothing was hidden.
"""

import json
import lzma
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from dragrig.analysis.gap import DecisionInputs, VerdictCalibration
from dragrig.analysis.gap.budget import presence_of_effects
from dragrig.analysis.gap.classifier import judge, unknown_by_excess_alone, with_verdict
from dragrig.analysis.gap.diagnosis import Verdict
from dragrig.analysis.gap.isolability import DEFAULT_TOLERANCE_MN
from dragrig.analysis.gap.presence import Cause, CauseKind, Presence, presence_of
from dragrig.analysis.gap.weighing import WeighedCauses, equals_noise
from dragrig.exam.hidden_cases import DRAWN_PLANT, EXAM_MIX, WRITTEN_PLANT, HiddenCase, draw_cases
from dragrig.scoring import (
    AnswerKey,
    ScoredCase,
    ScoredCause,
    ScoredDiagnosis,
    ScoredHypothesis,
    budget_rates,
    verdict_rates,
    wilson_rate,
)
from places import DATA

EVIDENCE, JUDGED = DATA / "exam" / "evidence.jsonl.xz", DATA / "exam" / "judged.csv"
FORMAT, VERSION = "dragrig-evidence", 1
MAX_SETS = 250
"""Likely sets that are kept: less likely ones have less than a thousandth of the probability together."""
DIGITS = 8
LEAST_STATED = 1e-3
"""Nothing is ever stated to be less likely."""
OUTCOME = ("campaign", "kind", "hidden", "verdict", "probability", "outcome")
"""Columns of `judged.csv`."""


def cause(name: str, kind: str) -> Cause:
    """Return a cause without its columns, at a scale over which its evidence was averaged."""
    return Cause(name, CauseKind(kind), np.zeros(0, dtype=np.intp), np.zeros(0), (1.0,))


def likely_sets(weighed: WeighedCauses) -> tuple[Mapping[str, str], Sequence[Sequence[float]]]:
    """Return `causes` and `sets` of weighed causes."""
    tried, presence = weighed.causes.competition.causes, weighed.causes.presence
    kinds = {name: kind.value for name, kind in presence.kinds.items()}
    numbers = {name: number for number, name in enumerate(kinds)}
    prior = {name: cause(name, kind).log_prior_odds for name, kind in kinds.items()}
    together: dict[tuple[int, ...], list[float]] = {}
    for chosen, log_odds in presence.log_odds.items():
        names = sorted((tried[index].name for index, _ in chosen), key=lambda name: numbers[name])
        together.setdefault(tuple(numbers[name] for name in names), []).append(log_odds)
    posterior = {key: float(np.logaddexp.reduce(values)) for key, values in together.items()}
    likely = sorted(posterior, key=lambda key: -posterior[key])[:MAX_SETS]
    names = list(kinds)
    return kinds, [[*key, round(posterior[key] - sum(prior[names[number]] for number in key), 4)] for key in likely]


def rounded(document: object) -> object:
    """Return a document with all its numbers rounded to `DIGITS`."""
    if isinstance(document, Mapping):
        return {name: rounded(value) for name, value in document.items()}
    if isinstance(document, list | tuple):
        return [rounded(value) for value in document]
    return float(f"{document:.{DIGITS}g}") if isinstance(document, float) else document


@dataclass(frozen=True, slots=True)
class StoredCampaign:
    """A hidden campaign, and what the judging takes of it."""

    name: str
    answer: AnswerKey
    inputs: DecisionInputs
    gap_over_floor: float | None
    place_p: float
    budget: tuple[ScoredCause, ...]

    def judged(self, calibration: VerdictCalibration | None = None) -> ScoredCase:
        """Judge it anew, by the shipped calibration or another."""
        judgement = judge(self.inputs, DEFAULT_TOLERANCE_MN, calibration)
        verdict = judgement.verdict
        may_be_noise = self.gap_over_floor is not None and equals_noise(self.gap_over_floor, 1.0, self.place_p)
        if may_be_noise and unknown_by_excess_alone(self.inputs, verdict, DEFAULT_TOLERANCE_MN, calibration):
            verdict = with_verdict(verdict, Verdict.NO_GAP)
        total = sum(verdict.probabilities.values())
        ranking = tuple(
            ScoredHypothesis(hypothesis=name, probability=value / total)
            for name, value in verdict.probabilities.items()
        )
        in_position = [name for name, _ in self.inputs.position]
        diagnosis = ScoredDiagnosis(
            verdict=verdict.verdict.value,
            effects=verdict.effects,
            ranking=ranking,
            confusable_with=verdict.confusable_with,
            budget=self.budget,
            presence=presence_of_effects(judgement.presence, verdict, in_position),
        )
        return ScoredCase(self.name, self.answer, diagnosis)


def outcome(case: ScoredCase) -> tuple[str, ...]:
    """Return name, kind, hidden causes, verdict, its probability, and whether it is right, as `judged.csv` has them."""
    diagnosis = case.diagnosis
    hidden, named = ("+".join(sorted(names)) for names in (case.answer.truth.split(", "), diagnosis.effects))
    right = "right" if case.right else "misleading" if case.misleading else "partly right"
    return case.name, case.answer.case, hidden, named or diagnosis.verdict, f"{diagnosis.probability:.2f}", right


def counts(cases: Sequence[ScoredCase]) -> dict[str, tuple[int, int]]:
    """Return how many verdicts are right, and every rate of an exam that needs only verdicts, as held and counted."""
    rates = [wilson_rate("all, right", [case.right for case in cases]), *verdict_rates(cases), *budget_rates(cases)]
    return {rate.name: (rate.held, rate.count) for rate in rates}


def surprise(cases: Sequence[ScoredCase]) -> float:
    """Return minus the log of the probabilities that were stated of what is hidden, of each effect and each answer."""
    stated = [
        probability if name in case.answer.effects else 1.0 - probability
        for case in cases
        for name, probability in case.diagnosis.presence.items()
    ]
    stated += [
        sum(ranked.probability for ranked in case.diagnosis.ranking if ranked.name in case.answer.accepted)
        for case in cases
    ]
    return -float(np.sum(np.log(np.maximum(stated, LEAST_STATED))))


def competed(kinds: Mapping[str, str], sets: Sequence[Sequence[float]]) -> Presence:
    """Return which causes are there, by `causes` and `sets` and today's prior probabilities."""
    causes = tuple(cause(name, kind) for name, kind in kinds.items())
    log_odds = {
        tuple((int(number), 0) for number in numbers): value
        + sum(causes[int(number)].log_prior_odds for number in numbers)
        for *numbers, value in sets
    }
    return presence_of(causes, log_odds)


def stored_campaigns(lines: Sequence[str]) -> tuple[StoredCampaign, ...]:
    """Return all campaigns of a file of evidence that were diagnosed; the first line is the file's own."""
    inputs, found = TypeAdapter(DecisionInputs), []
    for record in map(json.loads, lines[1:]):
        if "failed" in record:
            continue
        numbers, presence = inputs.validate_python(record["inputs"]), competed(record["causes"], record["sets"])
        found.append(
            StoredCampaign(
                record["name"],
                AnswerKey.model_validate(record["answer"]),
                replace(numbers, competition=presence.probabilities, by_model=presence.by_model),
                record.get("gap_over_floor"),
                record.get("place_p", 0.0),
                tuple(ScoredCause(cause=name, share=share) for name, share in record.get("budget", ())),
            )
        )
    return tuple(found)


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """The first line of a file of evidence: how its campaigns are drawn."""

    format: str = FORMAT
    version: int = VERSION
    seed: int
    written: int
    drawn: int
    command: str

    @property
    def cases(self) -> Mapping[str, HiddenCase]:
        """The campaigns of both plants by their names, in turn, so that any first ones are a mixture."""
        turns = [
            ((number + 0.5) / count, f"{plant}-{case.name}", case)
            for plant, count in ((WRITTEN_PLANT, self.written), (DRAWN_PLANT, self.drawn))
            for number, case in enumerate(draw_cases(count, self.seed, EXAM_MIX, plant))
        ]
        return {name: case for _, name, case in sorted(turns, key=lambda turn: turn[:2])}


def header_of(lines: Sequence[str]) -> Header:
    """Return the first line."""
    return Header(**json.loads(lines[0]))


def stored_lines(path: Path = EVIDENCE) -> list[str]:
    """Return the lines of a file of evidence."""
    return lzma.decompress(path.read_bytes()).decode("utf-8").splitlines()
