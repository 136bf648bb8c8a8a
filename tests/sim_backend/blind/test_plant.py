"""The plant that examines a diagnosis: its nominal equations, its secrets, and the files it writes."""

import tomllib
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dragrig.rig.runfile.reader import read_run
from dragrig.sim_backend.blind import (
    CATALOGUE,
    OUTSIDE,
    BlindCampaign,
    draw_campaign,
    effect_group,
    effect_signatures,
    parallel_session,
    true_answer,
    without_effects,
    write_campaign,
)
from dragrig.sim_backend.blind.blind_campaign import HiddenSpecimen, NoiseLevels, NominalErrors, RunVariation
from dragrig.sim_backend.blind.plant import PlantRecord, noise_free_run, recorded_run
from dragrig.sim_backend.blind.run_plans import RunPlan, StageLoop, planned_motion
from places import REFERENCE, ROOT
from property_tests import thorough

PUBLISHED = HiddenSpecimen(1.0, (1.0,) * 5, 0.082, 1.0, 60.0, 1.0, 60.0)
FORCE_OF_SEED_7_MN = 65.96916933788414
NAMES = sorted({*CATALOGUE, *OUTSIDE})
KINDS = ("drag", "coulomb", "relaxation", "blank")


def stroke(kind: str, speed: float) -> RunPlan:
    return RunPlan(kind, 0, 0.0, speed, 40.0, 400.0, 1.0, 3.0)


def ramp(strain: float) -> RunPlan:
    return RunPlan("relaxation", 0, 0.0, 20.0, 2.5 * strain, 2000.0, 1.0, 20.0, strain)


def published(run: RunPlan, errors: NominalErrors | None = None) -> PlantRecord:
    """The run on the published specimen, with nothing hidden in it."""
    quiet, same = NoiseLevels(1.0, 0.3, 0.2), RunVariation(1.0, 1.0, 0.0)
    return noise_free_run(
        BlindCampaign(1, PUBLISHED, quiet, errors or NominalErrors(), (), (), "practice", (run,), (same,)), 0
    )


def short(campaign: BlindCampaign) -> BlindCampaign:
    """A few of its runs: one of each kind, and drags at 5 and 60 mm/s."""
    first: dict[tuple[str, float], int] = {}
    for at, run in enumerate(campaign.runs):
        if run.kind != "coulomb" or run.speed_mm_s > 1:
            first.setdefault((run.kind, run.speed_mm_s if run.kind == "drag" else 0.0), at)
    chosen = sorted(at for (kind, speed), at in first.items() if kind != "drag" or speed in {5.0, 60.0})
    return replace(
        campaign,
        runs=tuple(campaign.runs[at] for at in chosen),
        variations=tuple(campaign.variations[at] for at in chosen),
    )


@pytest.mark.parametrize(
    ("name", "run"),
    [
        ("drag-2", stroke("drag", 2.0)),
        ("drag-20", stroke("drag", 20.0)),
        ("drag-60", stroke("drag", 60.0)),
        ("coulomb-0.5", stroke("coulomb", 0.5)),
        ("relaxation-050", ramp(0.5)),
        ("relaxation-100", ramp(1.0)),
        ("relaxation-200", ramp(2.0)),
    ],
)
def test_nominal_runs_agree_with_the_reference(name: str, run: RunPlan) -> None:
    reference = np.genfromtxt(REFERENCE / f"{name}.csv", delimiter=",", names=True)
    trace = published(run)
    at = np.round(reference["time_s"] * 500)
    common = (np.abs(reference["time_s"] * 500 - at) < 1e-6) & (at < trace.time.size)
    settled = np.ones(reference.size, dtype=bool)
    for change in np.flatnonzero(np.diff(reference["phase"])):
        settled[change + 1 : change + 3] = False
    compared = common & settled
    index = at[compared].astype(int)
    assert np.array_equal(trace.phase[index], reference["phase"][compared])
    assert np.abs(trace.position[index] - reference["position_mm"][compared]).max() < 1e-5
    error = np.abs(trace.force[index] - reference["force_mN"][compared]).max()
    assert error < 0.002 * np.ptp(reference["force_mN"])


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(tmp_path: Path) -> None:
    def digest(folder: Path) -> str:
        return sha256(b"".join(file.read_bytes() for file in sorted(folder.glob("*.h5")))).hexdigest()

    for name, seed in (("a", 4), ("b", 4), ("c", 5)):
        write_campaign(short(draw_campaign(seed, effects=["table_vibration", "stribeck"])), tmp_path / name)
    assert digest(tmp_path / "a") == digest(tmp_path / "b") != digest(tmp_path / "c")


def test_a_seed_means_the_same_campaign_in_every_version() -> None:
    campaign = draw_campaign(7, effects=["stribeck", "folds", "servo_lag"])
    forms = [effect.form for effect in campaign.effects]
    assert forms == ["log v over load", "wandering triangle", "dead time, grows with speed"]
    assert campaign.effects[0].amplitude == pytest.approx(0.4611828904622062, rel=1e-12)
    assert campaign.specimen.mu == pytest.approx(0.07675926121024586, rel=1e-12)
    assert recorded_run(campaign, 12).force.mean() == pytest.approx(FORCE_OF_SEED_7_MN, rel=1e-9)
    assert effect_group("mains_hum") == effect_group("force_drift") != effect_group("servo_lag")


def test_the_files_are_read_as_runs_and_say_nothing_of_what_is_hidden(tmp_path: Path) -> None:
    campaign = draw_campaign(11, effects=["stribeck"])
    kinds = [run.kind for run in campaign.runs]
    assert 27 <= len(kinds) <= 31
    assert [kinds.count(kind) for kind in ("relaxation", "coulomb")] == [4, 3]
    assert kinds.count("drag") >= 18
    few = short(campaign)
    write_campaign(few, tmp_path)
    files = sorted(tmp_path.glob("*.h5"))
    assert [read_run(file).info.kind for file in files] == [run.kind for run in few.runs]
    with h5py.File(files[-1]) as file:
        contents: list[str] = []
        file.visititems(lambda name, item: contents.append(f"{name} {dict(item.attrs)}"))
    assert not any(word in " ".join(contents) for word in ("stribeck", "seed", "rational"))


def strength(run: PlantRecord) -> float:
    """Mean size of what an effect adds to a run, force and position together."""
    return float(np.abs(run.force).mean() + np.abs(run.position).mean())


@pytest.mark.parametrize("name", [thorough(name) if number % 16 else name for number, name in enumerate(NAMES)])
def test_every_form_acts_where_it_says_on_its_own_channel_and_scales_with_size(name: str) -> None:
    plain = short(draw_campaign(3))
    for form in CATALOGUE.get(name) or OUTSIDE[name]:
        whole, third, none = (form.drawn(np.random.default_rng(8), size) for size in (1.0, 1 / 3, 0.0))
        signatures = effect_signatures(replace(plain, effects=(whole,), sizes=(1.0,)))
        for run in signatures:
            assert np.isfinite(run.force).all()
            assert np.isfinite(run.position).all()
            if run.run.kind not in form.kinds:
                assert not run.force.any()
                assert not run.position.any()
        moved = any(np.abs(run.position).max() > 1e-6 for run in signatures)
        assert moved == (form.channel == "position"), form
        strengths = [strength(run) for run in signatures]
        at = strengths.index(max(strengths))
        strongest = replace(plain, runs=plain.runs[at : at + 1], variations=plain.variations[at : at + 1])
        less, nothing = (
            strength(effect_signatures(replace(strongest, effects=(effect,), sizes=(1.0,)))[0])
            for effect in (third, none)
        )
        assert strengths[at] > less > 100 * nothing, form


def test_a_campaign_without_noise_has_only_its_effect_beyond_the_same_without_effects() -> None:
    campaign = short(draw_campaign(9, effects=["folds"]))
    for index, run in enumerate(effect_signatures(campaign)):
        both = noise_free_run(campaign, index).force - noise_free_run(without_effects(campaign), index).force
        assert np.array_equal(run.force, both)


def test_the_fresh_campaign_has_the_same_specimen_and_effect_at_other_speeds() -> None:
    first, second = (draw_campaign(21, effects=["adhesion"], runs=name) for name in ("practice", "fresh"))
    assert (first.specimen, first.effects, first.noise) == (second.specimen, second.effects, second.noise)
    assert parallel_session(first) == second
    speeds = [{run.speed_mm_s for run in session.runs if run.kind == "drag"} for session in (first, second)]
    assert not speeds[0] & speeds[1]
    assert {run.strain for run in second.runs if run.kind == "relaxation"} == {0.75, 1.25}


def test_noise_is_as_large_and_as_slow_as_drawn() -> None:
    campaign = draw_campaign(13)
    at = next(index for index, run in enumerate(campaign.runs) if run.speed_mm_s == 0.5 and run.kind == "coulomb")
    rest = recorded_run(campaign, at).force - noise_free_run(campaign, at).force - campaign.variations[at].zero_mN
    white = float(np.std(np.diff(rest)) / np.sqrt(2))
    assert white == pytest.approx(campaign.noise.white_mN, rel=0.05)
    slow = float(np.std(rest[: rest.size // 25 * 25].reshape(-1, 25).mean(axis=1)))
    assert slow == pytest.approx(campaign.noise.slow_mN, rel=0.35)


def test_rough_campaigns_differ_slightly_from_the_nominal_equations() -> None:
    runs = (ramp(1.5), stroke("drag", 20.0))
    plain = [published(run).force for run in runs]
    for seed in range(12):
        errors = draw_campaign(seed, rough=True).nominal_errors
        wrong = [published(run, errors).force for run in runs]
        off = [
            np.sqrt(np.mean((right - force) ** 2)) / np.ptp(right) for right, force in zip(plain, wrong, strict=True)
        ]
        assert 5e-4 < max(off) < 0.10, errors


def test_the_answer_says_what_is_hidden() -> None:
    known = true_answer(draw_campaign(1, effects=["stribeck", "servo_lag"], size=(1.0, 1 / 3)))
    assert (known["verdict"], known["effects"], known["size"]) == ("several", ["stribeck", "servo_lag"], [1.0, 1 / 3])
    foreign = true_answer(draw_campaign(1, effects=["wall_seam"]))
    assert (foreign["verdict"], foreign["effects"], foreign["truth"]) == ("unknown", [], "wall_seam")
    assert true_answer(draw_campaign(1))["verdict"] == "no_gap"


def test_a_name_or_a_size_too_many_is_refused() -> None:
    with pytest.raises(ValueError, match="is no effect; take one of"):
        draw_campaign(1, effects=["friction"])
    with pytest.raises(ValueError, match="2 sizes for 1 effects"):
        draw_campaign(1, effects=["folds"], size=(1.0, 0.5))


def test_nothing_of_the_simulator_is_shared_with_the_plant() -> None:
    """The import contracts name every other part of the simulator, those that come later too."""
    rooms = {f"dragrig.sim_backend.{face.parent.name}" for face in (ROOT / "sim_backend").glob("*/__init__.py")}
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    for name in ("The blind plant shares nothing", "Nobody who is examined"):
        contract = next(contract for contract in contracts if contract["name"].startswith(name))
        assert rooms | {"dragrig.analysis"} == {*contract["source_modules"], *contract["forbidden_modules"]}


def test_all_24_effects_of_the_vocabulary_and_ten_others_are_there() -> None:
    assert len(CATALOGUE) == 24
    assert len(OUTSIDE) >= 10
    assert not set(CATALOGUE) & set(OUTSIDE)
    assert all(len(group) >= 2 for group in CATALOGUE.values())


def test_a_wall_that_comes_back_late_is_still_off_after_the_stop() -> None:
    run = stroke("drag", 60.0)
    late = next(form for form in CATALOGUE["wall_lift_off"] if form.form == "front fades, comes back late")
    effect = late.drawn(np.random.default_rng(1), 1.0)
    quiet, same = NoiseLevels(1.0, 0.3, 0.2), RunVariation(1.0, 1.0, 0.0)
    campaign = BlindCampaign(1, PUBLISHED, quiet, NominalErrors(), (effect,), (1.0,), "practice", (run,), (same,))
    (signature,) = effect_signatures(campaign)
    stop = run.bounds_s[3]
    moving, after, later = (
        signature.force[np.searchsorted(signature.time, at)] for at in (run.bounds_s[2] - 0.05, stop + 0.02, stop + 2.5)
    )
    assert moving < 0
    assert 0.1 * moving > after > moving
    assert abs(later) < 0.05 * abs(after)


@pytest.mark.parametrize("natural_hz", [20.0, 150.0])
def test_a_stage_under_a_loop_moves_as_its_equation_of_motion_says(natural_hz: float) -> None:
    loop, run, slip = StageLoop(natural_hz, 0.7, 1.5, 0.0), stroke("coulomb", 5.0), 0.05
    t = np.arange(run.samples) / 1000.0
    command = planned_motion(run, t, 0.02)
    smooth, friction = np.full_like(t, 30.0), np.full_like(t, 80.0)
    motion = loop.followed(command, run.bounds_s, smooth, friction, slip)
    omega = 2 * np.pi * natural_hz

    def rates(now: float, state: np.ndarray) -> tuple[float, float]:
        away, rate = state
        load = 30.0 + 80.0 * np.tanh((np.interp(now, t, command.v) + rate) / slip)
        return rate, -(omega**2) * away - 2 * 0.7 * omega * rate - load / 1.5

    first, last = np.searchsorted(t, [run.bounds_s[0] - 0.01, run.bounds_s[0] + 0.2])
    away = motion.p - command.p
    done = solve_ivp(rates, (t[first], t[last]), (away[first], 0.0), "LSODA", t[first:last], rtol=1e-8, atol=1e-10)
    at_rest = 110.0 / (1.5 * omega**2)
    assert away[first:last] == pytest.approx(done.y[0], abs=0.05 * at_rest)
    assert away[last] == pytest.approx(-at_rest, rel=0.01)
    assert motion.v == pytest.approx(np.gradient(motion.p, t), abs=0.02 * 5.0)


def test_the_encoder_of_a_loop_errs_within_the_period_of_its_scale() -> None:
    loop = StageLoop(50.0, 0.7, 1.0, 2e-4)
    position = np.array([0.0, 0.005, 0.010, 0.015, 0.020, 1.005])
    assert loop.recorded(position) - position == pytest.approx([0.0, 2e-4, 0.0, -2e-4, 0.0, 2e-4], abs=1e-9)
