"""Which runs of a very long campaign are diagnosed: as many of each condition as can be, spread over the session."""

from collections.abc import Sequence

import numpy as np

from dragrig.rig.runfile.model import RunInfo

MOST_RUNS = 75
"""A diagnosis holds about 10 MB of each; what is in a session shows in so many."""
CONDITIONS = ("shear_strain", "speed_mm_s", "travel_mm")


def spread(runs: Sequence[RunInfo], most: int = MOST_RUNS) -> list[RunInfo]:
    """Return at most so many runs, in their order; all where there are no more.

    Conditions get equal shares, and what rare ones leave of theirs goes to the others. Within a condition runs are
    evenly spaced in time, the first and the last among them.
    """
    if len(runs) <= most:
        return list(runs)
    groups: dict[tuple[object, ...], list[RunInfo]] = {}
    for one in sorted(runs, key=lambda run: run.header.start_time):
        groups.setdefault(_condition(one), []).append(one)
    kept: set[int] = set()
    waiting, room = sorted(groups.values(), key=len), most
    for done, group in enumerate(waiting):
        share = min(len(group), max(room // (len(waiting) - done), 1))
        chosen = np.unique(np.linspace(0, len(group) - 1, share).round().astype(int)).tolist() if room > 0 else []
        kept |= {id(group[at]) for at in chosen}
        room -= len(chosen)
    return [one for one in runs if id(one) in kept]


def _condition(run: RunInfo) -> tuple[object, ...]:
    return run.kind, *(run.header.protocol.get(name) for name in CONDITIONS)
