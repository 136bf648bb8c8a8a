"""Record what the program answers, and compare two records.

``python bench/freeze.py record FOLDER --python PYTHON`` calls ``PYTHON -m dragrig …`` as a user does and keeps the
answers: the JSON of every command, the samples of all shipped plans, of all effects and of the doubles, diagnoses of
practice campaigns and an exam. Each stage is a file of its own; a stage that is there already is skipped.
``python bench/freeze.py compare BEFORE AFTER`` says where two records differ (see `frozen_differences`).

Not recorded: pictures and HTML pages (only that they are written), what a terminal shows without --json, the window,
and the double in velocity mode, whose output buffer runs dry on a busy computer.
"""

import argparse
import gzip
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from frozen_differences import TOLERANCE, Tally, compare
from frozen_doubles import double_run
from frozen_values import Cleaner, Json, documents, exported, runs, toml_file, traces

REPOSITORY = Path(__file__).resolve().parents[1]
PLANS = ("blank", "coulomb", "demo", "diagnose", "drag", "drag-sweep", "paper", "relaxation")
COMMANDS = (
    "demo", "init", "check", "home", "jog", "touch-off", "calibrate encoder", "calibrate force", "run", "watch",
    "recover", "gui", "info", "table", "compare", "gap diagnose", "gap evaluate", "gap next", "gap isolability",
    "gap blind", "gap calibrate", "gap effects", "report", "show", "model", "paper", "identify", "mark", "filter",
    "import", "export",
)  # fmt: skip
EXAM = ("gap", "blind", "--cases", "24", "--seed", "8101")
WITHHELD = ("gap", "blind", "--cases", "6", "--seed", "8102", "--mix", "learning", "--without-true")
SLOW_DOUBLE = ("--backend", "hardware", "--double", "--pace", "0.5")
"""Half as fast as the rig: a busy computer misses no deadline of the guard."""
ATTEMPTS = 4
QUICK = ("commands", "thin", "plan-demo", "practice-p1", "practice-p5")
LONGEST_CALL_S = 3600.0
SHOWN = 12
"""Differences that are printed of each stage."""

EVERY_EFFECT_PLAN = """name = "short"
seed = 3
[[steps]]
kind = "relaxation"
shear_strain = 1.0
hold_s = 3.0
wait_s = 20.0
[[steps]]
kind = "blank"
speed_mm_s = 40.0
travel_mm = 20.0
wait_s = 5.0
[[steps]]
kind = "coulomb"
speed_mm_s = 5.0
travel_mm = 10.0
[[steps]]
kind = "drag"
speed_mm_s = [2.0, 20.0]
travel_mm = 20.0
[[steps]]
kind = "motion"
strokes = [{ travel_mm = 10.0, speed_mm_s = 10.0, pause_s = 1.0 }, { travel_mm = -10.0, speed_mm_s = 10.0 }]
way_back = "stay"
"""

PUBLIC_API = """
import enum, inspect, json, dragrig

def parameters(thing):
    try:
        found = inspect.signature(thing).parameters.values()
    except (TypeError, ValueError):
        return []
    return [f"{p.name} {p.kind.name}" + ("" if p.default is p.empty else " optional") for p in found]

def described(thing):
    if inspect.isclass(thing):
        return {name: parameters(getattr(thing, name)) for name in dir(thing) if not name.startswith("_")}
    return parameters(thing)

print(json.dumps({name: described(getattr(dragrig, name)) for name in dragrig.__all__ if name != "__version__"}))
"""


@dataclass(frozen=True, slots=True)
class Inputs:
    """Where programs, data and campaigns are.

    Parameters
    ----------
    python
        Interpreter of the environment in which the program under examination is installed.
    data
        The repository's ``tests/data``.
    campaigns
        Folders of practice campaigns.
    workers
        Processes of an exam.
    own_model
        Nominal model in a file, for which the program has the modules that it imports.
    """

    python: Path
    data: Path
    campaigns: tuple[Path, ...]
    workers: int
    own_model: Path


class Shell:
    """Calls the program in a working folder of its own."""

    def __init__(self, inputs: Inputs, folder: Path) -> None:
        self.inputs = inputs
        self.folder = folder
        self.cleaner = Cleaner(folder)

    def call(self, *words: str, typed: str = "") -> tuple[int, str]:
        """Call ``dragrig`` and return its exit code and what it printed."""
        return self._run([str(self.inputs.python), "-P", "-m", "dragrig", *words], typed)

    def evaluate(self, code: str) -> Json:
        """Run Python that prints JSON, in the environment of the program."""
        return documents(self._run([str(self.inputs.python), "-P", "-c", code], "")[1], self.cleaner)

    def answer(self, *words: str, typed: str = "") -> Json:
        """Return a command's exit code and its JSON."""
        code, printed = self.call(*words, "--json", typed=typed)
        answer = documents(printed, self.cleaner) if code != 1 else None
        return {"command": " ".join(("dragrig", *words)), "code": code, "answer": answer}

    def _run(self, command: Sequence[str], typed: str) -> tuple[int, str]:
        single = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        environment = {
            **os.environ,
            **single,
            "TZ": "UTC",
            "PYTHONHASHSEED": "0",
            "MPLBACKEND": "Agg",
            "COLUMNS": "120",
        }
        done = subprocess.run(
            command, cwd=self.folder, input=typed, capture_output=True, text=True, encoding="utf-8", env=environment,
            timeout=LONGEST_CALL_S, check=False,
        )  # fmt: skip
        if done.returncode == 1:
            print(f"  {' '.join(command[3:6])}: {done.stderr.strip().rpartition(chr(10))[2]}", file=sys.stderr)
        return done.returncode, done.stdout


Stage = Callable[[Shell], dict[str, Json]]


def commands(shell: Shell) -> dict[str, Json]:
    """Record options of all commands, the public API, the catalogue, and answers to wrong input."""
    result: dict[str, Json] = {f"options of {command}": _options(shell, command) for command in COMMANDS}
    result["public API"] = shell.evaluate(PUBLIC_API)
    result["effects"] = shell.answer("gap", "effects")
    result["check beyond limits"] = shell.answer("check", "drag", "--set", "speed_mm_s=5000")
    result["check with a wrong key"] = shell.answer("check", "drag", "--set", "sped_mm_s=5")
    result["run of no plan"] = shell.answer("run", "no-such-plan", "--yes")
    return result


def _options(shell: Shell, command: str) -> Json:
    code, printed = shell.call(*command.split(), "--help")
    # An option begins in the third column below "Options:"; what is further right is wrapped help.
    listed = printed.partition("\nOptions:")[2]
    lines = [line.strip() for line in listed.splitlines() if line.startswith("  -")]
    words = (word.strip(",") for line in lines for word in line.split("  ")[0].split())
    return {"code": code, "options": [word for word in words if word.startswith("-")]}


def rig(shell: Shell) -> dict[str, Json]:
    """Record the friction model, what plans would do, and motion by hand on the simulated rig."""
    result: dict[str, Json] = {f"check {name}": shell.answer("check", name) for name in PLANS}
    for name, words in {
        "model": (),
        "model table1": ("--wall", "table1", "--speeds", "0.5,5,50"),
        "model newtonian": ("--viscous", "newtonian"),
        "model stribeck": ("--effect", "stribeck:ratio=0.4,speed_mm_s=2"),
        "model rough": ("--capsule", "rough", "--model", "table1"),
    }.items():
        result[name] = shell.answer("model", *words)
    result["check of the rig"] = shell.answer("check")
    shell.call("init", "lab")
    choices = ("--rig", "lab/rig.toml", "--yes")
    shell.call("demo", "-o", "demo")
    result["demo"] = {
        shell.cleaner.text(path.name): traces(path) for path in sorted((shell.folder / "demo").rglob("*.h5"))
    }
    result["home"] = shell.answer("home", *choices)
    result["jog"] = shell.answer("jog", "5", *choices)
    result["calibrate encoder"] = shell.answer("calibrate", "encoder", "--travel", "50", *choices)
    result["touch-off"] = shell.answer("touch-off", *choices)
    return result


def thin(shell: Shell) -> dict[str, Json]:
    """Record every command that reads runs, on the thin campaign."""
    shutil.copytree(shell.inputs.data / "campaign", shell.folder / "thin")
    drags = sorted(path.relative_to(shell.folder).as_posix() for path in (shell.folder / "thin").glob("*-drag.h5"))
    result: dict[str, Json] = {
        "info": shell.answer("info", "thin"),
        "verify": shell.answer("info", "thin", "--verify"),
        **campaign(shell, "thin"),
        "identify drive": shell.answer("identify", "thin", "--nominal", "drive"),
        "compare two runs": shell.answer("compare", *drags[1:3]),
        "report of a run": shell.answer("report", drags[0], "-o", "run.html"),
        "report": shell.answer("report", "thin", "-o", "thin.html"),
        "show": shell.answer("show", "thin", "-o", "pictures"),
        "recover": shell.answer("recover", "thin"),
        "watch": shell.answer("watch", "thin", "--once"),
        "filter": shell.answer("filter", "thin"),
        "filter by samples": shell.answer(
            "filter", drags[0], "--window-samples", "41", "--order", "2", "--derivative", "1"
        ),
        "run files": runs(shell.folder / "thin", shell.cleaner),
        "mark": shell.answer("mark", drags[-1], "--bad", "torn"),
        "table after a mark": shell.answer("table", "thin"),
    }
    for ending in ("csv", "npz", "mat", "parquet"):
        result[f"export {ending}"] = shell.answer("export", "thin", "-f", ending, "-o", ending)
        written = sorted((shell.folder / ending).glob(f"*.{ending}"))
        remaining = written if ending == "csv" else written[:2]
        result[f"{ending} files"] = {path.name: exported(path, shell.cleaner) for path in remaining}
    return result


def campaign(shell: Shell, name: str) -> dict[str, Json]:
    """Ask for all that is said of a campaign: table, comparison, identification, diagnosis, isolability, next runs."""
    result = {
        "table": shell.answer("table", name),
        "compare with the model": shell.answer("compare", name, "--model", "paper"),
        "identify": shell.answer("identify", name, "--save-model", "identified.toml"),
        "identify with its own wall": shell.answer("identify", name, "--wall", "fitted"),
        "diagnose": shell.answer("gap", "diagnose", name, "--save-model", "amended.toml"),
        "isolability": shell.answer("gap", "isolability", name),
        "next": shell.answer("gap", "next", name, "--save-plan", "next.toml"),
    }
    for model in ("identified", "amended", "next"):
        result[f"{model}.toml"] = toml_file(shell.folder / f"{model}.toml", shell.cleaner)
    if (shell.folder / "amended.toml").exists():
        result["evaluate"] = shell.answer("gap", "evaluate", "amended.toml", name)
    return result


def practice(folder: Path) -> Stage:
    """Return a stage for a practice campaign."""

    def record(shell: Shell) -> dict[str, Json]:
        shutil.copytree(folder, shell.folder / folder.name)
        return campaign(shell, folder.name)

    return record


def several(shell: Shell) -> dict[str, Json]:
    """Record several campaigns at once, and two against each other."""
    names = [path.name for path in shell.inputs.campaigns[:3]]
    for path in shell.inputs.campaigns[:3]:
        shutil.copytree(path, shell.folder / path.name)
    return {
        "diagnose": shell.answer("gap", "diagnose", *names, "--workers", "2"),
        "diagnose without an effect": shell.answer(
            "gap", "diagnose", names[0], "--without", "stribeck", "--tolerance", "2"
        ),
        "identify": shell.answer("identify", *names, "--workers", "2"),
        "compare": shell.answer("compare", *names[:2]),
    }


def plan(name: str) -> Stage:
    """Return a stage for a shipped plan on the simulated rig."""

    def record(shell: Shell) -> dict[str, Json]:
        result = simulated(shell, name)
        result["table"] = shell.answer("table", "runs")
        result["watch"] = shell.answer("watch", "runs", "--once")
        result["report"] = shell.answer("report", "runs", "-o", "runs.html")
        result["isolability"] = shell.answer("gap", "isolability", name)
        result["next"] = shell.answer("gap", "next", name)
        first = sorted((shell.folder / "runs").glob("*.h5"))[0].relative_to(shell.folder).as_posix()
        result["filter"] = shell.answer("filter", first)
        result["export"] = shell.answer("export", first, "-o", "exported")
        files = sorted((shell.folder / "exported").glob("*.csv"))
        result["csv files"] = {shell.cleaner.text(path.name): exported(path, shell.cleaner) for path in files}
        return result

    return record


def simulated(shell: Shell, name: str, *words: str, out: str = "runs") -> dict[str, Json]:
    """Carry out a plan on the simulated rig, and return its answer and its run files."""
    ended = shell.answer("run", name, "--yes", "-o", out, *words)
    shell.cleaner.learn_runs(shell.folder / out)
    return {"run": ended, "run files": runs(shell.folder / out, shell.cleaner)}


def effects(shell: Shell) -> dict[str, Json]:
    """Record every effect of the catalogue on the simulated rig, at its usual size."""
    (shell.folder / "short.toml").write_text(EVERY_EFFECT_PLAN, "utf-8")
    catalogue = json.loads(shell.call("gap", "effects", "--json")[1])["effects"]
    result: dict[str, Json] = {}
    for effect in sorted(entry["id"] for entry in catalogue):
        out = f"runs-{effect}"
        result[f"run {effect}"] = shell.answer("run", "short.toml", "--yes", "-o", out, "--effect", effect)
        files = sorted((shell.folder / out).glob("*.h5"))
        result[f"samples {effect}"] = {shell.cleaner.text(path.name): traces(path) for path in files}
        result[f"model {effect}"] = shell.answer("model", "--effect", effect)
    return result


def made(shell: Shell) -> dict[str, Json]:
    """Record a campaign of the simulated rig with an effect, the stage alone, and a run made again from its file."""
    result = simulated(
        shell, "diagnose", "--effect", "stribeck:ratio=0.4,speed_mm_s=2", "--set", "rig.simulated.seed=11"
    )
    result |= campaign(shell, "runs")
    result["diagnose drive"] = shell.answer("gap", "diagnose", "runs", "--nominal", "drive")
    result["identify drive"] = shell.answer("identify", "runs", "--nominal", "drive")
    fresh = simulated(shell, "drag-sweep", "--model", "amended.toml", out="fresh")
    result["run amended"], result["fresh run files"] = fresh["run"], fresh["run files"]
    result["evaluate fresh"] = shell.answer("gap", "evaluate", "amended.toml", "fresh")
    again = sorted((shell.folder / "fresh").glob("*.h5"))[0].relative_to(shell.folder).as_posix()
    repeated = simulated(shell, again, out="again")
    result["run again"], result["again run files"] = repeated["run"], repeated["run files"]
    return result


def elsewhere(shell: Shell) -> dict[str, Json]:
    """Record measured traces from elsewhere: import, and diagnosis with a user's own model and with the stage alone."""
    data = shell.inputs.data / "elsewhere"
    slip = ("--map", "time=Time:s", "--map", "position=Displ:um", "--map", "force=Friction:1*1000")
    turn = ("--map", "time=Time:s", "--map", "position=Position:rad*10", "--map", "motor_force=Iq:A*1000")
    shutil.copy(shell.inputs.own_model, shell.folder / "own_model.py")
    result: dict[str, Json] = {}
    for name, file, words in (
        ("sepiolite", "velocity-steps/sepiolite.txt", (*slip, "--resample-hz", "1", "--from-s", "21326")),
        ("basalt", "velocity-steps/basalt.txt", (*slip, "--resample-hz", "10", "--from-s", "11676.5")),
        ("motor", "cogging/speed_test.txt", (*turn, "--resample-hz", "1000", "--from-s", "1.9", "--to-s", "3.3")),
        ("steady motor", "cogging/speed_test.txt",
         (*turn, "--resample-hz", "1000", "--from-s", "1.9", "--to-s", "3.3", "--steady")),
    ):  # fmt: skip
        shutil.copy(data / file, shell.folder / "trace.txt")
        result[f"import {name}"] = shell.answer("import", "trace.txt", *words, "--specimen", name, "-o", name)
        shell.cleaner.learn_runs(shell.folder / name)
        result[f"run files {name}"] = runs(shell.folder / name, shell.cleaner)
        nominal = "drive" if "motor" in name else "own_model.py"
        result[f"diagnose {name}"] = shell.answer("gap", "diagnose", name, "--nominal", nominal)
        result[f"identify {name}"] = shell.answer("identify", name, "--nominal", nominal)
    return result


def paper(shell: Shell) -> dict[str, Json]:
    """Record the paper's programme with its identification, findings and tables."""
    answer = shell.answer("paper", "-o", "paper")
    folder = shell.folder / "paper"
    return {
        "paper": answer,
        "tables": {path.name: exported(path, shell.cleaner) for path in sorted(folder.glob("*.csv"))},
        "samples": {shell.cleaner.text(path.name): traces(path) for path in sorted(folder.glob("*.h5"))},
        "model.toml": toml_file(folder / "model.toml", shell.cleaner),
    }


def exam(*words: str) -> Stage:
    """Return a stage for an exam: its score, what was said of every campaign, and the campaigns' samples."""

    def record(shell: Shell) -> dict[str, Json]:
        score = shell.answer(*words, "--out", "exam", "--workers", str(shell.inputs.workers))
        folder = shell.folder / "exam"
        parts = {path: path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*.json"))}
        result: dict[str, Json] = {
            name: documents(path.read_text("utf-8"), shell.cleaner)
            for path, name in parts.items()
            if not name.startswith(("campaigns/", "fresh/"))
        }
        for path in sorted(folder.rglob("*.toml")):
            result[path.relative_to(folder).as_posix()] = toml_file(path, shell.cleaner)
        for kind in ("campaigns", "fresh"):
            for made_folder in sorted((folder / kind).iterdir()):
                files = sorted(made_folder.glob("*.h5"))
                result[f"samples of {kind}/{made_folder.name}"] = {path.name: traces(path) for path in files}
        calibrated = shell.answer("gap", "calibrate", "exam", "--folds", "4")
        return {"score": score, "calibrate": calibrated, **result}

    return record


def doubles(name: str, *words: str) -> Stage:
    """Return a stage for a plan on the doubles of the hardware; see `frozen_doubles` for what is kept."""

    def record(shell: Shell) -> dict[str, Json]:
        for attempt in range(ATTEMPTS):
            out = f"runs-{attempt}"
            answer = ("run", name, "--yes", "-o", out, *SLOW_DOUBLE, *words, "--json")
            code, _ = shell.call(*answer, typed="d\n" * 50)
            if code == 0:
                break
            print(f"  the double ended with exit code {code}; attempt {attempt + 1} of {ATTEMPTS}", file=sys.stderr)
        shell.cleaner.learn_runs(shell.folder / out)
        files = sorted((shell.folder / out).glob("*.h5"))
        return {"code": code, **{shell.cleaner.text(path.name): double_run(path, shell.cleaner) for path in files}}

    return record


def double_by_hand(shell: Shell) -> dict[str, Json]:
    """Look at the double's devices, home, jog and calibrate."""
    shell.call("init", "lab")
    double = ("--rig", "lab/rig.toml", *SLOW_DOUBLE[:3])
    looks = json.loads(shell.call("check", *double, "--json")[1])
    hands = (*double, "--pace", "1", "--yes")
    return {
        "devices that are fine": [bool(look["fine"]) for look in looks],
        "home": shell.answer("home", *hands, typed="d\n" * 20),
        "calibrate encoder": shell.answer("calibrate", "encoder", "--travel", "20", *hands, typed="d\n" * 20),
    }


def stages(inputs: Inputs) -> dict[str, Stage]:
    """Return all stages by their names, quick ones first."""
    campaigns = {f"practice-{path.name}": practice(path) for path in inputs.campaigns}
    return {
        "commands": commands,
        "rig": rig,
        "thin": thin,
        **{f"plan-{name}": plan(name) for name in PLANS},
        "elsewhere": elsewhere,
        "made": made,
        "paper": paper,
        "effects": effects,
        **campaigns,
        **({"several": several} if campaigns else {}),
        "exam": exam(*EXAM),
        "exam-withheld": exam(*WITHHELD),
        "double-by-hand": double_by_hand,
        "double-drag": doubles("drag"),
        "double-relaxation": doubles("relaxation", "--set", "hold_s=4"),
        "double-blank": doubles("blank"),
    }


def record(inputs: Inputs, folder: Path, names: Sequence[str], jobs: int) -> None:
    """Record stages that are not there yet, each in a file of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    available = stages(inputs)

    def carry_out(name: str) -> None:
        if _file(folder, name).exists():
            print(f"{name}: there already")
            return
        begun, used = time.perf_counter(), _child_seconds()
        with TemporaryDirectory(prefix="freeze-") as scratch:
            result = available[name](Shell(inputs, Path(scratch).resolve()))
        _save(_file(folder, name), result)
        alone = f", {_child_seconds() - used:.0f} s of CPU" if jobs == 1 else ""
        print(f"{name}: {len(result)} cases in {time.perf_counter() - begun:.0f} s{alone}", flush=True)

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(carry_out, names))


def _child_seconds() -> float:
    times = os.times()
    return times.children_user + times.children_system


def _file(folder: Path, stage: str) -> Path:
    return folder / f"{stage}.json.gz"


def _save(path: Path, result: Mapping[str, Json]) -> None:
    text = json.dumps(result, ensure_ascii=False, separators=(",", ":"))
    path.write_bytes(gzip.compress(text.encode(), mtime=0))


def _load(path: Path) -> dict[str, Json]:
    answer = json.loads(gzip.decompress(path.read_bytes()))
    assert isinstance(answer, dict)
    return answer


def compare_folders(before: Path, after: Path, names: Sequence[str], tolerance: float, *, sentences: bool) -> bool:
    """Compare the stages of two records; print a line each, and the differences; return whether there are none."""
    same = True
    for name in names:
        missing = [str(folder) for folder in (before, after) if not _file(folder, name).exists()]
        if missing:
            print(f"{name}: MISSING in {' and '.join(missing)}")
            same = False
            continue
        tally = compare(_load(_file(before, name)), _load(_file(after, name)), tolerance)
        print("\n".join(_lines(name, tally, sentences=sentences)))
        same = same and not tally.differences
    print("no difference" if same else "DIFFERENCES, see above")
    return same


def _lines(name: str, tally: Tally, *, sentences: bool) -> Iterator[str]:
    remarks = [f"{tally.values} values", f"{tally.exact} identical"]
    if tally.largest_relative:
        remarks.append(f"the others within {tally.largest_relative:.1e}")
    if tally.small:
        remarks.append(f"{tally.small} small ones within rounding of their scale")
    if tally.rounded_arrays:
        remarks.append(f"{tally.rounded_arrays} arrays not bit for bit")
    remarks.append(f"{len(tally.sentences)} sentences reworded")
    yield f"{name}: {'DIFFERS' if tally.differences else 'same'}; {', '.join(remarks)}"
    yield from (f"  {line}" for line in tally.repaired)
    yield from (f"  {difference}" for difference in tally.differences[:SHOWN])
    if len(tally.differences) > SHOWN:
        yield f"  … and {len(tally.differences) - SHOWN} more"
    if sentences:
        yield from (f"  {difference}" for difference in tally.sentences)


def arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands_ = parser.add_subparsers(dest="command", required=True)
    recording = commands_.add_parser("record", help="record what a program answers")
    recording.add_argument("folder", type=Path)
    recording.add_argument(
        "--python", type=Path, default=Path(sys.executable), help="its interpreter; default: this one"
    )
    recording.add_argument("--data", type=Path, default=REPOSITORY / "tests" / "data")
    recording.add_argument(
        "--own-model",
        type=Path,
        default=REPOSITORY / "bench" / "linear_trend.py",
        help="nominal model that it can load",
    )
    recording.add_argument("--jobs", type=int, default=1, help="stages side by side")
    recording.add_argument("--workers", type=int, default=2, help="processes of an exam")
    comparing = commands_.add_parser("compare", help="compare two records")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    comparing.add_argument("--tolerance", type=float, default=TOLERANCE)
    comparing.add_argument("--sentences", action="store_true", help="print reworded sentences, too")
    for command in (recording, comparing):
        command.add_argument(
            "--campaigns",
            type=Path,
            nargs="*",
            default=[Path("../shared/practice")],
            metavar="FOLDER",
            help="folders whose subfolders are practice campaigns; default: ../shared/practice",
        )
        command.add_argument("--quick", action="store_true", help=f"only {', '.join(QUICK)}")
        command.add_argument("--only", nargs="+", metavar="STAGE", help="only these stages")
    return parser.parse_args()


def practice_campaigns(folders: Sequence[Path]) -> tuple[Path, ...]:
    """Return the campaigns below folders, as ``p1`` to ``p10`` are below ``practice``."""
    for folder in folders:
        if not folder.is_dir():
            print(f"{folder} is not there: its campaigns are left out", file=sys.stderr)
    result = [path for folder in folders if folder.is_dir() for path in folder.iterdir() if any(path.glob("*.h5"))]
    return tuple(sorted((path.resolve() for path in result), key=lambda path: (len(path.name), path.name)))


def main() -> None:
    """Record or compare."""
    options = arguments()
    campaigns = practice_campaigns(options.campaigns)
    recording = options.command == "record"
    inputs = (
        Inputs(
            options.python.absolute(), options.data.resolve(), campaigns, options.workers, options.own_model.resolve()
        )
        if recording
        else None
    )
    available = stages(inputs or Inputs(Path(), Path(), campaigns, 1, Path()))
    chosen = options.only or (QUICK if options.quick else available)
    names = [name for name in chosen if name in available]
    for name in sorted(set(chosen) - set(names)):
        print(f"{name}: there is no such stage with these campaigns", file=sys.stderr)
    if inputs is not None:
        record(inputs, options.folder, names, options.jobs)
    elif not compare_folders(options.before, options.after, names, options.tolerance, sentences=options.sentences):
        sys.exit(1)


if __name__ == "__main__":
    main()
