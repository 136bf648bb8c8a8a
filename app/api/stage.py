"""Move the stage by hand (home, jog, touch off) and calibrate force sensor and encoder."""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from math import isfinite
from pathlib import Path
from typing import TypeVar, Unpack

from dragrig.campaign_session import PromptRelay, run_on_worker
from dragrig.config.errors import AbortedError, DeviceError, SettingsError
from dragrig.config.rig import Calibration, ContactPoint
from dragrig.rig.devices import Backend, BackendRequest, TravelEnd, Trip
from dragrig.rig.engine import Engine
from dragrig.rig.guard import Guard
from dragrig.rig.lab_folder import append_calibration, write_contact
from dragrig.rig.manual import JOG_SPEED_MM_S, ManualControl, require_jog, require_speed, require_touch_off
from dragrig.rig.operator import NullOperator, Operator, park
from dragrig.rig.sensor_calibration import (
    CalibrationLine,
    MeasuredLoad,
    MeasuredTravel,
    fit_encoder,
    fit_force,
    measure_driven_travel,
    measure_loads,
    measure_pushed_travel,
    require_loads,
)
from dragrig.setup import Pace, RigChoices, RigSetup, open_backend, resolve_pace, resolve_rig

ResultT = TypeVar("ResultT")


@dataclass(frozen=True, slots=True)
class OpenRig:
    """An open rig, and what moves it by hand."""

    setup: RigSetup
    backend: Backend
    manual: ManualControl


@dataclass(frozen=True, slots=True)
class MoveResult:
    """Where the stage is [mm], and what the guard is tripped on still."""

    position_mm: float
    trip: Trip | None = None


def home(
    *,
    override: TravelEnd | None = None,
    pace: Pace | None = None,
    person: Operator | None = None,
    **choices: Unpack[RigChoices],
) -> MoveResult:
    """Find the stage's origin.

    Parameters
    ----------
    override
        Side whose limit switch is pressed and may be.
    pace
        Of a simulated rig, or of a double.
    person
        Who is asked before anything moves; nobody unless given, which will not do where hands are needed.
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

    return run_on_bench(work, resolve_rig(**choices), pace, person)


def jog(
    distance_mm: float,
    speed_mm_s: float | None = None,
    *,
    override: TravelEnd | None = None,
    pace: Pace | None = None,
    person: Operator | None = None,
    **choices: Unpack[RigChoices],
) -> MoveResult:
    """Move the stage by a signed distance; the rest as of `home` and `Manual.jog`."""

    def work(bench: OpenRig) -> MoveResult:
        if override is None:
            bench.manual.reset()
        return MoveResult(bench.manual.jog(distance_mm, speed_mm_s, override), bench.manual.trip)

    setup = resolve_rig(**choices)
    # Looked at before anybody is asked to do anything; so below.
    require_jog(distance_mm, speed_mm_s, override, setup.limits)
    return run_on_bench(work, setup, pace, person)


def touch_off(
    most_mm: float,
    *,
    force_mN: float = 20.0,
    speed_mm_s: float = 1.0,
    back_mm: float = 0.0,
    operator: str = "",
    pace: Pace | None = None,
    person: Operator | None = None,
    **choices: Unpack[RigChoices],
) -> ContactPoint:
    """Approach slowly until the force changes, and keep the contact in the lab folder; the rest as of `home`.

    Raises
    ------
    SettingsError
        Outside of a lab folder, too: nothing moves then.
    """
    setup = resolve_rig(**choices)
    folder = setup.rig_folder
    if folder is None:
        raise SettingsError("touch-off: there is no lab folder to keep the contact in; make one with dragrig init.")
    require_touch_off(force_mN, speed_mm_s, most_mm, back_mm, setup.limits)

    def work(bench: OpenRig) -> ContactPoint:
        bench.manual.reset()
        found = bench.manual.touch_off(force_mN, speed_mm_s, most_mm, back_mm)
        now = bench.backend.clock.now()
        kept = ContactPoint(
            position_mm=round(found.position_mm, 4), made_at=now, force_mN=round(found.force_mN, 2), operator=operator
        )
        write_contact(folder, kept)
        return kept

    return run_on_bench(work, setup, pace, person)


def run_on_bench(
    work: Callable[[OpenRig], ResultT], setup: RigSetup, pace: Pace | None = None, person: Operator | None = None
) -> ResultT:
    """Open a rig, do some work on it with Ctrl-C heard and people asked on the calling thread, and switch it off.

    Raises
    ------
    AbortedError
        When somebody ended it.
    DragrigError
        What the work raises; when the rig cannot be opened or switched off, too.
    """
    paced, operator = resolve_pace(pace, double=setup.double), PromptRelay(person or NullOperator())
    request = BackendRequest(
        setup.rig, setup.model, paced.real_time, None, setup.calibrations(), pace=paced.times_faster
    )
    with closing(open_backend(setup.backend, request, double=setup.double)) as backend:
        guard = Guard(setup.rig.guard, 1e-3 * setup.rig.encoder.resolution_um)
        engine = Engine(backend, setup.rig, guard)
        bench = OpenRig(setup, backend, ManualControl(backend, guard, engine, operator))
        try:
            done = run_on_worker(lambda: work(bench), engine.abort, operator)
        except (AbortedError, DeviceError) as error:
            if engine.cancelled.is_set():
                raise AbortedError(f"ended early ({engine.abort_reason}): the stage is stopped, and off.") from error
            raise
        finally:
            failures = park(backend)
        if failures:
            raise DeviceError(f"{'; '.join(failures)}.")
        return done


_MAX_REPEATS = 100
_MAX_DURATION_S = 600.0
_MAX_COUNT_DEVIATION = 0.01
"""Part by which a count may differ from the encoder's resolution without a word."""


@dataclass(frozen=True, slots=True)
class ForceCalibration:
    """A calibration of the force sensor as it was kept, its points, and what a person should be told."""

    entry: Calibration
    line: CalibrationLine
    points: tuple[MeasuredLoad, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class EncoderCalibration:
    """A calibration of the encoder as it was kept, its points, and what a person should be told."""

    entry: Calibration
    line: CalibrationLine
    points: tuple[MeasuredTravel, ...]
    notes: tuple[str, ...]


def calibrate_force(
    weights_g: Sequence[float],
    *,
    repeats: int = 1,
    duration_s: float = 2.0,
    operator: str = "",
    note: str = "",
    pace: Pace | None = None,
    person: Operator | None = None,
    **choices: Unpack[RigChoices],
) -> ForceCalibration:
    """Calibrate the force sensor with known weights and keep the result in the lab's history.

    Parameters
    ----------
    weights_g
        At least three distinct ones; 0 is the empty sensor.
    repeats
        How often all are hung on, up and down in turns.
    duration_s
        How long each is read.
    pace, person, choices
        As of `home`.

    Raises
    ------
    SettingsError
        Outside of a lab folder, for weights that make no line, and for readings that do not follow them.
    DeviceError, AbortedError
        When the sensor is overloaded or fails, and when the person says so; nothing is kept then.
    """
    setup = resolve_rig(**choices)
    folder = _require_lab(setup)
    require_loads(weights_g)
    _require_repeats(repeats, duration_s)

    def work(bench: OpenRig) -> ForceCalibration:
        rig = setup.rig
        points = tuple(measure_loads(bench.backend, rig, bench.manual, tuple(weights_g), repeats, duration_s))
        line = fit_force([one.load_mN for one in points], [one.reading.force_V for one in points])
        notes = []
        if line.residual > rig.force_sensor.accuracy_mN:
            notes.append(
                f"the residual of {line.residual:.1f} mN is larger than the sensor's accuracy of "
                f"{rig.force_sensor.accuracy_mN:g} mN"
            )
        now = bench.backend.clock.now()
        entry = _calibration_entry("force", line, now, setup, rig.force_sensor.serial, operator, (note, *notes))
        append_calibration(folder, entry)
        return ForceCalibration(entry, line, points, tuple(notes))

    return run_on_bench(work, setup, pace, person)


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
    pace: Pace | None = None,
    person: Operator | None = None,
    **choices: Unpack[RigChoices],
) -> EncoderCalibration:
    """Calibrate the encoder over a known travel and keep the result in the lab's history.

    Parameters
    ----------
    travel_mm
        Signed travel that the stage is driven, or pushed by hand.
    measured_mm
        What it really was at each repeat, where somebody measured it.
    by_hand
        Whether the stage is switched off and pushed, for `duration_s` each time.

    Raises
    ------
    SettingsError, DeviceError, AbortedError, TrippedError
        As `calibrate_force` and `Manual.jog`; nothing is kept then.
    """
    setup = resolve_rig(**choices)
    folder = _require_lab(setup)
    _require_repeats(repeats, duration_s)
    if not isfinite(travel_mm) or travel_mm == 0:
        raise SettingsError(f"travel_mm = {travel_mm:g}: must be a distance other than 0.")
    require_speed(speed_mm_s, setup.limits)
    if abs(travel_mm) > setup.limits.highest_mm - setup.limits.lowest_mm:
        raise SettingsError(
            f"travel_mm = {travel_mm:g}: is longer than the stage's way from {setup.limits.lowest_mm:g} to "
            f"{setup.limits.highest_mm:g} mm (stage.lowest_mm and highest_mm of the rig file)."
        )
    if measured_mm and (len(measured_mm) != repeats or any(one * travel_mm <= 0 for one in measured_mm)):
        raise SettingsError(
            f"measured_mm: needs one value of the travel's sign for each of {repeats} repeats, and there are "
            f"{len(measured_mm)}."
        )
    known = setup.calibrations().get("encoder")
    count_mm = known.gain if known is not None else 1e-3 * setup.rig.encoder.resolution_um

    def work(bench: OpenRig) -> EncoderCalibration:
        bench.manual.reset()
        if by_hand:
            travels = measured_mm or [travel_mm if repeat % 2 == 0 else -travel_mm for repeat in range(repeats)]
            points = tuple(measure_pushed_travel(bench.backend, bench.manual, travels, duration_s))
        else:
            points = tuple(measure_driven_travel(bench.manual, count_mm, travel_mm, speed_mm_s, measured_mm, repeats))
        line = fit_encoder([one.travel_mm for one in points], [one.counts for one in points])
        notes = _encoder_notes(line, setup, known_travel=by_hand or bool(measured_mm))
        now = bench.backend.clock.now()
        entry = _calibration_entry("encoder", line, now, setup, "", operator, (note, *notes))
        append_calibration(folder, entry)
        return EncoderCalibration(entry, line, points, notes)

    return run_on_bench(work, setup, pace, person)


def _encoder_notes(line: CalibrationLine, setup: RigSetup, *, known_travel: bool) -> tuple[str, ...]:
    notes = []
    resolution_um = setup.rig.encoder.resolution_um
    if abs(1e3 * line.gain / resolution_um - 1) > _MAX_COUNT_DEVIATION:
        notes.append(f"a count of {1e3 * line.gain:.5g} µm is not encoder.resolution_um = {resolution_um:g}")
    if not known_travel:
        notes.append("the travel is the drive's word; measure it with a gauge to calibrate beyond that")
    return tuple(notes)


def _require_lab(setup: RigSetup) -> Path:
    if setup.rig_folder is None:
        raise SettingsError("calibrate: there is no lab folder to keep the result in; make one with dragrig init.")
    return setup.rig_folder


def _require_repeats(repeats: int, duration_s: float) -> None:
    if not 1 <= repeats <= _MAX_REPEATS or not 0 < duration_s <= _MAX_DURATION_S:
        raise SettingsError(
            f"repeats = {repeats}, seconds = {duration_s:g}: allowed are 1 to {_MAX_REPEATS} repeats of up to "
            f"{_MAX_DURATION_S:g} s."
        )


def _calibration_entry(
    quantity: str,
    line: CalibrationLine,
    now: datetime,
    setup: RigSetup,
    serial: str,
    operator: str,
    notes: Sequence[str],
) -> Calibration:
    return Calibration(
        id=f"{quantity}-{now:%Y%m%d-%H%M%S}-{now.microsecond // 1000:03d}",
        made_at=now,
        made_on=setup.made_on,
        quantity=quantity,
        sensor_serial=serial,
        gain=line.gain,
        gain_error=line.gain_error,
        zero=line.zero,
        zero_error=line.zero_error,
        residual=line.residual,
        points=line.points,
        operator=operator,
        note="; ".join(one for one in notes if one),
    )
