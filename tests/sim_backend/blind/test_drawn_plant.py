"""The plant whose laws are drawn at random: what drawn functions promise, where effects act, conditions, shares."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dragrig.cli import main
from dragrig.config import AnalysisError, SettingsError
from dragrig.exam import gap_calibrate
from dragrig.exam.blind_exam import gap_blind, open_exam_folder
from dragrig.exam.hidden_cases import CONDITIONS_OF, draw_cases
from dragrig.rig.runfile.reader import read_run
from dragrig.sim_backend.blind import (
    CATALOGUE,
    CONDITIONS,
    BlindCampaign,
    draw_campaign,
    effect_signatures,
    hidden_shares,
    true_answer,
    without_effects,
    write_campaign,
)
from dragrig.sim_backend.blind.effects import DRAWN
from dragrig.sim_backend.blind.effects.random_laws import (
    RandomLaw,
    faded,
    fading,
    hump,
    periodic,
    pulses,
    rising,
    rising_late,
    rising_soft,
    steps,
)
from dragrig.sim_backend.blind.plant import noise_free_run, recorded_run
from property_tests import every_third, examples, thorough

seeds = st.integers(0, 2**31)
few = settings(max_examples=examples(60), deadline=None)
U = np.linspace(0.0, 1.0, 2001)


def drawn_law(family: Callable[[np.random.Generator], RandomLaw], seed: int) -> RandomLaw:
    return family(np.random.default_rng(seed))


@pytest.mark.parametrize("family", [rising, rising_late, rising_soft])
@given(seed=seeds)
@few
def test_a_rising_law_rises_from_0_to_1_and_stays_there(
    family: Callable[[np.random.Generator], RandomLaw], seed: int
) -> None:
    law = drawn_law(family, seed)
    values = law(U)
    assert np.diff(values).min() >= -1e-12
    assert (values[0], values[-1]) == (pytest.approx(0.0), pytest.approx(1.0))
    assert law(np.array([-3.0, 5.0])).tolist() == [values[0], values[-1]]
    assert drawn_law(family, seed) == law


@given(seed=seeds)
@few
def test_a_late_law_has_most_of_its_rise_in_the_last_third(seed: int) -> None:
    assert drawn_law(rising_late, seed)(2 / 3) < 0.5


@given(seed=seeds)
@few
def test_a_fading_law_falls_from_1_to_0_and_is_half_gone_at_1(seed: int) -> None:
    values = faded(drawn_law(fading, seed), np.concatenate([[0.0], np.logspace(-3, 4, 2000)]))
    assert np.diff(values).max() <= 1e-12
    assert values[0] == pytest.approx(1.0)
    assert values[-1] < 0.01
    assert faded(drawn_law(fading, seed), np.array(1.0)) == pytest.approx(0.5, abs=0.02)


@given(seed=seeds, turns=st.integers(-5, 5))
@few
def test_a_periodic_law_repeats_without_a_mean_and_has_the_size_of_a_sine(seed: int, turns: int) -> None:
    law = drawn_law(periodic, seed)
    np.testing.assert_allclose(law(U + turns), law(U), rtol=0, atol=1e-9)
    # The mean and the size of one period, counted once.
    once = law(U[:-1])
    assert once.mean() == pytest.approx(0.0, abs=0.01)
    assert once.std() == pytest.approx(2**-0.5, rel=0.02)
    assert np.abs(np.diff(once)).max() < 0.15


@given(seed=seeds)
@few
def test_pulses_repeat_and_are_quiet_in_between_a_hump_begins_and_ends_at_0(seed: int) -> None:
    beat, bump = drawn_law(pulses, seed), drawn_law(hump, seed)
    np.testing.assert_allclose(beat(U + 3), beat(U), rtol=0, atol=1e-9)
    assert beat(U).min() > -0.05
    assert beat(0.97) == pytest.approx(0.0, abs=0.02)
    assert (bump(0.0), bump(1.0)) == (pytest.approx(0.0, abs=1e-9), pytest.approx(0.0, abs=1e-9))
    rise = np.sign(np.diff(bump(U)))
    assert np.count_nonzero(np.diff(rise[rise != 0])) == 1


@given(seed=seeds)
@example(seed=2005)  # No change is drawn.
@few
def test_steps_are_levels_without_a_mean(seed: int) -> None:
    law = drawn_law(steps, seed)
    assert np.mean(law.values) == pytest.approx(0.0, abs=1e-9)
    assert np.std(law.values) == pytest.approx(1.0)
    assert set(law(U).tolist()) <= set(law.values)


def short(campaign: BlindCampaign) -> BlindCampaign:
    """One run of each kind, but no slow Coulomb test, and drags at 5, 10 and 60 mm/s where there are such."""
    chosen: dict[tuple[str, float], int] = {}
    for at, run in enumerate(campaign.runs):
        if run.speed_mm_s in {5.0, 10.0, 60.0} if run.kind == "drag" else run.kind != "coulomb" or run.speed_mm_s > 1:
            chosen.setdefault((run.kind, run.speed_mm_s if run.kind == "drag" else 0.0), at)
    places = sorted(chosen.values())
    return replace(
        campaign,
        runs=tuple(campaign.runs[at] for at in places),
        variations=tuple(campaign.variations[at] for at in places),
    )


def drawn(seed: int, *effects: str, size: float = 1.0, conditions: tuple[str, ...] = ()) -> BlindCampaign:
    return draw_campaign(seed, effects=effects, size=size, plant="drawn", conditions=conditions)


@pytest.mark.parametrize("seed", [1, thorough(2)])
@pytest.mark.parametrize("name", every_third(sorted(DRAWN)))
def test_a_drawn_effect_acts_where_it_says_and_vanishes_with_its_size(name: str, seed: int) -> None:
    whole, none = (short(drawn(seed, name, size=size)) for size in (1.0, 0.0))
    [effect] = whole.effects
    sizes = []
    for run in effect_signatures(whole):
        assert np.isfinite(run.force).all()
        assert np.isfinite(run.position).all()
        sizes.append(float(np.abs(run.force).max() + np.abs(run.position).max()))
        assert run.run.kind in effect.kinds or sizes[-1] == 0.0
    assert max(sizes) > 1e-6
    at = sizes.index(max(sizes))
    [gone] = effect_signatures(replace(none, runs=none.runs[at : at + 1], variations=none.variations[at : at + 1]))
    assert np.abs(gone.force).max() + np.abs(gone.position).max() <= 1e-6
    assert set(DRAWN) == {*CATALOGUE, "outside"}


def test_two_seeds_draw_two_laws_and_one_seed_the_same_bytes(tmp_path: Path) -> None:
    def digest(folder: Path, seed: int) -> str:
        write_campaign(short(drawn(seed, "velocity_ripple", "outside", conditions=("1/f noise", "dropouts"))), folder)
        return sha256(b"".join(file.read_bytes() for file in sorted(folder.glob("*.h5")))).hexdigest()

    assert digest(tmp_path / "a", 4) == digest(tmp_path / "b", 4) != digest(tmp_path / "c", 5)
    laws = [drawn(seed, "stribeck").effects[0].laws["law"] for seed in range(20)]
    assert len(set(laws)) == 20


def test_with_nothing_hidden_both_plants_are_the_nominal_model() -> None:
    for at in (0, 6, 24):
        ours, theirs = noise_free_run(drawn(3), at), noise_free_run(draw_campaign(3), at)
        assert np.array_equal(ours.force, theirs.force)
        assert np.array_equal(ours.position, theirs.position)


def test_what_acts_only_in_motion_is_nothing_at_rest() -> None:
    gated = [seed for seed in range(40) if drawn(seed, "folds").effects[0].gate]
    ripples = [seed for seed in range(40) if drawn(seed, "velocity_ripple").effects[0].gate == 1]
    assert len(gated) > 5
    assert len(ripples) > 5
    for name, seed in (("folds", gated[0]), ("velocity_ripple", ripples[0])):
        for run in effect_signatures(short(drawn(seed, name))):
            if run.run.kind != "drag":
                continue
            go, _, _, stop = run.run.bounds_s
            added = run.force if name == "folds" else 1000 * run.position
            moving = np.abs(added[(run.time > go) & (run.time < stop)]).max()
            assert np.abs(added[run.time <= go]).max() < 1e-6 * moving
            # A ripple settles within ten times its time constant, 0.3 s at the most.
            assert np.abs(added[run.time > stop + 2.99]).max() < 0.01 * moving


def test_ripple_is_the_same_at_one_place_in_every_run_while_it_moves() -> None:
    seed = next(seed for seed in range(40) if drawn(seed, "velocity_ripple").effects[0].gate == 0)
    campaign = short(drawn(seed, "velocity_ripple"))
    at, errors = np.linspace(5.0, 35.0, 300), []
    for k, plan in enumerate(campaign.runs):
        if plan.kind == "drag":
            command = noise_free_run(without_effects(campaign), k).position
            errors.append(np.interp(at, command, noise_free_run(campaign, k).position - command))
    assert len(errors) == 3
    # Each run begins without an error, at its own origin.
    assert np.ptp(np.subtract(errors, errors[0]), axis=1).max() < 0.1 * np.ptp(errors[0])


def test_ageing_may_scale_more_than_the_elastic_force() -> None:
    kinds = Counter(drawn(seed, "tissue_ageing").effects[0].on for seed in range(60))
    assert set(kinds) == {0.0, 1.0, 2.0}
    late = Counter(drawn(seed, "hyperelastic_wall").effects[0].steep for seed in range(60))
    assert min(late.values()) > 10


@pytest.mark.parametrize("condition", every_third(CONDITIONS))
def test_files_under_every_condition_are_read_as_runs_and_say_nothing_of_what_is_hidden(
    condition: str, tmp_path: Path
) -> None:
    campaign = drawn(11, "velocity_ripple", conditions=(condition,))
    part = replace(campaign, runs=campaign.runs[::20], variations=campaign.variations[::20])
    write_campaign(part, tmp_path)
    runs = [read_run(file) for file in sorted(tmp_path.glob("*.h5"))]
    assert len(runs) == len(part.runs)
    for run, plan in zip(runs, part.runs, strict=True):
        assert run.info.kind == plan.kind
        assert run.trace.sample_rate_hz == plan.rate_hz
        assert run.trace.time.size == plan.samples or campaign.noise.dropout == "lost"
    with h5py.File(sorted(tmp_path.glob("*.h5"))[-1]) as file:
        contents: list[str] = []
        file.visititems(lambda name, item: contents.append(f"{name} {dict(item.attrs)}"))
    assert not any(word in " ".join(contents) for word in ("ripple", "seed", "drawn", condition))
    assert true_answer(campaign)["conditions"] == [condition]


def test_conditions_do_what_they_say() -> None:
    def kinds(*conditions: str) -> set[str]:
        return {run.kind for run in drawn(5, conditions=conditions).runs}

    assert kinds("drags only") == {"drag"}
    assert kinds("no relaxations") == {"drag", "coulomb", "blank"}
    assert len(drawn(5, conditions=("one run",)).runs) == 1
    three = drawn(5, conditions=("three speeds", "100 Hz", "12 bits"))
    assert len({run.speed_mm_s for run in three.runs if run.kind == "drag"}) == 3
    assert {run.rate_hz for run in three.runs} == {100.0}
    forces = recorded_run(three, 0).force / (20_000 / 2**12)
    assert np.abs(forces - np.round(forces)).max() < 1e-9
    exchanged = drawn(5, conditions=("exchanged",))
    second = [run for run in exchanged.runs if run.specimen]
    assert second[0].order == 0
    assert {run.kind for run in second} >= {"relaxation", "drag"}
    assert exchanged.specimen_of(second[0]) != exchanged.specimen
    hidden = drawn(5, conditions=("exchanged, not recorded",))
    assert [run.order for run in hidden.runs] == list(range(len(hidden.runs)))
    capsules = [drawn(seed, conditions=("other capsule",)).capsule for seed in (5, 5, 6)]
    assert capsules[0] == capsules[1] != capsules[2] != drawn(5).capsule
    with pytest.raises(ValueError, match="'wet' is no condition"):
        drawn(5, conditions=("wet",))
    with pytest.raises(ValueError, match="'other' is not a plant"):
        draw_campaign(5, plant="other")


@pytest.mark.parametrize("condition", ["1/f noise", "hum"])
def test_noise_of_another_kind_is_no_larger_than_the_white_noise(condition: str) -> None:
    plain, noisy = drawn(8, conditions=()), drawn(8, conditions=(condition,))
    at = next(k for k, run in enumerate(plain.runs) if run.kind == "relaxation")
    added = recorded_run(noisy, at).force - recorded_run(plain, at).force
    assert 0.2 * plain.noise.white_mN < added.std() < 1.3 * plain.noise.white_mN


@pytest.mark.parametrize("part", [thorough(5), 10, thorough(20)])
def test_a_nominal_model_that_is_off_is_off_by_about_so_much(part: int) -> None:
    at, sizes = 20, []
    for seed in range(6):
        off, right = drawn(seed, conditions=(f"both {part} % off",)), drawn(seed)
        force = noise_free_run(right, at).force
        sizes.append(np.abs(noise_free_run(off, at).force - force).mean() / np.abs(force).mean())
    assert part / 400 < np.median(sizes) < part / 40


def test_shares_of_what_is_hidden_sum_to_one_in_each_channel() -> None:
    campaign = short(drawn(6, "folds", "velocity_ripple", conditions=("parameters 10 % off", "100 Hz")))
    shares = hidden_shares(campaign)
    assert [(share.cause, share.channel) for share in shares] == [
        ("folds", "force"),
        ("velocity_ripple", "position"),
        ("model", "force"),
    ]
    assert sum(share.share for share in shares if share.channel == "force") == pytest.approx(1.0)
    for share in shares:
        assert len(share.run_rms) == len(campaign.runs)
        assert share.rms == pytest.approx(np.sqrt(np.mean(np.square(share.run_rms))))
        assert share.refitted_rms <= share.rms * 1.001
    # Folds are in the force of drags alone.
    folds = dict(zip([run.kind for run in campaign.runs], shares[0].run_rms, strict=True))
    assert folds["blank"] == folds["relaxation"] == 0.0 < folds["drag"]
    assert hidden_shares(short(drawn(6, conditions=("100 Hz",)))) == ()


def test_the_mix_of_the_drawn_plant_has_every_condition(tmp_path: Path) -> None:
    cases = draw_cases(400, 5, plant="drawn")
    assert cases == draw_cases(400, 5, plant="drawn")
    met = Counter(condition for case in cases for condition in case.conditions)
    assert set(met) == {name for kind, names in CONDITIONS_OF.items() for name in names if kind != "motion"}
    assert {case.effects for case in cases if case.kind == "outside"} == {("outside",)}
    assert all(not case.effects for case in cases if case.kind.endswith("none"))
    singles = Counter(case.effects[0] for case in cases if case.kind == "full")
    assert set(singles) == set(CATALOGUE)


@pytest.mark.parametrize("plant", ["written", "drawn"])
def test_in_the_mix_of_motions_every_stage_moves_as_drives_do(plant: str) -> None:
    cases = draw_cases(120, 5, "motion", plant)
    assert {condition for case in cases for condition in case.conditions} == {"jerk-limited", "position loop"}
    assert all(len(case.conditions) == 1 for case in cases)
    assert Counter(case.sizes for case in cases) == {(1.0,): 60, (): 30, (1 / 3,): 18, (1 / 10,): 12}
    moved = next(case.secret for case in cases if case.conditions == ("position loop",))
    assert moved.stage is not None
    assert moved.nominal_errors.blunt_s > 0


def test_an_exam_by_the_drawn_plant_is_not_continued_with_the_other_nor_learnt_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "exam"
    with open_exam_folder(out, 12, 3, "exam", "drawn"):
        pass
    assert main(["gap", "blind", "--cases", "12", "--seed", "3", "--out", str(out)]) == 2
    assert "--mix exam --plant drawn to continue" in " ".join(capsys.readouterr().err.split())
    with pytest.raises(AnalysisError, match="learn from one with --plant written"):
        gap_calibrate([out])
    with pytest.raises(SettingsError, match="the plant drawn judges"):
        gap_blind(12, 3, plant="drawn", kind="learning")
