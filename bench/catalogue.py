"""How fast the catalogue of a lab of 100,000 runs answers, and `dragrig find` and `list` as whole processes.

The runs are empty files in 3,000 campaigns, entered as if a template had been read from each; reading is timed apart,
on the template. Times are those of the processor, in seconds, the least of five.

    python bench/catalogue.py [FOLDER]
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import dragrig.rig
from dragrig import catalogue, run_listing
from dragrig.rig import RunInfo, RunMark, read_info

TEMPLATE = Path(__file__).parents[1] / "tests" / "data" / "campaign" / "010-drag.h5"
CAMPAIGNS, RUNS = 3000, 34
KINDS = ("drag", "drag", "drag", "return", "relaxation", "coulomb")


def make_files(lab: Path) -> Path:
    """Make the files of a lab and return its data root."""
    root = lab / "runs"
    for campaign in range(CAMPAIGNS):
        folder = root / f"campaign-{campaign:04d}"
        folder.mkdir(parents=True)
        for run in range(RUNS):
            (folder / f"20260504-{run:06d}-{KINDS[run % len(KINDS)]}-{run:03d}.h5").touch()
    (lab / "rig.toml").write_text("", "utf-8")
    time.sleep(run_listing.SETTLING_S)
    return root


def entering(template: RunInfo) -> Callable[[Path], tuple[RunInfo, RunMark | None]]:
    """Return what takes the place of reading a run file."""

    def read(path: Path) -> tuple[RunInfo, RunMark | None]:
        campaign, run = int(path.parent.name[-4:]), int(path.stem[-3:])
        header = replace(
            template.header,
            kind=KINDS[run % len(KINDS)],
            order=run,
            start_time=template.header.start_time + timedelta(days=campaign, minutes=run),
            specimen={**template.header.specimen, "id": f"P{campaign // 3}"},
        )
        return replace(template, path=path, header=header), None

    return read


def least_s(measure: Callable[[], object], clock: Callable[[], float] = time.process_time) -> float:
    """Return the least time of five."""
    times = []
    for _ in range(5):
        began = clock()
        measure()
        times.append(clock() - began)
    return min(times)


def children_s() -> float:
    """Return the processor time of all processes that were waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Make the lab and print the times."""
    with tempfile.TemporaryDirectory(dir=sys.argv[1] if len(sys.argv) > 1 else None) as name:
        root = make_files(Path(name))
        reading_s = least_s(lambda: dragrig.rig.read_marked(TEMPLATE))
        dragrig.rig.read_marked = entering(read_info(TEMPLATE))
        began_s = time.process_time()
        catalogue.ask_runs(root, lambda listing: listing.folders())
        file = root.with_name(root.name + catalogue.SUFFIX)
        print(f"{CAMPAIGNS * RUNS} runs in {CAMPAIGNS} campaigns, catalogue {file.stat().st_size / 1e6:.0f} MB")
        print(f"read one run file {reading_s:.4f} s; enter all, without reading {time.process_time() - began_s:.1f} s")
        questions: dict[str, Callable[[run_listing.RunListing], object]] = {
            "no question, only what is new": lambda _: None,
            "find --specimen P7": lambda listing: listing.found(run_listing.RunQuery(specimen="P7")),
            "find --kind relaxation": lambda listing: listing.found(run_listing.RunQuery(kind="relaxation")),
            "find (all)": lambda listing: listing.found(run_listing.RunQuery()),
            "list": lambda listing: listing.summaries(),
        }
        for question, ask in questions.items():
            print(f"answer  {question:32s} {least_s(lambda ask=ask: catalogue.ask_runs(root, ask)):.3f} s")
        commands = ("find --help", "find --specimen P7", "find --kind relaxation", "find", "list")
        for command in commands:
            words = [
                sys.executable,
                "-c",
                "import sys; from dragrig.cli import main; sys.exit(main())",
                *command.split(),
            ]
            seconds = least_s(
                lambda words=words: subprocess.run(words, cwd=root.parent, stdout=subprocess.DEVNULL,
                                                   stderr=subprocess.DEVNULL, env=os.environ, check=True),
                children_s,
            )  # fmt: skip
            print(f"process dragrig {command:24s} {seconds:.3f} s")


if __name__ == "__main__":
    main()
