"""Feed dragrig settings and run files that somebody broke, and count bugs, hangs and what takes a gigabyte.

`python bench/mutations.py [--settings 10000] [--runs 5000] [--seed 1] [--processes 100] [--only N]`: settings files
(rig, plan, capsule, specimen, model, and what lies beside runs) are changed as text or in their values and given to the
commands that read them; run files, recordings with their journals, and files to import are changed in their bytes or
by h5py and given to the commands that take run files. The commands run one after another in a process that is watched
from outside; a share of the settings is given to a process of its own. `--only` makes a single case again, and prints
what its commands print.
"""

import argparse
import contextlib
import copy
import io
import json
import multiprocessing
import os
import random
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from datetime import time as time_of_day
from multiprocessing.connection import Connection
from pathlib import Path

import h5py
import numpy as np
import psutil
import tomli_w

from dragrig.cli import main as dragrig
from dragrig.config.settings import SHIPPED_FOLDERS, shipped_files

HANG_S = 10.0
MAX_RSS_BYTES = 1 << 30
MOST_SAMPLES = 1 << 20
"""What is read to be changed: a dataset may only claim its size, after an earlier change of the same file."""
BUG = 1
KINDS = tuple(SHIPPED_FOLDERS)
LONG = "x" * 70_000
TEXTS = (
    *("", " ", "nan", "none", "{}", "[[", "1e999", "2024-02-30", "=1+1", "%s{0}", "$\\frac{", "drag", "relaxation"),
    *("..", "/", "/dev/null", "COM1", "../../etc/passwd"),
    *("\x00", "\x1b]0;x\x07", "\ufeff", "µ\u202e", "a" * 5000, LONG),
)
WHOLE_NUMBERS = (0, -1, 1, 2, 7, 1000, 10**6, 10**9, 2**31, 2**63 - 1, 2**63, -(2**63), 10**400)
NUMBERS = (
    *WHOLE_NUMBERS,
    *(0.0, -0.0, 5e-324, 1e-300, 0.1, 1e6, 1e15, 1e300, -1e300, float("nan"), float("inf"), -float("inf")),
)
PIECES = (
    *(b"nan", b"-inf", b"1e999", b"true", b"0x", b"9" * 5000, b"1979-05-27", b"[[steps]]"),
    *(b'"', b"'''", b"[", b"]", b"{", b"}", b"=", b".", b"\n", b"# ", b"\r"),
    *(b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"\\u0000", b"\xed\xa0\x80"),
)


@dataclass(frozen=True, slots=True)
class Case:
    """A case: its number says everything about it."""

    number: int
    kind: str
    """`settings` or `run`."""
    alone: bool = False
    """Whether each command is a process of its own."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a command."""

    case: Case
    command: str
    code: int | None
    """None where it did not end."""
    problem: str = ""
    seconds: float = 0.0
    peak_bytes: int = 0


def any_value(draw: random.Random, depth: int = 0) -> object:
    """Return a value of any type that TOML knows."""
    match draw.randrange(9 if depth < 3 else 6):
        case 0:
            value: object = draw.choice(
                (True, False, date(1979, 5, 27), time_of_day(7, 32), datetime(1, 1, 1, tzinfo=UTC))
            )
        case 1 | 2 | 3:
            value = draw.choice(NUMBERS)
        case 4 | 5:
            value = draw.choice(TEXTS)
        case 6:
            value = [any_value(draw, depth + 1) for _ in range(draw.choice((0, 1, 2, 3)))]
        case 7:
            value = [draw.choice((1.0, 5, -1, 1e-3))] * draw.choice((1, 10, 1000, 100_000))
        case _:
            value = {draw.choice(("a", "kind", "", "µ", "x.y")): any_value(draw, depth + 1) for _ in range(2)}
    return value


def changed_table(draw: random.Random, table: dict[str, object]) -> dict[str, object]:
    """Change, remove, add or move values of a table, at any depth."""
    for _ in range(draw.choice((1, 1, 1, 2, 5))):
        holders = [table, *_tables_in(table)]
        holder = draw.choice(holders)
        key = draw.choice(list(holder)) if holder and draw.random() < 0.9 else draw.choice(("x", "kind", "steps", ""))
        match draw.randrange(6):
            case 0:
                holder.pop(key, None)
            case 1:
                holder[key] = copy.deepcopy(table) if draw.random() < 0.2 else [holder.get(key, 1)] * 3
            case 2:
                deep: object = 1
                for _ in range(draw.choice((10, 200, 3000))):
                    deep = [deep] if draw.random() < 0.5 else {"a": deep}
                holder[key] = deep
            case _:
                holder[key] = any_value(draw)
    return table


def _tables_in(value: object) -> Iterator[dict[str, object]]:
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    for entry in inner:
        if isinstance(entry, dict):
            yield entry
        yield from _tables_in(entry)


def changed_text(draw: random.Random, data: bytes) -> bytes:
    """Change a text as a slip of the hand, a bad copy or an ill will does."""
    for _ in range(draw.choice((1, 1, 2, 4, 20))):
        start, length = draw.randint(0, len(data)), draw.choice((0, 0, 1, 3, 12, 80))
        match draw.randrange(5):
            case 0:
                lines = data.splitlines(keepends=True) or [b""]
                data += draw.choice(lines)
            case 1:
                data = data[:start] + bytes(draw.randbytes(draw.choice((1, 3, 30)))) + data[start + length :]
            case 2 if draw.random() < 0.2:
                data = data[:start] + draw.choice((b"[", b"a.", b"{a=")) * draw.choice((100, 5000)) + data[start:]
            case _:
                data = data[:start] + draw.choice(PIECES) + data[start + length :]
    return data[: draw.randint(0, len(data))] if draw.random() < 0.05 else data


def written_toml(draw: random.Random, data: bytes) -> bytes:
    """Return a settings file changed, in its values or as text."""
    if draw.random() < 0.4:
        return changed_text(draw, data)
    try:
        return tomli_w.dumps(changed_table(draw, tomllib.loads(data.decode()))).encode("utf-8", "surrogatepass")
    except (RecursionError, ValueError, TypeError):
        return changed_text(draw, data)


CAMPAIGN_COMMANDS = (
    "table campaign",
    "watch campaign --once",
    "info campaign",
    "list .",
    "recover campaign",
    "find . --bad",
    "filter campaign",
    "run --resume campaign --yes",
)
TYPED_KEYS = (
    *("speed_mm_s", "travel_mm", "plan.seed", "specimen.excised_at", "model.effects", "model.friction"),
    *("rig", "rig.stage.highest_mm", "rig.sampling.rate_hz", "a.b.c", ""),
)


def settings_case(draw: random.Random, folder: Path, seeds: Path) -> list[list[str]]:
    """Write a broken settings file and return the commands that read it."""
    what = draw.choice((*KINDS, *KINDS, "plan", "plan", "rig", "beside", "typed"))
    if what == "beside":
        shutil.copytree(seeds / "campaign", folder / "campaign")
        target = draw.choice(sorted(path for path in (folder / "campaign").iterdir() if path.suffix != ".h5"))
        data = target.read_bytes()
        target.write_bytes(changed_text(draw, data) if target.suffix != ".toml" else written_toml(draw, data))
        return [draw.choice(CAMPAIGN_COMMANDS).split()]
    if what == "typed":
        value = draw.choice((*TEXTS[:10], *map(str, NUMBERS), "[1,2]", "[[1]]", "{a=1}", "[" * 3000, "9" * 5000))
        assigned = ["--set", f"{draw.choice(TYPED_KEYS)}={value}"]
        return [
            ["check", "drag", *draw.choice((assigned, ["--effect", f"stribeck:ratio={value}"], ["--effect", value]))]
        ]
    name, source = draw.choice(sorted(shipped_files(what).items()))
    path = folder / draw.choice((f"{name}.toml", f"{name}.toml", "µ own.toml"))
    path.write_bytes(written_toml(draw, source.read_bytes()))
    own = str(path)
    match what:
        case "plan":
            return [["check", own]]
        case "rig":
            return [draw.choice((["check", "drag", "--rig", own], ["check", "--rig", own, "--backend", "simulated"]))]
        case "model":
            return [draw.choice((["check", "drag", "--model", own], ["model", "--model", own, "--json"]))]
        case _:
            return [["check", "drag", f"--{what}", own]]


def broken_bytes(draw: random.Random, path: Path) -> None:
    """Flip, cut, move or overwrite bytes of a file."""
    data = bytearray(path.read_bytes())
    if not data:
        return
    for _ in range(draw.choice((1, 1, 2, 5, 40))):
        at = draw.randrange(len(data)) if draw.random() < 0.5 else draw.randrange(min(len(data), 4096))
        match draw.randrange(7):
            case 0 | 1 | 2:
                data[at] ^= 1 << draw.randrange(8)
            case 3:
                data[at] = draw.choice((0, 255, 127, 128))
            case 4:
                size = draw.choice((2, 8, 64, 512))
                data[at : at + size] = bytes(len(data[at : at + size]))
            case 5:
                data[at : at + 8] = draw.choice((b"\xff" * 8, (1 << 62).to_bytes(8, "little"), bytes(8)))
            case _:
                source = draw.randrange(len(data))
                size = draw.choice((8, 64, 512))
                data[at : at + size] = data[source : source + size]
    if draw.random() < 0.15:
        del data[draw.randrange(len(data)) :]
    path.write_bytes(bytes(data))


def any_attribute(draw: random.Random) -> object:
    """Return a value that HDF5 can hold as an attribute, of any type and shape."""
    numbers = (*WHOLE_NUMBERS[:8], 0.1, 1e300, -1e300, float("nan"), float("inf"), np.int8(-5), np.uint64(2**64 - 1))
    texts = ("", "x", "\x1b[2J", "é" * 2000, "k" * 60_000, b"\xff\xfe", "2026-05-04T09:30:00", "9999-99-99", "drag")
    pairs = np.zeros(2, [("a", "<f4"), ("b", "S5")])
    arrays = (np.zeros(3), np.zeros((2, 2), "<i4"), np.zeros(0), np.zeros(7000), pairs)
    types = (np.bool_(1), np.float16(1), np.complex128(1j), np.longdouble(3), np.void(b"opaque"), h5py.Empty("f"))
    named = np.array(3, dtype=h5py.enum_dtype({"A": 3}))
    words = np.array(["a", "b"], dtype=h5py.string_dtype())
    return draw.choice((*numbers, *texts, *arrays, *types, h5py.Empty("S10"), named, words))


REFUSALS = (KeyError, ValueError, TypeError, OSError, RuntimeError, OverflowError, AttributeError)
"""What h5py says where it does not make a change; the next is made all the same."""


def broken_layout(draw: random.Random, path: Path) -> None:
    """Change attributes, datasets, groups and links of a run file."""
    with h5py.File(path, "r+") as file:
        items: list[str] = ["/"]
        file.visit(items.append)
        datasets = [name for name in items if isinstance(file[name], h5py.Dataset)]
        groups = [name for name in items if name not in datasets]
        for _ in range(draw.choice((1, 1, 1, 2, 4))):
            change = draw.choice(_CHANGES)
            with contextlib.suppress(*REFUSALS), np.errstate(over="ignore"):
                change(draw, file, groups, datasets)


def _break_attribute(draw: random.Random, file: h5py.File, groups: list[str], datasets: list[str]) -> None:
    item = file[draw.choice((*groups, *groups, *datasets))]
    name = draw.choice(list(item.attrs)) if len(item.attrs) else "x"
    if draw.random() < 0.25:
        del item.attrs[name]
        return
    value = any_attribute(draw)
    if draw.random() < 0.1:
        name = draw.choice(("x\x1b", "speed_mm_s", "NX_class", "kind", "é" * 50))
    if draw.random() < 0.1:
        item.attrs.create(name, item.ref, dtype=h5py.ref_dtype)
    else:
        item.attrs[name] = value


def _break_dataset(draw: random.Random, file: h5py.File, _: list[str], datasets: list[str]) -> None:
    name = draw.choice(datasets)
    old = file[name]
    attributes, length, dtype = dict(old.attrs), max(old.size, 1) if old.shape else 1, old.dtype
    del file[name]
    huge = draw.choice((2**24, 2**33, 2**40, 2**62))
    other = draw.choice(("<i8", "<u1", "<f2", "<c8", "S8", ">f8", "<f4", "<f8", "g"))
    make: Callable[[], h5py.Dataset] = draw.choice((
        lambda: file.create_dataset(name, (huge,), dtype, chunks=(1024,)),
        lambda: file.create_dataset(name, (huge,), dtype, chunks=(1024,), compression="gzip"),
        lambda: file.create_dataset(name, (length,), dtype, chunks=(2**24,), maxshape=(None,), compression="gzip"),
        lambda: file.create_dataset(name, (max(length - 1, 0),), dtype),
        lambda: file.create_dataset(name, (length + 1,), dtype),
        lambda: file.create_dataset(name, (0,), dtype),
        lambda: file.create_dataset(name, (), dtype),
        lambda: file.create_dataset(name, (length, 2), dtype),
        lambda: file.create_dataset(name, data=h5py.Empty(dtype)),
        lambda: file.create_dataset(name, (length,), other),
        lambda: file.create_dataset(name, (length,), h5py.string_dtype()),
        lambda: file.create_dataset(name, (length,), h5py.vlen_dtype(np.float64)),
        lambda: file.create_dataset(name, (length,), h5py.ref_dtype),
        lambda: file.create_dataset(name, (length,), [("time_s", "<f8"), ("kind", "S4"), ("message", "<i4")]),
        lambda: file.create_dataset(name, (length,), dtype, fillvalue=1e30 if dtype.kind == "f" else None),
        lambda: file.create_group(name),
    ))  # fmt: skip
    made = make()
    for key, value in attributes.items():
        if key not in {"DIMENSION_LIST", "REFERENCE_LIST", "CLASS", "NAME"}:
            made.attrs[key] = value


def _break_link(draw: random.Random, file: h5py.File, groups: list[str], datasets: list[str]) -> None:
    group = file[draw.choice(groups)]
    name = draw.choice((*group, "loop", "x\x1b[2J")) if draw.random() < 0.6 else "loop"
    if name in group:
        del group[name]
    match draw.randrange(7):
        case 0:
            group[name] = h5py.SoftLink(f"{group.name}/{name}")
        case 1:
            group[name] = h5py.SoftLink("/nowhere/at/all")
        case 2:
            group[name] = file
        case 3:
            group[name] = h5py.ExternalLink("/etc/passwd", "/")
        case 4:
            group[name] = file[draw.choice(datasets)]
        case 5:
            for _ in range(draw.choice((40, 4000))):
                group = group.create_group("deeper")
        case _:
            for number in range(draw.choice((1, 300))):
                group.create_group(f"{name}{number}")


def _break_text(draw: random.Random, file: h5py.File, _: list[str], datasets: list[str]) -> None:
    """Change the settings that the file holds, which `run` and `check` take from it."""
    texts = [name for name in datasets if name.endswith("settings") and file[name].shape == ()]
    name = draw.choice(texts or ["of the first version"])
    text = file[name][()]
    text = written_toml(draw, text if isinstance(text, bytes) else text.encode()).replace(b"\0", b"")
    del file[name]
    file[name] = text.decode("utf-8", "replace")


def _break_samples(draw: random.Random, file: h5py.File, _: list[str], datasets: list[str]) -> None:
    traces = [name for name in datasets if "/trace/" in name or "/filtered/" in name]
    dataset = file[draw.choice([name for name in traces if file[name].size <= MOST_SAMPLES] or ["of no size"])]
    values = dataset[()]
    first = draw.randrange(len(values))
    last = first + draw.choice((1, 1, 10, len(values)))
    if values.dtype.kind == "f":
        values[first:last] = draw.choice((np.nan, np.inf, 1e30, 0.0, -1e300, 1e-40, 1e8))
    else:
        values[first:last] = draw.choice((0, 255, 9))
    dataset[...] = values if draw.random() < 0.8 else values[::-1]


_CHANGES = (
    *(_break_attribute, _break_attribute, _break_dataset, _break_dataset),
    *(_break_link, _break_text, _break_samples),
)
RUN_COMMANDS: tuple[tuple[float, str], ...] = (
    (300, "info bad.h5 --verify --json"),
    (200, "filter bad.h5"),
    (100, "export bad.h5 --out o"),
    (50, "export bad.h5 --format mat --out o"),
    (50, "export bad.h5 --format parquet --out o"),
    (50, "export bad.h5 --format npz --out o"),
    (100, "mark bad.h5 --bad x"),
    (100, "list ."),
    (100, "find ."),
    (200, "check bad.h5"),
    (100, "recover ."),
    (100, "watch . --once"),
    (50, "table . --json"),
    (30, "run bad.h5 --yes --out o"),
    (30, "compare bad.h5 good.h5 --json"),
    (30, "import bad.h5 --map time=time:s"),
    (30, "check drag --capsule bad.h5"),
    (10, "show bad.h5 --out o.png"),
    (10, "report bad.h5 --out r.html"),
    (8, "identify ."),
    (3, "report . --out r.html"),
    (2, "gap diagnose ."),
)
"""How often each is taken, and the command."""


def run_case(draw: random.Random, folder: Path, seeds: Path) -> list[list[str]]:
    """Write a broken run file and return the commands that take it."""
    if draw.random() < 0.1:
        source = draw.choice(sorted((seeds / "foreign").iterdir()))
        path = folder / source.name
        shutil.copy(source, path)
        broken_bytes(draw, path)
        return [["import", str(path), "--out", "o"]]
    if draw.random() < 0.1:
        for source in (seeds / "recording").iterdir():
            shutil.copy(source, folder / source.name)
        broken_bytes(draw, draw.choice(sorted(folder.iterdir())))
        return [["table", "."], ["recover", "."], ["table", "."]]
    shutil.copy(draw.choice(sorted((seeds / "runs").glob("*.h5"))), folder / "bad.h5")
    shutil.copy(seeds / "good.h5", folder / "good.h5")
    draw.choice((broken_layout, broken_layout, broken_layout, broken_bytes))(draw, folder / "bad.h5")
    weights, commands = zip(*RUN_COMMANDS, strict=True)
    return [["info", "bad.h5"], ["table", "."], *(command.split() for command in draw.choices(commands, weights, k=2))]


def make_seeds(seeds: Path) -> None:
    """Record what is broken: a campaign, single runs, a recording that was cut off, files of other software."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
    from dragrig.rig.runfile.recorder import Recorder
    from runfiles import blocks, header

    few = ["--set", "rig.sampling.rate_hz=200", "--yes", "--quiet", "--set", "hold_s=0.5", "--set", "wait_s=0"]
    drag = ["run", "drag", *few, "--set", "travel_mm=10", "--set", "speed_mm_s=[10.0, 20.0]", "--note", "a note"]
    assert dragrig([*drag, "--out", str(seeds / "campaign")]) == 0
    assert dragrig(["run", "relaxation", *few, "--set", "hold_s=5", "--out", str(seeds / "relaxed")]) == 0
    runs = seeds / "runs"
    runs.mkdir()
    drags = sorted((seeds / "campaign").glob("*-drag-*.h5"))
    shutil.copy(drags[0], seeds / "good.h5")
    shutil.copy(drags[0], runs / "drag.h5")
    shutil.copy(drags[1], runs / "filtered.h5")
    assert dragrig(["filter", str(runs / "filtered.h5"), "--quiet"]) == 0
    shutil.copy(next((seeds / "relaxed").glob("*.h5")), runs / "relaxation.h5")
    shutil.copy(Path(__file__).parents[1] / "tests" / "data" / "campaign" / "010-drag.h5", runs / "version1.h5")
    for form in ("csv", "mat", "npz", "parquet"):
        assert dragrig(["export", str(drags[0]), "--format", form, "--out", str(seeds / "foreign"), "--quiet"]) == 0
    assert dragrig(["mark", str(drags[0]), "--bad", "slipped"]) == 0
    assert dragrig(["mark", str(drags[1]), "--note", "a note"]) == 0
    (seeds / "recording").mkdir()
    recorder = Recorder(seeds / "recording" / "cut.h5", header(), reserve_bytes=0)
    for first, block in blocks(3000, 500):
        recorder.offer(first, block)
    time.sleep(0.5)
    for path in (seeds / "recording").iterdir():
        if path.suffix != ".lock":
            shutil.copy(path, seeds / f"copy-{path.name}")
    recorder.__exit__(None, None, None)
    shutil.rmtree(seeds / "recording")
    (seeds / "recording").mkdir()
    for path in seeds.glob("copy-*"):
        path.rename(seeds / "recording" / path.name.removeprefix("copy-"))


def outcomes_of(
    case: Case, seed: int, seeds: Path, tell: Callable[[str], None], *, echo: bool = False
) -> Iterator[Outcome]:
    """Make a case and run its commands; `tell` hears each command before it begins."""
    draw = random.Random(f"{seed} {case.kind} {case.number}")
    with tempfile.TemporaryDirectory(prefix="mutated-") as name:
        folder = Path(name)
        os.chdir(folder)
        tempfile.tempdir = name
        try:
            commands = (settings_case if case.kind == "settings" else run_case)(draw, folder, seeds)
            for command in commands:
                tell(" ".join(command)[:200])
                started = time.monotonic()
                code, printed = (in_a_process if case.alone else in_this_process)(command)
                if echo:
                    print(f"$ dragrig {' '.join(command)[:300]}\n{printed}\n→ {code}")
                peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
                problem = problem_in(code, printed, folder)
                yield Outcome(case, " ".join(command)[:200], code, problem, time.monotonic() - started, peak)
        finally:
            tempfile.tempdir = None
            os.chdir(seeds)


def in_this_process(command: Sequence[str]) -> tuple[int, str]:
    """Run a command here; return its exit code and what it prints."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            code = dragrig(command)
        except BaseException as error:  # noqa: BLE001  # whatever gets out is what is looked for
            return BUG, f"{printed.getvalue()}\nescaped: {type(error).__name__}: {error}"
    return code, printed.getvalue()


def in_a_process(command: Sequence[str]) -> tuple[int, str]:
    """Run a command in a process of its own."""
    made = subprocess.run(
        [sys.executable, "-m", "dragrig", *command], capture_output=True, timeout=HANG_S * 6, check=False
    )
    return made.returncode, (made.stdout + made.stderr).decode("utf-8", "replace")


def problem_in(code: int, printed: str, folder: Path) -> str:
    """Return what is wrong with an answer; empty where it is an answer."""
    if code == BUG or "a bug (" in printed or "Traceback" in printed:
        reports = [path.read_text("utf-8") for path in folder.glob("dragrig-bug-*.log")]
        for path in folder.glob("dragrig-bug-*.log"):
            path.unlink()
        text = reports[0] if reports else printed
        places = re.findall(r'File "([^"]*dragrig/[^"]*)", line (\d+)', text)
        place = f"{Path(places[-1][0]).name}:{places[-1][1]}" if places else ""
        return f"{place} {text.strip().splitlines()[-1][:160]}"
    if code not in {0, 2, 3, 4, 5}:
        return f"exit code {code}"
    if "Warning: " in printed:
        return f"warning: {next(line for line in printed.splitlines() if 'Warning: ' in line)[:160]}"
    errors = [line for line in printed.splitlines() if line.startswith("dragrig: ")]
    answered = errors or "NOT MIRRORED" in printed or "The rig is not ready: " in printed
    return "" if code == 0 or answered else f"no sentence: {printed[-160:]!r}"


def work(pipe: Connection, seed: int, seeds: Path) -> None:
    """Carry out cases until there is none; tell each command, and then what became of it."""
    while (case := pipe.recv()) is not None:
        try:
            for outcome in outcomes_of(case, seed, seeds, pipe.send):
                pipe.send(outcome)
        except Exception as error:  # noqa: BLE001  # a case that cannot be made is a mistake of this bench
            pipe.send(Outcome(case, "making it", None, f"the bench: {type(error).__name__}: {error}"))
        pipe.send(None)


class Watched:
    """A process that carries out cases, ended and started anew when it hangs, dies or holds too much memory."""

    def __init__(self, seed: int, seeds: Path) -> None:
        self._arguments = seed, seeds
        self._process: multiprocessing.process.BaseProcess | None = None

    def outcomes(self, case: Case) -> Iterator[Outcome]:
        """Yield what becomes of a case's commands."""
        if self._process is None:
            context = multiprocessing.get_context("spawn")
            self._pipe, theirs = context.Pipe()
            self._process = context.Process(target=work, args=(theirs, *self._arguments), daemon=True)
            self._process.start()
            theirs.close()
        self._pipe.send(case)
        command = ""
        while True:
            if not self._answers():
                self.end()
                yield Outcome(case, command, None, "HANG: no answer")
                return
            try:
                message = self._pipe.recv()
            except EOFError:
                process, self._process = self._process, None
                process.join()
                yield Outcome(case, command, None, f"CRASH: the process ended with {process.exitcode}")
                return
            if message is None:
                return
            if isinstance(message, str):
                command = message
                continue
            if message.peak_bytes > MAX_RSS_BYTES:
                self.end()
                problem = f"MEMORY: {message.peak_bytes / 1e9:.1f} GB {message.problem}"
                yield Outcome(case, message.command, message.code, problem, message.seconds, message.peak_bytes)
                return
            yield message

    def _answers(self) -> bool:
        """Wait for the process: for `HANG_S` of its own time, since the machine may be busy, or ten times as long."""
        process = psutil.Process(self._process.pid)
        before = sum(process.cpu_times()[:2])
        for _ in range(round(10 * HANG_S)):
            if self._pipe.poll(1.0):
                return True
            if sum(process.cpu_times()[:2]) - before > HANG_S:
                return False
        return False

    def end(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None


def main() -> None:
    """Count what becomes of all cases; exit with 1 where there is a bug, a hang, a crash or too much memory."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--settings", type=int, default=10_000)
    parser.add_argument("--runs", type=int, default=5_000)
    parser.add_argument("--processes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", metavar="KIND:NUMBER")
    options = parser.parse_args()
    alone_every = max(1, options.settings // max(1, options.processes))
    cases = [Case(number, "settings", number % alone_every == 0) for number in range(options.settings)]
    cases += [Case(number, "run") for number in range(options.runs)]
    with tempfile.TemporaryDirectory(prefix="mutations-") as name:
        seeds = Path(name)
        make_seeds(seeds)
        if options.only:
            kind, number = options.only.split(":")
            for outcome in outcomes_of(Case(int(number), kind), options.seed, seeds, print, echo=True):
                print(outcome)
            return
        watched = Watched(options.seed, seeds)
        codes: Counter[tuple[str, str]] = Counter()
        problems: dict[str, list[Outcome]] = {}
        slowest, peak = Outcome(cases[0], "", 0), 0
        for done, case in enumerate(cases):
            for outcome in watched.outcomes(case):
                codes[case.kind, "not ended" if outcome.code is None else f"exit code {outcome.code}"] += 1
                if outcome.problem:
                    known = problems.setdefault(re.sub(r"\d+", "N", outcome.problem), [])
                    if not known:
                        print(f"{case.kind}:{case.number} {outcome.command!r}: {outcome.problem}", flush=True)
                    known.append(outcome)
                slowest = max(slowest, outcome, key=lambda entry: entry.seconds if not entry.case.alone else 0.0)
                peak = max(peak, outcome.peak_bytes)
            if done % 250 == 249:
                print(f"  {done + 1} of {len(cases)}, peak {peak / 1e6:.0f} MB", flush=True)
        watched.end()
    print(json.dumps({f"{kind}, {code}": count for (kind, code), count in sorted(codes.items())}, indent=1))
    print(f"slowest {slowest.seconds:.1f} s ({slowest.case.kind}:{slowest.case.number} {slowest.command})")
    print(f"most memory {peak / 1e6:.0f} MB")
    for found in problems.values():
        first = found[0]
        print(f"{len(found)} × {first.problem}   first: {first.case.kind}:{first.case.number} {first.command}")
    if problems:
        raise SystemExit(f"{sum(map(len, problems.values()))} answers are none")


if __name__ == "__main__":
    main()
