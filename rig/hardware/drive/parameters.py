"""What the settings write into the drive, so that it keeps to it whatever the program does."""

import time

from dragrig.config.rig import RigSettings
from dragrig.rig.devices import Clock, StageLimits
from dragrig.rig.hardware.dialects.base import Parameter
from dragrig.rig.hardware.drive.link import DriveLink
from dragrig.rig.hardware.drive.strokes import Stroke


def write_safeguards(link: DriveLink, settings: RigSettings) -> None:
    """Write thrust limit, silence timeout and the deceleration of a stop, and read each back.

    Raises
    ------
    DeviceError
        When the drive holds another value than the one that was written, refuses, or does not answer.
    """
    drive = settings.hardware.drive
    for parameter, value, key in (
        (Parameter.THRUST_LIMIT_N, drive.thrust_limit_N, "hardware.drive.thrust_limit_N"),
        (Parameter.SILENCE_S, drive.silence_s, "hardware.drive.silence_s"),
        (Parameter.STOP_ACCELERATION_MM_S2, settings.stage.stop_accel_mm_s2, "stage.stop_accel_mm_s2"),
    ):
        link.set_and_verify(parameter, value, key)


def write_travel(link: DriveLink, limits: StageLimits) -> None:
    """Write the soft limits and read them back; raises as `write_safeguards`."""
    link.set_and_verify(Parameter.LOWEST_MM, limits.lowest_mm, "stage.lowest_mm")
    link.set_and_verify(Parameter.HIGHEST_MM, limits.highest_mm, "stage.highest_mm")


def write_motion(link: DriveLink, settings: RigSettings, limits: StageLimits, first: Stroke, clock: Clock) -> float:
    """Write what a motion must keep to and its first stroke's speed, read it back, and return the link's round trip.

    The round trip is in the rig's time. Raises as `write_safeguards`.
    """
    began_s, wall_s = clock.monotonic(), time.perf_counter()
    write_safeguards(link, settings)
    write_travel(link, limits)
    for parameter, value, key in (
        (Parameter.SPEED_MM_S, first.speed_mm_s, "the motion's speed"),
        (Parameter.ACCELERATION_MM_S2, first.acceleration_mm_s2, "the motion's acceleration"),
    ):
        link.set_and_verify(parameter, value, key)
    pace = (clock.monotonic() - began_s) / (time.perf_counter() - wall_s)
    return link.round_trip_s * pace


def write_homing(link: DriveLink, settings: RigSettings) -> None:
    """Write what homing needs and read it back; raises as `write_safeguards`."""
    speed = settings.hardware.drive.homing_speed_mm_s
    link.set_and_verify(Parameter.HOMING_SPEED_MM_S, speed, "hardware.drive.homing_speed_mm_s")
