"""Questions to the runs in a folder and below it, and the answers of the run files themselves."""

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from fnmatch import fnmatch
from functools import cached_property
from pathlib import Path
from time import time as now
from typing import TYPE_CHECKING, Protocol, Self

from dragrig.rig import FINISHED_SUFFIX, MARK_SUFFIX, RECORDING_SUFFIX, mark_path

if TYPE_CHECKING:
    from dragrig.rig import Campaign, RunInfo

SETTLING_S = 3.0
"""What has been written since may be written once more without a change of its time, which file systems count in steps
of up to 2 s."""
CLOCK_SKEW_S = 60.0
"""So far may the clock of a file server be ahead."""
_RECORD_PATTERN = "session-*.toml"


@dataclass(frozen=True, slots=True)
class CampaignSummary:
    """A campaign in a list of them."""

    folder: Path
    began: datetime | None
    """Start of the earliest run."""
    specimens: tuple[str, ...]
    kinds: Mapping[str, int]
    """Runs by kind."""
    operators: tuple[str, ...]
    bad: int
    unreadable: int

    @classmethod
    def of(cls, campaign: "Campaign") -> Self:
        """Summarise a campaign."""
        from dragrig.rig import specimen_key

        runs = campaign.runs
        return cls(
            folder=campaign.folder,
            began=min((run.header.start_time for run in runs), default=None),
            specimens=tuple(sorted({*map(specimen_key, runs)})),
            kinds=dict(Counter(run.kind for run in runs)),
            operators=tuple(sorted({*map(operator_of, runs)} - {""})),
            bad=len(campaign.marks),
            unreadable=len(campaign.unreadable),
        )

    def __str__(self) -> str:
        """In words: 58 runs · jejunum · Ann."""
        count = sum(self.kinds.values())
        runs = f"{count} run{'' if count == 1 else 's'}"
        return " · ".join(filter(None, (runs, ", ".join(self.specimens), ", ".join(self.operators))))


@dataclass(frozen=True, slots=True)
class RunQuery:
    """Which runs are wanted; None and empty for any."""

    specimen: str = ""
    """Name or id, in letters of any case."""
    kind: str = ""
    operator: str = ""
    since: datetime | None = None
    until: datetime | None = None
    marked: bool | None = None
    """Whether the run is marked bad."""

    def matches(self, run: "RunInfo", *, marked: bool) -> bool:
        """Whether a run is among them."""
        from dragrig.rig import specimen_key

        header = run.header
        return (
            self.specimen.casefold() in {"", specimen_key(run).casefold(), str(header.specimen["name"]).casefold()}
            and self.kind in {"", *kinds_of(run)}
            and self.operator.casefold() in operator_of(run).casefold()
            and (self.since is None or header.start_time >= self.since)
            and (self.until is None or header.start_time <= self.until)
            and self.marked in {None, marked}
        )

    def of(self, campaign: "Campaign") -> "tuple[RunInfo, ...]":
        """Return the runs of a campaign that are wanted."""
        return tuple(run for run in campaign.runs if self.matches(run, marked=run.path in campaign.marks))


class RunListing(Protocol):
    """The questions to the runs in a folder and below it; folders in order of name."""

    def folders(self, *, with_files: bool = False) -> tuple[Path, ...]:
        """Return the folders that hold run files or records of sessions, or only those with files of runs."""

    def summaries(self) -> tuple[CampaignSummary, ...]:
        """Summarise the campaigns."""

    def found(self, query: RunQuery) -> Mapping[Path, tuple[str, ...]]:
        """Return the names of the wanted run files by folder, in the order of `Campaign.runs`."""

    def kinds(self) -> tuple[str, ...]:
        """Return the kinds of the runs, and `sentinel` where there are any."""

    def campaign(self) -> "Campaign":
        """Return the campaign in the folder itself."""


class FileListing:
    """The runs as their files tell, each read."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def folders(self, *, with_files: bool = False) -> tuple[Path, ...]:
        """Return the folders that hold run files or records of sessions, or only those with files of runs."""
        scanned = walk(self._folder, lambda _path, _state: None)
        return tuple(
            sorted(
                self._folder / found.path for found in scanned if found.files or (found.is_campaign and not with_files)
            )
        )

    def summaries(self) -> tuple[CampaignSummary, ...]:
        """Summarise the campaigns."""
        return tuple(map(CampaignSummary.of, self._campaigns))

    def found(self, query: RunQuery) -> Mapping[Path, tuple[str, ...]]:
        """Return the names of the wanted run files by folder."""
        wanted = ((campaign, query.of(campaign)) for campaign in self._campaigns)
        return {campaign.folder: tuple(run.path.name for run in runs) for campaign, runs in wanted if runs}

    def kinds(self) -> tuple[str, ...]:
        """Return the kinds of the runs."""
        runs = (run for campaign in self._campaigns for run in campaign.runs)
        return tuple(sorted({kind for run in runs for kind in kinds_of(run)}))

    def campaign(self) -> "Campaign":
        """Return the campaign in the folder itself."""
        from dragrig.rig import read_campaign

        return read_campaign(self._folder)

    @cached_property
    def _campaigns(self) -> "tuple[Campaign, ...]":
        from dragrig.rig import read_campaign

        return tuple(map(read_campaign, self.folders()))


def operator_of(run: "RunInfo") -> str:
    """Return the operator of a run, "" where nobody said."""
    return str(run.header.entry.get("operator", ""))


def kinds_of(run: "RunInfo") -> tuple[str, ...]:
    """Return the kind that a run counts as."""
    return (run.kind, "sentinel") if run.is_sentinel else (run.kind,)


@dataclass(frozen=True, slots=True)
class ScannedFolder:
    """A folder as the file system shows it; `path` is relative to the folder that is asked about, "" for itself."""

    path: str
    state: str
    """Key of its state; empty while that is not settled."""
    files: Mapping[str, str]
    """Keys of the states of its run files with their marks, by name; empty while a state is not settled."""
    is_campaign: bool

    @property
    def signature(self) -> str:
        """Key of everything in it that a catalogue knows of."""
        text = repr((sorted(self.files.items()), self.is_campaign))
        return hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=16).hexdigest()


def below(path: str, name: str) -> str:
    """Join relative paths, of which the first may be ""."""
    return f"{path}/{name}" if path else name


def _state(stat: os.stat_result, now_s: float) -> str:
    """Return the key of a file's or folder's state, empty where it may still change without a trace."""
    for changed_s in (stat.st_mtime, stat.st_ctime):
        # What lies further ahead was dated so, and not just written.
        if -CLOCK_SKEW_S < now_s - changed_s < SETTLING_S:
            return ""
    return f"{stat.st_size}:{stat.st_mtime_ns}:{stat.st_ctime_ns}:{stat.st_ino}"


def walk(top: Path, known_subfolders: Callable[[str, str], Iterable[str] | None]) -> list[ScannedFolder]:
    """Look at a folder and all below it, without the insides of links.

    Parameters
    ----------
    known_subfolders
        Returns the names of the subfolders of a folder that is known in this state, which is then not looked into.
    """
    scanned: list[ScannedFolder] = []
    left, base = [""], str(top)
    while left:
        path = left.pop()
        # A folder that is gone meanwhile, or may not be read, holds nothing; the latter may be allowed later.
        try:
            state = _state(os.stat(f"{base}/{path}"), now())  # noqa: PTH116  # thousands of them
            subfolders = known_subfolders(path, state)
            if subfolders is None:
                found, subfolders = scan_folder(top, path, state)
                scanned.append(found)
            left.extend(below(path, name) for name in subfolders)
        except PermissionError:
            scanned.append(ScannedFolder(path, "", {}, is_campaign=False))
        except (FileNotFoundError, NotADirectoryError):
            continue
    return scanned


def scan_folder(top: Path, path: str, state: str) -> tuple[ScannedFolder, list[str]]:
    """Look at the content of a folder in this state; return it, and the names of its subfolders."""
    now_s = now()
    files: dict[str, str] = {}
    marks: dict[str, str] = {}
    subfolders: list[str] = []
    is_campaign = False
    with os.scandir(top / path) as entries:
        for entry in entries:
            name = os.path.normcase(entry.name)
            if name.endswith(FINISHED_SUFFIX):
                is_campaign = True
                files[entry.name] = "" if name.endswith(RECORDING_SUFFIX) else _entry_state(entry, now_s)
            elif name.endswith(MARK_SUFFIX):
                marks[entry.name] = _entry_state(entry, now_s)
            elif fnmatch(name, _RECORD_PATTERN):
                is_campaign = True
            if entry.is_dir(follow_symlinks=False):
                subfolders.append(entry.name)
    for name, own in files.items():
        mark = marks.get(mark_path(Path(name)).name, "unmarked") if marks else "unmarked"
        files[name] = f"{own} {mark}" if own and mark else ""
    return ScannedFolder(path, state, files, is_campaign), subfolders


def count_files(folder: Path) -> int:
    """Return how many run files there are in a folder, recordings included; none where it cannot be read."""
    try:
        with os.scandir(folder) as entries:
            return sum(os.path.normcase(entry.name).endswith(FINISHED_SUFFIX) for entry in entries)
    except OSError:
        return 0


def _entry_state(entry: "os.DirEntry[str]", now_s: float) -> str:
    try:
        return _state(entry.stat(), now_s)
    except OSError:
        return ""  # a link to nothing, or gone
