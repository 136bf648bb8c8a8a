"""Count what the verdict has learnt and which constants it is set by, and print what accuracy costs without each.

`python bench/learnt_numbers.py [LEARN … --judge JUDGE …]`: folders of exams (`dragrig gap blind --out`), some to learn
from and some to judge by. Every learnt number is left out in turn, the others are learnt again, and the campaigns that
judge are answered by what is left. Without folders, the counts alone. Nothing is simulated or diagnosed anew: an exam
keeps the numbers that its verdicts were reached by.

A constant is a number, or a tuple or table of numbers, that a module of the diagnosis gives a name; it is explained
where a sentence or a comment stands beside it.
"""

import argparse
import ast
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from dragrig.analysis.gap import DecisionInputs, TrainingCase, VerdictCalibration, calibrate
from dragrig.analysis.gap.classifier import judge
from dragrig.analysis.gap.features import shipped_calibration
from dragrig.scoring import AnswerKey
from dragrig.sim_backend.effects import catalogue

TOLERANCE_MN = 0.5
DIAGNOSIS = ("analysis/gap", "analysis/noise.py", "analysis/linear_gaussian.py")
BINS = (0.0, 0.1, 0.5, 0.8, 0.95, 1.0)


@dataclass(frozen=True, slots=True)
class Case:
    """A campaign of an exam: what is hidden, and the numbers that its verdict was reached by."""

    answer: AnswerKey
    inputs: DecisionInputs
    exam: str

    @property
    def lesson(self) -> TrainingCase:
        """The same to learn from."""
        hidden = frozenset(self.answer.effects)
        return TrainingCase(self.inputs, hidden, self.answer.verdict == "unknown", self.answer.smallest_size)


def cases_of(folder: Path) -> Iterator[Case]:
    """Yield the campaigns of an exam that are diagnosed."""
    answers = TypeAdapter(dict[str, AnswerKey]).validate_json((folder / "answers.json").read_text("utf-8"))
    inputs = TypeAdapter(DecisionInputs)
    for name, answer in sorted(answers.items()):
        file = folder / "said" / f"{name}.json"
        if file.exists() and (evidence := json.loads(file.read_text("utf-8")).get("evidence")):
            yield Case(answer, inputs.validate_python(evidence), folder.name)


@dataclass(frozen=True, slots=True)
class Marks:
    """How well campaigns are answered."""

    right: int
    wrong: int
    missed: int
    log_loss: float
    stated: tuple[tuple[float, bool], ...]

    @classmethod
    def of(cls, cases: Sequence[Case], calibration: VerdictCalibration) -> "Marks":
        """Judge campaigns by what was learnt."""
        right = wrong = missed = 0
        stated = []
        for case in cases:
            judgement = judge(case.inputs, TOLERANCE_MN, calibration)
            hidden, named = set(case.answer.effects), set(judgement.verdict.effects)
            right += is_right(case.answer, named, judgement.verdict.verdict.value)
            wrong += bool(named - hidden)
            missed += bool(hidden - named)
            stated += [(value, name in hidden) for name, value in judgement.presence.items()]
        limited = [(min(max(value, 0.003), 0.997), there) for value, there in stated]
        loss = -float(np.sum(np.log([value if there else 1.0 - value for value, there in limited])))
        return cls(right, wrong, missed, loss, tuple(limited))

    def __str__(self) -> str:
        counts = f"{self.right:4d} right, {self.wrong:3d} wrong names, {self.missed:3d} missed"
        return f"{counts}, log loss {self.log_loss:6.1f}"


def is_right(answer: AnswerKey, named: set[str], verdict: str) -> bool:
    """Whether all hidden effects are named and no other; nothing hidden may leave a gap that is the model's own."""
    if answer.effects:
        return named == set(answer.effects) or (not answer.detectable and verdict == "no_gap")
    if answer.verdict == "unknown":
        return not named and verdict == "unknown"
    return named <= set(answer.also_right) and (verdict == "no_gap" or bool(answer.conditions))


def constants(repository: Path) -> Mapping[str, tuple[int, int]]:
    """Return how many constants each module of the diagnosis has, and how many of them are explained."""
    counts = {}
    for place in DIAGNOSIS:
        path = repository / place
        for file in sorted(path.glob("*.py")) if path.is_dir() else [path]:
            counts[file.relative_to(repository).as_posix()] = _constants_of(file)
    return counts


def _constants_of(file: Path) -> tuple[int, int]:
    text = file.read_text("utf-8")
    lines, body = text.splitlines(), ast.parse(text).body
    count = explained = 0
    for statement, following in pairwise([*body, ast.Pass()]):
        targets = statement.targets if isinstance(statement, ast.Assign) else []
        targets = [statement.target] if isinstance(statement, ast.AnnAssign) else targets
        names = [node for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)]
        value = statement.value if isinstance(statement, ast.Assign | ast.AnnAssign) else None
        numbers = value is not None and any(
            isinstance(node, ast.Constant) and isinstance(node.value, int | float) for node in ast.walk(value)
        )
        if not names or not numbers or not all(name.id.isupper() for name in names):
            continue
        said = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
        beside = "#" in lines[statement.lineno - 1] or lines[statement.lineno - 2].startswith("#")
        count += len(names)
        explained += len(names) * (said or beside)
    return count, explained


def main() -> None:
    """Print counts, and what accuracy costs without each learnt number."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("learn", nargs="*", type=Path)
    parser.add_argument("--judge", nargs="+", type=Path, default=[])
    options = parser.parse_args()
    shipped = shipped_calibration()
    of_effects = [name for name in shipped.weights if any(effect in name for effect in catalogue())]
    gate, presence = len(shipped.gate.model_dump()), len(shipped.presence.model_dump())
    print(
        f"learnt numbers: {gate + presence + len(shipped.weights)} ({gate} thresholds and widths of a gap, "
        f"{len(shipped.weights)} weights of an explanation, {presence} of presence); of an effect {len(of_effects)}"
    )
    counts = constants(Path(__file__).parents[1])
    for name, (count, explained) in counts.items():
        print(f"  {name:40s} {count:3d} constants, {explained:3d} explained")
    print(f"constants: {sum(count for count, _ in counts.values())}, {sum(e for _, e in counts.values())} explained")
    if options.learn:
        judged = [case for folder in options.judge for case in cases_of(folder)]
        print_costs([case for folder in options.learn for case in cases_of(folder)], judged)


def print_costs(learn: Sequence[Case], judged: Sequence[Case]) -> None:
    """Print how well campaigns are answered with everything, and without each learnt number."""
    lessons = [case.lesson for case in learn]
    full = calibrate(lessons, TOLERANCE_MN)
    marks = Marks.of(judged, full)
    print(f"\nlearnt from {len(learn)} campaigns, judged by {len(judged)}\n  {'with all':34s} {marks}")
    print(f"  {'as shipped':34s} {Marks.of(judged, shipped_calibration())}")
    for feature in full.weights:
        print(f"  {'without ' + feature:34s} {Marks.of(judged, calibrate(lessons, TOLERANCE_MN, left_out=(feature,)))}")
    for name in ("classifier", "competition"):
        presence = full.presence.model_copy(update={name: 0.0})
        print(f"  {'without the ' + name:34s} {Marks.of(judged, full.model_copy(update={'presence': presence}))}")
    for low, high in pairwise(BINS):
        inside = [there for value, there in marks.stated if low <= value < high]
        print(f"  presence {low:.2f} to {high:.2f}: there {sum(inside)} of {len(inside)}")


if __name__ == "__main__":
    main()
