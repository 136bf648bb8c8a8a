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
"""Share of each kind of case; single effects cycle through the whole catalogue of the plant."""
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
"""An exam has campaigns as rigs may have them; to learn from, there are more hard cases."""


@dataclass(frozen=True, slots=True)
class HiddenCase:
    """What is hidden in one campaign.

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
        """The number as in names of folders and files."""
        return f"{self.number:04d}"

    @property
    def secret(self) -> BlindCampaign:
        """The campaign with its hidden effects."""
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
    hidden = [(kind, *_draw_effects(kind, singles, foreign, random)) for kind in kinds]
    order = random.permutation(len(hidden)).tolist()
    seeds = random.integers(1, 2**31, len(hidden)).tolist()
    return [
        HiddenCase(number, kind, case_seed, effects, sizes, rough=kind.startswith("rough"))
        for number, (case_seed, (kind, effects, sizes)) in enumerate(
            zip(seeds, (hidden[place] for place in order), strict=True), 1
        )
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
"""Suffix of the hidden folder in which an unfinished campaign is written."""


@dataclass(frozen=True, slots=True)
class CampaignOrder:
    """A campaign to simulate into a folder, and a fresh session of the same specimen into another."""

    case: HiddenCase
    campaign: Path
    fresh: Path


def simulate_campaign(order: CampaignOrder) -> None:
    """Simulate what does not exist yet; a folder exists with all its runs or not at all.

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
        unfinished = Path(mkdtemp(prefix=f".{folder.name}-", suffix=UNFINISHED_SUFFIX, dir=folder.parent))
        try:
            write_campaign(secret, unfinished, runs=runs)
            unfinished.chmod(0o755)
            unfinished.rename(folder)
        except OSError:
            if not folder.is_dir():  # else another worker had the same task and was first
                raise
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)


def remove_unfinished(order: CampaignOrder) -> None:
    """Remove what killed workers left; no other program may work in the exam's folder."""
    for folder in (order.campaign, order.fresh):
        for unfinished in folder.parent.glob(f".{folder.name}-*{UNFINISHED_SUFFIX}"):
            shutil.rmtree(unfinished, ignore_errors=True)


def hidden_d_prime(case: HiddenCase) -> float:
    """Return the larger d′ of the hidden effects, in the force or in the position."""
    from dragrig.sim_backend.blind.effect_size import effect_size

    size = effect_size(case.secret)
    return max(size.force, size.position)


EXAM_FILE, SEAL_FILE, ANSWERS_FILE = "exam.json", "answers.sha256", "answers.json"
EXAM_FORMAT, EXAM_VERSION = "dragrig-blind", 1


@dataclass(frozen=True, slots=True)
class ExamFolder:
    """Paths of an exam."""

    root: Path

    def campaign(self, name: str) -> Path:
        """Return the folder of a campaign's runs."""
        return self.root / "campaigns" / name

    def fresh(self, name: str) -> Path:
        """Return the folder of runs of the same specimen at other speeds and strains."""
        return self.root / "fresh" / name

    def diagnosis_file(self, name: str) -> Path:
        """Return the file of its diagnosis."""
        return self.root / "said" / f"{name}.json"

    def model(self, name: str) -> Path:
        """Return the file of the amended model."""
        return self.root / "said" / f"{name}.toml"

    def withheld(self, name: str) -> Path:
        """Return the file of its diagnosis without the true effect."""
        return self.root / "withheld" / f"{name}.json"

    def achieved(self, name: str) -> Path:
        """Return the file of the amended model's evaluation on fresh runs."""
        return self.root / "achieved" / f"{name}.json"

    def amount(self, name: str) -> Path:
        """Return the file of the hidden effect's d′."""
        return self.root / "amounts" / f"{name}.json"


@contextmanager
def open_exam_folder(out: Path, cases: int, seed: int, mix: str) -> Iterator[ExamFolder]:
    """Lock and yield an exam's folder: a new one, or one started with the same numbers.

    Raises
    ------
    SettingsError
        When it holds an exam with other numbers.
    OutputError
        When it holds something else, cannot be written, or another program uses it.
    """
    from filelock import FileLock, Timeout

    try:
        out.mkdir(parents=True, exist_ok=True)
        existing = _read_exam_numbers(out)
        if existing is None and any(path.name != ".lock" for path in out.iterdir()):
            raise OutputError(f"{out}: holds something that is no exam; name an empty or a new folder.")
        if existing is not None and existing != (cases, seed, mix):
            numbers = f"--cases {existing[0]} --seed {existing[1]} --mix {existing[2]}"
            raise SettingsError(
                f"{out}: holds an exam of {existing[0]} cases with seed {existing[1]}; give {numbers} to continue "
                "it, or name another folder."
            )
        with FileLock(out / ".lock", timeout=0):
            write_json(
                out / EXAM_FILE,
                {"format": EXAM_FORMAT, "version": EXAM_VERSION, "cases": cases, "seed": seed, "mix": mix},
            )
            yield ExamFolder(out)
    except Timeout as error:
        raise OutputError(f"{out}: another program uses it; wait for it, or name another folder.") from error
    except OSError as error:
        place = error.filename or out
        raise OutputError(f"{place}: cannot be written ({error.strerror}); name another folder.") from error


def _read_exam_numbers(out: Path) -> tuple[int, int, str] | None:
    """Return number of cases, seed and mix of the exam in a folder; None where there is none."""
    try:
        exam = json.loads((out / EXAM_FILE).read_text("utf-8"))
        return int(exam["cases"]), int(exam["seed"]), str(exam["mix"])
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise OutputError(f"{out / EXAM_FILE}: is not what an exam writes; name another folder.") from error


def seal_answers(folder: ExamFolder, planned: Sequence[HiddenCase]) -> str:
    """Write the hash of the answers where it does not exist, and return it.

    Raises
    ------
    AnalysisError
        When another hash exists.
    """
    digest = hashlib.sha256(_answers_json(planned).encode()).hexdigest()
    path = folder.root / SEAL_FILE
    if not path.exists():
        _replace_file(path, f"{digest}  {ANSWERS_FILE}\n")
    elif path.read_text("utf-8").split()[:1] != [digest]:
        raise AnalysisError(
            f"{path}: the plant gives other answers than were sealed, so it was changed meanwhile; start again in "
            "another folder."
        )
    return digest


def open_answers(folder: ExamFolder, planned: Sequence[HiddenCase]) -> Mapping[str, Mapping[str, object]]:
    """Write and return the answers by the campaigns' names; raises `AnalysisError` when others were sealed."""
    seal_answers(folder, planned)
    text = _answers_json(planned)
    _replace_file(folder.root / ANSWERS_FILE, text)
    answers: Mapping[str, Mapping[str, object]] = json.loads(text)
    return answers


def _answers_json(planned: Sequence[HiddenCase]) -> str:
    return json.dumps({case.name: {"case": case.kind, **true_answer(case.secret)} for case in planned}, indent=1)


def write_json(path: Path, document: object) -> None:
    """Write JSON to a file atomically."""
    _replace_file(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def _replace_file(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.begun")
    partial.write_text(text, "utf-8", newline="\n")
    partial.replace(path)


def read_json(path: Path) -> Mapping[str, object]:
    """Return what `write_json` wrote."""
    content: Mapping[str, object] = json.loads(path.read_text("utf-8"))
    return content
