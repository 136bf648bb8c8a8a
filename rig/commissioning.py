"""The guided look at a newly wired rig: a person pushes, presses and watches; each signal is judged.

Nothing is driven until the end, when its stops are taken away from the drive.

No program can know by itself which way the wires of a rig go: whether the encoder counts up where the stage
goes up, the sign of the force, which switch is which, and whether the drive obeys its enable line.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from math import isfinite
from operator import methodcaller
from pathlib import Path
from typing import Protocol, TypeAlias, runtime_checkable

from dragrig.config import (
    COMMISSIONING_FILE,
    CommissioningRecord,
    RigCheck,
    RigSettings,
    read_settings_file,
    to_toml,
)
from dragrig.rig.devices import SupportsBenchActions
from dragrig.rig.operator import Answer, Prompt, ignore
from dragrig.rig.runfile import replace_text
from dragrig.rig.stops import StopName

PUSH_MM = 20.0
"""How far a person is asked to push the carriage: well beyond what a bumped stage moves, and easy to judge by eye."""
_PUSH_WITHIN_S = 0.6
_FINGER_MN = 500.0
_VIEWS_OF_DOUBLE = 10
"""Half a second, for what a double does once the prompt is answered."""
_MAX_RATIO = 1.6
"""A push by eye is right to a third; a wrong decoding or signal period is a factor of 2, 4, ….

The bound lies between the two, where 20 mm shown as 12.5 or 32 mm would be equally badly judged and wired.
"""
_JITTER_COUNTS = 2
_MIN_PRESS_ACCURACIES = 4.0
"""Beyond the sensor's accuracy by so much, a change is a finger's."""
STANDSTILL_PROMPT = (
    "Hands out: the drive is switched on for a few seconds, and the stage holds where it stands, while enable line, "
    "heartbeat and the program's requests are taken away from it in turn"
)
MOTION_PROMPT = (
    "The same in motion, which alone shows whether the drive stops when it hears nothing: at most 2 mm at 1 mm/s for "
    "every stop. Path clear, and a hand at the e-stop; skip it if in doubt, and those stops stay unproven"
)
SWITCH_NAMES: Mapping[str, str] = {
    "e_stop": "e-stop",
    "limit_low": "lower limit switch",
    "limit_high": "upper limit switch",
}

_BenchAction: TypeAlias = Callable[[SupportsBenchActions], None]


@dataclass(frozen=True, slots=True)
class LiveView:
    """The card's readings at a moment at which nothing is driven."""

    force_V: float
    """Mean of the force input over a block."""
    force_mN: float
    counts: int
    """Since the look began, rising where the stage goes up."""
    pressed: frozenset[str]
    """Switches that read as pressed, as named in `hardware.card.lines`."""
    text: str = ""
    """All of it as a line for a person."""


class LiveRig(Protocol):
    """The signals of a rig while a person works on it; reading raises `DeviceError` when the card does not answer."""

    @property
    def wired_switches(self) -> tuple[str, ...]:
        """Switches that the settings name a line for."""

    @property
    def count_mm(self) -> float:
        """Length of an encoder's count in force."""

    def view(self) -> LiveView:
        """Read everything now."""


@runtime_checkable
class SupportsLiveLook(Protocol):
    """A backend with signals that a person can try out."""

    def look(self) -> AbstractContextManager[LiveRig]:
        """Open the card's signals; the drive is not needed."""

    def check_port(self) -> RigCheck:
        """List the serial ports that exist, and look whether the drive's is among them."""

    @property
    def creeps(self) -> bool:
        """Whether `try_stops` can try in motion: the drive makes strokes by itself."""

    def try_stops(self, *, in_motion: bool) -> Iterator[RigCheck]:
        """Switch the drive on, and take enable line, heartbeat and the program's requests away in turn.

        At a standstill, or at 1 mm/s over 2 mm at most. A device that fails is a finding.
        """


@dataclass(frozen=True, slots=True)
class Watched:
    """The readings from a request to a person until shortly after its answer."""

    before: LiveView
    views: tuple[LiveView, ...]

    @property
    def travel_counts(self) -> int:
        """Where the encoder came to, from where it was."""
        return self.views[-1].counts - self.before.counts

    @property
    def counted(self) -> bool:
        """Whether it counted at all, to and fro included."""
        return any(view.counts != self.before.counts for view in self.views)

    @property
    def force_change_mN(self) -> float:
        """The largest change of the force, with its sign."""
        changes = [view.force_mN - self.before.force_mN for view in self.views if isfinite(view.force_mN)]
        return max(changes, key=abs, default=0.0)

    @property
    def changed_switches(self) -> frozenset[str]:
        """Switches that read otherwise at some moment."""
        return frozenset().union(*(view.pressed ^ self.before.pressed for view in self.views))


def judge_rest(view: LiveView) -> RigCheck:
    """Judge the switches while nobody touches the rig."""
    if not view.pressed:
        return RigCheck("switches at rest", True, "none reads as pressed")
    names = " and ".join(SWITCH_NAMES[switch] for switch in SWITCH_NAMES if switch in view.pressed)
    return RigCheck(
        "switches at rest",
        False,
        f"reads as pressed: {names}. It is pressed, its wire is broken, or its contact is normally open: dragrig needs "
        "normally closed contacts between +5 V and the line",
    )


def judge_push(watched: Watched, count_mm: float, *, reversed_counts: bool) -> RigCheck:
    """Judge the encoder after a push towards the upper end by about `PUSH_MM`.

    Parameters
    ----------
    count_mm
        Length of a count in force.
    reversed_counts
        The setting `hardware.card.encoder.reversed`.
    """
    travel_mm = watched.travel_counts * count_mm
    if abs(watched.travel_counts) <= _JITTER_COUNTS:
        problem = (
            "counts to and fro by a count: one of A and B does not arrive"
            if watched.counted
            else "does not count: check its supply and line receiver, and hardware.card.encoder.a and b"
        )
    elif travel_mm < 0:
        problem = (
            f"shows {travel_mm:.3f} mm for a push up, so it counts the wrong way: swap A and B, or set "
            f"hardware.card.encoder.reversed = {str(not reversed_counts).lower()}"
        )
    elif not 1 / _MAX_RATIO <= travel_mm / PUSH_MM <= _MAX_RATIO:
        problem = (
            f"shows {travel_mm:.3f} mm for about {PUSH_MM:g} mm. If the push was right, encoder.resolution_um is off "
            f"by a factor of about {PUSH_MM / travel_mm:.2g}: it is a count after X4 decoding, a quarter of the signal "
            "period"
        )
    else:
        return RigCheck("encoder", True, f"counts up where the stage goes up, {travel_mm:.3f} mm in this push")
    return RigCheck("encoder", False, problem)


def judge_press(watched: Watched, accuracy_mN: float) -> RigCheck:
    """Judge the force sensor after a press in the direction in which a gut holds the capsule back."""
    change_mN = watched.force_change_mN
    if abs(change_mN) < _MIN_PRESS_ACCURACIES * accuracy_mN:
        problem = (
            f"changed by {change_mN:.1f} mN: check the sensor's plug, the supply of its bridge and amplifier, and "
            "hardware.card.force.channel"
        )
    elif change_mN < 0:
        problem = (
            f"fell by {-change_mN:.0f} mN where it has to rise: swap the sensor's signal wires, or change the sign of "
            "hardware.card.force.per_V, and calibrate again"
        )
    else:
        return RigCheck("force", True, f"rose by {change_mN:.0f} mN, the sign of a gut that resists")
    return RigCheck("force", False, problem)


def judge_switch(watched: Watched, switch: str, line: str) -> RigCheck:
    """Judge a switch after a person pressed and released it.

    Parameters
    ----------
    line
        The card's line of this switch, as in the settings.
    """
    name, changed = SWITCH_NAMES[switch], watched.changed_switches
    others = " and ".join(SWITCH_NAMES[seen] for seen in SWITCH_NAMES if seen in changed - {switch})
    if switch not in changed:
        problem = (
            f"{others} changed in its place: swap their wires, or their lines in hardware.card.lines"
            if others
            else f"nothing changed on {line}: check its wires and hardware.card.lines.{switch}"
        )
    elif others:
        problem = f"{others} changed with it: check for a short between their wires"
    elif switch in watched.before.pressed:
        problem = (
            "reads as pressed until it is pressed: its contact is normally open, or it was held; use the normally "
            "closed contact, between +5 V and the line, so that a broken wire stops the stage too"
        )
    else:
        return RigCheck(name, True, f"pressed and released on {line}")
    return RigCheck(name, False, problem)


class _Guide:
    """Asks a person for something, and watches the signals from then until shortly after the answer."""

    def __init__(self, live: LiveRig, bench: SupportsBenchActions | None, confirm: Callable[[Prompt], Answer]) -> None:
        self._live, self._bench, self._confirm = live, bench, confirm

    def watch(self, text: str, act: _BenchAction = ignore, undo: _BenchAction = ignore) -> Watched:
        """Return the readings; `act` and `undo` are a double's actions in the person's place."""
        before = self._live.view()
        views: list[LiveView] = []

        def look() -> LiveView:
            views.append(self._live.view())
            return views[-1]

        self._confirm(Prompt(text, look=look))
        look()
        if self._bench is not None:
            act(self._bench)
            for _ in range(_VIEWS_OF_DOUBLE):
                look()
            undo(self._bench)
            look()
        return Watched(before, tuple(views))


def look_at_rig(backend: SupportsLiveLook, rig: RigSettings, confirm: Callable[[Prompt], Answer]) -> Iterator[RigCheck]:
    """Guide a person through the rig, signal by signal, and yield the findings.

    Parameters
    ----------
    confirm
        Shows a prompt and returns whether it is done or, where that is allowed, skipped; raises where the person ends
        the look.

    Raises
    ------
    DeviceError
        When the card does not answer.
    """
    bench = backend if isinstance(backend, SupportsBenchActions) else None
    with backend.look() as live:
        guide = _Guide(live, bench, confirm)
        yield judge_rest(guide.watch("Hands off: nobody touches sensor, carriage or switches").views[-1])
        text = f"Push the carriage up, towards its highest position, by about {PUSH_MM:g} mm"
        pushed = guide.watch(text, lambda bench: bench.push(PUSH_MM, _PUSH_WITHIN_S))
        yield judge_push(pushed, live.count_mm, reversed_counts=rig.hardware.card.encoder.reversed)
        text = "Press the force sensor the way a gut pulls that holds the capsule back while the stage goes up; let go"
        pressed = guide.watch(text, lambda bench: bench.hang(_FINGER_MN), lambda bench: bench.hang(0.0))
        yield judge_press(pressed, rig.force_sensor.accuracy_mN)
        for switch in live.wired_switches:
            hold, release = (methodcaller("press", switch, on=on) for on in (True, False))
            touched = guide.watch(f"Press the {SWITCH_NAMES[switch]} for a second and release it", hold, release)
            yield judge_switch(touched, switch, getattr(rig.hardware.card.lines, switch))
    yield backend.check_port()
    confirm(Prompt(STANDSTILL_PROMPT))
    tried = ""
    for finding in backend.try_stops(in_motion=False):
        yield finding
        tried = finding.name
    # A device that failed at a standstill moves nothing.
    all_tried = tried == StopName.WATCHDOG
    if all_tried and backend.creeps and confirm(Prompt(MOTION_PROMPT, can_skip=True)) is Answer.DONE:
        yield from backend.try_stops(in_motion=True)


def wiring_key(rig: RigSettings) -> str:
    """Return a key of all that a look at the rig is about; another key means that the wiring has changed since."""
    card = rig.hardware.card
    wired = {
        "force": card.force.model_dump(include={"channel", "per_V"}),
        "encoder": card.encoder.model_dump(exclude={"filter_ns"}),
        "resolution_um": rig.encoder.resolution_um,
        "lines": card.lines.model_dump(exclude={"heartbeat_s"}),
        "drive": rig.hardware.drive.model_dump(include={"mode", "dialect"}),
    }
    return hashlib.sha256(json.dumps(wired, sort_keys=True).encode()).hexdigest()[:16]


def read_commissioning(folder: Path) -> CommissioningRecord | None:
    """Return the record of a lab folder, or None; raises `SettingsError`."""
    path = folder / COMMISSIONING_FILE
    return read_settings_file(CommissioningRecord, path) if path.is_file() else None


def write_commissioning(folder: Path, record: CommissioningRecord) -> Path:
    """Store a record in place of the one before; raises `OutputError`."""
    path = folder / COMMISSIONING_FILE
    replace_text(path, to_toml(record))
    return path
