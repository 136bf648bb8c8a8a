"""Evidence of hidden campaigns that the tests judge anew in seconds.

`python bench/replay.py make --seed S --out FILE.jsonl.xz` simulates campaigns as exams draw them, of both plants and in
turn, and weighs what causes the gap of each, in about 15 s of a core, on all cores; the evidence is kept beside FILE
until all is there, so that the same command continues after a stop.

`python bench/replay.py judge` judges the evidence of the tests anew, prints how often that is right, and writes the
verdict on each campaign beside it, for the tests to compare with. `python bench/replay.py sense` prints which changes
of the judging it notices.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import csv
import json
import lzma
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

import stored_evidence
from dragrig.analysis import no_progress
from dragrig.analysis.gap import choose_runs, classifier, features, presence, weighing
from dragrig.analysis.gap.diagnose import tell
from dragrig.analysis.gap.localise import localise
from dragrig.analysis.gap.weighing import WeighedCauses, weigh_causes
from dragrig.api.gap import DiagnosisRequest
from dragrig.exam.hidden_cases import HiddenCase
from dragrig.present import diagnosis_json
from dragrig.scoring import AnswerKey, ScoredCase
from dragrig.sim_backend.blind import true_answer, write_campaign
from stored_evidence import (
    JUDGED,
    OUTCOME,
    Header,
    counts,
    header_of,
    likely_sets,
    outcome,
    rounded,
    stored_campaigns,
    stored_lines,
    surprise,
)

WRITTEN, DRAWN = 60, 100
"""Campaigns of each plant; those with drawn laws are as many more as their mix has more kinds."""


def evidence(name: str, case: HiddenCase) -> Mapping[str, object]:
    """Simulate and weigh a campaign."""
    answer = {"case": case.kind, **true_answer(case.secret)}
    record = {"name": name, "answer": AnswerKey.model_validate(answer).model_dump(mode="json", exclude_defaults=True)}
    request = DiagnosisRequest(next_runs=None)
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root) / name
        write_campaign(case.secret, folder)
        try:
            weighed = weigh_causes(choose_runs(folder, None, no_progress), request.model(), request.options())
        except Exception as error:  # noqa: BLE001  # whatever it is, the campaign counts as not diagnosed, as in an exam
            return {**record, "failed": f"{type(error).__name__}: {error}".replace(str(folder), name)}
        return {**record, **stored(weighed, nothing_hidden=not case.effects)}


def stored(weighed: WeighedCauses, *, nothing_hidden: bool) -> Mapping[str, object]:
    """Return what is kept of weighed causes."""
    inputs = weighed.inputs.document()
    del inputs["competition"], inputs["by_model"]
    causes, sets = likely_sets(weighed)
    found: dict[str, object] = {"inputs": inputs, "causes": causes, "sets": sets}
    if not weighed.verdict.effects:
        reduction = weighed.held_out[0]
        found["gap_over_floor"] = None if reduction is None else reduction.gap_before_mN / reduction.noise_floor_mN
        found["place_p"] = localise(weighed.blocks, present=True).p
    if nothing_hidden:
        budget = diagnosis_json(tell(weighed))["budget"]
        assert isinstance(budget, list)
        found["budget"] = [[part["cause"], part["share"]] for part in budget]
    return {name: rounded(value) for name, value in found.items()}


def make(seed: int, written: int, drawn: int, first: int | None, out: Path) -> None:
    """Make all evidence that is not there yet, and the file once all is there."""
    partial = out.with_name(f".{out.name}.begun")
    command = f"python bench/replay.py make --seed {seed} --written {written} --drawn {drawn} --out {out.name}"
    header = Header(seed=seed, written=written, drawn=drawn, command=command)
    lines = partial.read_text("utf-8").split("\n")[:-1] if partial.exists() else [json.dumps(asdict(header))]
    if header_of(lines) != header:
        sys.exit(f"{partial}: holds other campaigns; remove it, or give the numbers of its first line.")
    partial.parent.mkdir(parents=True, exist_ok=True)
    partial.write_text("".join(f"{line}\n" for line in lines), "utf-8", newline="\n")
    chosen = list(header.cases.items())[:first]
    with partial.open("a", encoding="utf-8", newline="\n") as file, ProcessPoolExecutor() as pool:
        missing = chosen[len(lines) - 1 :]
        for (name, case), found in zip(missing, pool.map(evidence, *zip(*missing, strict=True)), strict=True):
            lines.append(json.dumps(found, separators=(",", ":")))
            file.write(f"{lines[-1]}\n")
            file.flush()
            print(name, case.kind, *case.effects, *case.conditions, flush=True)
    if first is not None:
        lines[0] = json.dumps(asdict(replace(header, command=f"{command} --first {first}")))
    text = "".join(f"{line}\n" for line in lines[: 1 + len(chosen)])
    out.write_bytes(lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME))
    if first is None:
        partial.unlink()


def write_judged() -> None:
    """Judge the tests' evidence anew, write the verdicts, and print how often they are right."""
    judged = [campaign.judged() for campaign in stored_campaigns(stored_lines())]
    with JUDGED.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([OUTCOME, *map(outcome, judged)])
    for name, count in counts(judged).items():
        print(f'    "{name}": {count},')
    print(f"SURPRISE = {surprise(judged):.3f}")


FACTORS = (0.8, 1.25)
CHANGED: Mapping[ModuleType, tuple[str, ...]] = {
    features: (
        *("CHANCE_SIGMAS", "NOISE_UNCERTAINTY", "FORM_LOSS", "ABRUPT_WEIGHT", "AT_LIMIT_MIN_SHARE"),
        *("NONPARAMETRIC_CHANCE_LLR", "SHARE_SOFTENING", "MANY_LOOKALIKES", "EQUAL_SHARE"),
    ),
    classifier: (
        *("MIN_OTHER_LINE_LLR", "OTHER_LINE_LLR_WIDTH", "MIN_MAINS_LLR", "MAINS_LLR_WIDTH"),
        *("CONFUSABLE_RATIO", "MIN_POSITION_SHARE"),
        *("POSITION_SHARE_WIDTH", "POSITION_RIVAL_SLOPE", "ESTABLISHED", "MIN_COMPETITION", "MOTION_ERROR_LOG_ODDS"),
    ),
    weighing: ("MAX_GAP_OVER_FLOOR", "ALPHA"),
    stored_evidence: ("DEFAULT_TOLERANCE_MN",),
}
"""Constants of the judging, where they are used."""


def changed_verdicts(lines: Sequence[str]) -> Iterator[tuple[str, Sequence[ScoredCase]]]:
    """Yield plausible changes of the judging, and what it then makes of the evidence."""
    campaigns, shipped = stored_campaigns(lines), features.shipped_calibration()
    for part in ("gate", "weights", "presence"):
        numbers = getattr(shipped, part)
        numbers = dict(numbers if part == "weights" else numbers.model_dump())
        for (name, value), factor in product(numbers.items(), FACTORS):
            document = shipped.model_dump() | {part: {**numbers, name: value * factor}}
            calibration = features.VerdictCalibration.model_validate(document)
            yield f"{part}, {name} × {factor:g}", [campaign.judged(calibration) for campaign in campaigns]
    for module, names in CHANGED.items():
        for name, factor in product(names, FACTORS):
            with patch.object(module, name, getattr(module, name) * factor):
                yield f"{name} × {factor:g}", [campaign.judged() for campaign in campaigns]
    for kind, factor in product(presence.PRIOR_PROBABILITIES, FACTORS):
        with patch.dict(presence.PRIOR_PROBABILITIES, {kind: factor * presence.PRIOR_PROBABILITIES[kind]}):
            yield f"prior of {kind} × {factor:g}", [campaign.judged() for campaign in stored_campaigns(lines)]


def print_sense() -> None:
    """Print what each change of the judging does to verdicts: how many change, and which counts."""
    lines = stored_lines()
    usual = [campaign.judged() for campaign in stored_campaigns(lines)]
    before, outcomes = counts(usual), list(map(outcome, usual))
    columns = "change", "right", "misleading", "counts", "verdicts", "lines", "surprise"
    print("{:42s} {:>5s} {:>10s} {:>7s} {:>8s} {:>6s} {:>9s}".format(*columns))
    for name, judged in changed_verdicts(lines):
        after, changed = counts(judged), list(map(outcome, judged))
        right, misleading = after["all, right"][0], after["all, wrong above 0.8"][0]
        differing = sum(after.get(rate) != count for rate, count in before.items())
        verdicts = sum(old[3] != new[3] for old, new in zip(outcomes, changed, strict=True))
        stated = sum(old != new for old, new in zip(outcomes, changed, strict=True))
        less_sure = surprise(judged) - surprise(usual)
        print(f"{name:42s} {right:5d} {misleading:10d} {differing:7d} {verdicts:8d} {stated:6d} {less_sure:+9.3f}")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    maker = commands.add_parser("make", help="make the evidence")
    maker.add_argument("--seed", type=int, required=True)
    maker.add_argument("--written", type=int, default=WRITTEN)
    maker.add_argument("--drawn", type=int, default=DRAWN)
    maker.add_argument("--first", type=int)
    maker.add_argument("--out", type=Path, required=True)
    commands.add_parser("judge", help="judge the tests' evidence, and write the verdicts beside it")
    commands.add_parser("sense", help="print which changes of the judging the tests' evidence notices")
    options = parser.parse_args()
    if options.command == "judge":
        write_judged()
    elif options.command == "sense":
        print_sense()
    else:
        make(options.seed, options.written, options.drawn, options.first, options.out)


if __name__ == "__main__":
    main()
