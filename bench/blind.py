"""Campaigns with hidden effects, and how a diagnosis did on them.

`python bench/blind.py make --cases 100 --seed 1 --out DIR` writes DIR/0001/*.h5 and so on, and DIR/answers.json;
`python bench/blind.py diagnose DIR` diagnoses them, `python bench/blind.py score DIR` opens the answers.
`python bench/blind.py score DIR` reads DIR/0001/diagnosis.json and so on and prints how often they are right.
`python bench/blind.py sizes --draws 4` prints how large the effects are, form by form.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import hashlib
import json
import multiprocessing
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from dragrig.sim_backend.blind import CATALOGUE, OUTSIDE, answer, draw, make

SHARES = {
    "full": 0.40,
    "third": 0.15,
    "tenth": 0.10,
    "none": 0.10,
    "outside": 0.10,
    "pair": 0.07,
    "rough": 0.08 * 2 / 3,
    "rough none": 0.08 / 3,
}
"""Of each kind of case; single effects go through the whole vocabulary in turn."""


@dataclass(frozen=True, slots=True)
class Case:
    """What is to be hidden in one campaign."""

    number: int
    kind: str
    seed: int
    effects: tuple[str, ...]
    sizes: tuple[float, ...]
    rough: bool


def mix(cases: int, seed: int) -> list[Case]:
    """Return a balanced mix in random order; counts follow the shares as nearly as whole numbers allow."""
    random = np.random.default_rng(seed)
    exact = np.array([share * cases for share in SHARES.values()])
    counts = np.floor(exact).astype(int)
    counts[np.argsort(counts - exact)[: cases - int(counts.sum())]] += 1
    kinds = [kind for kind, count in zip(SHARES, counts.tolist(), strict=True) for _ in range(count)]
    singles, foreign = _in_turn(tuple(CATALOGUE), random), _in_turn(tuple(OUTSIDE), random)
    made = []
    for kind in kinds:
        effects, sizes = _hidden(kind, singles, foreign, random)
        made.append((kind, effects, sizes))
    order = random.permutation(len(made)).tolist()
    seeds = random.integers(1, 2**31, len(made)).tolist()
    return [
        Case(number, made[at][0], own, made[at][1], made[at][2], rough=made[at][0].startswith("rough"))
        for number, (at, own) in enumerate(zip(order, seeds, strict=True), 1)
    ]


def _in_turn(names: Sequence[str], random: np.random.Generator) -> Iterator[str]:
    while True:
        yield from random.permutation(np.array(names)).tolist()


def _hidden(
    kind: str, singles: Iterator[str], foreign: Iterator[str], random: np.random.Generator
) -> tuple[tuple[str, ...], tuple[float, ...]]:
    if kind in {"none", "rough none"}:
        return (), ()
    if kind == "outside":
        return (next(foreign),), (1.0,)
    if kind == "pair":
        first, second = next(singles), next(singles)
        while _place(first) == _place(second):
            second = next(singles)
        return (first, second), (1.0, 1.0 if random.random() < 0.5 else 1 / 3)
    return (next(singles),), ({"third": 1 / 3, "tenth": 1 / 10}.get(kind, 1.0),)


def _place(name: str) -> str:
    return CATALOGUE[name][0].__module__


def write(out: Path, fresh: bool, case: Case) -> dict[str, Any]:
    """Write one campaign and return its answer."""
    secret = draw(case.seed, effects=case.effects, size=case.sizes, rough=case.rough)
    name = f"{case.number:04d}"
    for folder, runs in ((out / name, None), (out / "fresh" / name, "fresh"))[: 2 if fresh else 1]:
        if folder.exists():
            shutil.rmtree(folder)
        make(secret, folder, runs=runs)
    return {"case": case.kind, **answer(secret)}


def make_all(cases: int, seed: int, out: Path, *, fresh: bool) -> None:
    """Write all campaigns of a mix and seal their answers."""
    out.mkdir(parents=True, exist_ok=True)
    planned = mix(cases, seed)
    with multiprocessing.Pool(2) as pool:
        found = pool.map(partial(write, out, fresh), planned, chunksize=1)
    text = json.dumps({f"{one.number:04d}": told for one, told in zip(planned, found, strict=True)}, indent=1)
    (out / "answers.json").write_text(text, encoding="utf-8")
    digest = hashlib.sha256(text.encode()).hexdigest()
    (out / "answers.sha256").write_text(f"{digest}  answers.json\n", encoding="utf-8")
    print(f"{len(planned)} campaigns in {out}, answers sealed with sha256 {digest}")


def print_score(folder: Path) -> None:
    """Print how often the diagnoses beside the campaigns are right."""
    from rich.console import Console

    from dragrig.gap_scoring import score

    text = (folder / "answers.json").read_text(encoding="utf-8")
    sealed = folder / "answers.sha256"
    if sealed.exists() and sealed.read_text(encoding="utf-8").split()[0] != hashlib.sha256(text.encode()).hexdigest():
        print("answers.json is not what was sealed")
    answers: dict[str, dict[str, Any]] = json.loads(text)
    told = {name: folder / name / "diagnosis.json" for name in answers}
    pairs = [
        (name, answers[name], json.loads(path.read_text(encoding="utf-8")))
        for name, path in told.items()
        if path.exists()
    ]
    if len(pairs) < len(answers):
        print(f"{len(answers) - len(pairs)} of {len(answers)} campaigns have no diagnosis.json and are left out")
    console = Console()
    for table in score(pairs).tables():
        console.print(table)


def print_sizes(draws: int, names: Sequence[str]) -> None:
    """Print d′ of every form at full size: median, least and largest of some draws."""
    from dataclasses import replace

    from blind_sizes import directions, size

    bases = [draw(7 + at) for at in range(draws)]
    nominal = [directions(one) for one in bases]
    print(f"{'effect':20s} {'form':28s} {'force':>6s} {'least':>6s} {'most':>6s}  position")
    for name, forms in {**CATALOGUE, **OUTSIDE}.items():
        for form in forms if name in names or not names else ():
            found = []
            for base, known in zip(bases, nominal, strict=True):
                effect = form.drawn(np.random.default_rng(base.seed), 1.0)
                found.append(size(replace(base, effects=(effect,), sizes=(1.0,)), known))
            force = sorted(one.force for one in found)
            place = np.median([one.position for one in found])
            print(f"{name:20s} {form.form:28s} {np.median(force):6.0f} {force[0]:6.0f} {force[-1]:6.0f}  {place:.0f}")


def diagnose_all(folder: Path, without: bool) -> None:
    """Diagnose every campaign that has no diagnosis yet, two at a time, each without knowledge of the answers."""
    cases = [one for one in sorted(folder.iterdir()) if one.is_dir() and one.name != "fresh"]
    answers = json.loads((folder / "answers.json").read_text(encoding="utf-8")) if without else {}
    waiting = [(one, tuple(answers.get(one.name, {}).get("effects", ())) if without else ()) for one in cases]
    waiting = [one for one in waiting if not (one[0] / _name(without)).is_file()]
    began = perf_counter()
    with multiprocessing.Pool(2, maxtasksperchild=8) as pool:
        seconds = list(pool.imap_unordered(partial(_diagnose_one, without), waiting))
    if seconds:
        print(f"{len(seconds)} campaigns in {perf_counter() - began:.0f} s, each {np.median(seconds):.1f} s (median)")


def _name(without: bool) -> str:
    return "diagnosis-without.json" if without else "diagnosis.json"


def _diagnose_one(without: bool, case: tuple[Path, tuple[str, ...]]) -> float:
    from dragrig.diagnosing import diagnosed, gap_evaluate
    from dragrig.gap_json import gap_document, shrink_document

    folder, left_out = case
    began = perf_counter()
    found = diagnosed(folder, without=left_out, workers=1).result
    seconds = perf_counter() - began
    fresh = folder.parent / "fresh" / folder.name
    if not without and fresh.is_dir() and found.model is not None:
        told = json.dumps(shrink_document(gap_evaluate(found.model, fresh)))
        (folder / "fresh.json").write_text(told, encoding="utf-8")
    (folder / _name(without)).write_text(json.dumps(gap_document(found)), encoding="utf-8")
    return seconds


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    maker = commands.add_parser("make", help="write campaigns and their sealed answers")
    maker.add_argument("--cases", type=int, default=100)
    maker.add_argument("--seed", type=int, default=1)
    maker.add_argument("--out", type=Path, required=True)
    maker.add_argument(
        "--fresh", action="store_true", help="write DIR/fresh/0001 too: the same at other speeds and strains"
    )
    doctor = commands.add_parser("diagnose", help="diagnose the campaigns that have no diagnosis yet")
    doctor.add_argument("folder", type=Path)
    doctor.add_argument("--without", action="store_true", help="with the true effects taken out of the catalogue")
    scorer = commands.add_parser("score", help="compare diagnoses with the answers")
    scorer.add_argument("folder", type=Path)
    sizer = commands.add_parser("sizes", help="print how large the effects are")
    sizer.add_argument("--draws", type=int, default=4)
    sizer.add_argument("effects", nargs="*")
    given = parser.parse_args()
    if given.command == "make":
        make_all(given.cases, given.seed, given.out, fresh=given.fresh)
    elif given.command == "diagnose":
        diagnose_all(given.folder, given.without)
    elif given.command == "score":
        print_score(given.folder)
    else:
        print_sizes(given.draws, given.effects)


if __name__ == "__main__":
    main()
