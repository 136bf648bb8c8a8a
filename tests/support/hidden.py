"""Campaigns with hidden effects, as run files, for what diagnoses them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import dragrig
from dragrig.analysis.gap.run_data import choose_runs
from dragrig.analysis.models.experiment import SOURCE_KEY, START_UNKNOWN_KEY
from dragrig.analysis.selection import RunSelection
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.sim_backend.blind import BlindCampaign, draw_campaign, write_campaign

PLAN = {
    "name": "short",
    "seed": 3,
    "steps": [
        {"kind": "relaxation", "shear_strain": 1.0, "hold_s": 10.0, "wait_s": 30.0},
        {"kind": "blank", "speed_mm_s": 20.0, "travel_mm": 40.0},
        {"kind": "coulomb", "speed_mm_s": [2.0, 20.0], "travel_mm": 40.0},
        {"kind": "drag", "speed_mm_s": [2.0, 10.0, 40.0], "travel_mm": 40.0},
    ],
}


def hidden(folder: Path, seed: int, *effects: str, size: float | Sequence[float] = 1.0, every: int = 1) -> RunSelection:
    """Return some runs of a campaign of the blind plant, read back from its files."""
    write_campaign(thinned(draw_campaign(seed, effects=effects, size=size), every), folder)
    return choose_runs(folder)


def thinned(campaign: BlindCampaign, every: int = 1) -> BlindCampaign:
    """Keep of each kind of run every so many speeds or strains, once, but 2 and 20 mm/s twice."""
    groups: dict[str, dict[float, list[int]]] = {}
    for number, run in enumerate(campaign.runs):
        condition = run.speed_mm_s if run.strain is None else run.strain
        groups.setdefault(run.kind, {}).setdefault(condition, []).append(number)
    kept = sorted(
        number
        for conditions in groups.values()
        for condition in sorted(conditions, reverse=True)[::every]
        for number in conditions[condition][: 2 if condition in {2.0, 20.0} else 1]
    )
    runs, variations = (tuple(of_run[number] for number in kept) for of_run in (campaign.runs, campaign.variations))
    return replace(campaign, runs=runs, variations=variations)


def simulated(model: FrictionModelSettings) -> RunSelection:
    """Return the runs of a short plan on the simulated rig, with its noise and with specimens that vary."""
    return choose_runs(dragrig.simulate(Plan.model_validate(PLAN), model=model))


def without_clock(selection: RunSelection) -> RunSelection:
    """Return the same runs, of which it is not known when each was made."""
    experiments = []
    for experiment in selection.experiments:
        info = experiment.run.info
        entry = {**info.header.entry, START_UNKNOWN_KEY: True, SOURCE_KEY: info.path.name}
        header = replace(info.header, entry=entry)
        experiments.append(replace(experiment, run=replace(experiment.run, info=replace(info, header=header))))
    return replace(selection, experiments=tuple(experiments))
