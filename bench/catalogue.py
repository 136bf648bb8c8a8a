"""How fast the catalogue of a lab of 100,000 runs answers, and `dragrig find` and `list` as whole processes.

The runs are empty files in 3,000 campaigns, entered as if a template had been read from each; reading is timed apart,
on the template. Times are those of the processor, in seconds, the least of five.

    python bench/catalogue.py [FOLDER]

With `--attacks N` instead: N times, somebody changes what a catalogue says of a campaign, in its values, its columns,
as a bomb or as deep JSON; counted is whatever is no answer, takes more than 10 s of the processor, or comes twice.
"""

import json
import os
import random
import resource
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
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


ODD_VALUES = (None, True, -1, 2**70, 1e308, float("nan"), "", "\ud800", "9" * 5000, [], {}, [[]], {"": None})
MOST_S = 10.0


def places_in(value: object) -> Iterator[tuple[object, object]]:
    """Yield what holds a value, at any depth, and its key there."""
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in list(entries):
        yield value, key
        yield from places_in(inner)


def changed_content(draw: random.Random, content: bytes) -> bytes:
    """Change what is known of a campaign."""
    match draw.randrange(8):
        case 0:
            return zlib.compress(draw.choice((b"[", b'{"a":', b'[{"":')) * draw.choice((500, 100_000)))
        case 1:
            return zlib.compress(draw.choice((b"\0", b" ", b"[],", b'"')) * draw.choice((1 << 20, 1 << 28)))
        case 2:
            at = draw.randrange(len(content))
            return content[:at] + draw.randbytes(3) + content[at + draw.choice((3, 30)) :]
        case _:
            known = json.loads(zlib.decompress(content))
            for _ in range(draw.choice((1, 1, 3))):
                holder, key = draw.choice(list(places_in(known)))
                if isinstance(holder, dict) and draw.random() < 0.3:
                    holder.pop(key, None)
                else:
                    holder[key] = draw.choice(ODD_VALUES)
            return zlib.compress(json.dumps(known).encode("ascii"))


def attack(draw: random.Random, file: Path) -> None:
    """Change a row of a catalogue."""
    with closing(sqlite3.connect(file)) as connection, connection:
        column = draw.choice(("content", "content", "content", "summary", "state", "signature", "files"))
        (content,) = connection.execute("SELECT content FROM folder WHERE content IS NOT NULL").fetchone()
        value = changed_content(draw, content) if column == "content" else draw.choice((*ODD_VALUES[5:9], 2**62))
        try:
            connection.execute(f"UPDATE folder SET {column} = ? WHERE content IS NOT NULL", (value,))
        except (sqlite3.Error, UnicodeEncodeError):
            connection.execute("UPDATE folder SET summary = '[' WHERE content IS NOT NULL")


def count_attacks(count: int) -> int:
    """Attack a catalogue so often; return how many answers were none."""
    wrong, again, slowest_s = 0, 0, 0.0
    with tempfile.TemporaryDirectory() as name:
        root = Path(name) / "runs"
        shutil.copytree(TEMPLATE.parent, root / "first")
        (Path(name) / "rig.toml").write_text("", "utf-8")
        time.sleep(run_listing.SETTLING_S)
        file = root.with_name(root.name + catalogue.SUFFIX)
        for number in range(count):
            catalogue.ask_runs(root, lambda listing: listing.summaries(), rebuild=True)
            attack(random.Random(number), file)
            remarks: list[str] = []
            began_s = time.process_time()
            try:
                for _ in range(2):
                    catalogue.ask_runs(root / "first", lambda listing: listing.campaign(), remark=remarks.append)
                    catalogue.ask_runs(root, lambda listing: listing.summaries(), remark=remarks.append)
            except Exception as error:  # noqa: BLE001  # whatever it is, it is no answer
                remarks += [f"{type(error).__name__}: {error}"] * 2
            taken_s = time.process_time() - began_s
            slowest_s = max(slowest_s, taken_s)
            again += any("it is made again" in remark for remark in remarks)
            if len(remarks) > 1 or taken_s > MOST_S:
                wrong += 1
                print(f"attack {number}: {taken_s:.1f} s, {remarks[:2]}"[:300], flush=True)
    print(f"{count} attacks, {again} made again, {wrong} answers that are none; at most {slowest_s:.1f} s")
    return wrong


def main() -> None:
    """Make the lab and print the times."""
    if sys.argv[1:2] == ["--attacks"]:
        raise SystemExit(min(count_attacks(int(sys.argv[2])), 1))
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
