"""Move the stage by hand (home, jog, touch off), look at the rig's wiring, and calibrate force sensor and encoder."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from math import isfinite
from pathlib import Path
from threading import Event as Signal
from typing import Generic, TypeAlias, TypeVar, Unpack

from dragrig.config import (
    AbortedError,
    Calibration,
    CommissioningRecord,
    ContactPoint,
    DeviceError,
    SettingsError,
    require_text,
)
from dragrig.hosted_session import PromptRelay, idle_reader, run_on_worker
from dragrig.rig import (
    JOG_SPEED_MM_S,
    Answer,
    Backend,
    CalibrationLine,
    Engine,
    Guard,
    LoadReading,
    ManualControl,
    NullOperator,
    Operator,
    Prompt,
    RigCheck,
    SupportsLiveLook,
    TravelEnd,
    TravelReading,
    Trip,
    append_calibration,
    fit_encoder,
    fit_force,
    ignore,
    look_at_rig,
    measure_driven_travel,
    measure_loads,
    measure_pushed_travel,
    park,
    require_jog,
    require_loads,
    require_speed,
    require_touch_off,
    wiring_key,
    write_commissioning,
    write_contact,
)
from dragrig.setup import Pace, RigChoices, RigSetup, opened_rig, resolve_rig

ResultT = TypeVar("ResultT")
PointT = TypeVar("PointT", LoadReading, TravelReading)


Begun: TypeAlias = Callable[[Callable[[str], None]], object]


@dataclass(frozen=True, slots=True)
class OpenRig:
    """An open rig and its manual control."""

    setup: RigSetup
    backend: Backend
    manual: ManualControl


@dataclass(frozen=True, slots=True)
class MoveResult:
    """Position of the stage [mm], and why the guard is still tripped."""

    position_mm: float
    trip: Trip | None = None


def home(
    *,
    override: TravelEnd | None = None,
    pace: Pace | None = None,
    person: Operator | None = None,
    begun: Begun = ignore,
    **choices: Unpack[RigChoices],
) -> MoveResult:
    """Find the stage's origin.

    Parameters
    ----------
    override
        Side whose pressed limit switch is ignored.
    pace
        Of a simulated rig, or of a double.
    person
        Confirms every motion (default: nobody, which fails where hands at the rig are needed).
    begun
        Called before anything moves with a function that stops the stage from any thread, for a reason.
    choices
        As of `examine`.

    Raises
    ------
    AbortedError, TrippedError, DeviceError, SettingsError
        With the stage stopped and switched off.
    """

    def work(bench: OpenRig) -> MoveResult:
        if override is None:
            bench.manual.reset()
        return MoveResult(bench.manual.home(override), bench.manual.trip)

    return run_on_bench(work, resolve_rig(**choices), pace, person, begun)


def jog(
    distance_mm: float,
    speed_mm_s: float | None = None,
    *,
    override: TravelEnd | None = None,
    pace: Pace | None = None,
    person: Operator | None = None,
    begun: Begun = ignore,
    **choices: Unpack[RigChoices],
) -> MoveResult:
    """Move the stage by a signed distance; otherwise as `home` and `ManualControl.jog`."""

    def work(bench: OpenRig) -> MoveResult:
        if override is None:
            bench.manual.reset()
        return MoveResult(bench.manual.jog(distance_mm, speed_mm_s, override), bench.manual.trip)

    setup = resolve_rig(**choices)
    # Checked before the operator is asked for anything, here and below.
    require_jog(distance_mm, speed_mm_s, override, setup.limits)
    return run_on_bench(work, setup, pace, person, begun)


def touch_off(
    most_mm: float,
    *,
    force_mN: float = 20.0,
    speed_mm_s: float = 1.0,
    back_mm: float = 0.0,
    operator: str = "",
    pace: Pace | None = None,
    person: Operator | None = None,
    begun: Begun = ignore,
    **choices: Unpack[RigChoices],
) -> ContactPoint:
    """Approach slowly until the force changes, and store the contact in the lab folder; otherwise as `home`.

    Raises
    ------
    SettingsError
        Also outside of a lab folder; nothing moves then.
    """
    setup = resolve_rig(**choices)
    require_text(operator=operator)
    folder = _require_lab(setup, "touch-off")
    require_touch_off(force_mN, speed_mm_s, most_mm, back_mm, setup.limits)

    def work(bench: OpenRig) -> ContactPoint:
        bench.manual.reset()
        touch = bench.manual.touch_off(force_mN, speed_mm_s, most_mm, back_mm)
        position_mm, change_mN = round(touch.position_mm, 4), round(touch.force_mN, 2)
        now = bench.backend.clock.now()
        contact = ContactPoint(position_mm=position_mm, made_at=now, force_mN=change_mN, operator=operator)
        write_contact(folder, contact)
        return contact

    return run_on_bench(work, setup, pace, person, begun)


def commission(
    *,
    operator: str = "",
    pace: Pace | None = None,
    person: Operator | None = None,
    found: Callable[[RigCheck], None] = ignore,
    **choices: Unpack[RigChoices],
) -> CommissioningRecord:
    """Guide a person through the rig's signals: push the carriage, press the sensor, press each switch.

    At the end the drive is switched on, and enable line, heartbeat and the program's requests are taken away in turn:
    at a standstill, and, where the person does not skip that, at 1 mm/s over 2 mm at most. The record is stored in the
    lab folder, whatever was found.

    Parameters
    ----------
    operator
        Stored in the record.
    found
        Called with each finding as it is made.
    pace, person, choices
        As of `home`.

    Raises
    ------
    SettingsError
        Outside of a lab folder, and for a rig without wires; nothing is touched then.
    AbortedError, DeviceError
        When the person ends it, and when the card does not answer; nothing is stored then.
    """
    setup = resolve_rig(**choices)
    require_text(operator=operator)
    folder = _require_lab(setup, "check --live")
    request = replace(setup.request(pace), connect=False)
    with opened_rig(setup.backend, request, double=setup.double) as backend:
        if not isinstance(backend, SupportsLiveLook):
            raise SettingsError(
                f"check --live: backend {setup.backend} has no wires to look at; choose --backend hardware."
            )
        ended = Signal()
        operator_here = PromptRelay(person or NullOperator())

        def confirm(prompt: Prompt) -> Answer:
            answer = operator_here.ask(prompt)
            if answer not in {Answer.DONE, Answer.SKIP} or ended.is_set():
                raise AbortedError("the look at the rig was ended; nothing is stored.")
            return answer

        def work() -> list[RigCheck]:
            findings = []
            for finding in look_at_rig(backend, setup.rig, confirm):
                found(finding)
                findings.append(finding)
            return findings

        signals = run_on_worker(work, lambda _reason: ended.set(), operator_here)
        record = CommissioningRecord(
            made_at=backend.clock.now(),
            made_on=setup.made_on,
            wiring=wiring_key(setup.rig),
            operator=operator,
            signals=tuple(replace(signal, after_s=round(signal.after_s, 3)) for signal in signals),
        )
    write_commissioning(folder, record)
    return record


def run_on_bench(
    work: Callable[[OpenRig], ResultT],
    setup: RigSetup,
    pace: Pace | None = None,
    person: Operator | None = None,
    begun: Begun = ignore,
) -> ResultT:
    """Open a rig, work on it, and switch it off; the calling thread handles Ctrl-C and prompts.

    Raises
    ------
    AbortedError
        When the operator ended it.
    DragrigError
        The errors of the work; also when the rig cannot be opened or switched off.
    """
    request = setup.request(pace)
    with opened_rig(setup.backend, request, double=setup.double) as backend:
        guard = Guard(setup.rig.guard, 1e-3 * setup.rig.encoder.resolution_um)
        engine = Engine(backend, setup.rig, guard)
        look = idle_reader(backend, timed=request.real_time or backend.needs_hands)
        operator = PromptRelay(person or NullOperator(), look)
        bench = OpenRig(setup, backend, ManualControl(backend, guard, engine, operator))
        begun(engine.abort)
        try:
            result = run_on_worker(lambda: work(bench), engine.abort, operator)
        except (AbortedError, DeviceError) as error:
            if engine.cancelled.is_set():
                raise AbortedError(f"ended early ({engine.abort_reason}): the stage is stopped, and off.") from error
            raise
        finally:
            failures = park(backend)
        if failures:
            raise DeviceError(f"{'; '.join(failures)}.")
        return result


_MAX_REPEATS = 100
_MAX_DURATION_S = 600.0
_MAX_COUNT_DEVIATION = 0.01
"""Relative difference of a count from the encoder's resolution that is not noted."""


@dataclass(frozen=True, slots=True)
class SensorCalibration(Generic[PointT]):
    """A calibration, its fitted line, its points, and remarks."""

    entry: Calibration
    line: CalibrationLine
    points: tuple[PointT, ...]
    notes: tuple[str, ...]


def calibrate_force(
    weights_g: Sequence[float],
    *,
    repeats: int = 1,
    duration_s: float = 2.0,
    operator: str = "",
    note: str = "",
    store: bool = True,
    pace: Pace | None = None,
    person: Operator | None = None,
    begun: Begun = ignore,
    **choices: Unpack[RigChoices],
) -> SensorCalibration[LoadReading]:
    """Calibrate the force sensor with known weights and add the result to the lab's history.

    Parameters
    ----------
    weights_g
        At least three distinct weights; 0 is the empty sensor.
    repeats
        Number of series, up and down alternately.
    duration_s
        Duration of each reading.
    store
        Whether to add the result to the history; otherwise `store_calibration` does, once somebody has looked at it.
    pace, person, begun, choices
        As of `home`.

    Raises
    ------
    SettingsError
        Outside of a lab folder, for weights that determine no line, and for readings that do not follow them.
    DeviceError, AbortedError
        When the sensor is overloaded or fails, and when the operator aborts; nothing is stored then.
    """
    setup = resolve_rig(**choices)
    folder = _require_lab(setup)
    require_text(operator=operator, note=note)
    require_loads(weights_g)
    _require_repeats(repeats, duration_s)

    def work(bench: OpenRig) -> SensorCalibration[LoadReading]:
        rig = setup.rig
        points = tuple(measure_loads(bench.backend, rig, bench.manual, tuple(weights_g), repeats, duration_s))
        line = fit_force([point.load_mN for point in points], [point.reading.force_V for point in points])
        notes = []
        if line.residual > rig.force_sensor.accuracy_mN:
            notes.append(
                f"the residual of {line.residual:.1f} mN is larger than the sensor's accuracy of "
                f"{rig.force_sensor.accuracy_mN:g} mN"
            )
        noises_V = [point.reading.force_noise_V for point in points if isfinite(point.reading.force_noise_V)]
        entry = _calibration_entry("force", line, bench, operator, (note, *notes)).model_copy(
            update={"sensor_serial": rig.force_sensor.serial, "noise_uV": round(1e6 * min(noises_V, default=0.0), 3)}
        )
        if store:
            append_calibration(folder, entry)
        return SensorCalibration(entry, line, points, tuple(notes))

    return run_on_bench(work, setup, pace, person, begun)


def calibrate_encoder(
    travel_mm: float,
    *,
    measured_mm: Sequence[float] = (),
    repeats: int = 3,
    speed_mm_s: float = JOG_SPEED_MM_S,
    by_hand: bool = False,
    duration_s: float = 20.0,
    operator: str = "",
    note: str = "",
    store: bool = True,
    pace: Pace | None = None,
    person: Operator | None = None,
    begun: Begun = ignore,
    **choices: Unpack[RigChoices],
) -> SensorCalibration[TravelReading]:
    """Calibrate the encoder over a known travel and add the result to the lab's history.

    Parameters
    ----------
    travel_mm
        Signed travel of the stage, driven or pushed by hand.
    measured_mm
        Measured travel of each repeat, where it was measured.
    by_hand
        Whether the stage is switched off and pushed, within `duration_s` each time.
    store, pace, person, begun, choices
        As of `calibrate_force`.

    Raises
    ------
    SettingsError, DeviceError, AbortedError, TrippedError
        As `calibrate_force` and `ManualControl.jog`; nothing is stored then.
    """
    setup = resolve_rig(**choices)
    folder = _require_lab(setup)
    require_text(operator=operator, note=note)
    _require_repeats(repeats, duration_s)
    if not isfinite(travel_mm) or travel_mm == 0:
        raise SettingsError(f"travel_mm = {travel_mm:g}: must be a distance other than 0.")
    require_speed(speed_mm_s, setup.limits)
    if abs(travel_mm) > setup.limits.highest_mm - setup.limits.lowest_mm:
        raise SettingsError(
            f"travel_mm = {travel_mm:g}: is longer than the stage's range from {setup.limits.lowest_mm:g} to "
            f"{setup.limits.highest_mm:g} mm (stage.lowest_mm and highest_mm of the rig file)."
        )
    if measured_mm and (len(measured_mm) != repeats or any(measured * travel_mm <= 0 for measured in measured_mm)):
        raise SettingsError(
            f"measured_mm: needs one value of the travel's sign for each of {repeats} repeats, and there are "
            f"{len(measured_mm)}."
        )
    known = setup.calibrations().get("encoder")
    count_mm = known.gain if known is not None else 1e-3 * setup.rig.encoder.resolution_um

    def work(bench: OpenRig) -> SensorCalibration[TravelReading]:
        bench.manual.reset()
        if by_hand:
            travels = measured_mm or [travel_mm if repeat % 2 == 0 else -travel_mm for repeat in range(repeats)]
            points = tuple(measure_pushed_travel(bench.backend, bench.manual, travels, duration_s))
        else:
            points = tuple(measure_driven_travel(bench.manual, count_mm, travel_mm, speed_mm_s, measured_mm, repeats))
        line = fit_encoder([point.travel_mm for point in points], [point.counts for point in points])
        notes = _encoder_notes(line, setup, known_travel=by_hand or bool(measured_mm))
        entry = _calibration_entry("encoder", line, bench, operator, (note, *notes))
        if store:
            append_calibration(folder, entry)
        return SensorCalibration(entry, line, points, notes)

    return run_on_bench(work, setup, pace, person, begun)


def store_calibration(entry: Calibration, **choices: Unpack[RigChoices]) -> None:
    """Add a calibration that was made without `store` to the lab's history; it applies from then on.

    Raises
    ------
    SettingsError, OutputError
        Outside of a lab folder, and when the history cannot be written.
    """
    append_calibration(_require_lab(resolve_rig(**choices)), entry)


def _encoder_notes(line: CalibrationLine, setup: RigSetup, *, known_travel: bool) -> tuple[str, ...]:
    notes = []
    resolution_um = setup.rig.encoder.resolution_um
    if abs(1e3 * line.gain / resolution_um - 1) > _MAX_COUNT_DEVIATION:
        notes.append(f"a count of {1e3 * line.gain:.5g} µm is not encoder.resolution_um = {resolution_um:g}")
    if not known_travel:
        notes.append("the travel is that of the drive; measure it with a gauge for an independent calibration")
    return tuple(notes)


def _require_lab(setup: RigSetup, command: str = "calibrate") -> Path:
    if setup.rig_folder is None:
        raise SettingsError(f"{command}: there is no lab folder to store the result in; make one with dragrig init.")
    return setup.rig_folder


def _require_repeats(repeats: int, duration_s: float) -> None:
    if not 1 <= repeats <= _MAX_REPEATS or not 0 < duration_s <= _MAX_DURATION_S:
        raise SettingsError(
            f"repeats = {repeats}, seconds = {duration_s:g}: allowed are 1 to {_MAX_REPEATS} repeats of up to "
            f"{_MAX_DURATION_S:g} s."
        )


def _calibration_entry(
    quantity: str, line: CalibrationLine, bench: OpenRig, operator: str, notes: Sequence[str]
) -> Calibration:
    now = bench.backend.clock.now()
    return Calibration(
        id=f"{quantity}-{now:%Y%m%d-%H%M%S}-{now.microsecond // 1000:03d}",
        made_at=now,
        made_on=bench.setup.made_on,
        quantity=quantity,
        operator=operator,
        note="; ".join(filter(None, notes)),
        **asdict(line),
    )
