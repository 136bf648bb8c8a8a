"""Calibrating force sensor and encoder on an open rig: what is applied, and what converter and counter say to it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from dragrig.config.errors import DeviceError
from dragrig.config.rig import RigSettings
from dragrig.rig.backend import Backend, Handled
from dragrig.rig.manual import Manual
from dragrig.rig.people import Prompt
from dragrig.rig.raw import RawReading

STANDARD_GRAVITY = 9.80665
"""Weight of a gram [mN]."""


@dataclass(frozen=True, slots=True)
class Weighing:
    """A weight on the sensor [g], its load [mN], and the reading."""

    weight_g: float
    load_mN: float
    reading: RawReading


@dataclass(frozen=True, slots=True)
class Stretch:
    """A known travel [mm], and what the encoder counted over it."""

    travel_mm: float
    counts: float


def weigh(
    backend: Backend, rig: RigSettings, manual: Manual, weights_g: Sequence[float], repeats: int, duration_s: float
) -> Iterator[Weighing]:
    """Have each weight hung on the sensor, up and down in turns, and read it.

    Raises
    ------
    DeviceError
        When the sensor is overloaded.
    AbortedError
        When the person says so.
    """
    for repeat in range(repeats):
        for weight_g in weights_g if repeat % 2 == 0 else weights_g[::-1]:
            what = f"Hang {weight_g:g} g on the sensor" if weight_g else "Take every weight off the sensor"
            manual.ask(Prompt(f"{what} and let it hang still", hands=backend.needs_hands))
            if isinstance(backend, Handled):
                backend.hang(weight_g * STANDARD_GRAVITY)
            reading = backend.sampler.measure(duration_s)
            if not abs(reading.force_V) < rig.hardware.card.force.overload_V:
                raise DeviceError(
                    f"at {weight_g:g} g the sensor gives {reading.force_V:.3f} V, where it counts as overloaded: take "
                    "lighter weights, or look at its wires."
                )
            yield Weighing(weight_g, weight_g * STANDARD_GRAVITY, reading)


def drive(
    manual: Manual, count_mm: float, travel_mm: float, speed_mm_s: float, measured_mm: Sequence[float], repeats: int
) -> Iterator[Stretch]:
    """Drive the stage there and back, and tell what the encoder counted over each way whose travel is known.

    Parameters
    ----------
    count_mm
        Length of a count as the sampler takes it now.
    measured_mm
        Travel of every way there as somebody measured it; where it is empty, the drive's word is taken for both ways.
    """
    manual.make_ready()
    for repeat in range(repeats):
        there = manual.travel(travel_mm, speed_mm_s) / count_mm
        yield Stretch(measured_mm[repeat] if measured_mm else travel_mm, there)
        back = manual.travel(-travel_mm, speed_mm_s) / count_mm
        if not measured_mm:
            yield Stretch(-travel_mm, back)


def push(backend: Backend, manual: Manual, travels_mm: Sequence[float], duration_s: float) -> Iterator[Stretch]:
    """Have the stage, switched off, pushed by known travels, and tell what the encoder counted."""
    backend.stage.disable()
    for travel_mm in travels_mm:
        way = f"{abs(travel_mm):g} mm {'up' if travel_mm > 0 else 'down'}"
        text = f"The stage is off. After this answer, push it {way} against a gauge, within {duration_s:g} s"
        manual.ask(Prompt(text, hands=backend.needs_hands))
        if isinstance(backend, Handled):
            backend.push(travel_mm, duration_s)
        reading = backend.sampler.measure(duration_s)
        yield Stretch(travel_mm, reading.counts_end - reading.counts_begin)
