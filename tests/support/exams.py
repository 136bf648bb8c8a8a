"""Made-up exams, for what scores and presents them, and exams of few runs, which are soon held."""

from collections import Counter
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from dragrig.exam.blind_exam import gap_blind
from dragrig.scoring import ExamScore, score_exam
from dragrig.sim_backend.effects.base import catalogue

Document = dict[str, object]

RUNS_LEFT = {"relaxation": 1, "blank": 1, "coulomb": 2, "drag": 4}
"""Runs of each kind that suffice for a diagnosis."""


class StoppedError(Exception):
    pass


def make_campaigns(
    cases: int, seed: int, out: Path, workers: int | None = None, scheduler: str | None = None
) -> dict[str, str]:
    """Begin an exam, stop it once its campaigns are made, and remove most of their runs.

    Returns
    -------
    The SHA-256 of each run that was made, by its path in the exam's folder.
    """

    def stop_when_made(done: int, of: int) -> None:
        if all(len(list(out.glob(f"{part}/*"))) == cases for part in ("campaigns", "fresh")):
            raise StoppedError

    with pytest.raises(StoppedError):
        gap_blind(cases, seed, out, workers=workers, scheduler=scheduler, sizes=False, progress=stop_when_made)
    paths = sorted(out.glob("*/*/*.h5"))
    digests = {path.relative_to(out).as_posix(): sha256(path.read_bytes()).hexdigest() for path in paths}
    seen = Counter[tuple[Path, str]]()
    for path in paths:
        kind = path.stem.partition("-")[2]
        seen[path.parent, kind] += 1
        if seen[path.parent, kind] > RUNS_LEFT[kind]:
            path.unlink()
    return digests


def truth(*effects: str, size: float = 1.0, outside: bool = False, rough: bool = False) -> Document:
    verdict = "unknown" if outside else ("no_gap", "effect", "several")[min(len(effects), 2)]
    sizes = [size] * len(effects)
    return {"verdict": verdict, "effects": list(effects), "size": sizes, "nominal_slightly_wrong": rough,
            "truth": ", ".join(effects) or "nothing", "form": ["one"] * len(effects)}  # fmt: skip


def diagnosis_record(
    *effects: str,
    p: float = 0.9,
    verdict: str = "",
    channel: str = "force",
    confusable: tuple[str, ...] = (),
    closed: float | None = None,
    interval: tuple[float, float] | None = None,
) -> Document:
    answer = verdict or ("effect" if len(effects) == 1 else "several")
    first = "+".join(effects) or answer
    shrink = {"closed": closed, "closed_95ci": None if interval is None else list(interval)}
    return {
        "verdict": answer,
        "effects": list(effects),
        "ranking": [{"hypothesis": first, "probability": p}, {"hypothesis": "rest", "probability": 1 - p}],
        "confusable_with": list(confusable),
        "where": {"channel": {"force": 0.2, "position": 0.2, channel: 0.8}},
        "shrink": None if closed is None else shrink,
    }


def large_exam(cases: int = 160, seed: int = 4) -> ExamScore:
    """Return the score of an exam in which most verdicts are right, some are not, and small effects are not seen."""
    random = np.random.default_rng(seed)
    names = sorted(catalogue())
    pairs, withheld, achieved, amounts = [], {}, {}, {}
    for number in range(cases):
        name, effect = f"{number + 1:04d}", names[number % len(names)]
        size = (1.0, 1 / 3, 0.1)[number % 3]
        amount = float(60.0 * size * np.exp(random.normal(0.0, 0.8)))
        p = float(random.uniform(0.55, 0.99))
        right = random.random() < p * min(amount / 5.0, 1.0)
        second = names[(number + 3) % len(names)]
        closed = float(1.0 - abs(random.normal(0.0, 0.05)))
        answer = diagnosis_record(
            effect if right else second, p=p, closed=closed, interval=(closed - 0.02, closed + 0.01)
        )
        if amount < 4.0:
            answer = diagnosis_record(verdict="no_gap", p=p)
        hidden = truth(effect, size=size)
        if number % 11 == 0:
            hidden, answer = truth(), diagnosis_record(verdict="no_gap" if number % 33 else "unknown", p=p)
        elif number % 13 == 0:
            hidden, answer = truth(outside=True), diagnosis_record(verdict="unknown", p=p)
        else:
            amounts[name] = amount
            withheld[name] = diagnosis_record(verdict="unknown", p=p) if number % 5 else diagnosis_record(second, p=p)
            achieved[name] = {"shrink": {"closed": closed + float(random.normal(0.0, 0.03)), "closed_95ci": None}}
        pairs.append((name, hidden, answer))
    return score_exam(pairs, withheld=withheld, achieved=achieved, amounts=amounts)
