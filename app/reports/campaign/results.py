"""What a campaign's report is made of."""

from collections.abc import Mapping
from dataclasses import dataclass

from dragrig.analysis.table import UNREADABLE, TableRow
from dragrig.rig.record import SessionRecord
from dragrig.rig.runfile import Campaign
from dragrig.rig.runfile.model import RunInfo
from dragrig.rig.runfile.naming import run_name


@dataclass(frozen=True, slots=True)
class CampaignResults:
    """A campaign, looked at whole.

    Attributes
    ----------
    rows
        Its runs in numbers, by the names of their files.
    sessions
        Records of its sessions that can be read, the earliest first.
    damaged
        Records that cannot be read, each with what is wrong.
    """

    name: str
    found: Campaign
    rows: tuple[TableRow, ...]
    sessions: tuple[SessionRecord, ...] = ()
    damaged: tuple[str, ...] = ()

    @property
    def readable(self) -> tuple[RunInfo, ...]:
        """Runs whose samples can be read."""
        lost = {row.file for row in self.rows if row.status == UNREADABLE}
        return tuple(one for one in self.found.runs if one.path.name not in lost)

    @property
    def bad(self) -> Mapping[str, str]:
        """Why runs were marked bad, by the names of their files."""
        return {path.name: mark.reason for path, mark in self.found.marks.items()}


def anchor(file: str) -> str:
    """Return the id that a run has in the page."""
    return f"run-{file.removesuffix('.h5')}"


def anchor_of(info: RunInfo) -> str:
    """Return the same of a run."""
    return f"run-{run_name(info.path)}"
