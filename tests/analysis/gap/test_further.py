"""A second effect beside a strong one: seen where the first does little, and not made of its form."""

from pathlib import Path

import numpy as np
import pytest

from diagnosed import UNADVISED
from dragrig.analysis.gap import forward_selection
from dragrig.analysis.gap.design import Candidate, Design, ParameterPoint, Study, gain_of_step, linearise
from dragrig.analysis.gap.diagnose import diagnose
from dragrig.analysis.gap.diagnosis import Verdict
from dragrig.analysis.gap.forward_selection import FORM_ERROR_SD, MAX_NOMINAL_GAIN, inflate_by_form_error
from dragrig.analysis.gap.hypothesis_fit import fit_hypothesis
from dragrig.analysis.gap.run_data import choose_runs
from dragrig.analysis.gap.studies import prepare_study
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.sim_backend.effects.base import catalogue
from hidden import hidden
from places import CAMPAIGN


@pytest.fixture(scope="module")
def study() -> Study:
    return prepare_study(choose_runs(CAMPAIGN), MODEL, [catalogue()["breakaway"]])


@pytest.fixture(scope="module")
def broken_away(study: Study) -> Design:
    effect = catalogue()["breakaway"]
    return linearise(study, study.initial_z, [Candidate(effect, effect.defaults)])


def test_what_an_effect_adds_is_doubted_block_by_block(broken_away: Design) -> None:
    random = np.random.default_rng(8)
    for before, after in zip(broken_away.runs, inflate_by_form_error(broken_away).runs, strict=True):
        sure, doubted = before.whitening, after.whitening
        own = sure.noise_root @ np.column_stack(
            (sure.noise_root.T, sure.run_effects @ sure.run_effects.T @ sure.noise_root.T)
        )
        blocks = sure.noise_root.shape[0]
        covariance = own[:, :blocks] + own[:, blocks:] + np.diag((FORM_ERROR_SD * before.effect_force) ** 2)
        values = random.standard_normal(blocks)
        assert np.sum(doubted.whiten(values) ** 2) == pytest.approx(values @ np.linalg.solve(covariance, values))
        assert after.motion_sd == pytest.approx(np.hypot(before.motion_sd, FORM_ERROR_SD * before.effect_force))


def test_beside_nothing_nothing_is_doubted(study: Study) -> None:
    nominal = linearise(study, study.initial_z)
    for before, after in zip(nominal.grams, inflate_by_form_error(nominal).grams, strict=True):
        assert after == pytest.approx(before, rel=1e-9, abs=1e-9)


def test_another_form_of_an_effect_counts_for_little_and_what_acts_elsewhere_as_much(broken_away: Design) -> None:
    """A quarter of the effect, this way and that from block to block, against a wave where it does nothing."""
    doubted = inflate_by_form_error(broken_away)
    sure, unsure = np.zeros(2), np.zeros(2)
    for before, after in zip(broken_away.runs, doubted.runs, strict=True):
        bent = FORM_ERROR_SD * before.effect_force * np.sign(np.sin(np.arange(before.effect_force.size)))
        elsewhere = np.where(
            np.abs(before.effect_force) < 0.1, 3.0 * np.sin(np.arange(before.effect_force.size) / 9.0), 0.0
        )
        both = np.column_stack((bent, elsewhere))
        sure += np.sum(before.whitening.whiten(both) ** 2, axis=0)
        unsure += np.sum(after.whitening.whiten(both) ** 2, axis=0)
    blocks = sum(broken_away.block_counts)
    assert sure[0] > 2 * unsure[0]
    assert unsure[0] < blocks
    assert unsure[1] > 0.9 * sure[1]


@pytest.mark.parametrize(
    ("seed", "strong", "weak"),
    [
        pytest.param(61, "mesentery_tether", "adhesion", marks=pytest.mark.thorough),
        pytest.param(64, "extra_relaxation", "adhesion", marks=pytest.mark.thorough),
        pytest.param(66, "film_depletion", "adhesion", marks=pytest.mark.thorough),
    ],
)
def test_a_weak_effect_is_named_beside_a_strong_one(tmp_path: Path, seed: int, strong: str, weak: str) -> None:
    """What the strong one's foreign form leaves is larger than the weak one, and is not called an effect."""
    diagnosis = diagnose(hidden(tmp_path, seed, strong, weak, size=(1.5, 0.4)), MODEL, UNADVISED)
    assert (diagnosis.verdict, set(diagnosis.effects)) == (Verdict.SEVERAL, {strong, weak})


def test_the_nominal_model_converges_before_an_effect_is_tried(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    def first_step_alone(study: Study, start: ParameterPoint, steps: int, reference: Design) -> ParameterPoint:
        del study, start, steps
        return ParameterPoint(reference.z + 0.5)

    far = linearise(study, study.initial_z + 0.5)
    assert gain_of_step(far) > MAX_NOMINAL_GAIN
    monkeypatch.setattr(forward_selection, "gauss_newton", first_step_alone)
    monkeypatch.setattr(forward_selection, "MIN_EXCESS_SIGMAS", -100.0)
    search = forward_selection.search_effects(study)
    best = max(entry.llr for entry in search.ranked)
    allowed = max(MAX_NOMINAL_GAIN, forward_selection.MAX_NOMINAL_GAIN_SHARE * best)
    assert gain_of_step(linearise(study, search.nominal.z)) < 1.5 * allowed


def test_what_the_nominal_parameters_do_is_not_the_change_by_an_effect(study: Study) -> None:
    effect = catalogue()["breakaway"]
    nominal = linearise(study, study.initial_z)
    small = Candidate(effect, {**effect.defaults, effect.size.name: 1e-4 * effect.defaults[effect.size.name]})
    fit = fit_hypothesis(study, ParameterPoint(study.initial_z + 1.0, (small,)), nominal)[0]
    assert fit.change_mN < 0.1
