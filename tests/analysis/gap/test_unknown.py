"""A gap that no effect explains: laws that were planted are found, chance gives none, words say where and how."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dragrig.analysis.gap.excess import ResidualBlocks
from dragrig.analysis.gap.localise import localise
from dragrig.analysis.gap.unknown_gap import dependence_text, location_text
from dragrig.analysis.gap.unknown_law import (
    FoldProducts,
    GapLaw,
    block_speed,
    condition_folds,
    fit_gap_law,
    gap_region,
    held_out_chi2,
    time_since_start,
)
from dragrig.rig.profile import FloatArray, Phase
from property_tests import examples, thorough
from residuals import Planted, campaign


def moving(blocks: ResidualBlocks, *kinds: str) -> FloatArray:
    inside = (blocks.phase != Phase.REST) & (blocks.phase != Phase.HOLD)
    return np.asarray(inside * (blocks.kind in kinds), dtype=np.float64)


def rise_and_fall(blocks: ResidualBlocks) -> FloatArray:
    v = np.maximum(block_speed(blocks), 0.5)
    return np.asarray((1.2 * v - 12.0 * np.log(v)) * moving(blocks, "drag"))


def way_and_time(blocks: ResidualBlocks) -> FloatArray:
    return (0.9 * blocks.position_mm - 0.5 * time_since_start(blocks)) * moving(blocks, "drag", "coulomb")


def held_strain(blocks: ResidualBlocks) -> FloatArray:
    return np.asarray(12.0 * blocks.strain**2 * (blocks.phase == Phase.HOLD))


def late_in_the_session(blocks: ResidualBlocks) -> FloatArray:
    return -10.0 * (blocks.session_s > 1800.0) * moving(blocks, "drag")


def in_one_run(blocks: ResidualBlocks) -> FloatArray:
    return 1.5 * blocks.position_mm * moving(blocks, "drag") * (blocks.session_s == 1500.0)


def its_own_in_every_run(blocks: ResidualBlocks) -> FloatArray:
    return np.asarray(20.0 * np.sin(blocks.session_s) * blocks.position_mm / 40.0 * moving(blocks, "drag"))


def waves(blocks: ResidualBlocks) -> FloatArray:
    return 0.011 * np.sin(2 * np.pi * blocks.position_mm / 6.0) * moving(blocks, "drag")


def law_of(blocks: list[ResidualBlocks]) -> GapLaw | None:
    return fit_gap_law(gap_region(localise(blocks, present=True), blocks))


def words_of(blocks: list[ResidualBlocks]) -> tuple[str, str]:
    where = localise(blocks, present=True)
    return location_text(where, blocks), dependence_text(where, gap_region(where, blocks))


@pytest.mark.parametrize("seed", [1, thorough(2)])
@pytest.mark.parametrize(
    ("planted", "terms"),
    [(rise_and_fall, {"v": 1.2, "ln(v)": -12.0}), (way_and_time, {"x": 0.9, "t": -0.5}), (held_strain, {"ε²": 12.0})],
)
def test_a_planted_law_is_found_with_its_coefficients(planted: Planted, terms: dict[str, float], seed: int) -> None:
    law = law_of(campaign(seed, planted))
    assert law is not None
    assert set(law.terms) == set(terms)
    assert law.held_out_share > 0.9
    for name, value, sd in zip(law.terms, law.coefficients, law.sd, strict=True):
        assert abs(value - terms[name]) < 5 * sd
        assert sd < 0.1 * abs(terms[name])


def test_what_strokes_make_is_no_function_of_time() -> None:
    def strokes(blocks: ResidualBlocks, amplitude_mm: float) -> ResidualBlocks:
        place = amplitude_mm * np.sin(2 * np.pi * blocks.time_s / 2.5)
        return replace(blocks, position_mm=place, residual=blocks.residual + 0.5 * place)

    runs = [blocks for blocks in campaign(1, lambda blocks: 0.0 * blocks.time_s) if blocks.kind == "relaxation"]
    by_strokes = [strokes(blocks, 20.0 + 5.0 * number) for number, blocks in enumerate(runs)]
    assert "periodic in time" not in words_of(by_strokes)[1]
    without = [replace(blocks, position_mm=was.position_mm) for blocks, was in zip(by_strokes, runs, strict=True)]
    assert "periodic in time with a period of 2.47 s" in words_of(without)[1]


def test_a_wave_longer_than_any_steady_motion_is_told_without_an_amplitude() -> None:
    def slow_wave(blocks: ResidualBlocks) -> FloatArray:
        return np.asarray(15.0 * np.sin(2 * np.pi * blocks.time_s / 5.0) * (blocks.kind == "relaxation"))

    text = words_of([blocks for blocks in campaign(1, slow_wave) if blocks.kind == "relaxation"])[1]
    assert "periodic in time" in text
    assert "longer than the steady motion of any run" in text
    assert "nan" not in text


def test_a_law_is_looked_for_where_a_single_relaxation_comes_first() -> None:
    def drags_and_the_hold(run: ResidualBlocks) -> FloatArray:
        return rise_and_fall(run) + 40.0 * (run.phase == Phase.HOLD) * (run.kind == "relaxation")

    blocks = campaign(1, drags_and_the_hold)
    remaining = [run for run in blocks if run.kind != "relaxation" or run.run_id == blocks[0].run_id]
    region = gap_region(localise(remaining, present=True), remaining)
    assert {run.strain for run in region.blocks} == {0.0, 0.5}
    law = fit_gap_law(region)
    assert law is None or np.isfinite(law.coefficients).all()


def test_what_follows_the_measured_force_is_told_as_such() -> None:
    made = [
        replace(blocks, force_mN=200.0 + 30.0 * np.sqrt(block_speed(blocks)) * np.cos(blocks.position_mm))
        for blocks in campaign(3)
    ]
    planted = [
        replace(blocks, residual=blocks.residual + 0.1 * blocks.force_mN * moving(blocks, "drag"))
        if blocks.channel == "force" and blocks.force_mN is not None
        else blocks
        for blocks in made
    ]
    law = law_of(planted)
    assert law is not None
    assert law.terms == ("F",)
    assert law.text.endswith("·F [mN], measured force F in mN")


@pytest.mark.parametrize("seeds", [range(100, 102), thorough(range(102, 130))], ids=["some", "others"])
def test_noise_has_no_law(seeds: range) -> None:
    assert not [seed for seed in seeds if law_of(campaign(seed)) is not None]


@pytest.mark.parametrize("planted", [thorough(in_one_run), its_own_in_every_run])
def test_what_other_runs_do_not_have_is_no_law(planted: Planted) -> None:
    for seed in (1, 2):
        blocks = campaign(seed, planted)
        assert localise(blocks).rms > 1.0
        assert law_of(blocks) is None


def test_a_law_needs_other_conditions_to_hold_in() -> None:
    blocks = [run for run in campaign(1, rise_and_fall) if run.kind == "drag" and run.speed_mm_s in {0.5, 60.0}]
    assert law_of(blocks) is None


def test_runs_of_one_condition_are_in_one_fold() -> None:
    blocks = [run for run in campaign(1) if run.channel == "force"]
    result = condition_folds(blocks)
    assert result is not None
    by_condition: dict[tuple[str, float, float], set[int]] = {}
    for run, fold in zip(blocks, result.tolist(), strict=True):
        by_condition.setdefault((run.kind, run.speed_mm_s, run.strain), set()).add(fold)
    assert all(len(part) == 1 for part in by_condition.values())
    assert len(set(result.tolist())) == 6


def test_squares_that_are_held_out_are_those_of_a_fit_without_them() -> None:
    generator = np.random.default_rng(0)
    x, y = generator.standard_normal((4, 50, 3)), generator.standard_normal((4, 50))
    products = FoldProducts(np.einsum("fni,fnj->fij", x, x), np.einsum("fni,fn->fi", x, y), (y**2).sum(axis=1))
    result = held_out_chi2(products, np.array([[0, 2]]))[0]
    for fold in range(4):
        others = np.arange(4) != fold
        fitted = np.linalg.lstsq(x[others].reshape(-1, 3)[:, [0, 2]], y[others].ravel(), rcond=None)[0]
        assert result[fold] == pytest.approx(np.sum((y[fold] - x[fold][:, [0, 2]] @ fitted) ** 2), rel=1e-5)


@settings(max_examples=examples(60), deadline=None)
@given(st.floats(1e-6, 1e6), st.floats(1e-6, 1e3), st.booleans())
def test_coefficients_are_as_exact_as_they_are_known(value: float, share: float, falls: bool) -> None:
    law = GapLaw(("v",), (-value if falls else value,), (share * value,), "mN", 0.9)
    number, _, rest = law.text.partition("·")
    assert rest == "v [mN], speed v in mm/s"
    assert number.startswith("−") is falls
    shown = float(number.removeprefix("−"))
    assert shown > 0
    assert abs(shown - value) <= 0.51 * max(share * value, 0.2 * value)


def test_signs_and_units_of_a_law_are_those_of_a_formula() -> None:
    law = GapLaw(("1", "v", "ln(v)"), (-5.23, 0.4234, -3.14), (0.4, 0.012, 0.13), "mN", 0.8)
    assert law.text == "−5.2 + 0.423·v − 3.14·ln(v) [mN], speed v in mm/s"


def test_a_law_of_speed_is_told_in_words() -> None:
    where, how = words_of(campaign(1, lambda blocks: 0.012 * block_speed(blocks) ** 2 * moving(blocks, "drag")))
    assert where == (
        "It is in the force of drag runs at 45 mm/s and faster, while moving; not in relaxation, blank or Coulomb runs."
    )
    assert how.startswith("Mainly a function of speed, nearly the same in every run.")
    assert "grows with speed, from " in how
    assert "mN at 60 mm/s" in how
    assert "The measured force is higher" in how


def test_waves_are_told_with_period_amplitude_and_phase() -> None:
    where, how = words_of(campaign(1, waves, channel="position"))
    assert where.startswith("It is in the position of drag runs")
    assert (
        "periodic along the stroke with a period of 6 mm and an amplitude of 11 µm, at the same place in every run"
        in how
    )
    assert "both signs" in how


def test_a_late_gap_is_told_by_the_session() -> None:
    where, how = words_of(campaign(1, late_in_the_session))
    assert " min of the session" in where
    assert "function of session time" in how
    assert "falls with session time" in how
    assert "The measured force is lower" in how


def test_large_forces_are_told_in_whole_numbers() -> None:
    _, how = words_of(campaign(1, lambda blocks: -4.0 * block_speed(blocks) * moving(blocks, "drag")))
    assert re.search(r"falls with speed, from −\S+ mN at 0\.5 mm/s to −(19|20)\d mN at 60 mm/s\.", how)


def test_one_odd_run_is_named() -> None:
    where, how = words_of(campaign(2, in_one_run))
    assert "Nearly all of it is in one run, 015-drag." in where
    assert how.startswith("It differs from run to run")
