"""Campaigns with a known secret and their diagnoses, each made once for all processes of a test run."""

import pickle
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import mkdtemp

from filelock import FileLock

from dragrig.analysis.gap import DiagnosisOptions
from dragrig.analysis.gap.diagnose import diagnose
from dragrig.analysis.gap.diagnosis import Diagnosis
from dragrig.analysis.gap.run_data import choose_runs
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.analysis.selection import RunSelection
from dragrig.sim_backend.effects import catalogue
from hidden import hidden

UNADVISED = DiagnosisOptions(next_runs=None)
"""A diagnosis without the search for the next run, which takes a third of its time."""


def trying(*effects: str) -> DiagnosisOptions:
    """Return options for a diagnosis that tries these effects alone."""
    return replace(UNADVISED, excluded=tuple(effect for effect in catalogue() if effect not in effects))


OF_SOME = trying("adhesion", "film_depletion", "wall_lift_off", "stribeck", "force_drift", "encoder_scale")
"""Of some effects, in half the time, for what is about something else than telling all of the catalogue apart."""


@dataclass(frozen=True)
class Secret:
    """A campaign of the blind plant, by its seed, and the effects that it hides.

    Attributes
    ----------
    every
        Of how many speeds and strains one is kept.
    sizes
        Of the effects, each of its usual one.
    """

    seed: int
    every: int
    effects: tuple[str, ...] = ()
    options: DiagnosisOptions = UNADVISED
    sizes: tuple[float, ...] | float = 1.0


SECRETS = {
    "nothing": Secret(11, 3, options=OF_SOME),
    "stribeck": Secret(12, 5, ("stribeck",)),
    "strayed position": Secret(14, 5, ("encoder_scale",), OF_SOME),
    "two effects": Secret(
        43, 4, ("mains_hum", "force_drift"), trying("mains_hum", "force_drift", "stribeck"), (2.0, 1.0)
    ),
    "two effects of all": Secret(21, 2, ("film_depletion", "force_drift")),
    "unknown": Secret(18, 4, ("stick_slip",), trying("stribeck")),
    "unknown of all": Secret(18, 2, ("stick_slip",)),
    "unknown law": Secret(12, 2, ("wall_seam",)),
}


@dataclass(frozen=True)
class Diagnosed:
    """A campaign and its diagnosis.

    Attributes
    ----------
    runs
        Folder of its run files; nobody's to change.
    """

    runs: Path
    diagnosis: Diagnosis

    @cached_property
    def selection(self) -> RunSelection:
        return choose_runs(self.runs)


class DiagnosedCampaigns:
    """The campaigns by name, made when they are first asked for.

    Parameters
    ----------
    folder
        Folder that the processes of a test run share.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[str, Diagnosed] = {}

    def __getitem__(self, name: str) -> Diagnosed:
        if name not in self._known:
            self._known[name] = self._made(name)
        return self._known[name]

    def _made(self, name: str) -> Diagnosed:
        runs = self._folder / name
        result = self._folder / f"{name}.pickle"
        with FileLock(self._folder / f"{name}.lock"):
            if not result.exists():
                write_hidden(runs, SECRETS[name])
                result.write_bytes(pickle.dumps(diagnose(choose_runs(runs), MODEL, SECRETS[name].options)))
        return Diagnosed(runs, pickle.loads(result.read_bytes()))


def write_hidden(folder: Path, secret: Secret) -> None:
    """Write the runs of a blind campaign; the folder is there once they all are."""
    if not folder.exists():
        begun = Path(mkdtemp(dir=folder.parent))
        hidden(begun, secret.seed, *secret.effects, size=secret.sizes, every=secret.every)
        begun.rename(folder)
