"""Calibrations made and kept: the rig opened, a person guided, a line fitted, an entry added to the lab's history."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from math import isfinite
from pathlib import Path
from typing import Unpack

from dragrig.config.errors import SettingsError
from dragrig.config.lab import Calibration
from dragrig.handling import Bench, at_the_bench
from dragrig.pacing import Pace
from dragrig.rig import calibration
from dragrig.rig.calibrating import Stretch, Weighing, drive, push, weigh
from dragrig.rig.fitting import Line, encoder_line, force_line, require_loads
from dragrig.rig.manual import SPEED_MM_S, require_speed
from dragrig.rig.people import Operator
from dragrig.rigs import RigChoices, RigSetup, resolve_rig

_MOST_REPEATS = 100
_MOST_SECONDS = 600.0
_COUNT_OFF = 0.01
"""Part by which a count may differ from the encoder's resolution without a word."""


@dataclass(frozen=True, slots=True)
class ForceCalibration:
    """A calibration of the force sensor as it was kept, its points, and what a person should be told."""

    entry: Calibration
    line: Line
    points: tuple[Weighing, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class EncoderCalibration:
    """A calibration of the encoder as it was kept, its points, and what a person should be told."""

    entry: Calibration
    line: Line
    points: tuple[Stretch, ...]
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
    folder = _lab_of(setup)
    require_loads(weights_g)
    _require_measure(repeats, duration_s)

    def work(bench: Bench) -> ForceCalibration:
        rig = setup.rig
        points = tuple(weigh(bench.backend, rig, bench.manual, tuple(weights_g), repeats, duration_s))
        line = force_line([one.load_mN for one in points], [one.reading.force_V for one in points])
        notes = []
        if line.residual > rig.force_sensor.accuracy_mN:
            notes.append(
                f"the residual of {line.residual:.1f} mN is larger than the sensor's accuracy of "
                f"{rig.force_sensor.accuracy_mN:g} mN"
            )
        now = bench.backend.clock.now()
        entry = _entry("force", line, now, setup, rig.force_sensor.serial, operator, (note, *notes))
        calibration.append(folder, entry)
        return ForceCalibration(entry, line, points, tuple(notes))

    return at_the_bench(work, setup, pace, person)


def calibrate_encoder(
    travel_mm: float,
    *,
    measured_mm: Sequence[float] = (),
    repeats: int = 3,
    speed_mm_s: float = SPEED_MM_S,
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
    folder = _lab_of(setup)
    _require_measure(repeats, duration_s)
    if not isfinite(travel_mm) or travel_mm == 0:
        raise SettingsError(f"travel_mm = {travel_mm:g}: is no way to go.")
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

    def work(bench: Bench) -> EncoderCalibration:
        bench.manual.reset()
        if by_hand:
            travels = measured_mm or [travel_mm if repeat % 2 == 0 else -travel_mm for repeat in range(repeats)]
            points = tuple(push(bench.backend, bench.manual, travels, duration_s))
        else:
            points = tuple(drive(bench.manual, count_mm, travel_mm, speed_mm_s, measured_mm, repeats))
        line = encoder_line([one.travel_mm for one in points], [one.counts for one in points])
        notes = _notes_on_a_count(line, setup, known_travel=by_hand or bool(measured_mm))
        now = bench.backend.clock.now()
        entry = _entry("encoder", line, now, setup, "", operator, (note, *notes))
        calibration.append(folder, entry)
        return EncoderCalibration(entry, line, points, notes)

    return at_the_bench(work, setup, pace, person)


def _notes_on_a_count(line: Line, setup: RigSetup, *, known_travel: bool) -> tuple[str, ...]:
    notes = []
    resolution_um = setup.rig.encoder.resolution_um
    if abs(1e3 * line.gain / resolution_um - 1) > _COUNT_OFF:
        notes.append(f"a count of {1e3 * line.gain:.5g} µm is not encoder.resolution_um = {resolution_um:g}")
    if not known_travel:
        notes.append("the travel is the drive's word; measure it with a gauge to calibrate beyond that")
    return tuple(notes)


def _lab_of(setup: RigSetup) -> Path:
    if setup.rig_folder is None:
        raise SettingsError("calibrate: there is no lab folder to keep the result in; make one with dragrig init.")
    return setup.rig_folder


def _require_measure(repeats: int, duration_s: float) -> None:
    if not 1 <= repeats <= _MOST_REPEATS or not 0 < duration_s <= _MOST_SECONDS:
        raise SettingsError(
            f"repeats = {repeats}, seconds = {duration_s:g}: allowed are 1 to {_MOST_REPEATS} repeats of up to "
            f"{_MOST_SECONDS:g} s."
        )


def _entry(
    quantity: str, line: Line, now: datetime, setup: RigSetup, serial: str, operator: str, notes: Sequence[str]
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
