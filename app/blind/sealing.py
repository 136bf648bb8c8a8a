"""The folder of an exam, and the seal on its answers.

The answers follow from the seed and are on no disk while campaigns are diagnosed: what is written beforehand is their
hash, and they themselves when all have been.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from dragrig.blind.mixing import Case
from dragrig.config.errors import AnalysisError, OutputError, SettingsError
from dragrig.sim_backend.blind import answer

EXAM, SEAL, ANSWERS = "exam.json", "answers.sha256", "answers.json"
FORMAT, VERSION = "dragrig-blind", 1


@dataclass(frozen=True, slots=True)
class Folder:
    """Where an exam keeps what it has."""

    root: Path

    def campaign(self, name: str) -> Path:
        """Return where the runs of a campaign are."""
        return self.root / "campaigns" / name

    def fresh(self, name: str) -> Path:
        """Return where those of the same specimen at other speeds and strains are."""
        return self.root / "fresh" / name

    def said(self, name: str) -> Path:
        """Return where its diagnosis is."""
        return self.root / "said" / f"{name}.json"

    def model(self, name: str) -> Path:
        """Return where the model that the diagnosis amended is."""
        return self.root / "said" / f"{name}.toml"

    def withheld(self, name: str) -> Path:
        """Return where its diagnosis without the true effect is."""
        return self.root / "withheld" / f"{name}.json"

    def achieved(self, name: str) -> Path:
        """Return where it is how far the amended model closes the gap on fresh runs."""
        return self.root / "achieved" / f"{name}.json"

    def amount(self, name: str) -> Path:
        """Return where d′ of the hidden effect is."""
        return self.root / "amounts" / f"{name}.json"


@contextmanager
def opened(out: Path, cases: int, seed: int, mix: str) -> Iterator[Folder]:
    """Yield an exam's folder for one program at a time: a new one, or one that was begun with the same numbers.

    Raises
    ------
    SettingsError
        When it holds an exam of other numbers.
    OutputError
        When it holds something else, cannot be written, or another program is at work in it.
    """
    from filelock import FileLock, Timeout

    try:
        out.mkdir(parents=True, exist_ok=True)
        there = _begun(out)
        if there is None and any(one.name != ".lock" for one in out.iterdir()):
            raise OutputError(f"{out}: holds something that is no exam; name an empty or a new folder.")
        if there is not None and there != (cases, seed, mix):
            raise SettingsError(
                f"{out}: holds an exam of {there[0]} cases with seed {there[1]}; give --cases {there[0]} --seed "
                f"{there[1]} --mix {there[2]} to go on with it, or name another folder."
            )
        with FileLock(out / ".lock", timeout=0):
            put(out / EXAM, {"format": FORMAT, "version": VERSION, "cases": cases, "seed": seed, "mix": mix})
            yield Folder(out)
    except Timeout as error:
        raise OutputError(f"{out}: another program is at work in it; wait for it, or name another folder.") from error
    except OSError as error:
        place = error.filename or out
        raise OutputError(f"{place}: cannot be written ({error.strerror}); name another folder.") from error


def _begun(out: Path) -> tuple[int, int, str] | None:
    """Return number of cases, seed and mix of the exam in a folder; None where there is none."""
    try:
        told = json.loads((out / EXAM).read_text("utf-8"))
        return int(told["cases"]), int(told["seed"]), str(told["mix"])
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise OutputError(f"{out / EXAM}: is not what an exam writes; name another folder.") from error


def seal(folder: Folder, planned: Sequence[Case]) -> str:
    """Write the hash of the answers unless it is there, and return it.

    Raises
    ------
    AnalysisError
        When it is there and another one.
    """
    digest = hashlib.sha256(_answers(planned).encode()).hexdigest()
    path = folder.root / SEAL
    if not path.exists():
        _replace(path, f"{digest}  {ANSWERS}\n")
    elif path.read_text("utf-8").split()[:1] != [digest]:
        raise AnalysisError(
            f"{path}: the plant gives other answers than were sealed, so that it was changed meanwhile; begin anew in "
            "another folder."
        )
    return digest


def open_answers(folder: Folder, planned: Sequence[Case]) -> Mapping[str, Mapping[str, object]]:
    """Write and return the answers by the campaigns' names; raises `AnalysisError` when others were sealed."""
    seal(folder, planned)
    text = _answers(planned)
    _replace(folder.root / ANSWERS, text)
    found: Mapping[str, Mapping[str, object]] = json.loads(text)
    return found


def _answers(planned: Sequence[Case]) -> str:
    return json.dumps({one.name: {"case": one.kind, **answer(one.secret)} for one in planned}, indent=1)


def put(path: Path, document: object) -> None:
    """Write JSON to a file that is there whole or not at all."""
    _replace(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def _replace(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    begun = path.with_name(f".{path.name}.begun")
    begun.write_text(text, "utf-8", newline="\n")
    begun.replace(path)


def taken(path: Path) -> Mapping[str, object]:
    """Return what `put` wrote."""
    found: Mapping[str, object] = json.loads(path.read_text("utf-8"))
    return found
