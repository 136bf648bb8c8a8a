"""Laws that bear no name: what they are found by, what they say against a name, and in which words."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from diagnosed import UNADVISED, DiagnosedCampaigns
from dragrig.analysis.gap.classifier import classify
from dragrig.analysis.gap.design import Design, RunDesign, Study, linearise
from dragrig.analysis.gap.diagnose import diagnose
from dragrig.analysis.gap.diagnosis import Verdict
from dragrig.analysis.gap.excess import ResidualBlocks
from dragrig.analysis.gap.features import DecisionInputs, HypothesisSummary, NonparametricLaw
from dragrig.analysis.gap.forward_selection import fit_nonparametric_laws
from dragrig.analysis.gap.isolability import DEFAULT_TOLERANCE_MN
from dragrig.analysis.gap.run_data import RunData, choose_runs
from dragrig.analysis.gap.studies import prepare_study
from dragrig.analysis.gap.unknown_gap import (
    NOT_LOCALISABLE,
    describe_unexplained_gap,
    fit_decay,
    nonparametric_law_text,
)
from dragrig.analysis.gap.unknown_law import GapRegion
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.rig.devices import Contact
from dragrig.rig.profile import FloatArray, Phase
from dragrig.sim_backend.effects.base import Effect, catalogue
from hidden import hidden
from places import CAMPAIGN

PERIOD_S = 13.0
Law = Callable[[RunData], FloatArray | float]


@pytest.fixture(scope="module")
def study() -> Study:
    return prepare_study(choose_runs(CAMPAIGN), MODEL, ())


@pytest.fixture(scope="module")
def nominal(study: Study) -> Design:
    return linearise(study, study.initial_z)


def planted(study: Study, design: Design, law: Law, seed: int = 5) -> Design:
    """The same campaign with nothing in it but noise and a force [mN]."""
    random = np.random.default_rng(seed)

    def run(run_design: RunDesign, run_data: RunData) -> RunDesign:
        noise = run_design.whitening.noise_root @ random.standard_normal(run_design.residual.size)
        return replace(run_design, residual=noise + law(run_data))

    return replace(design, runs=tuple(run(*pair) for pair in zip(design.runs, study.runs, strict=True)))


def in_the_gut(run: RunData) -> bool:
    return run.experiment.contact is Contact.SLIDING and run.experiment.kind == "drag"


def creeping(run: RunData) -> FloatArray:
    """What gives way while the stage moves, and comes back once it stands."""
    time = run.coordinates.time_s
    start, stop = run.experiment.motion.breaks_s[[1, -2]].tolist()
    grown = 1.0 - np.exp(-np.clip(time - start, 0.0, stop - start) / 0.5)
    return np.asarray(20.0 * grown * np.exp(-np.maximum(time - stop, 0.0) / 0.8))


LAWS: dict[str, Law] = {
    "speed": lambda run: 15.0 * run.coordinates.speed_mm_s / 60.0,
    "speed in the gut": lambda run: (
        in_the_gut(run) * 12.0 * np.exp(-(((np.log(run.coordinates.speed_mm_s + 1e-9) - 1.6) / 0.4) ** 2))
    ),
    "place in the gut": lambda run: in_the_gut(run) * 15.0 * np.exp(-(((run.coordinates.position_mm - 12) / 2.0) ** 2)),
    "time since start and stop": creeping,
    "swing in all runs": lambda run: 12.0 * np.sin(2 * np.pi * run.coordinates.session_s / PERIOD_S),
}


@pytest.mark.parametrize("law", LAWS)
def test_a_force_of_one_coordinate_is_found_as_that(law: str, study: Study, nominal: Design) -> None:
    best, *others = fit_nonparametric_laws(planted(study, nominal, LAWS[law]), study.runs, PERIOD_S)
    assert best.name == law
    assert all(entry.chi2 > best.chi2 + 20 for entry in others)
    assert 3.0 < best.change_mN < 20.0


EXAMPLES = [effect for effect in catalogue().values() if effect.free_law]
"""Effects that are a nonparametric law themselves."""


@pytest.mark.parametrize("seed", range(4))
def test_noise_alone_is_no_law(seed: int, study: Study, nominal: Design) -> None:
    noise = planted(study, nominal, lambda _: 0.0, seed)
    laws = {law.name: law for law in fit_nonparametric_laws(noise, study.runs, PERIOD_S)}
    assert set(laws) >= {*LAWS, *(effect.free_law for effect in EXAMPLES)}
    blocks = sum(nominal.block_counts)
    assert all(law.chi2 > blocks - 4 * np.sqrt(2 * blocks) for law in laws.values())


BLOCKS, NOISE, LOUD = 8000, 8010.0, 20_000.0


def case(effect: str, squares: float, law: str, left: float) -> DecisionInputs:
    """An effect that leaves so many squares in any form, and a law that leaves others."""
    tried = HypothesisSummary((effect,), squares, squares, 5.0, llr=0.5 * (LOUD - squares), chi2_without=LOUD)
    return DecisionInputs(BLOCKS, LOUD, (tried,), laws=(NonparametricLaw(law, left, 5.0),))


def test_a_name_that_explains_less_than_any_speed_law_is_not_given() -> None:
    assert (
        classify(case("wall_lift_off", 12_000.0, "speed in the gut", 15_000.0), DEFAULT_TOLERANCE_MN).verdict
        is Verdict.EFFECT
    )
    assert (
        classify(case("wall_lift_off", 12_000.0, "speed in the gut", NOISE), DEFAULT_TOLERANCE_MN).verdict
        is Verdict.UNKNOWN
    )


@pytest.mark.parametrize("effect", EXAMPLES, ids=lambda effect: effect.id)
def test_an_effect_that_is_such_a_law_stays_named(effect: Effect) -> None:
    inputs = case(effect.id, 8600.0, effect.free_law, NOISE)
    assert classify(inputs, DEFAULT_TOLERANCE_MN).effects == (effect.id,)


def test_a_law_opens_a_gap_that_no_effect_sees_unless_it_is_too_small_to_matter() -> None:
    seen = DecisionInputs(BLOCKS, NOISE + 400.0, (), laws=(NonparametricLaw("speed", NOISE, 5.0),))
    assert classify(seen, DEFAULT_TOLERANCE_MN).verdict is Verdict.UNKNOWN
    assert classify(seen, 6.0).verdict is Verdict.NO_GAP


def test_what_a_gap_may_be_a_function_of_is_said_beside_the_effect_most_like_it() -> None:
    inputs = case("wall_lift_off", 14_000.0, "speed in the gut", 8400.0)
    assert nonparametric_law_text(inputs) == (
        "By itself, a force that depends on the speed alone, in the gut, in any form, would explain 96.7 % of it; "
        "wall lift-off, in any form, 50 %."
    )
    assert nonparametric_law_text(case("wall_lift_off", 8400.0, "speed in the gut", 8400.0)) == ""
    assert nonparametric_law_text(case("wall_lift_off", 19_000.0, "speed in the gut", 16_000.0)) == ""


def test_a_gap_that_only_many_runs_together_show_has_no_place(diagnosed: DiagnosedCampaigns) -> None:
    quiet = diagnosed["nothing"].diagnosis.where
    assert not any(quiet.location("channel").shares.values())
    gap = describe_unexplained_gap(quiet, (), Verdict.UNKNOWN, None, (), case("folds", 19_000.0, "speed", NOISE))
    assert gap.location == NOT_LOCALISABLE
    assert gap.dependence.startswith("By itself, a force that depends on the speed")


def test_every_law_has_words(study: Study, nominal: Design) -> None:
    for law in fit_nonparametric_laws(nominal, study.runs, PERIOD_S):
        assert "a force " in nonparametric_law_text(case("folds", 19_000.0, law.name, NOISE))


@pytest.mark.parametrize(
    ("effect", "seed", "text"),
    [
        pytest.param("foam_resonance", 31, "depends on the speed alone, in the gut", marks=pytest.mark.thorough),
        pytest.param("current_crosstalk", 32, "depends on the speed alone, in all runs", marks=pytest.mark.thorough),
        pytest.param("fixture_creeps", 33, "time since start and stop alone, in all runs", marks=pytest.mark.thorough),
        pytest.param("gain_switches", 34, "whose gain differs from run to run", marks=pytest.mark.thorough),
        pytest.param("thermostat_zero", 35, "is periodic in session time, in all runs", marks=pytest.mark.thorough),
    ],
)
def test_what_resembles_an_effect_but_is_another_law_is_unknown(
    effect: str, seed: int, text: str, tmp_path: Path
) -> None:
    diagnosis = diagnose(hidden(tmp_path, seed, effect), MODEL, UNADVISED)
    assert (diagnosis.verdict, diagnosis.effects) == (Verdict.UNKNOWN, ())
    assert diagnosis.unknown is not None
    assert text in diagnosis.unknown.dependence
    there, _, elsewhere = diagnosis.unknown.location.split(". ")[0].partition("; not in ")
    assert not any(kind in there and kind in elsewhere for kind in ("relaxation", "blank", "Coulomb", "drag"))


@pytest.mark.parametrize("decays", [True, False])
def test_what_decays_over_many_strokes_does_so_along_the_way_made(decays: bool) -> None:
    corners_s, noise = np.arange(11) * 4.0, np.random.default_rng(7).normal(0.0, 0.3, 400)
    time = np.linspace(0.05, 39.95, 400)
    position = np.interp(time, corners_s, 20.0 * (np.arange(11) % 2))
    way = np.interp(time, corners_s, 20.0 * np.arange(11))
    residual = 20.0 * np.exp(-way / 30.0) if decays else 5.0 * np.sign(np.gradient(position))
    run = ResidualBlocks(
        "a", "force", "motion", Contact.SLIDING, 5.0, 0.0, None, residual + noise, np.full(400, 0.3),
        np.full(400, 0.1), time, np.full(400, int(Phase.STEADY), np.uint8), position,
    )  # fmt: skip
    decay = fit_decay(GapRegion("force", ("motion",), (run,), (np.ones(400, dtype=np.bool_),), 1.0))
    if decays:
        assert decay is not None
        assert (decay.along_way, decay.length) == (True, pytest.approx(30.0, rel=0.1))
    else:
        assert decay is None
