"""One acquisition on the simulated rig: what is recorded, noted, said and returned, however it ends."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import datetime
from math import isnan, nan
from pathlib import Path

import numpy as np
import pytest

from dragrig.config import (
    AbortedError,
    DeviceError,
    DragrigError,
    OverrunError,
    RecordingError,
    StaleDataError,
    TrippedError,
)
from dragrig.rig.devices import Backend, Block, StageState, TravelEnd, Trip, TripCause
from dragrig.rig.engine import (
    AcquisitionOutcome,
    Engine,
    attempt,
    early_end_error,
    require_agreement,
    require_complete,
)
from dragrig.rig.guard import Guard
from dragrig.rig.profile import AnyFloatArray, PhaseArray
from dragrig.rig.reading import CheckReport, Reading
from dragrig.rig.runfile import Attribute, RunEnding, RunEvent, RunStatus
from sim_faults import DriveFault, Faults, FollowError, ForceSpike, LostSamples, StaleData, StuckEncoder
from simulated import acquire, session, settings, stroke

PROFILE = stroke(10.0, 20.0, 400.0, 0.2, 0.3)
SAMPLES = 1050
BEGIN = [(0.0, "start", "drag"), (0.0, "phase", "rest"), (0.2, "phase", "accelerate"), (0.25, "phase", "steady")]
REST_OF_IT = [(0.7, "phase", "decelerate"), (0.75, "phase", "hold"), (1.05, "end", "complete")]
FINDINGS = Path("run.h5")


class Notes:
    """A record that keeps what it is given, and may refuse samples from a time on."""

    def __init__(self, refuses_from: int = 1 << 30) -> None:
        self.refuses_from = refuses_from
        self.samples: list[tuple[int, int]] = []
        self.events: list[tuple[float, str, str]] = []
        self.annotations: list[Mapping[str, Attribute]] = []
        self.closed: list[tuple[RunStatus, str, datetime, Mapping[str, Attribute]]] = []

    def offer(self, first_index: int, arrays: Mapping[str, AnyFloatArray | PhaseArray]) -> None:
        if first_index >= self.refuses_from:
            raise RecordingError("the disk is full.")
        self.samples.append((first_index, len(arrays["force"])))

    def event(self, event: RunEvent) -> None:
        self.events.append((round(event.time_s, 6), event.kind, event.message))

    def annotate(self, entry: Mapping[str, Attribute]) -> None:
        self.annotations.append(dict(entry))

    def close(self, ending: RunEnding) -> Path:
        self.closed.append((ending.status, ending.reason, ending.end_time, ending.checks))
        return FINDINGS


class Bench:
    """A simulated rig with an engine whose guard is reset."""

    def __init__(self, faults: Faults | None = None) -> None:
        rig = settings()
        self.backend: Backend = session(rig, faults)
        self.guard = Guard(rig.guard)
        self.guard.reset(self.backend.stage.state())
        self.engine = Engine(self.backend, rig, self.guard)
        self.notes = Notes()

    def run(self, **options: object) -> AcquisitionOutcome:
        return self.engine.acquire(acquire(PROFILE), self.notes, **options)  # type: ignore[arg-type]


def test_a_run_as_planned_is_recorded_whole() -> None:
    bench = Bench()
    outcome = bench.run()
    assert (outcome.status, outcome.reason, outcome.samples, outcome.path) == (
        RunStatus.COMPLETE, "", SAMPLES, FINDINGS,
    )  # fmt: skip
    assert sum(count for _, count in bench.notes.samples) == SAMPLES
    assert bench.notes.events == [*BEGIN, *REST_OF_IT]
    assert bench.notes.annotations == [{"command_t0_uncertainty_s": 0.0}]
    ((status, reason, _, checks),) = bench.notes.closed
    assert (status, reason, checks) == (RunStatus.COMPLETE, "", outcome.checks.values)
    assert not bench.engine.cancelled.is_set()
    bench.engine.require_not_aborted()
    require_complete(outcome)
    require_agreement(outcome)


def test_the_mean_force_is_over_all_samples_and_knows_no_tare() -> None:
    forces: list[AnyFloatArray] = []
    outcome = Bench().run(view=lambda reading: forces.append(reading.channels["force"]), tare_mN=50.0)
    assert outcome.mean_force_mN == pytest.approx(np.concatenate(forces).mean(dtype=np.float64) + 50.0, abs=1e-3)
    assert isnan(aborted_before().mean_force_mN)


def aborted_before() -> AcquisitionOutcome:
    bench = Bench()
    bench.engine.abort("Ctrl-C")
    outcome = bench.run()
    assert (outcome.status, outcome.reason, outcome.samples) == (RunStatus.ABORTED, "Ctrl-C", 0)
    return outcome


STUCK = (
    "encoder silent: the encoder showed no count for 99 ms, while the command moved by 1.98 mm; check its cable, and "
    "whether the stage is blocked"
)
STALE = "stale data: the sampler delivered nothing for 0.2 s (guard.stale_data_s): check its clock and cables"


@pytest.mark.parametrize(
    ("faults", "at_s", "samples", "reason", "went_on"),
    [
        (Faults(follow_error=FollowError(0.4, 3.0)), 0.45, 458, "speed: speed of 49.4 mm/s is over the limit of "
         "35.0 mm/s", "0.28 mm after the stop, at 6.28 mm"),
        (Faults(stuck_encoder=StuckEncoder(0.3)), 0.4, 408, STUCK, "0.00 mm after the stop, at 1.50 mm"),
        (Faults(force_spike=ForceSpike(0.4, 9000.0)), 0.45, 458, "force: force of 9116 mN is over the limit of "
         "8000 mN", "0.07 mm after the stop, at 4.57 mm"),
        (Faults(drive_fault=DriveFault(0.4)), 0.4, 408, "drive fault: the drive reports simulated overcurrent",
         "0.07 mm after the stop, at 3.57 mm"),
    ],
    ids=["speed", "encoder", "force", "drive"],
)  # fmt: skip
def test_a_trip_is_noted_where_it_was_and_recorded_to_the_standstill(
    faults: Faults, at_s: float, samples: int, reason: str, went_on: str
) -> None:
    """The stage brakes from 20 mm/s within 6.7 ms: of the block with the cause, all is known."""
    bench = Bench(faults)
    outcome = bench.run()
    assert (outcome.status, outcome.reason, outcome.samples) == (RunStatus.TRIPPED, reason, samples)
    end_s = samples / 1000
    assert bench.notes.events == [
        *BEGIN,
        (at_s, "trip", reason),
        (at_s, "phase", "decelerate"),
        (end_s - 0.001, "phase", "hold"),
        (end_s, "stopped", went_on),
        (end_s, "end", reason),
    ]
    assert bench.notes.closed[0][:2] == (RunStatus.TRIPPED, reason)
    with pytest.raises(TrippedError) as caught:
        require_complete(outcome)
    assert str(caught.value) == reason
    with pytest.raises(TrippedError, match="reset"):
        bench.run()


def test_what_stands_after_a_trip_is_no_part_of_its_following_error() -> None:
    """The stage follows its new command, so that only samples before the stop show how well it follows."""
    outcome = Bench(Faults(stuck_encoder=StuckEncoder(0.3))).run()
    assert outcome.checks.values["following_error_mm"] == pytest.approx(0.98)


def test_a_sampler_that_falls_silent_is_told_with_the_time_of_the_stop() -> None:
    bench = Bench(Faults(stale_data=StaleData(0.4)))
    outcome = bench.run()
    assert (outcome.status, outcome.reason, outcome.samples) == (RunStatus.TRIPPED, STALE, 400)
    assert bench.notes.events == [*BEGIN, (0.6, "trip", STALE), (0.4, "end", STALE)]


def test_lost_samples_are_lost_and_nothing_else() -> None:
    outcome = Bench(Faults(lost_samples=LostSamples(0.3, 30))).run()
    assert (outcome.status, outcome.samples, outcome.checks.values["lost_samples"]) == (
        RunStatus.COMPLETE, SAMPLES - 30, 30,
    )  # fmt: skip


def after(samples: int, act: Callable[[], object]) -> Callable[[Reading], None]:
    """Return a viewer that acts once, with the first reading that ends at so many samples or later."""
    acted: list[bool] = []

    def view(reading: Reading) -> None:
        if reading.end_index >= samples and not acted:
            acted.append(True)
            act()

    return view


def test_an_abort_from_elsewhere_brakes_at_once_and_its_reason_is_final() -> None:
    bench = Bench()

    def twice() -> None:
        bench.engine.abort("stop button")
        bench.engine.abort("again")

    outcome = bench.run(view=after(400, twice))
    assert (outcome.status, outcome.reason, outcome.samples) == (RunStatus.ABORTED, "stop button", 408)
    assert bench.notes.events == [
        *BEGIN,
        (0.4, "stop", "stop button"),
        (0.4, "phase", "decelerate"),
        (0.407, "phase", "hold"),
        (0.408, "stopped", "0.07 mm after the stop, at 3.57 mm"),
        (0.408, "end", "stop button"),
    ]
    assert bench.engine.abort_reason == "stop button"
    for refused in (bench.engine.require_not_aborted, lambda: require_complete(outcome)):
        with pytest.raises(AbortedError, match="stop button"):
            refused()


def test_an_abort_without_a_reason_is_called_so() -> None:
    bench = Bench()
    bench.engine.abort("")
    assert bench.run().reason == "aborted"
    with pytest.raises(AbortedError, match=r"^aborted$"):
        bench.engine.require_not_aborted()


def test_a_stage_that_reached_its_aim_is_stopped_there_and_the_run_is_complete() -> None:
    bench = Bench()
    outcome = bench.run(stop_when=lambda reading: reading.end_index >= 400)
    assert (outcome.status, outcome.reason, outcome.samples) == (RunStatus.COMPLETE, "", 408)
    assert (0.4, "stop", "aim reached") in bench.notes.events
    assert bench.notes.events[-1] == (0.408, "end", "complete")


def test_a_viewer_that_fails_is_left_out_and_told_once() -> None:
    bench = Bench()
    calls: list[int] = []

    def fail(reading: Reading) -> None:
        calls.append(reading.end_index)
        raise ValueError("no screen")

    assert bench.run(view=fail).status is RunStatus.COMPLETE
    assert len(calls) == 1
    told = [event for event in bench.notes.events if event[1] == "view"]
    assert told == [(calls[0] / 1000, "view", "the viewer failed and gets no more data: no screen")]


def test_a_disk_that_refuses_stops_the_stage_and_all_that_follows_is_made() -> None:
    bench = Bench()
    bench.notes.refuses_from = 400
    outcome = bench.run()
    assert (outcome.status, outcome.reason, outcome.path) == (RunStatus.FAILED, "the disk is full", FINDINGS)
    assert outcome.samples == 458
    assert (0.45, "stop", "the disk is full") in bench.notes.events
    assert bench.notes.closed[0][:2] == (RunStatus.FAILED, "the disk is full")
    with pytest.raises(DeviceError, match="the disk is full"):
        require_complete(outcome)


def refuse(error: Exception) -> Callable[..., None]:
    def step(*_: object) -> None:
        raise error

    return step


@pytest.mark.parametrize(
    ("device", "step", "reason"),
    [
        ("stage", "stop", "out of reach"),
        ("sampler", "stop", "out of reach"),
    ],
)
def test_a_step_of_the_clean_up_that_fails_prevents_no_other(
    monkeypatch: pytest.MonkeyPatch, device: str, step: str, reason: str
) -> None:
    bench = Bench()
    monkeypatch.setattr(getattr(bench.backend, device), step, refuse(DeviceError(f"{reason}.")))
    outcome = bench.run()
    assert (outcome.status, outcome.reason, outcome.path) == (RunStatus.FAILED, reason, FINDINGS)
    assert bench.notes.closed[0][:2] == (RunStatus.FAILED, reason)


def test_a_record_that_cannot_be_closed_fails_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    monkeypatch.setattr(bench.notes, "close", refuse(RecordingError("the disk is full.")))
    outcome = bench.run()
    assert (outcome.status, outcome.reason, outcome.path) == (RunStatus.FAILED, "the disk is full", None)


def test_a_stage_that_does_not_take_the_stop_is_told_beside_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    monkeypatch.setattr(bench.backend.stage, "stop", refuse(DeviceError("no reply.")))
    outcome = bench.run(view=after(400, lambda: bench.engine.abort("stop button")))
    assert outcome.status is RunStatus.ABORTED
    assert outcome.reason == "stop button; and the stage did not take the stop (no reply); no reply"
    bench = Bench()
    monkeypatch.setattr(bench.backend.stage, "stop", refuse(DeviceError("no reply.")))
    outcome = bench.run(stop_when=lambda reading: reading.end_index >= 400)
    assert outcome.status is RunStatus.FAILED
    assert outcome.reason == "the stage did not take the stop (no reply); no reply"


def reading_then(bench: Bench, blocks: int, monkeypatch: pytest.MonkeyPatch, then: Callable[[Block], Block]) -> None:
    """Let the sampler hand over so many blocks as they are, and all later ones as `then` changes them."""
    read, taken = bench.backend.sampler.read, []

    def altered(cancel: threading.Event) -> Block | None:
        block = read(cancel)
        taken.append(block)
        return then(block) if len(taken) > blocks and block is not None else block

    monkeypatch.setattr(bench.backend.sampler, "read", altered)


@pytest.mark.parametrize(
    ("error", "status", "reason"),
    [
        (DeviceError("the card is gone."), RunStatus.FAILED, "the card is gone"),
        (StaleDataError("nothing came."), RunStatus.TRIPPED, "stale data: nothing came"),
        (OverrunError("too slow."), RunStatus.TRIPPED, "overrun: too slow"),
    ],
)
def test_a_sampler_that_fails_ends_the_run(
    monkeypatch: pytest.MonkeyPatch, error: DragrigError, status: RunStatus, reason: str
) -> None:
    bench = Bench()
    reading_then(bench, 8, monkeypatch, lambda _: refuse(error)())  # type: ignore[arg-type,return-value]
    outcome = bench.run()
    assert (outcome.status, outcome.reason, outcome.samples) == (status, reason, 400)
    assert bench.backend.stage.state().moving is False
    assert (bench.guard.trip is not None) is (status is RunStatus.TRIPPED)


def test_an_error_of_nobodys_kind_is_raised_after_the_clean_up(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    reading_then(bench, 8, monkeypatch, lambda _: refuse(ZeroDivisionError("by 0"))())  # type: ignore[arg-type,return-value]
    with pytest.raises(ZeroDivisionError):
        bench.run()
    assert bench.notes.closed[0][:2] == (RunStatus.FAILED, "ZeroDivisionError: by 0")


@pytest.mark.parametrize(
    ("fault", "status", "reason"),
    [
        (Trip(TripCause.SENSOR_OPEN, "cut off"), RunStatus.TRIPPED, "sensor open circuit: cut off"),
        (Trip(TripCause.CARD_FAULT, "the card is gone"), RunStatus.FAILED, "the card is gone"),
    ],
)
def test_what_the_sampler_detects_trips(
    monkeypatch: pytest.MonkeyPatch, fault: Trip, status: RunStatus, reason: str
) -> None:
    bench = Bench()
    reading_then(bench, 7, monkeypatch, lambda block: replace(block, fault=fault))
    outcome = bench.run()
    assert (outcome.status, outcome.reason, outcome.samples) == (status, reason, 408)
    assert bench.guard.trip is fault
    kind = "trip" if status is RunStatus.TRIPPED else "stop"
    assert (0.4, kind, reason) in bench.notes.events


@pytest.mark.parametrize(
    ("abort", "reason"), [("stop button", "stop button; overrun: 12 samples are lost"), ("", "")], ids=["abort", "aim"]
)
def test_an_overrun_that_shows_after_the_stop_is_told_beside_its_reason(
    monkeypatch: pytest.MonkeyPatch, abort: str, reason: str
) -> None:
    bench = Bench()
    late = Trip(TripCause.OVERRUN, "12 samples are lost")
    reading_then(bench, 8, monkeypatch, lambda block: replace(block, fault=late))
    options: dict[str, object] = (
        {"view": after(400, lambda: bench.engine.abort(abort))}
        if abort
        else {"stop_when": lambda reading: reading.end_index >= 400}
    )
    outcome = bench.run(**options)
    assert outcome.reason == reason
    assert bench.notes.closed[0][1] == outcome.reason


def test_a_sampler_that_ends_before_the_profile_fails_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    reading_then(bench, 8, monkeypatch, lambda _: None)  # type: ignore[arg-type,return-value]
    outcome = bench.run()
    assert (outcome.status, outcome.reason) == (RunStatus.FAILED, "sampling ended after 400 of 1050 samples")


class Reporting:
    """What the drive reports, in place of the simulated stage's own, once so many blocks were read."""

    def __init__(self, bench: Bench, monkeypatch: pytest.MonkeyPatch, fault: Trip | None, blocks: int = 7) -> None:
        self.taken = 0
        read = bench.backend.sampler.read

        def counted(cancel: threading.Event) -> Block | None:
            self.taken += 1
            return read(cancel)

        monkeypatch.setattr(bench.backend.sampler, "read", counted)
        monkeypatch.setattr(
            type(bench.backend.stage), "fault", property(lambda _: fault if self.taken > blocks else None)
        )


def test_a_watchdogs_stop_is_told_before_the_error_that_follows_from_it(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    bench.notes.refuses_from = 350
    fault = Trip(TripCause.WATCHDOG, "nobody read the data")
    Reporting(bench, monkeypatch, fault, blocks=8)
    monkeypatch.setattr(bench.notes, "offer", lambda *_: None)
    reading_then(bench, 8, monkeypatch, lambda _: refuse(StaleDataError("nothing came."))())  # type: ignore[arg-type,return-value]
    assert bench.run().reason == "watchdog: nobody read the data; nothing came"
    assert bench.guard.trip == Trip(TripCause.WATCHDOG, "nobody read the data; nothing came")


def test_a_drive_that_does_not_tell_its_state_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    stage = type(bench.backend.stage)
    begun = threading.Event()
    reported = stage.fault.fget  # type: ignore[attr-defined]

    def fault(self: object) -> Trip | None:
        if begun.is_set():
            raise DeviceError("no reply.")
        return reported(self)  # type: ignore[no-any-return]

    monkeypatch.setattr(stage, "fault", property(fault))
    outcome = bench.run(view=after(400, begun.set))
    assert outcome.reason == "drive fault: no reply"


def test_a_switch_that_is_overridden_stops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    pressed = Trip(TripCause.LIMIT_SWITCH_LOW, "pressed")
    for side, status in ((TravelEnd.LOW, RunStatus.COMPLETE), (TravelEnd.HIGH, RunStatus.TRIPPED)):
        bench = Bench()
        bench.guard.override(side, StageState(5.0, enabled=True, homed=True, moving=False))
        with monkeypatch.context() as patch:
            Reporting(bench, patch, pressed)
            reading_then(bench, 7, patch, lambda block: replace(block, fault=pressed))
            assert bench.run().status is status


def test_an_emergency_stop_takes_the_place_of_a_stage_that_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(Faults(stuck_encoder=StuckEncoder(0.3)))
    Reporting(bench, monkeypatch, Trip(TripCause.EMERGENCY_STOP, "pressed"), blocks=8)
    outcome = bench.run()
    assert (outcome.status, outcome.reason) == (RunStatus.TRIPPED, "emergency stop: pressed")
    assert [event for event in bench.notes.events if event[1] == "trip"] == [
        (0.4, "trip", STUCK),
        (0.4, "trip", "emergency stop: pressed"),
    ]
    assert bench.notes.closed[0][1] == "emergency stop: pressed"


def drive_shows(bench: Bench, monkeypatch: pytest.MonkeyPatch, *positions_mm: float) -> None:
    """Let the drive's own encoder show these positions, one at each look, and the last from then on."""
    state, left = bench.backend.stage.state, list(positions_mm)
    monkeypatch.setattr(
        bench.backend.stage, "state", lambda: replace(state(), drive_mm=left.pop(0) if len(left) > 1 else left[0])
    )


def test_a_stage_that_never_set_out_is_told_from_a_silent_encoder(monkeypatch: pytest.MonkeyPatch) -> None:
    for drive_mm, cause in ((7.0, "no motion"), (8.5, "encoder silent"), (5.5, "encoder silent"), (nan, "encoder")):
        bench = Bench(Faults(stuck_encoder=StuckEncoder(0.0)))
        with monkeypatch.context() as patch:
            drive_shows(bench, patch, 7.0, drive_mm)
            outcome = bench.run()
        assert outcome.reason.startswith(cause), (drive_mm, outcome.reason)


@pytest.mark.parametrize(("drive_mm", "agrees"), [(10.0, True), (10.054, True), (10.06, False), (-10.0, False)])
def test_drive_and_encoder_are_compared_at_the_standstill(
    monkeypatch: pytest.MonkeyPatch, drive_mm: float, agrees: bool
) -> None:
    """The bound is 0.05 mm and 0.0005 of the travel."""
    bench = Bench()
    drive_shows(bench, monkeypatch, 3.0, 3.0 + drive_mm)
    outcome = bench.run()
    assert outcome.status is RunStatus.COMPLETE
    assert (outcome.checks.encoder_fault == "") is agrees
    if not agrees:
        with pytest.raises(DeviceError) as caught:
            require_agreement(outcome)
        assert str(caught.value) == f"{outcome.checks.encoder_fault}; home the stage, and look at the encoder."


def test_a_fault_while_a_late_stage_comes_to_its_end_trips(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    waited: list[object] = []
    monkeypatch.setattr(bench.backend.stage, "await_end", waited.append)
    Reporting(bench, monkeypatch, Trip(TripCause.DRIVE_FAULT, "hot"), blocks=21)
    outcome = bench.run()
    assert waited == [bench.engine.cancelled]
    assert (outcome.status, outcome.reason, outcome.samples) == (RunStatus.TRIPPED, "drive fault: hot", SAMPLES)


def test_a_stage_on_a_clock_of_its_own_tells_how_well_its_begin_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    monkeypatch.setattr(type(bench.backend.stage), "start_uncertainty_s", property(lambda _: 0.004))
    bench.run()
    assert bench.notes.annotations == [{"command_t0_uncertainty_s": 0.004}]


def test_replies_that_came_late_are_those_of_this_run(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    late = [5]
    monkeypatch.setattr(type(bench.backend.stage), "late_replies", property(lambda _: late[0]), raising=False)
    assert bench.run(view=after(400, lambda: late.append(late.pop() + 3))).checks.values["late_replies"] == 3


def test_a_run_that_cannot_begin_closes_its_record(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    monkeypatch.setattr(bench.guard, "watch", refuse(ValueError("absurd")))
    with pytest.raises(ValueError, match="absurd"):
        bench.run()
    ((status, reason, end_time, checks),) = bench.notes.closed
    assert (status, reason, checks) == (RunStatus.FAILED, "absurd", {})
    assert end_time.tzinfo is not None
    with pytest.raises(ValueError, match="absurd"):
        bench.engine.acquire(acquire(PROFILE))


def test_an_early_end_has_the_error_of_its_status() -> None:
    for status, kind in (
        (RunStatus.ABORTED, AbortedError),
        (RunStatus.TRIPPED, TrippedError),
        (RunStatus.FAILED, DeviceError),
    ):
        error = early_end_error(status, "why")
        assert (type(error), str(error)) == (kind, "why")
    complete = AcquisitionOutcome(RunStatus.COMPLETE, "", 1, CheckReport({}, ()), 0.0)
    require_complete(complete)
    require_agreement(complete)


def test_a_step_of_a_clean_up_returns_its_error_as_text() -> None:
    assert attempt(lambda: None) == ""
    assert attempt(refuse(DeviceError("no reply."))) == "no reply"
    assert attempt(refuse(OSError("cable pulled"))) == "OSError: cable pulled"


def test_an_abort_stops_the_stage_itself_for_the_acquiring_thread_may_be_held_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench()
    stopped: list[str] = []
    monkeypatch.setattr(bench.backend.stage, "stop", lambda: stopped.append(bench.engine.abort_reason))
    bench.engine.abort("stop button")
    bench.engine.abort("again")
    assert stopped == ["stop button", "stop button"]
    monkeypatch.setattr(bench.backend.stage, "stop", refuse(DeviceError("no reply.")))
    bench.engine.abort("once more")


@pytest.mark.parametrize("faults", [Faults(force_spike=ForceSpike(0.4, 9000.0)), Faults(stale_data=StaleData(0.4))])
def test_a_stage_that_was_stopped_is_not_waited_for(monkeypatch: pytest.MonkeyPatch, faults: Faults) -> None:
    bench = Bench(faults)
    waited: list[object] = []
    monkeypatch.setattr(bench.backend.stage, "await_end", waited.append)
    assert bench.run().status is RunStatus.TRIPPED
    assert waited == []
