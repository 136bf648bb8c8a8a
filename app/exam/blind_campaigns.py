"""What knows the blind plant: the mix of hidden effects, the simulated campaigns, the exam folder and sealed answers.

The answers follow from the seed and are on no disk while campaigns are diagnosed: only their hash is written
beforehand, and they themselves once every campaign has been diagnosed.
"""

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

from dragrig.config.errors import AnalysisError, OutputError, SettingsError
from dragrig.sim_backend.blind import (
    CATALOGUE,
    OUTSIDE,
    BlindCampaign,
    draw_campaign,
    effect_group,
    true_answer,
    write_campaign,
)

EXAM_MIX, LEARNING_MIX = "exam", "learning"
EXAM_SHARES = {
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
MIXES = {
    EXAM_MIX: EXAM_SHARES,
    LEARNING_MIX: {
        "full": 0.35,
        "third": 0.13,
        "tenth": 0.06,
        "none": 0.06,
        "outside": 0.14,
        "pair": 0.16,
        "rough": 0.07,
        "rough none": 0.03,
    },
}
"""An exam has what rigs may have; to learn from, there is more of what is hard."""


@dataclass(frozen=True, slots=True)
class HiddenCase:
    """What is to be hidden in one campaign.

    Attributes
    ----------
    kind
        One of `EXAM_SHARES`: an effect at full size, a third or a tenth of it; nothing; an effect that the catalogue
        does not have; two effects; and with nominal equations that are slightly wrong, an effect or nothing.
    """

    number: int
    kind: str
    seed: int
    effects: tuple[str, ...]
    sizes: tuple[float, ...]
    rough: bool

    @property
    def name(self) -> str:
        """The number as names of folders and files have it."""
        return f"{self.number:04d}"

    @property
    def secret(self) -> BlindCampaign:
        """The campaign with all that is hidden in it."""
        return draw_campaign(self.seed, effects=self.effects, size=self.sizes, rough=self.rough)

    @property
    def single(self) -> bool:
        """Whether one effect of the catalogue is hidden."""
        return len(self.effects) == 1 and self.effects[0] in CATALOGUE


def draw_cases(cases: int, seed: int, which: str = EXAM_MIX) -> list[HiddenCase]:
    """Return a balanced mix in random order; counts follow the shares as nearly as whole numbers allow."""
    random = np.random.default_rng(seed)
    shares = MIXES[which]
    exact = np.array([share * cases for share in shares.values()])
    counts = np.floor(exact).astype(int)
    counts[np.argsort(counts - exact)[: cases - int(counts.sum())]] += 1
    kinds = [kind for kind, count in zip(shares, counts.tolist(), strict=True) for _ in range(count)]
    singles, foreign = _shuffled_cycle(tuple(CATALOGUE), random), _shuffled_cycle(tuple(OUTSIDE), random)
    made = []
    for kind in kinds:
        effects, sizes = _draw_effects(kind, singles, foreign, random)
        made.append((kind, effects, sizes))
    order = random.permutation(len(made)).tolist()
    seeds = random.integers(1, 2**31, len(made)).tolist()
    return [
        HiddenCase(number, made[at][0], own, made[at][1], made[at][2], rough=made[at][0].startswith("rough"))
        for number, (at, own) in enumerate(zip(order, seeds, strict=True), 1)
    ]


def _shuffled_cycle(names: Sequence[str], random: np.random.Generator) -> Iterator[str]:
    while True:
        yield from random.permutation(np.array(names)).tolist()


def _draw_effects(
    kind: str, singles: Iterator[str], foreign: Iterator[str], random: np.random.Generator
) -> tuple[tuple[str, ...], tuple[float, ...]]:
    if kind in {"none", "rough none"}:
        return (), ()
    if kind == "outside":
        return (next(foreign),), (1.0,)
    if kind == "pair":
        first, second = next(singles), next(singles)
        while effect_group(first) == effect_group(second):
            second = next(singles)
        return (first, second), (1.0, 1.0 if random.random() < 0.5 else 1 / 3)
    return (next(singles),), ({"third": 1 / 3, "tenth": 1 / 10}.get(kind, 1.0),)


UNFINISHED_SUFFIX = ".begun"
"""How the name of a hidden folder ends in which runs are written that are not all there yet."""


@dataclass(frozen=True, slots=True)
class CampaignOrder:
    """A campaign to be written to a folder, and a fresh session of the same specimen to another."""

    case: "HiddenCase"
    campaign: Path
    fresh: Path


def simulate_campaign(order: CampaignOrder) -> None:
    """Write what is not there yet; a folder is there with all its runs or not at all.

    Raises
    ------
    OSError
        When a file cannot be written.
    """
    secret = order.case.secret
    for folder, runs in ((order.campaign, None), (order.fresh, "fresh")):
        if folder.is_dir():
            continue
        folder.parent.mkdir(parents=True, exist_ok=True)
        begun = Path(mkdtemp(prefix=f".{folder.name}-", suffix=UNFINISHED_SUFFIX, dir=folder.parent))
        try:
            write_campaign(secret, begun, runs=runs)
            begun.chmod(0o755)
            begun.rename(folder)
        except OSError:
            if not folder.is_dir():  # else another worker was told to write the same, and was first
                raise
        finally:
            shutil.rmtree(begun, ignore_errors=True)


def remove_unfinished(order: CampaignOrder) -> None:
    """Remove what workers have left that were killed while they wrote a campaign or a fresh session.

    Nobody else may be at work in the exam's folder.
    """
    for folder in (order.campaign, order.fresh):
        for left in folder.parent.glob(f".{folder.name}-*{UNFINISHED_SUFFIX}"):
            shutil.rmtree(left, ignore_errors=True)


def hidden_d_prime(case: "HiddenCase") -> float:
    """Return d′ of what is hidden: in the force, or in the position where it is larger there."""
    from dragrig.sim_backend.blind.effect_size import effect_size

    found = effect_size(case.secret)
    return max(found.force, found.position)


EXAM_FILE, SEAL_FILE, ANSWERS_FILE = "exam.json", "answers.sha256", "answers.json"
EXAM_FORMAT, EXAM_VERSION = "dragrig-blind", 1


@dataclass(frozen=True, slots=True)
class ExamFolder:
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
def open_exam_folder(out: Path, cases: int, seed: int, mix: str) -> Iterator[ExamFolder]:
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
        there = _read_exam_numbers(out)
        if there is None and any(one.name != ".lock" for one in out.iterdir()):
            raise OutputError(f"{out}: holds something that is no exam; name an empty or a new folder.")
        if there is not None and there != (cases, seed, mix):
            raise SettingsError(
                f"{out}: holds an exam of {there[0]} cases with seed {there[1]}; give --cases {there[0]} --seed "
                f"{there[1]} --mix {there[2]} to go on with it, or name another folder."
            )
        with FileLock(out / ".lock", timeout=0):
            write_json(
                out / EXAM_FILE,
                {"format": EXAM_FORMAT, "version": EXAM_VERSION, "cases": cases, "seed": seed, "mix": mix},
            )
            yield ExamFolder(out)
    except Timeout as error:
        raise OutputError(f"{out}: another program is at work in it; wait for it, or name another folder.") from error
    except OSError as error:
        place = error.filename or out
        raise OutputError(f"{place}: cannot be written ({error.strerror}); name another folder.") from error


def _read_exam_numbers(out: Path) -> tuple[int, int, str] | None:
    """Return number of cases, seed and mix of the exam in a folder; None where there is none."""
    try:
        told = json.loads((out / EXAM_FILE).read_text("utf-8"))
        return int(told["cases"]), int(told["seed"]), str(told["mix"])
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise OutputError(f"{out / EXAM_FILE}: is not what an exam writes; name another folder.") from error


def seal_answers(folder: ExamFolder, planned: Sequence[HiddenCase]) -> str:
    """Write the hash of the answers unless it is there, and return it.

    Raises
    ------
    AnalysisError
        When it is there and another one.
    """
    digest = hashlib.sha256(_answers_json(planned).encode()).hexdigest()
    path = folder.root / SEAL_FILE
    if not path.exists():
        _replace_file(path, f"{digest}  {ANSWERS_FILE}\n")
    elif path.read_text("utf-8").split()[:1] != [digest]:
        raise AnalysisError(
            f"{path}: the plant gives other answers than were sealed, so that it was changed meanwhile; begin anew in "
            "another folder."
        )
    return digest


def open_answers(folder: ExamFolder, planned: Sequence[HiddenCase]) -> Mapping[str, Mapping[str, object]]:
    """Write and return the answers by the campaigns' names; raises `AnalysisError` when others were sealed."""
    seal_answers(folder, planned)
    text = _answers_json(planned)
    _replace_file(folder.root / ANSWERS_FILE, text)
    found: Mapping[str, Mapping[str, object]] = json.loads(text)
    return found


def _answers_json(planned: Sequence[HiddenCase]) -> str:
    return json.dumps({one.name: {"case": one.kind, **true_answer(one.secret)} for one in planned}, indent=1)


def write_json(path: Path, document: object) -> None:
    """Write JSON to a file that is there whole or not at all."""
    _replace_file(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def _replace_file(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    begun = path.with_name(f".{path.name}.begun")
    begun.write_text(text, "utf-8", newline="\n")
    begun.replace(path)


def read_json(path: Path) -> Mapping[str, object]:
    """Return what `put` wrote."""
    found: Mapping[str, object] = json.loads(path.read_text("utf-8"))
    return found
