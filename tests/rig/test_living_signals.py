"""A force input that is dead, frozen, saturated or unplugged, and an encoder that loses counts, on the rig's doubles.

Healthy rigs, quiet ones among them, are to be left alone.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

import dragrig as api
from dragrig.config.errors import DeviceError, TrippedError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import Calibration, RigSettings
from dragrig.rig.devices import BackendRequest, Contact, TripCause
from dragrig.rig.engine import AcquisitionOutcome, Engine
from dragrig.rig.guard import Guard
from dragrig.rig.hardware.card.scaling import ForceInputMonitor, NoiseLimits
from dragrig.rig.manual import ManualControl
from dragrig.rig.operator import Answer, NullOperator, Prompt
from dragrig.rig.profile import AnyFloatArray, FloatArray, MotionProfile, PhaseArray
from dragrig.rig.reading import Reading
from dragrig.rig.runfile.model import Attribute, RunEnding, RunEvent, RunStatus
from dragrig.setup import create_lab
from dragrig.sim_backend.doubles.backend import DoubleBackend
from dragrig.sim_backend.doubles.simulated_bench import FaultInjector
from driving import Stall
from property_tests import thorough
from rig_faults import sentence
from simulated import acquire, stroke
from voltage_bench import velocity_rig, voltage_rig

# A hold that is long enough to be judged where a busy computer has the stage set out late.
PROFILE = stroke(travel_mm=24.0, speed_mm_s=20.0, accel_mm_s2=500.0, rest_s=0.2, hold_s=0.5)
PACE = 3.0


def wired(
    force: Mapping[str, object] | None = None, lines: Mapping[str, str] | None = None, **groups: object
) -> RigSettings:
    hardware = {
        "drive": {"homing_speed_mm_s": 50.0, "reply_s": 2.0, "silence_s": 5.0},
        "hang_s": 2.0,
        "card": {"force": force or {}, "lines": lines or {}},
    }
    guard = {"following_error_mm": 50.0, "encoder_silent_mm": 50.0, "stale_data_s": 5.0}
    return RigSettings.model_validate({"hardware": hardware, "guard": guard, **groups})


@dataclass
class Kept:
    """A record that keeps the attributes that were written during the run."""

    entry: dict[str, Attribute] = field(default_factory=dict)

    def offer(self, first_index: int, arrays: Mapping[str, AnyFloatArray | PhaseArray]) -> None:
        pass

    def event(self, event: RunEvent) -> None:
        pass

    def annotate(self, entry: Mapping[str, Attribute]) -> None:
        self.entry.update(entry)

    def close(self, ending: RunEnding) -> Path:
        return Path("nowhere")


class Hands(NullOperator):
    """A person who does what is asked."""

    def ask(self, prompt: Prompt) -> Answer:
        return Answer.DONE


@dataclass
class Rig:
    backend: DoubleBackend
    faults: FaultInjector
    engine: Engine
    guard: Guard

    def make_ready(self) -> None:
        """Repair it, and have it homed and its guard reset as if it were just opened."""
        self.faults.clear()
        self.backend.stage.disable()
        assert self.guard.reset(self.backend.stage.state()) is None
        self.backend.stage.enable()
        self.backend.stage.home()

    def run(
        self,
        contact: Contact = Contact.SLIDING,
        sink: Kept | None = None,
        profile: MotionProfile = PROFILE,
        **in_motion: float,
    ) -> AcquisitionOutcome:
        """Make a run, with faults that begin in the middle of its motion."""

        def view(reading: Reading) -> None:
            if in_motion and float(reading.channels["position"][-1]) > 2.0:
                self.faults.inject(**in_motion)
                in_motion.clear()

        return self.engine.acquire(acquire(profile, contact=contact), sink, view)


@contextmanager
def rig_with(
    settings: RigSettings, calibrations: Mapping[str, Calibration] | None = None, pace: float = PACE
) -> Iterator[Rig]:
    faults = FaultInjector()
    request = BackendRequest(settings, FrictionModelSettings(), pace=pace, calibrations=calibrations or {})
    backend = DoubleBackend(request, faults)
    try:
        guard = Guard(settings.guard, 0.001)
        made = Rig(backend, faults, Engine(backend, settings, guard), guard)
        made.make_ready()
        yield made
    finally:
        backend.close()


@pytest.fixture(scope="module")
def shared() -> Iterator[Rig]:
    with rig_with(wired(lines={"encoder_error": "port1/line5"})) as made:
        yield made


@pytest.fixture
def rig(shared: Rig) -> Rig:
    shared.make_ready()
    return shared


@pytest.mark.parametrize(
    ("fault", "row"),
    [
        ({"force_frozen": True}, "force input dead"),
        thorough({"force_constant_V": 4.9}, "force input dead"),
        thorough({"force_constant_V": 1e-9}, "force input dead"),
        ({"force_added_mN": 9850.0}, "force over range"),
        ({"force_added_mN": 8500.0}, "force over the limit"),
        ({"sensor_open": True}, "force sensor's wire broken"),
        thorough({"encoder_added_counts": 100}, "encoder loses counts"),
        ({"encoder_added_counts": -400}, "encoder loses counts"),
        thorough({"encoder_jitter_counts": 200}, "encoder loses counts"),
        ({"encoder_error": True}, "encoder's error line"),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(f"{key}={of}" for key, of in value.items()),
)
def test_what_no_living_signal_does_stops_the_run_for_the_reason_of_the_page(
    rig: Rig, fault: dict[str, float], row: str
) -> None:
    # So long that a busy computer stops it within its way too.
    outcome = rig.run(profile=stroke(travel_mm=80.0, speed_mm_s=20.0), **fault)
    assert outcome.status is RunStatus.TRIPPED
    said = f"the session ended early: {outcome.reason}."
    assert sentence(row).fullmatch(said), said
    assert rig.backend.bench.position_mm() < 79.9


def test_a_healthy_run_is_left_alone(rig: Rig) -> None:
    outcome = rig.run()
    assert (outcome.status, outcome.reason, outcome.checks.warnings) == (RunStatus.COMPLETE, "", ())
    assert outcome.checks.values["force_response"] == "resists the motion"
    assert abs(float(outcome.checks.values["encoder_mismatch_mm"])) <= 0.003
    blank = rig.run(Contact.NONE, None)
    assert blank.checks.warnings == ()
    assert "force_response" not in blank.checks.values


@pytest.mark.parametrize(
    ("fault", "warning"),
    [
        ({"force_dead": True}, "did not change when the stage moved"),
        thorough({"force_inverted": True}, "acts along the motion"),
        ({"encoder_lost_share": 0.01}, r"differ by -0\.24"),
        thorough({"encoder_lost_share": -0.01}, r"differ by \+0\.24"),
    ],
)
def test_what_only_the_whole_run_shows_marks_it(rig: Rig, fault: dict[str, float], warning: str) -> None:
    rig.faults.inject(**fault)
    outcome = rig.run()
    assert outcome.status is RunStatus.COMPLETE
    (text,) = outcome.checks.warnings
    assert re.search(warning, text), text


FLOATS = [
    (
        {"force_floats_hum_mN": 50.0},
        ["noise or hum began within the run: 3", "did not change when the stage stopped"],
    ),
    thorough({"force_floats_hum_mN": 6.0}, ["noise or hum began within the run: 4"]),
    thorough({"force_floats_drift_mN_s": 40.0}, ["did not change when the stage stopped"]),
    thorough({}, ["did not change when the stage stopped"]),
]


def pulled(rig: Rig, floats: dict[str, float], warnings: list[str]) -> None:
    outcome = rig.run(force_floats_mN=350.0, **floats)
    assert outcome.status is RunStatus.COMPLETE
    for part in warnings:
        row = "input floats" if part.startswith("noise") else "force goes on over a stop"
        shown = sentence(f"force cable pulled, {row}")
        assert any(part in warning and shown.search(warning) for warning in outcome.checks.warnings), outcome.checks


@pytest.mark.parametrize(("floats", "warnings"), FLOATS)
def test_a_cable_that_is_pulled_in_mid_stroke_marks_the_run(
    rig: Rig, floats: dict[str, float], warnings: list[str]
) -> None:
    pulled(rig, floats, warnings)


@pytest.mark.thorough
@pytest.mark.parametrize(("floats", "warnings"), FLOATS)
def test_a_cable_that_is_pulled_in_mid_stroke_marks_a_run_of_5000_samples_a_second(
    floats: dict[str, float], warnings: list[str]
) -> None:
    with rig_with(wired(sampling={"rate_hz": 5000.0})) as made:
        pulled(made, floats, warnings)


@pytest.mark.thorough
@pytest.mark.parametrize("added", [{"force_tone_mN": 6.0, "force_tone_hz": 50.0}])
def test_hum_that_begins_within_a_run_is_told_from_hum_before_it(rig: Rig, added: dict[str, float]) -> None:
    outcome = rig.run(**added)
    (warning,) = outcome.checks.warnings
    assert "noise or hum began within the run" in warning
    rig.backend.stage.home()
    steady = rig.run()
    assert not [warning for warning in steady.checks.warnings if "began" in warning]


@pytest.mark.thorough
def test_in_velocity_mode_the_drives_own_position_tells_what_the_card_lost() -> None:
    settings = velocity_rig()
    with voltage_rig(settings) as backend:
        guard = Guard(settings.guard, 0.001)
        assert guard.reset(backend.stage.state()) is None
        backend.ready()
        engine = Engine(backend, settings, guard)
        for lost_share, mismatch_mm in ((0.0, 0.0), (0.01, -0.24)):
            backend.bench.faults.inject(encoder_lost_share=lost_share)
            outcome = engine.acquire(acquire(PROFILE, contact=Contact.SLIDING))
            assert (outcome.status, outcome.reason) == (RunStatus.COMPLETE, "")
            assert float(outcome.checks.values["encoder_mismatch_mm"]) == pytest.approx(mismatch_mm, abs=0.03)
            assert bool(outcome.checks.warnings) is bool(lost_share)
            backend.stage.move(stroke(travel_mm=-24.0))
            backend.await_standstill()


def test_a_dead_input_trips_an_approach(rig: Rig) -> None:
    rig.faults.inject(force_constant_V=1e-9)
    manual = ManualControl(rig.backend, rig.guard, rig.engine, Hands())
    with pytest.raises(TrippedError, match=r"repeats 0\.000 V"):
        manual.touch_off(50.0, 5.0, 20.0)
    assert rig.backend.bench.position_mm() < 2.0


def test_a_jog_after_which_drive_and_encoder_disagree_says_so(rig: Rig) -> None:
    manual = ManualControl(rig.backend, rig.guard, rig.engine, Hands())
    assert manual.jog(5.0) == pytest.approx(5.0, abs=0.01)
    rig.faults.inject(encoder_lost_share=0.02)
    with pytest.raises(DeviceError, match=r"encoder and drive differ by -0\.10"):
        manual.jog(5.0)


def test_the_recorded_uncertainty_covers_a_drive_that_starts_late() -> None:
    stated, stalled_s = {}, {}
    with rig_with(wired(stage={"start_mm": 5.0}), pace=1.0) as rig:
        for late_s in (0.0, 0.045):
            rig.faults.inject(drive_starts_late_s=late_s)
            sink, profile = Kept(), stroke(travel_mm=6.0, speed_mm_s=20.0, accel_mm_s2=500.0, rest_s=0.2, hold_s=0.3)
            with Stall() as stall:
                assert rig.run(Contact.NONE, sink, profile).status is RunStatus.COMPLETE
            stalled_s[late_s] = stall.longest_s
            stated[late_s] = float(sink.entry["command_t0_uncertainty_s"])
    assert stated[0.0] < 0.04 + stalled_s[0.0]
    # Late against the sample clock, which a busy machine may start late as well.
    assert 0.045 - stalled_s[0.045] <= stated[0.045] < 0.09 + stalled_s[0.045]


def test_a_measured_rail_makes_a_saturated_amplifier_an_overload() -> None:
    with rig_with(wired({"rail_V": 5.0})) as made:
        outcome = made.run(force_rail_V=5.0, force_added_mN=7000.0)
    assert outcome.reason.startswith(f"{TripCause.SENSOR_OVERLOAD}: force input ai0 is at 5.00 V")


@pytest.mark.thorough
def test_a_rig_that_was_calibrated_knows_an_amplifier_that_saturates_where_nobody_measured(
    tmp_path: Path,
) -> None:
    create_lab(tmp_path / "lab")
    made = api.calibrate_force(
        [0.0, 20.0, 50.0], duration_s=0.4, rig=tmp_path / "lab" / "rig.toml", backend="hardware", double=True, pace=2.0,
        person=Hands(),
    )  # fmt: skip
    assert made.entry.noise_uV == pytest.approx(750.0, rel=0.2)
    with rig_with(wired(), {"force": made.entry}) as rig:
        assert rig.run().status is RunStatus.COMPLETE
        rig.backend.stage.home()
        outcome = rig.run(force_rail_V=5.0, force_added_mN=7000.0)
    assert outcome.reason.startswith(f"{TripCause.SENSOR_DEAD}: force input ai0 shows ")


@pytest.mark.parametrize("fault", ["force_dead", thorough("sensor_open")])
def test_with_a_known_noise_a_dead_amplifier_or_a_pull_down_is_found(fault: str) -> None:
    noisy = {"noise": {"white_mN": 20.0}}
    with rig_with(wired({"least_noise_uV": 450.0, "unplugged": "zero"}, simulated=noisy)) as made:
        assert made.run().status is RunStatus.COMPLETE
        made.make_ready()
        outcome = made.run(**{fault: True})
        assert outcome.reason.startswith(f"{TripCause.SENSOR_DEAD}: ")


def monitor_of(settings: RigSettings, rate_hz: float, alive_uV: float = 0.0) -> ForceInputMonitor:
    return ForceInputMonitor(settings, NoiseLimits(settings, alive_uV, rate_hz), rate_hz)


@pytest.mark.parametrize("rate_hz", [thorough(100.0), 1000.0, thorough(25_000.0)])
@pytest.mark.parametrize("range_V", [0.2, thorough(1.0), thorough(5.0), 10.0])
def test_a_sensor_quieter_than_the_converter_is_alive_in_every_range(range_V: float, rate_hz: float) -> None:
    settings = RigSettings.model_validate({"hardware": {"card": {"force": {"range_V": range_V}}}})
    step_V, samples = 2 * range_V / 2**16, round(0.05 * rate_hz)
    monitor = monitor_of(settings, rate_hz)
    draw = np.random.default_rng(3)
    for place in range(2000):
        level = 0.3 * range_V * np.sin(0.3 * (place * 0.05 + np.arange(samples) / rate_hz))
        volts = np.rint((level + draw.normal(0, 0.8 * step_V, samples)) / step_V) * step_V
        assert monitor.add(volts) is None


def test_the_noise_at_the_calibration_tells_a_living_sensor_from_one_that_is_off() -> None:
    rate_hz, alive_uV, draw = 25_000.0, 1500.0, np.random.default_rng(5)
    for own_noise_V, dead in ((1.5e-3, False), (0.75e-3, False), (0.0, True)):
        monitor = monitor_of(RigSettings(), rate_hz, alive_uV)
        found = None
        for _ in range(200):
            means = np.repeat(draw.normal(0, own_noise_V, 50), 25)
            found = found or monitor.add(means + draw.normal(0, 244e-6, 1250))
        assert (found is not None) is dead
    assert found is not None
    assert "hardware.card.force.least_noise_uV" in found.message
    assert NoiseLimits(RigSettings(), 150.0, rate_hz).least_V == 0.0


@pytest.mark.parametrize(("rate_hz", "within_s"), [(25_000.0, 0.05), (1000.0, 0.25)])
def test_a_frozen_input_is_found_soon_though_it_lived_before(rate_hz: float, within_s: float) -> None:
    monitor, block = monitor_of(RigSettings(), rate_hz), round(0.01 * rate_hz)
    draw = np.random.default_rng(4)
    living: FloatArray = draw.normal(0, 1e-3, 7 * block)
    assert monitor.add(living) is None
    found = [monitor.add(np.full(block, 0.7)) for _ in range(round(within_s / 0.01))]
    trip = next(trip for trip in found if trip is not None)
    assert trip.cause is TripCause.SENSOR_DEAD
