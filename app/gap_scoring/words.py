"""What an exam says, in words: terminal and page say the same."""

from collections.abc import Iterator
from math import isfinite

from dragrig.gap_scoring.calibration import Calibration
from dragrig.gap_scoring.promises import Promises
from dragrig.gap_scoring.rates import Rate
from dragrig.gap_scoring.scoring import Score


def exam_sentences(score: Score, cases: int, seed: int, answers_sha256: str) -> Iterator[str]:
    """Sum an exam up: how many verdicts were right, what misled, and how that was made sure of."""
    told = score.confusion
    count = sum(map(sum, told.counts))
    wrong = score["all, wrong above 0.8"]
    yield f"{count - len(score.missed)} of {count} verdicts are right; {wrong.held} mislead with more than 0.8."
    yield (
        f"{cases} campaigns of the blind plant, seed {seed}. Their answers were sealed before any was diagnosed, with "
        f"sha256 {answers_sha256[:16]}…, and each was diagnosed by a process that was given its runs alone."
    )
    yield (
        "Intervals hold 95 % (Wilson). They say how certain a rate is for campaigns like these: simulated ones, of "
        "which a real rig is none."
    )


def calibration_sentences(one: Calibration) -> Iterator[str]:
    """Say how good the probabilities are."""
    if isfinite(one.skill):
        yield (
            f"Brier score of all hypotheses {one.brier:.3f}, against {one.brier_base:.3f} for always stating how often "
            f"each is true in this exam: a skill of {one.skill:.2f}."
        )
    if isfinite(one.verdict_skill):
        yield (
            f"Of the verdict's probability alone {one.verdict_brier:.3f}, against {one.verdict_base:.3f} for always "
            f"stating the share of right verdicts: a skill of {one.verdict_skill:.2f}. The better a diagnosis, the "
            "less there is left to win here."
        )


def promise_sentences(one: Promises) -> Iterator[str]:
    """Say what came of the promised shrink."""
    fresh = "fresh runs of the same specimen at other speeds and strains"
    yield (
        f"Promised and achieved share of the gap that closes, over {len(one.kept)} campaigns with {fresh}: they "
        f"differ by {one.difference:.3f} in the median{_right(one)}."
    )
    if one.closed.count:
        yield f"Of the right names at full size and at a third, {_of(one.closed)} close 90 % of the gap there."
    if one.within.count:
        yield (
            f"In {_of(one.within)} the achieved share lies in the promised 95 % interval. That interval is over the "
            "runs of one session; what other speeds, strains and another session change comes on top of it. Parameters "
            "have no coverage to be checked: the plant's forms are others than the catalogue's, so that there is no "
            "true value."
        )


def _right(one: Promises) -> str:
    return f", and by {one.right_difference:.3f} where the name is right" if isfinite(one.right_difference) else ""


def _of(one: Rate) -> str:
    return f"{one.held} of {one.count} ({one.low:.2f} to {one.high:.2f})"
