"""The page of a campaign."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

from dragrig.figures.header import title_of
from dragrig.reports.campaign.pictures import OVERVIEW
from dragrig.reports.campaign.results import CampaignResults, anchor_of
from dragrig.reports.campaign.tables import tables
from dragrig.reports.embedding import Picture
from dragrig.reports.rendering import render
from dragrig.rig.protocols.way_back import Return


@dataclass(frozen=True, slots=True)
class Folded:
    """A run that is drawn by itself, folded away until somebody looks."""

    id: str
    title: str
    file: str
    trouble: str
    picture: Picture


def page(results: CampaignResults, pictures: Mapping[str, Picture]) -> str:
    """Return the report on a campaign as one HTML page.

    Parameters
    ----------
    pictures
        From `pictures.pictures`: the overview, and runs by their ids.
    """
    tabulated = tables(results, frozenset(pictures) - {OVERVIEW})
    backends = sorted({one.header.backend for one in results.found.runs})
    return render(
        "campaign.html",
        {
            "title": f"Campaign {results.name}",
            "lead": _lead(results),
            "backends": backends,
            "left_out": len(tabulated["left-out"].rows),
            "runs": _folded(results, pictures),
            "not_drawn": _not_drawn(results, pictures),
            "tables": tabulated,
            "pictures": pictures,
        },
    )


def _lead(results: CampaignResults) -> str:
    runs = results.found.runs
    if not runs:
        return "No run in this folder can be read."
    counts = Counter("way back" if one.kind == Return.kind else one.kind for one in runs)
    kinds = ", ".join(f"{count} {_several(kind, count)}" for kind, count in counts.most_common())
    specimens = sorted({str(one.header.specimen.get("name", "")) for one in runs} - {""})
    begun, last = (pick(one.header.start_time for one in runs) for pick in (min, max))
    until = f"{last:%H:%M}" if last.date() == begun.date() else _moment(last)
    on = f" of {' and '.join(specimens)}" if specimens else ""
    return f"{len(runs)} run{'' if len(runs) == 1 else 's'}{on} ({kinds}), {_moment(begun)} to {until}."


def _moment(when: datetime) -> str:
    return f"{when.day} {when:%B %Y, %H:%M}"


def _several(kind: str, count: int) -> str:
    return "ways back" if kind == "way back" and count > 1 else kind


def _folded(results: CampaignResults, pictures: Mapping[str, Picture]) -> list[Folded]:
    return [
        Folded(
            anchor_of(one),
            title_of(one),
            one.path.name,
            "marked bad" if one.path.name in results.bad else "" if one.status == "complete" else str(one.status),
            pictures[anchor_of(one)],
        )
        for one in results.readable
        if anchor_of(one) in pictures
    ]


def _not_drawn(results: CampaignResults, pictures: Mapping[str, Picture]) -> str:
    back = sum(one.kind == Return.kind for one in results.readable)
    others = sum(one.kind != Return.kind and anchor_of(one) not in pictures for one in results.readable)
    told = [f"{back} {_several('way back', back)}"] if back else []
    told += [f"{others} more"] if others else []
    return " and ".join(told)
