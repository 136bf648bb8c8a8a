"""Many campaigns identified side by side, and where their files go."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dragrig.analysis.identification.results import Identification
from dragrig.analysis.progress import Progress, silent
from dragrig.config.errors import DragrigError
from dragrig.config.library import from_anywhere
from dragrig.identifying import IdentifiedCampaign, Wall, identify, pictures, save_model
from dragrig.spreading import executor, spread_counted


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedFolder:
    """What was identified from one of many campaigns.

    Attributes
    ----------
    source
        Its folder.
    result
        All numbers; None where there could be none.
    files
        What was written.
    why_not
        Why there is no result, or no model, a sentence; empty where there is one.
    """

    source: str
    result: Identification | None
    files: tuple[Path, ...] = ()
    why_not: str = ""

    @property
    def failed(self) -> bool:
        """Whether there is no result, or the fit did not converge."""
        return self.result is None or (self.result.joint is not None and not self.result.joint.converged)


def identify_many(
    campaigns: Sequence[str | Path],
    *,
    nominal: str | Path = "capsule",
    model: str | Path = "paper",
    wall: Wall = "scaled",
    specimen: str | None = None,
    write: bool = False,
    out: Path | None = None,
    overwrite: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress = silent,
) -> tuple[IdentifiedFolder, ...]:
    """Identify many campaigns, each as `dragrig.identify` does it; one that cannot be is told, the others go on.

    Parameters
    ----------
    campaigns
        Their folders. On a cluster its workers must see the same ones.
    nominal, model, wall, specimen
        As in `dragrig.identify`, for all.
    write
        Whether model and pictures are written, into a folder `identified` beside each campaign's runs.
    out
        Folder in whose place: each campaign has one in it, of its own name.
    workers
        Processes that share the campaigns; as many as there are cores unless given.
    scheduler
        Address of a Dask cluster that does the work in their place.

    Returns
    -------
    tuple of IdentifiedFolder
        In the order of the campaigns, the same for any number of workers.

    Raises
    ------
    SettingsError
        When the cluster cannot be used.
    WorkerError
        When processes end before the work is done.
    """
    folders = [Path(one).absolute() for one in campaigns]
    places = _places(folders, out) if write else [None] * len(folders)
    asked = _Asked(from_anywhere(str(nominal)), from_anywhere(str(model)), wall, specimen, overwrite)
    with executor(workers, scheduler, most=len(folders)) as some:
        found = spread_counted(some, asked.identified, list(zip(folders, places, strict=True)), progress)
    return tuple(
        IdentifiedFolder(str(given), one.result, one.files, one.why_not.replace(one.source, str(given)))
        for given, one in zip(campaigns, found, strict=True)
    )


def beside(campaign: Path) -> Path:
    """Return a new folder for what was identified; measured data often lie where nothing may be added."""
    first = campaign / "identified" if os.access(campaign, os.W_OK) else Path(f"{campaign.resolve().name}-identified")
    folder, number = first, 1
    while folder.exists():
        number += 1
        folder = first.with_name(f"{first.name}-{number}")
    return folder


def write_files(found: IdentifiedCampaign, folder: Path, *, with_model: bool, overwrite: bool) -> tuple[Path, ...]:
    """Write model and pictures into a folder; raises `OutputError`."""
    written = []
    if with_model:
        name = "model.toml" if found.nominal.name == "capsule" else f"{found.nominal.name}.toml"
        written.append(save_model(found, folder / name, overwrite=overwrite))
    return (*written, *pictures(found, folder, overwrite=overwrite))


def _places(folders: Sequence[Path], out: Path | None) -> list[Path | None]:
    """Return where the files of each campaign go: never two into one folder."""
    places: list[Path | None] = []
    for one in folders:
        first = beside(one) if out is None else out.absolute() / one.name
        taken = [place for place in places if place is not None]
        place, number = first, 1
        while place in taken:
            number += 1
            place = first.with_name(f"{first.name}-{number}")
        places.append(place)
    return places


@dataclass(frozen=True, slots=True)
class _Asked:
    nominal: str
    model: str
    wall: Wall
    specimen: str | None
    overwrite: bool

    def identified(self, piece: tuple[Path, Path | None]) -> IdentifiedFolder:
        campaign, place = piece
        try:
            found = identify(campaign, nominal=self.nominal, model=self.model, wall=self.wall, specimen=self.specimen)
            files: tuple[Path, ...] = ()
            if place is not None:
                with_model = found.why_no_model is None
                files = write_files(found, place, with_model=with_model, overwrite=self.overwrite)
            return IdentifiedFolder(str(campaign), found.result, files, found.why_no_model or "")
        except DragrigError as error:
            return IdentifiedFolder(str(campaign), None, (), str(error))
