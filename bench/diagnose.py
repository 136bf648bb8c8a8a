"""How long a campaign of 31 runs at 500 Hz takes to diagnose, where the time goes, and how it grows with the runs.

    python bench/diagnose.py [--effects stribeck force_drift] [--seed 26] [--rounds 3] [--runs 124 1000]

The blind plant makes the campaign. Each round times the command as a process of its own and the diagnosis from folder
to result in a fresh process, whose peak memory is told too. The stages are timed where the diagnosis calls them; one
that calls another counts it. Longer campaigns are the same runs copied under other ids and later times.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from datetime import datetime, timedelta
from pathlib import Path
from statistics import median
from uuid import uuid4

import h5py

from dragrig.sim_backend.blind import draw_campaign, write_campaign

RATE_HZ, RUNS = 500, 31
BAR_MB = 1000.0
"""Peak memory that no campaign may need."""
STAGES = {
    "dragrig.analysis.gap.forward_selection": ("linearise", "refit_with_effect", "_relinearised", "forward_selection"),
    "dragrig.analysis.gap.diagnose": (
        "analyse_position",
        "find_spectral_lines",
        "prepare_study",
        "search_effects",
        "localise",
        "predict_held_out",
    ),
    "dragrig.analysis.gap.studies": ("model_error_columns",),
    "dragrig.analysis.gap.design": ("linearise", "signatures", "parameter_derivatives", "_nominal_derivatives"),
}


def copied(campaign: Path, folder: Path, runs: int) -> Path:
    """Copy a campaign's runs in turn until there are so many, each session after the one before."""
    folder.mkdir()
    files = sorted(campaign.glob("*.h5"))
    for number in range(runs):
        session, at = divmod(number, len(files))
        path = Path(shutil.copy(files[at], folder / f"{number:04d}-{files[at].stem.split('-')[1]}.h5"))
        with h5py.File(path, "r+") as file:
            entry = file["entry"].attrs
            later = datetime.fromisoformat(str(entry["start_time"])) + timedelta(hours=2 * session)
            entry.update({"run_id": str(uuid4()), "start_time": later.isoformat(), "order": number})
    return folder


@contextmanager
def timed(spent: dict[str, float]) -> Iterator[None]:
    """Add up what the stages take."""
    from importlib import import_module

    modules = [(import_module(name), names) for name, names in STAGES.items()]
    before = [(module, name, getattr(module, name)) for module, names in modules for name in names]

    def wrapped(name: str, call: Callable[..., object]) -> Callable[..., object]:
        def run(*text: object, **named: object) -> object:
            began = time.perf_counter()
            try:
                return call(*text, **named)
            finally:
                spent[name] += time.perf_counter() - began

        return run

    for module, name, call in before:
        setattr(module, name, wrapped(name, call))
    try:
        yield
    finally:
        for module, name, call in before:
            setattr(module, name, call)


def diagnose_once(folder: Path, *, stages: bool) -> None:
    """Diagnose a folder and print what it took as JSON."""
    import psutil

    from dragrig.analysis.gap.diagnose import diagnose
    from dragrig.analysis.gap.run_data import choose_runs
    from dragrig.analysis.models.capsule_model import MODEL

    spent = defaultdict[str, float](float)
    began, own = time.perf_counter(), time.process_time()
    selection = choose_runs(folder)
    read = time.perf_counter() - began
    with timed(spent) if stages else nullcontext():
        diagnosis = diagnose(selection, MODEL)
    wall, cpu = time.perf_counter() - began, time.process_time() - own
    memory = psutil.Process().memory_info()
    peak = getattr(memory, "peak_wset", 0) / 1e6 or _peak_mb()
    answer = {
        "verdict": diagnosis.verdict.value,
        "effects": diagnosis.effects,
        "used": diagnosis.runs,
        "read": read,
        "wall": wall,
    }
    print(json.dumps({**answer, "cpu": cpu, "peak_MB": peak, "stages": {**diagnosis.timings_s, **spent}}))


def _peak_mb() -> float:
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0) / 1e6


def fresh(folder: Path, *more: str) -> dict[str, object]:
    """Do it in a process of its own."""
    done = subprocess.run([sys.executable, __file__, "--one", str(folder), *more], capture_output=True, check=True)
    answer: dict[str, object] = json.loads(done.stdout)
    return answer


def commanded(folder: Path) -> float:
    """Return the wall time [s] of the command."""
    command = [sys.executable, "-m", "dragrig", "gap", "diagnose", str(folder), "--quiet"]
    began = time.perf_counter()
    subprocess.run(command, capture_output=True, check=True)
    return time.perf_counter() - began


def line(name: str, result: dict[str, object]) -> str:
    """Return one measurement as a line."""
    return (
        "  {name:>10}  {used:>5}  {read:5.1f}  {wall:6.1f}  {cpu:6.1f}  {peak_MB:7.0f}  {verdict} {effects}".format_map(
            {"name": name, **result}
        )
    )


def report(seed: int, effects: Sequence[str], rounds: int, runs: Sequence[int]) -> bool:
    """Print all; return whether the memory stays below its bar."""
    with tempfile.TemporaryDirectory() as place:
        made = Path(place) / "made"
        write_campaign(draw_campaign(seed, effects=effects), made)
        campaign = copied(made, Path(place) / "campaign", RUNS)
        commands = [commanded(campaign) for _ in range(rounds)]
        print(f"{RUNS} runs at {RATE_HZ} Hz with {' and '.join(effects) or 'no effect'}, seed {seed}")
        print(f"the command: {median(commands):.1f} s, median of {rounds}\n")
        print("        runs   used   read    wall     CPU  peak MB")
        whole = [fresh(campaign) for _ in range(rounds)]
        for result in whole:
            print(line(str(RUNS), result))
        peaks = [float(str(row["peak_MB"])) for row in whole]
        for many in runs:
            result = fresh(copied(made, Path(place) / str(many), many))
            print(line(str(many), result))
            peaks.append(float(str(result["peak_MB"])))
        stages = fresh(campaign, "--stages")["stages"]
        print("\nwhere the time goes [s]")
        if isinstance(stages, dict):
            for name, took in sorted(stages.items(), key=lambda pair: -pair[1]):
                print(f"  {took:6.2f}  {name}")
        return max(peaks) < BAR_MB


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--effects", nargs="*", default=["stribeck", "force_drift"])
    parser.add_argument("--seed", type=int, default=26)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--runs", type=int, nargs="*", default=[124, 1000])
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--stages", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one is not None:
        diagnose_once(options.one, stages=options.stages)
        return
    sys.exit(0 if report(options.seed, options.effects, options.rounds, options.runs) else 1)


if __name__ == "__main__":
    main()
