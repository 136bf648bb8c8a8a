"""A busy computer: replies of the drive that come late, and an emergency stop that no thread sees at once."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import Backend, BackendRequest, Contact, TripCause
from dragrig.rig.engine import AcquisitionOutcome, Engine
from dragrig.rig.guard import Guard
from dragrig.rig.hardware.drive.stage_base import MonitoredStage
from dragrig.rig.reading import Reading
from dragrig.rig.runfile.model import RunStatus
from dragrig.sim_backend.doubles.backend import DoubleBackend
from dragrig.sim_backend.doubles.simulated_bench import FaultInjector
from driving import driven, until
from simulated import acquire, stroke
from voltage_bench import velocity_rig, voltage_rig

PROFILE = stroke(travel_mm=12.0, speed_mm_s=20.0, accel_mm_s2=500.0, rest_s=0.2, hold_s=0.25)
FAR = stroke(travel_mm=140.0, speed_mm_s=20.0, accel_mm_s2=500.0, rest_s=0.2, hold_s=0.25)


def rig_settings(reply_s: float, silence_s: float, **guard: float) -> RigSettings:
    drive = {"homing_speed_mm_s": 50.0, "reply_s": reply_s, "silence_s": silence_s}
    patient = {"stale_data_s": 5.0, "following_error_mm": 50.0, "encoder_silent_mm": 50.0}
    return RigSettings.model_validate(
        {"stage": {"start_mm": 5.0}, "hardware": {"drive": drive, "hang_s": 5.0}, "guard": {**patient, **guard}}
    )


@contextmanager
def ready(settings: RigSettings) -> Iterator[tuple[DoubleBackend, FaultInjector]]:
    faults = FaultInjector()
    backend = DoubleBackend(BackendRequest(settings, FrictionModelSettings()), faults)
    try:
        backend.stage.enable()
        backend.stage.home()
        yield backend, faults
    finally:
        faults.clear()
        backend.close()


def run(
    backend: Backend, settings: RigSettings, under_way: Callable[[], None] = lambda: None, far: bool = False
) -> AcquisitionOutcome:
    """Make a run, with something that happens in the middle of its motion."""
    guard, happened = Guard(settings.guard, 0.001), []
    assert guard.reset(backend.stage.state()) is None

    def view(reading: Reading) -> None:
        if not happened and float(reading.channels["position"][-1]) > 2.0:
            happened.append(under_way())

    acquisition = acquire(FAR if far else PROFILE, contact=Contact.SLIDING)
    return Engine(backend, settings, guard).acquire(acquisition, view=view)


def test_a_run_through_late_replies_is_complete_and_says_how_many() -> None:
    settings = rig_settings(0.1, 2.0)
    with ready(settings) as (backend, faults):
        quiet = run(backend, settings)
        faults.inject(drive_reply_load_s=0.2)
        outcome = run(backend, settings)
    assert (quiet.status, outcome.status, outcome.reason) == (RunStatus.COMPLETE, RunStatus.COMPLETE, "")
    late = outcome.checks.values["late_replies"]
    # A reply that tells of a stroke late may shift the next one's start, which other checks may say.
    assert any(warning.startswith(f"{late} repl") for warning in outcome.checks.warnings)
    assert "late_replies" not in quiet.checks.values or int(quiet.checks.values["late_replies"]) < int(late)


def test_an_emergency_stop_is_seen_while_a_reply_is_awaited() -> None:
    with driven(reply_s=1.0, silence_s=5.0, wired=True) as rig:
        rig.ready().stage.move(FAR)
        until(lambda: rig.bench.speed_mm_s() > 0.0)
        rig.bench.faults.inject(drive_reply_late_s=3.0)
        until(lambda: rig.link.unheard_s > 0.1)
        rig.bench.faults.inject(e_stop_pressed=True)
        pressed_s = time.monotonic()
        until(lambda: rig.stage.fault is not None)
        assert rig.link.unheard_s >= time.monotonic() - pressed_s, "a reply came in between"
        assert rig.stage.fault is not None
        assert rig.stage.fault.cause is TripCause.EMERGENCY_STOP
        # Nothing waits for the late replies then.
        rig.bench.faults.inject(drive_unplugged=True)


@contextmanager
def unseen(stage: object) -> Iterator[Callable[[], None]]:
    """Return what keeps the monitor from looking at the switches again, as on a computer that does not run it."""
    assert isinstance(stage, MonitoredStage)
    with ExitStack() as held:
        yield lambda: held.enter_context(stage.withholding(polls=True))


def test_an_emergency_stop_that_the_guard_sees_first_is_no_silent_encoder() -> None:
    settings = rig_settings(2.0, 5.0, encoder_silent_mm=0.4, following_error_mm=0.5)
    with ready(settings) as (backend, faults), unseen(backend.stage) as never_look:

        def press() -> None:
            never_look()
            faults.inject(e_stop_pressed=True)

        outcome = run(backend, settings, press, far=True)
        assert outcome.status is RunStatus.TRIPPED
        assert outcome.reason.startswith(f"{TripCause.EMERGENCY_STOP}: ")


def test_an_emergency_stop_that_the_velocity_loop_sees_first_is_no_following_error() -> None:
    settings = velocity_rig()
    with voltage_rig(settings) as backend, unseen(backend.stage) as never_look:
        backend.ready()

        def press() -> None:
            never_look()
            backend.bench.faults.inject(e_stop_pressed=True)

        outcome = run(backend, settings, press, far=True)
        assert outcome.status is RunStatus.TRIPPED
        assert outcome.reason.startswith(f"{TripCause.EMERGENCY_STOP}: ")


def test_an_encoder_that_is_silent_stays_a_silent_encoder() -> None:
    settings = rig_settings(2.0, 5.0, encoder_silent_mm=0.4)
    with ready(settings) as (backend, faults):
        outcome = run(backend, settings, lambda: faults.inject(encoder_stuck=True), far=True)
        assert outcome.reason.startswith(f"{TripCause.ENCODER_SILENT}: ")
