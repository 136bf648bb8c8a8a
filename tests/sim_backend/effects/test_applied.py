"""Effects of the simulated rig, from settings and command line into run files."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dragrig
from dragrig.analysis.comparison.compare import resimulate
from dragrig.cli import main
from dragrig.config.errors import SettingsError
from dragrig.config.friction_model import EffectSettings, FrictionModelSettings, parse_effects
from dragrig.config.settings import parse, read_settings_file, to_toml
from dragrig.rig.runfile import read_campaign, read_run
from dragrig.rig.runfile.model import Run
from dragrig.sim_backend.effects.base import EffectChain, active_effects, catalogue
from finishing import finished_here

SILENT = tuple(f"rig.simulated.noise.{name}_mN=0" for name in ("white", "slow", "zero"))
SAME = ("rig.simulated.variation.run_stiffness=0", "rig.simulated.variation.run_friction=0")
QUICK = (*SILENT, *SAME, "travel_mm=12", "hold_s=1", "wait_s=60")
STEP_MN = 20_000 / 65_536
"""One code of the force sensor's converter."""


def made(*effects: str | EffectSettings, plan: str = "drag", assignments: tuple[str, ...] = QUICK) -> tuple[Run, ...]:
    return dragrig.simulate(plan, effects=effects, assignments=assignments)


def steady(run: Run) -> np.ndarray:
    return np.asarray(run.trace.force)[np.asarray(run.trace.phase) == 2]


def test_a_model_file_may_have_effects(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text('name = "own"\n[[effects]]\nid = "stribeck"\nratio = 0.4\n[[effects]]\nid = "mains_hum"\n', "utf-8")
    model = read_settings_file(FrictionModelSettings, path)
    assert [(active.effect.id, active.values) for active in active_effects(model)] == [
        ("stribeck", {**catalogue()["stribeck"].defaults, "ratio": 0.4}),
        ("mains_hum", catalogue()["mains_hum"].defaults),
    ]


names = st.from_regex(r"[a-z_]{1,12}", fullmatch=True).filter(lambda name: name not in {"id", "parameters"})


@given(
    st.lists(
        st.builds(
            EffectSettings,
            id=names,
            parameters=st.dictionaries(names, st.floats(-1e9, 1e9, allow_nan=False), max_size=4),
        ),
        max_size=3,
    )
)
def test_effects_come_back_from_a_file_and_from_what_is_typed(effects: list[EffectSettings]) -> None:
    import tomllib

    model = FrictionModelSettings(effects=tuple(effects))
    assert parse(FrictionModelSettings, tomllib.loads(to_toml(model)), "x") == model
    typed = [
        f"{effect.id}:{','.join(f'{key}={value!r}' for key, value in effect.parameters.items())}" for effect in effects
    ]
    assert parse_effects([text.removesuffix(":") for text in typed]) == tuple(effects)


@pytest.mark.parametrize(
    ("typed", "sentence"),
    [
        ("stribek", "effect stribek: is not in the catalogue; did you mean stribeck?"),
        ("stribeck:speed=3", "effect stribeck: has no parameter speed; did you mean speed_mm_s?"),
        ("mains_hum:size=3", "has no parameter size; known are amplitude_mN, frequency_hz, phase_rad."),
        ("stribeck:ratio=-1", "effect stribeck: ratio = -1 is not possible; usual are 0 to 2."),
        ("servo_lag:damping=1", "effect servo_lag: damping = 1 is not possible; usual are 0.1 to 0.95."),
        ("direction_asymmetry", "belongs to the model drive, which is not the simulated rig's."),
        ("stribeck:ratio", "is not of the form id:parameter=number,…"),
        ("stribeck:ratio=much", "is not of the form id:parameter=number,…"),
        (":ratio=1", "is not of the form id:parameter=number,…"),
        ("x" * 5000, "must not be longer than 4096 characters"),
        ("", "names no effect; dragrig gap effects lists them."),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence_before_anything_moves(typed: str, sentence: str) -> None:
    with pytest.raises(SettingsError) as refused:
        dragrig.check("drag", effects=[typed])
    assert sentence in str(refused.value)
    assert str(refused.value).count("\n") == 0


@pytest.mark.parametrize("double", [(), ("--double",)])
def test_effects_are_not_for_the_real_rig(double: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "drag", "--backend", "hardware", *double, "--effect", "stribeck"]) == 2
    errors = capsys.readouterr().err
    assert errors.startswith("dragrig: effects act in the simulated rig")
    assert errors.count("\n") == 1


def test_a_double_takes_no_model_with_effects(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "own.toml"
    path.write_text('[[effects]]\nid = "mains_hum"\n', "utf-8")
    for words in (["check"], ["check", "drag"]):
        assert main([*words, "--backend", "hardware", "--double", "--model", str(path)]) == 2
        assert "effects act in the simulated rig" in capsys.readouterr().err


def test_beyond_the_prior_range_is_allowed_where_it_can_be() -> None:
    assert active_effects(FrictionModelSettings(effects=parse_effects(["stribeck:ratio=7"])))[0].values["ratio"] == 7


def test_the_chain_goes_from_payload_to_clock_whatever_the_settings_order() -> None:
    listed = ["channel_latency", "mains_hum", "force_hysteresis", "arm_compliance", "payload_inertia"]
    for order in (listed, listed[::-1]):
        chain = EffectChain.of(FrictionModelSettings(effects=parse_effects(order)))
        assert [active.effect.id for active in chain.effects] == listed[::-1]


def test_a_dry_run_contains_what_its_effects_say() -> None:
    plain, _ = made(assignments=(*QUICK, "speed_mm_s=1"))
    both, _ = made("stribeck:ratio=0.5,speed_mm_s=2", "force_drift:drift_mN_min=30,warm_up_s=3000",
                   assignments=(*QUICK, "speed_mm_s=1"))  # fmt: skip
    time = np.asarray(plain.trace.time)
    added = np.asarray(both.trace.force) - np.asarray(plain.trace.force)
    creep = 30.0 * np.expm1(-time / 3000.0) / np.expm1(-60.0 / 3000.0)
    resting = np.isin(plain.trace.phase, (0, 4))
    assert added[resting] == pytest.approx(creep[resting], abs=2 * STEP_MN)
    sliding = np.asarray(plain.trace.phase) == 2
    tabulated = dragrig.model([1.0]).iloc[0]
    stribeck = 0.5 * np.exp(-1.0 / 2.0) * tabulated["f_c_mN"]
    assert (added - creep)[sliding][-500:] == pytest.approx(stribeck, rel=0.02, abs=STEP_MN)
    assert np.array_equal(plain.trace.position, both.trace.position)


def test_a_dry_run_without_effects_is_as_before_one_with_them() -> None:
    runs = [made()[0], made("stribeck:ratio=0")[0]]
    difference = np.abs(np.asarray(runs[0].trace.force) - np.asarray(runs[1].trace.force))
    assert difference.max() <= STEP_MN


def test_the_stage_ripples_and_its_encoder_counts_wrong_while_the_command_stays() -> None:
    plain, _ = made()
    moved, _ = made("velocity_ripple:amplitude_mm=0.05,pitch_mm=4", "encoder_scale:scale_error=0.01")
    assert np.array_equal(plain.trace.command, moved.trace.command)
    command = np.asarray(moved.trace.command)
    expected = 1.01 * (command + 0.05 * np.sin(2 * np.pi * command / 4.0))
    assert np.asarray(moved.trace.position) == pytest.approx(expected, abs=0.0011)


def test_a_ripple_in_speed_shows_in_the_force_and_in_the_motor() -> None:
    slow = (*QUICK, "speed_mm_s=2")
    plain, rippled = made(assignments=slow)[0], made("velocity_ripple:amplitude_mm=0.2,pitch_mm=2", assignments=slow)[0]
    for channel, minimum in (("force", 1.0), ("motor_force", 2.0)):
        change = np.asarray(rippled.trace.channels[channel]) - np.asarray(plain.trace.channels[channel])
        sliding = change[np.asarray(plain.trace.phase) == 2]
        spectrum = np.abs(np.fft.rfft(sliding[-4000:] - sliding[-4000:].mean()))
        assert np.argmax(spectrum[1:]) + 1 == 4  # 1 Hz in 4 s
        assert np.ptp(sliding) > minimum


def test_effects_go_by_the_clock_that_the_files_tell_through_tares_and_after_a_resumption(tmp_path: Path) -> None:
    frequency = 0.25
    hum = EffectSettings(id="mains_hum", parameters={"frequency_hz": frequency, "amplitude_mN": 50.0})
    quick = (*SILENT, *SAME, "travel_mm=5", "hold_s=1", "tare_s=0.5", "repeats=2", "wait_s=17.3")
    folder = tmp_path / "c"
    with finished_here():
        dragrig.simulate("blank", out=folder, effects=[hum], assignments=quick)
        made_before = read_campaign(folder).runs
        for info in made_before[-2:]:  # the last run and its way back
            info.path.unlink()
        assert len(dragrig.resume(folder).session.runs) == 2
    again = [read_run(info.path) for info in read_campaign(folder).runs]
    assert len(again) == len(made_before)
    first = min(run.info.header.start_time for run in again)
    for run in again:
        began = (run.info.header.start_time - first).total_seconds()
        expected = 50.0 * np.sin(2 * np.pi * frequency * (began + np.asarray(run.trace.time)))
        tared = np.asarray(run.trace.force) + float(run.info.header.entry.get("tare_mN", 0.0))
        assert tared == pytest.approx(expected, abs=STEP_MN), run.info.path.name
    away = (again[-1].info.header.start_time - first).total_seconds()
    assert away > 60


def test_run_writes_files_with_effects_and_a_run_file_repeats_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = [f"--set={assignment}" for assignment in (*QUICK, "speed_mm_s=2")]
    with finished_here():
        assert main(["run", "drag", "--yes", "--json", "--out", "a", "--effect", "stribeck:ratio=0.8", *words]) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    first = read_run(Path(runs[0]["file"]))
    assert 'id = "stribeck", ratio = 0.8' in first.info.header.settings_toml
    again, _ = dragrig.simulate(runs[0]["file"])
    assert np.array_equal(again.trace.force, first.trace.force)
    plain, _ = made(assignments=(*QUICK, "speed_mm_s=2"))
    assert steady(first).mean() > steady(plain).mean() + 5


def test_effects_bear_a_long_hold() -> None:
    (run,) = dragrig.simulate(
        "relaxation",
        effects=["force_drift", "servo_lag", "arm_compliance"],
        assignments=[*SILENT, *SAME, "hold_s=100", "rig.sampling.rate_hz=20", "shear_strain=1"],
    )[:1]
    assert np.isfinite(run.trace.force).all()


def test_the_model_tells_what_effects_add_at_steady_speed(capsys: pytest.CaptureFixture[str]) -> None:
    typed = "stribeck:ratio=0.5,speed_mm_s=2"
    frame = dragrig.model([1.0, 30.0], effects=[typed])
    law = 0.5 * np.exp(-frame["speed_mm_s"] / 2.0) * frame["f_c_mN"]
    assert frame["effects_mN"].to_numpy() == pytest.approx(law.to_numpy(), abs=0.05)
    assert frame["total_mN"].to_numpy() == pytest.approx(
        frame[["f_e_mN", "f_v_mN", "f_c_mN", "effects_mN"]].sum(axis=1)
    )
    assert main(["model", "--json", "--speeds", "1;30", "--effect", typed]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["effects_mN"] for row in rows] == pytest.approx(frame["effects_mN"].tolist())
    assert "effects_mN" not in dragrig.model([1.0])


def test_a_run_with_effects_is_what_the_model_with_them_says() -> None:
    effects = ["stribeck:ratio=0.8,speed_mm_s=3", "peristalsis", "velocity_ripple", "arm_compliance"]
    steps = (*QUICK, "speed_mm_s=3", "way_back=stay", "repeats=2", "rig.stage.start_mm=20")
    first, second = made(*effects, assignments=steps)
    own = FrictionModelSettings(effects=parse_effects(effects))
    for model, minimum, maximum in ((own, 0.0, 2.5), (FrictionModelSettings(), 10.0, 100.0)):
        for run in (first, second):
            again = resimulate(run, model, first.info.header.start_time)
            off = (np.asarray(again.trace.force) - np.asarray(run.trace.force))[np.asarray(run.trace.phase) != 1]
            assert minimum <= np.sqrt(np.mean(off**2)) <= maximum


def test_the_force_gain_acts_on_effects_in_the_gut_and_not_on_those_of_the_sensor_or_the_motor() -> None:
    fast = (*QUICK, "speed_mm_s=2", "rig.simulated.motor.noise_mN=0")
    effects = ["stribeck", "force_drift:drift_mN_min=100"]
    plain, doubled = (made(*effects, assignments=(*fast, f"model.force_gain={gain}"))[0] for gain in (1, 2))
    crept = made("force_drift:drift_mN_min=100", plan="blank", assignments=(*fast, "way_back=stay"))[0]
    size = min(plain.trace.force.size, crept.trace.force.size)
    creep = np.asarray(crept.trace.force)[:size]
    twice = 2 * (np.asarray(plain.trace.force)[:size] - creep) + creep
    assert np.asarray(doubled.trace.force)[:size] == pytest.approx(twice, abs=4 * STEP_MN)
    motor = (np.asarray(run.trace.channels["motor_force"]) for run in (plain, doubled))
    assert next(motor) == pytest.approx(next(motor), abs=1e-3)
