"""Campaigns of the blind plant: how the time of diagnosing them grows, and how large their effects are.

`python bench/blind.py scale --campaigns 10 40 --workers 1 2` diagnoses campaigns side by side and prints how long it
takes; run it on a machine that does nothing else. `python bench/blind.py sizes --draws 4 stribeck` prints how large
effects are, form by form; with `--plant drawn` those whose laws are drawn at random. `python bench/blind.py diagnose
DIR` and `python bench/blind.py score DIR` diagnose and score campaigns DIR/NAME whose answers somebody else wrote to
DIR/answers.json. An exam is held by `dragrig gap blind`.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from dragrig.api.gap import gap_diagnose_many
from dragrig.exam.hidden_cases import draw_cases
from dragrig.sim_backend.blind import CATALOGUE, OUTSIDE, draw_campaign, write_campaign

MANY = 1000
"""Campaigns that the time is extrapolated to."""


def print_scale(campaigns: Sequence[int], workers: Sequence[int], seed: int) -> None:
    """Print how the time of diagnosing grows with campaigns and workers."""
    with tempfile.TemporaryDirectory() as root:
        folders = [Path(root) / case.name for case in draw_cases(max(campaigns), seed)]
        for case, folder in zip(draw_cases(max(campaigns), seed), folders, strict=True):
            write_campaign(case.secret, folder)
        print("campaigns  workers  seconds  s per campaign  times as fast  " + f"{MANY} campaigns (extrapolated)")
        for count in campaigns:
            alone = None
            for some in workers:
                began = perf_counter()
                result = gap_diagnose_many(folders[:count], workers=some)
                seconds = perf_counter() - began
                alone = alone or seconds
                failed = sum(entry.result is None for entry in result)
                answer = f"{MANY * seconds / count / 60:.0f} min" + (f", {failed} failed" if failed else "")
                print(
                    f"{count:9d}  {some:7d}  {seconds:7.1f}  {seconds / count:14.2f}  {alone / seconds:13.2f}  {answer}"
                )


def diagnose(folder: Path) -> None:
    """Diagnose every campaign that has no diagnosis yet."""
    from dragrig.present.diagnosis import diagnosis_json
    from dragrig.present.numbers import to_json_value

    waiting = [path for path in sorted(folder.iterdir()) if path.is_dir() and not (path / "diagnosis.json").exists()]
    for entry in gap_diagnose_many(waiting):
        if entry.result is None:
            print(entry.why_not)
        else:
            (Path(entry.source) / "diagnosis.json").write_text(
                json.dumps(to_json_value(diagnosis_json(entry.result))), encoding="utf-8"
            )


def print_score(folder: Path) -> None:
    """Print how often the diagnoses beside the campaigns are right."""
    from dragrig.present.document import Document, Section
    from dragrig.present.exam import missed_table, rates_table
    from dragrig.present.terminal import print_document
    from dragrig.scoring import score_exam

    answers: dict[str, dict[str, Any]] = json.loads((folder / "answers.json").read_text(encoding="utf-8"))
    answer = {name: folder / name / "diagnosis.json" for name in answers}
    there = {name: json.loads(path.read_text(encoding="utf-8")) for name, path in answer.items() if path.exists()}
    if len(there) < len(answers):
        print(f"{len(answers) - len(there)} of {len(answers)} campaigns have no diagnosis.json and are left out")
    score = score_exam([(name, answers[name], text) for name, text in there.items()])
    tables = rates_table("rates", "", score.rates), missed_table(score)
    print_document(Document("How often the diagnosis is right", (Section("rates", "", tables),)))


def print_sizes(draws: int, names: Sequence[str], plant: str) -> None:
    """Print d′ of every form at full size: median, least and largest of some draws."""
    from dataclasses import replace

    from dragrig.sim_backend.blind.effect_sizes import effect_size, nuisance_directions

    if plant == "drawn":
        print_drawn_sizes(draws, names)
        return
    bases = [draw_campaign(7 + at) for at in range(draws)]
    nominal = [nuisance_directions(base) for base in bases]
    print(f"{'effect':20s} {'form':28s} {'force':>6s} {'least':>6s} {'most':>6s}  position")
    for name, forms in {**CATALOGUE, **OUTSIDE}.items():
        for form in forms if name in names or not names else ():
            result = []
            for base, known in zip(bases, nominal, strict=True):
                effect = form.drawn(np.random.default_rng(base.seed), 1.0)
                result.append(effect_size(replace(base, effects=(effect,), sizes=(1.0,)), known))
            force = sorted(entry.force for entry in result)
            place = np.median([entry.position for entry in result])
            print(f"{name:20s} {form.form:28s} {np.median(force):6.0f} {force[0]:6.0f} {force[-1]:6.0f}  {place:.0f}")


def print_drawn_sizes(draws: int, names: Sequence[str]) -> None:
    """Print d′ of effects at full size whose laws are drawn: sorted, one a draw, at 100 Hz."""
    from dataclasses import replace

    from dragrig.sim_backend.blind.effect_sizes import effect_size, nuisance_directions

    base = draw_campaign(7, conditions=["100 Hz"])
    nominal = nuisance_directions(base)
    for name in names or (*CATALOGUE, "outside"):
        result = []
        for seed in range(100, 100 + draws):
            effects = draw_campaign(seed, effects=[name], plant="drawn").effects
            size = effect_size(replace(base, effects=effects, sizes=(1.0,)), nominal)
            result.append(size.force if effects[0].channel == "force" else max(size.force, size.position))
        print(f"{name:20s} " + " ".join(f"{value:6.0f}" for value in sorted(result)), flush=True)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    scale = commands.add_parser("scale", help="print how time grows with campaigns and workers")
    scale.add_argument("--campaigns", type=int, nargs="+", default=[10, 40])
    scale.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    scale.add_argument("--seed", type=int, default=3)
    for name, answer in (("diagnose", "diagnose what has no diagnosis yet"), ("score", "compare with the answers")):
        commands.add_parser(name, help=answer).add_argument("folder", type=Path)
    sizer = commands.add_parser("sizes", help="print how large the effects are")
    sizer.add_argument("--draws", type=int, default=4)
    sizer.add_argument("--plant", choices=["written", "drawn"], default="written")
    sizer.add_argument("effects", nargs="*")
    options = parser.parse_args()
    if options.command == "scale":
        print_scale(options.campaigns, options.workers, options.seed)
    elif options.command == "diagnose":
        diagnose(options.folder)
    elif options.command == "score":
        print_score(options.folder)
    else:
        print_sizes(options.draws, options.effects, options.plant)


if __name__ == "__main__":
    main()
