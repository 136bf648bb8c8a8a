"""What an exam says, as text for a terminal."""

from collections.abc import Iterator, Sequence
from math import isfinite
from typing import TYPE_CHECKING

from dragrig.cli.gap.printing import table
from dragrig.cli.gap.rate_rows import RATE_HEADER, RATE_NUMBERS, rate_row
from dragrig.gap_scoring.scoring import missed_cells
from dragrig.gap_scoring.words import calibration_sentences, exam_sentences, promise_sentences

if TYPE_CHECKING:
    from rich.console import RenderableType

    from dragrig.blind.exam import BlindExam
    from dragrig.gap_scoring.calibration import Calibration
    from dragrig.gap_scoring.detection import Detection
    from dragrig.gap_scoring.rates import Rate

MOST_MISSED = 40


def exam_parts(exam: "BlindExam") -> "Iterator[RenderableType]":
    """Yield all that an exam says, the sentence that sums it up first."""
    found = exam.score
    yield "\n".join(exam_sentences(found, exam.cases, exam.seed, exam.answers_sha256))
    yield table("How often the diagnosis is right", RATE_HEADER, map(rate_row, found.rates), RATE_NUMBERS)
    if any(one.count for one in found.withheld):
        title = "Where the true effect is taken out of the catalogue"
        yield table(title, RATE_HEADER, map(rate_row, (one for one in found.withheld if one.count)), RATE_NUMBERS)
    if found.detection:
        yield _detection(found.detection)
    if found.calibration.bins:
        yield "\n".join(calibration_sentences(found.calibration))
        yield _reliability(found.calibration)
    if found.promises.kept:
        yield "\n".join(promise_sentences(found.promises))
    if found.missed:
        header = ("case", "truth", "form", "size", "said", "probability")
        more = f", the first {MOST_MISSED} of {len(found.missed)}" if len(found.missed) > MOST_MISSED else ""
        yield table(f"Not right{more}", header, [missed_cells(one) for one in found.missed[:MOST_MISSED]], (5,))


def _detection(bins: "Sequence[Detection]") -> "RenderableType":
    header = ("d′", "effects", "a gap is seen", "the right name", "a wrong name")
    rows = [
        (
            f"{one.low:g} to {one.high:g}" if isfinite(one.high) else f"above {one.low:g}",
            str(one.seen.count),
            _share(one.seen),
            _share(one.named),
            _share(one.misled),
        )
        for one in bins
    ]
    return table("Detection against size (d′ of the hidden effect)", header, rows, (1, 2, 3, 4))


def _reliability(calibration: "Calibration") -> "RenderableType":
    header = ("probability", "verdicts", "right", "would be right, 95 %")
    rows = [
        (
            f"{one.low:g} to {one.high:g}",
            str(one.count),
            f"{one.share:.2f}",
            f"{one.band[0]:.2f} to {one.band[1]:.2f}",
        )
        for one in calibration.bins
    ]
    return table("Reliability: verdicts by their probability", header, rows, (1, 2))


def _share(one: "Rate") -> str:
    return f"{one.share:.2f} ({one.low:.2f} to {one.high:.2f})"
