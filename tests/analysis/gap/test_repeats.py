"""Repeats of a run are computed once: what is laid out of each is what it would be alone, and no more is shared."""

import shutil
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from uuid import uuid4

import h5py
import numpy as np
import pytest

from dragrig.analysis.gap.design import Candidate, Study, linearise, problem_of_runs, signature, variants_of
from dragrig.analysis.gap.run_data import choose_runs
from dragrig.analysis.gap.studies import prepare_study
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.sim_backend.effects.base import ForceEffect, SensorEffect, catalogue
from dragrig.sim_backend.effects.run_state import RunState
from effect_scenes import KINDS, scene
from places import CAMPAIGN

EFFECTS = [effect for effect in catalogue().values() if isinstance(effect, ForceEffect | SensorEffect)]
DWELL_S = 240.0


def later(seen: RunState) -> RunState:
    """The same run, made later in its session."""
    return replace(seen, session_start_s=seen.session_start_s + 777.0, order=seen.order + 5)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """Every drag of the campaign twice, the second time an hour later; the last of them after a longer rest."""
    folder = tmp_path_factory.mktemp("repeats")
    drags = sorted(CAMPAIGN.glob("*drag*.h5"))[:3]
    for number, path in enumerate(drags):
        shutil.copy(path, folder / path.name)
        again = Path(shutil.copy(path, folder / f"again-{path.name}"))
        with h5py.File(again, "r+") as file:
            entry = file["entry"].attrs
            start = datetime.fromisoformat(str(entry["start_time"])) + timedelta(hours=1)
            entry.update({"run_id": str(uuid4()), "start_time": start.isoformat(), "order": 100 + number})
            if number == len(drags) - 1:
                entry["insertion_dwell_s"] = DWELL_S
    return prepare_study(choose_runs(folder), MODEL, EFFECTS)


@pytest.mark.parametrize(
    "effect", [effect for effect in EFFECTS if not effect.varies_in_session], ids=lambda first: first.id
)
def test_what_is_said_not_to_know_the_session_does_not(effect: ForceEffect | SensorEffect) -> None:
    for kind in KINDS:
        seen = scene(kind, until_s=3.0)
        for shape in variants_of([effect]):
            assert np.array_equal(signature(shape, seen, 0.9), signature(shape, later(seen), 0.9))


def test_what_an_effect_adds_to_a_sticking_wall_varies_as_its_stiffness_does() -> None:
    """Else a stiffer run is a misfit of the effect, and the fit gives it up for the specimen's own stiffness."""
    relaxing = prepare_study(choose_runs(CAMPAIGN), MODEL, EFFECTS)
    candidate = Candidate(catalogue()["hyperelastic_wall"], catalogue()["hyperelastic_wall"].defaults)
    plain, stiffer = (linearise(relaxing, relaxing.initial_z, chosen) for chosen in ((), (candidate,)))
    seen = 0
    for run, run_design, second in zip(relaxing.runs, plain.runs, stiffer.runs, strict=True):
        before, after = run_design.whitening.run_effects, second.whitening.run_effects
        if run.experiment.kind != "relaxation":
            assert np.array_equal(before, after)
            continue
        share = np.linalg.norm(second.effect_force) / np.linalg.norm(run_design.predicted)
        stiff = -len(relaxing.problem.variation_sds)
        more = run_design.whitening.whiten_noise(relaxing.problem.variation_sds[0] * second.effect_force)
        assert after[:, stiff] == pytest.approx(before[:, stiff] + more)
        assert share > 0.01
        seen += 1
    assert seen


def test_a_repeat_is_alike_unless_its_contact_is_of_another_age(study: Study) -> None:
    alike = {run.file: first for run, first in zip(study.runs, study.problem.representatives, strict=True)}
    own = [run.file for run in study.runs if run.experiment.insertion_dwell_s == DWELL_S]
    assert (len(own), len(alike)) == (1, 6)
    assert list(alike.values()).count(alike[own[0]]) == 1
    repeats = [name for name in alike if name.startswith("again-") and name not in own]
    assert all(alike[name] == alike[name.removeprefix("again-")] for name in repeats)


def test_every_run_is_laid_out_as_it_would_be_alone(study: Study) -> None:
    together = linearise(study, study.initial_z + 0.1, dictionary=True)
    for number in range(len(study.runs)):
        one_run = replace(study, problem=problem_of_runs(study.problem, [number]), runs=study.runs[number : number + 1])
        alone = linearise(one_run, study.initial_z + 0.1, dictionary=True)
        assert np.array_equal(together.runs[number].columns, alone.runs[0].columns)
        assert np.array_equal(together.grams[number], alone.grams[0])
