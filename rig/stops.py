"""The stops of a stage that its program cannot stop any more, and how far the stage goes until then.

The serial cable fails, and the program takes enable line and heartbeat away; or the program itself is stopped or
killed, and the card holds its enable line. Nothing is assumed to be wired: `dragrig check --live` proves each stop, or
finds it missing; before that, it is a claim of the settings, and called so.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import floor, inf, isfinite, sqrt

import numpy as np

from dragrig.config import CommissioningRecord, RigCheck, RigSettings
from dragrig.rig.devices import STANDSTILL_SPEED_MM_S, StageLimits
from dragrig.rig.profile import MotionExtremes, MotionProfile

RELAY_BEATS = 3
"""How many missed beats open a heartbeat relay, unless its own time was measured."""
RELEASE_S = 0.1
"""How long after `hardware.drive.silence_s` a drive that is heard no more has lost enable line and heartbeat."""
HAND_S = 5.0
"""What counts for a person who sees that the stage does not stop, and presses the e-stop."""
COASTING_MM_S2 = 250.0
"""Deceleration without current, by the friction of the guide alone: 0.3 N on 1.2 kg."""
MIN_APPROACH_MM_S = 1.0
"""No way to a run's start is made more slowly: from there a hand is soon enough."""
_LATE_S = 0.1
"""What is later than this beyond what the settings claim does not act as soon as claimed."""
_POINTS_PER_PIECE = 33
_MIN_ALLOWED_MM_S = 0.1
_SHORTER_SILENCE = "lower hardware.drive.silence_s"


class StopName(StrEnum):
    """A signal of the commissioning record that stops the stage past its serial link."""

    ENABLE = "enable"
    RELAY = "relay"
    WATCHDOG = "watchdog"

    @property
    def in_motion(self) -> str:
        """Name of the signal that was tried in motion."""
        return f"{self.value} in motion"


class Failure(StrEnum):
    """The failures that keep the program from stopping the stage."""

    PROGRAM = "the program is stopped or killed"
    LINK = "the serial cable fails"


@dataclass(frozen=True, slots=True)
class Stop:
    """The stop that ends a motion after a failure."""

    until: str
    """In words that go on after "until"."""
    after_s: float
    """From the failure to the beginning of the stop."""
    deceleration_mm_s2: float
    proven: bool = False
    """Whether `dragrig check --live` has seen it, or it is the program's own."""
    timely: bool = True
    """Whether it acts as soon as claimed. In position mode the end of the stroke counts as a stop until then, and no
    longer: a stage that nothing else stops would be left to its drive alone."""
    by_hand: bool = False
    """Whether nothing but a person is left."""
    because: str = field(default="", compare=False)
    """Why nothing else is."""
    remedy: str = field(default="", compare=False)
    """What would make its way shorter."""

    @property
    def ends(self) -> str:
        """The stop that ends the motion, and why no other does, in words that go on after "until"."""
        return f"{self.until} ({self.because})" if self.because else self.until

    def way_mm(self, speed_mm_s: float) -> float:
        """Return how far the stage goes on at a speed, without a sign."""
        return speed_mm_s * self.after_s + speed_mm_s**2 / (2 * self.deceleration_mm_s2)

    def speed_mm_s(self, room_mm: float) -> float:
        """Return the greatest speed with a way that fits into a room."""
        deceleration, after_s = self.deceleration_mm_s2, self.after_s
        return deceleration * (sqrt(after_s**2 + 2 * max(room_mm, 0.0) / deceleration) - after_s)


@dataclass(frozen=True, slots=True)
class Stops:
    """The stop that ends a motion after each failure."""

    on_program: Stop
    on_link: Stop

    def __iter__(self) -> Iterator[tuple[str, Stop]]:
        """Yield each stop with its failures in words that go on after "if"."""
        if self.on_program == self.on_link:
            yield f"{Failure.PROGRAM}, or {Failure.LINK}", self.on_link
        else:
            yield Failure.PROGRAM.value, self.on_program
            yield Failure.LINK.value, self.on_link

    def approach_speed_mm_s(self, room_mm: float) -> float:
        """Return the greatest speed of a way to a place that is so far from the end beyond it; never below 1 mm/s."""
        late = [stop.speed_mm_s(room_mm) for _, stop in self if not stop.timely]
        return max(MIN_APPROACH_MM_S, min(late, default=inf))


def assess_stops(rig: RigSettings, record: CommissioningRecord | None, *, has_timeout: bool) -> Stops:
    """Return the stop that ends a motion: the soonest proven one, else that of the settings, else a person.

    Parameters
    ----------
    record
        The finding of a look at this wiring; None where nobody has looked.
    has_timeout
        Whether the drive's dialect has a silence timeout.
    """
    lines = rig.hardware.card.lines
    seen = {name: _seen_s(record, name) for name in StopName}
    there = {
        StopName.WATCHDOG: has_timeout,
        StopName.RELAY: bool(lines.heartbeat),
        StopName.ENABLE: bool(lines.enable),
    }
    claimed = {
        name: _claimed_stops(rig, name, seen_s) for name, seen_s in seen.items() if there[name] and seen_s is not None
    }
    # In the order in which claims are believed.
    names = StopName.WATCHDOG, StopName.RELAY, StopName.ENABLE
    on_program = [claimed[name][Failure.PROGRAM] for name in names if Failure.PROGRAM in claimed.get(name, {})]
    on_link = [claimed[name][Failure.LINK] for name in names if name in claimed]
    if rig.hardware.drive.mode == "velocity":
        on_link = [_ramp_of_voltage(rig)]
    hands = _hand(seen, there, names[:2]), _hand(seen, there, names)
    return Stops(_chosen(on_program, hands[0]), _chosen(on_link, hands[1]))


def _claimed_stops(rig: RigSettings, name: StopName, seen_s: float) -> dict[Failure, Stop]:
    """Return how a stop ends a motion after each failure; `seen_s` is 0 where it was not tried."""
    drive, lines, proven = rig.hardware.drive, rig.hardware.card.lines, seen_s > 0
    released_s = drive.silence_s + RELEASE_S
    heard = f"the drive has heard nothing for {drive.silence_s:g} s (hardware.drive.silence_s)"
    if name is StopName.WATCHDOG:
        timely, took_s = seen_s <= drive.silence_s + _LATE_S, max(seen_s, drive.silence_s)
        stop = Stop(heard, took_s, rig.stage.stop_accel_mm_s2, proven, timely, remedy=_SHORTER_SILENCE)
        return {Failure.PROGRAM: stop, Failure.LINK: stop}
    if name is StopName.ENABLE:
        until, timely = f"{heard} and its enable line has gone low", seen_s <= _LATE_S
        stop = Stop(until, released_s + seen_s, COASTING_MM_S2, proven, timely, remedy=_SHORTER_SILENCE)
        return {Failure.LINK: stop}
    claimed_s = RELAY_BEATS * lines.heartbeat_s
    timely, took_s = seen_s <= claimed_s + _LATE_S, seen_s or claimed_s
    opens = f"its heartbeat relay opens, {took_s:.2g} s after the last edge"
    alone = Stop(opens, took_s, COASTING_MM_S2, proven, timely, remedy="use a faster relay")
    return {
        Failure.PROGRAM: alone,
        Failure.LINK: replace(alone, until=f"{heard} and {opens}", after_s=released_s + took_s),
    }


def _ramp_of_voltage(rig: RigSettings) -> Stop:
    """Return how the program itself stops the stage in velocity mode, once the voltages written ahead are put out."""
    drive = rig.hardware.drive
    after_s = drive.silence_s / 2 + drive.velocity.update_s * (drive.velocity.ahead + 1)
    until = "the program has brought its voltage down"
    return Stop(until, after_s, rig.stage.stop_accel_mm_s2, proven=True, remedy=_SHORTER_SILENCE)


def _chosen(stops: list[Stop], hand: Stop) -> Stop:
    proven = [stop for stop in stops if stop.proven]
    if proven:
        return min(proven, key=lambda stop: stop.after_s)
    return stops[0] if stops else hand


def _seen_s(record: CommissioningRecord | None, name: StopName) -> float | None:
    """Return the time that a stop was seen to take; 0 where it was not tried, None where it was found missing."""
    signals = [signal for signal in record.signals if signal.name in {name, name.in_motion}] if record else []
    if not all(signal.passed for signal in signals):
        return None
    return max((signal.after_s for signal in signals), default=0.0)


_ABSENT = {
    StopName.WATCHDOG: ("the drive has no silence timeout", "its silence timeout did not stop it"),
    StopName.RELAY: ("no heartbeat relay is set", "its heartbeat relay took no power"),
    StopName.ENABLE: ("no enable line is set", "it does not obey its enable line"),
}


def _hand(seen: dict[StopName, float | None], there: dict[StopName, bool], names: tuple[StopName, ...]) -> Stop:
    why = ", ".join(_ABSENT[name][there[name]] for name in names if not there[name] or seen[name] is None)
    wire = (
        "wire a heartbeat relay into its power (hardware.card.lines.heartbeat)"
        if not there[StopName.RELAY]
        else "bring the heartbeat relay's contact into its power"
    )
    until = f"somebody presses the e-stop, for which {HAND_S:g} s count"
    remedy = f"{wire} and have dragrig check --live prove it"
    return Stop(until, HAND_S, COASTING_MM_S2, timely=False, by_hand=True, because=why, remedy=remedy)


@dataclass(frozen=True, slots=True)
class RunOn:
    """Where a stage comes to when its program fails at the worst moment of a motion.

    In position mode it makes no more than the stroke that the drive was sent; in velocity mode its voltage stays.
    """

    stop: Stop
    distance_mm: float
    unstopped_mm: float
    """Without that stop: to the end of the stroke; infinite in velocity mode."""
    lowest_mm: float
    highest_mm: float
    """`lowest_mm`, `highest_mm`: relative to the start of the motion."""

    @classmethod
    def of(cls, profile: MotionProfile, rig: RigSettings, stop: Stop) -> "RunOn":
        """Return it for a motion from standstill."""
        ends_s = np.append(profile.start_s[1:], profile.duration_s)
        shares = np.linspace(0.0, 1.0, _POINTS_PER_PIECE)
        time_s = (profile.start_s[:, None] + (ends_s - profile.start_s)[:, None] * shares).ravel()
        position, velocity = profile.position(time_s), profile.velocity(time_s)
        way = velocity * stop.after_s + velocity * np.abs(velocity) / (2 * stop.deceleration_mm_s2)
        on, unstopped_mm = way, inf
        if rig.hardware.drive.mode == "position":
            standing = np.abs(velocity) <= STANDSTILL_SPEED_MM_S
            standing[-1] = True
            stops = np.flatnonzero(standing)
            left = position[stops[np.searchsorted(stops, np.arange(len(position)))]] - position
            unstopped_mm = float(np.abs(left).max())
            on = left if stop.by_hand else np.sign(velocity) * np.minimum(np.abs(way), np.abs(left))
        reached = position + (on if stop.timely else way)
        return cls(stop, float(np.abs(on).max()), unstopped_mm, float(reached.min()), float(reached.max()))

    def violations(self, failure: str, extremes: MotionExtremes, start_mm: float, limits: StageLimits) -> Iterator[str]:
        """Say where only the run-on leaves the soft limits, which speed would not, and which wire is needed."""
        low_mm, high_mm = start_mm + extremes.lowest_mm, start_mm + extremes.highest_mm
        for reached_mm, limit_mm, room_mm, beyond_mm in (
            (start_mm + self.lowest_mm, limits.lowest_mm, low_mm - limits.lowest_mm, -self.lowest_mm),
            (start_mm + self.highest_mm, limits.highest_mm, limits.highest_mm - high_mm, self.highest_mm),
        ):
            if room_mm < 0 or beyond_mm <= abs(limit_mm - start_mm):
                continue
            allowed = floor(self.stop.speed_mm_s(room_mm) / _MIN_ALLOWED_MM_S) * _MIN_ALLOWED_MM_S
            lower = f"lower its speed to {allowed:g} mm/s, " if allowed >= _MIN_ALLOWED_MM_S else ""
            yield (
                f"would go on to {reached_mm:.1f} mm, beyond the limit of {limit_mm:g} mm, if {failure}, until "
                f"{self.stop.ends}: {lower}keep further off the end, or {self.stop.remedy}"
            )


def run_on_remark(failure: str, run_on: RunOn, speed_mm_s: float) -> str:
    """Say how far the stage goes on after a failure, and whether anybody has seen it stopped."""
    stop, unstopped_mm = run_on.stop, run_on.unstopped_mm
    end = ", never beyond the end of its stroke" if isfinite(unstopped_mm) else ""
    text = (
        f"if {failure}, the stage goes on, at up to {speed_mm_s:g} mm/s by up to {run_on.distance_mm:.1f} mm{end}, "
        f"until {stop.ends}"
    )
    if stop.proven or stop.by_hand:
        return text
    without = f"by up to {unstopped_mm:.1f} mm" if isfinite(unstopped_mm) else "until somebody presses the e-stop"
    return f"{text}; that is set but untried, and without it {without} (dragrig check --live tries it)"


def check_stops(rig: RigSettings, stops: Stops) -> RigCheck:
    """Check whether anything but a person ends a motion after a failure, and say how far the stage goes until then."""
    speed_mm_s, travel_mm = rig.stage.max_speed_mm_s, rig.stage.highest_mm - rig.stage.lowest_mm
    by_strokes = rig.hardware.drive.mode == "position"
    said = []
    for failure, stop in stops:
        way_mm = inf if stop.by_hand and by_strokes else stop.way_mm(speed_mm_s)
        far = f"by {way_mm:.0f} mm" if way_mm < travel_mm else "to an end of its travel"
        end = ", or of its stroke" if by_strokes else ""
        tried = "" if stop.proven or stop.by_hand else f", untried: without it to an end of its travel{end}"
        said.append(f"if {failure}, it goes on {far}{end if way_mm >= travel_mm else ''}, until {stop.ends}{tried}")
    untried = any(not stop.proven and not stop.by_hand for _, stop in stops)
    by_hand = [stop for _, stop in stops if stop.by_hand]
    advice = f": {by_hand[0].remedy}" if by_hand else " (dragrig check --live tries it)" if untried else ""
    return RigCheck("way without program", not by_hand, f"at {speed_mm_s:g} mm/s: {'; '.join(said)}{advice}")
