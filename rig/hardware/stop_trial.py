"""The trial of the stops past the drive's serial link: they are taken away, and the drive has to go off.

At a standstill, and over 2 mm at 1 mm/s: few drives show at a standstill that they would stop when they hear nothing.
"""

import time
from collections.abc import Iterator

from dragrig.config import DeviceError, RigSettings, reason_of
from dragrig.rig import RELAY_BEATS, Clock, RigCheck, StopName
from dragrig.rig.hardware.dialects import Dialect, Lack
from dragrig.rig.hardware.drive import MonitoredStage, PositionModeStage
from dragrig.rig.hardware.lines import CardLines

CREEP_MM = 2.0
CREEP_SPEED_MM_S = 1.0
_MOST_MM = 1.5
"""What the longest trial may take of `CREEP_MM`; the rest is for the stop after a trial that failed."""
_SET_OUT_MM = 0.05
_SET_OUT_S = 1.0
_WAIT_S = 1.0
"""How long a relay or a drive may take to go off, at least."""
_POLL_S = 0.005
_SILENCE_MARGIN_S = 0.3
_MIN_SILENCE_SHARE = 0.5
_MIN_SEEN_S = 1e-3
_ABSENT = {
    StopName.ENABLE: "not wired (hardware.card.lines.enable is empty): only the serial line switches the drive",
    StopName.RELAY: "not wired (hardware.card.lines.heartbeat is empty): a killed program takes no power away",
    StopName.WATCHDOG: "a drive of this dialect has none, so that relay and enable line alone stop it",
}


class StopTrial:
    """Takes enable line, heartbeat and requests away from a drive that is on, and looks whether it goes off."""

    def __init__(
        self, rig: RigSettings, stage: MonitoredStage, lines: CardLines, clock: Clock, dialect: Dialect
    ) -> None:
        self._rig, self._stage, self._lines, self._clock, self._dialect = rig, stage, lines, clock, dialect
        self._wired = rig.hardware.card.lines
        self._quiet_s = rig.hardware.drive.silence_s + _SILENCE_MARGIN_S
        self._relay_wait_s = _WAIT_S + RELAY_BEATS * self._wired.heartbeat_s
        longest_s = max(self._quiet_s, self._relay_wait_s)
        self._speed_mm_s = min(CREEP_SPEED_MM_S, _MOST_MM / longest_s)
        self._in_motion = False

    def run(self, *, in_motion: bool) -> Iterator[RigCheck]:
        """Yield a finding for each stop; a device that fails ends the trial with one."""
        self._in_motion = in_motion
        for name, is_there, trial in (
            (StopName.ENABLE, bool(self._wired.enable), self._try_enable),
            (StopName.RELAY, bool(self._wired.heartbeat), self._try_relay),
            (StopName.WATCHDOG, Lack.SILENCE_TIMEOUT not in self._dialect.lacks, self._try_silence),
        ):
            if not is_there:
                if not in_motion:
                    yield RigCheck(name.value, True, _ABSENT[name])
                continue
            try:
                self._switch_on()
                try:
                    yield trial()
                finally:
                    self._stage.disable()
            except DeviceError as error:
                yield RigCheck(self._label(name), False, reason_of(error))
                return

    def _switch_on(self) -> None:
        stage = self._stage
        stage.enable()
        if not self._in_motion or not isinstance(stage, PositionModeStage):
            return
        from_mm, until_s = stage.state().position_mm, time.monotonic() + _SET_OUT_S
        stage.creep(CREEP_MM, self._speed_mm_s)
        while abs(stage.state().position_mm - from_mm) < _SET_OUT_MM:
            if time.monotonic() > until_s:
                raise DeviceError("the stage did not set out: check the motor's power, and whether it is blocked.")
            time.sleep(_POLL_S)

    def _try_enable(self) -> RigCheck:
        from_mm, from_s = self._stage.state().position_mm, time.monotonic()
        self._lines.set_enable(False)
        off_s = self._await_off(_WAIT_S)
        if off_s is None:
            return self._missing(
                StopName.ENABLE,
                f"the drive stays on when {self._wired.enable} goes low: check the wire, and the drive's setting of "
                "this input; without it, nothing but the serial line switches the drive off",
            )
        self._refuse_late_beats(from_s)
        return self._found(StopName.ENABLE, off_s - from_s, "its enable line went low", from_mm)

    def _try_relay(self) -> RigCheck:
        from_mm = self._stage.state().position_mm
        with self._stage.withholding(beats=True):
            off_s = self._await_off(self._relay_wait_s)
            from_s = self._stage.last_beat_s
            # Before the next beat, which would give power back to a drive that is still told to move.
            self._stage.disable()
        if off_s is None:
            return self._missing(
                StopName.RELAY,
                f"the drive stays on without edges on {self._wired.heartbeat}: check the relay, and that its contact "
                "is in the drive's motor power or its enable chain; without it, nothing takes the drive's power when "
                "the program is killed",
            )
        return self._found(StopName.RELAY, off_s - from_s, f"the last edge on {self._wired.heartbeat}", from_mm)

    def _try_silence(self) -> RigCheck:
        with self._stage.withholding(polls=True):
            before, from_s, model_s = self._stage.state(), time.monotonic(), self._clock.monotonic()
            self._keep_quiet()
            passed_s = time.monotonic() - from_s
            pace = (self._clock.monotonic() - model_s) / passed_s
            after = self._stage.state()
        if not self._in_motion and after.enabled:
            stays = "shows in motion only: at a standstill the drive stays on when it hears nothing, as most do"
            return RigCheck(StopName.WATCHDOG.value, True, stays)
        if self._in_motion and after.moving:
            return self._missing(
                StopName.WATCHDOG,
                f"the drive went on for {passed_s:.2f} s without a request, although it holds a silence timeout of "
                f"{self._rig.hardware.drive.silence_s:g} s: set up what it does then, or wire a heartbeat relay "
                "(hardware.card.lines.heartbeat)",
            )
        self._refuse_late_beats(from_s)
        travel_mm = abs(after.position_mm - before.position_mm)
        took_s = travel_mm / (self._speed_mm_s * pace) if self._in_motion else passed_s
        if took_s < _MIN_SILENCE_SHARE * self._rig.hardware.drive.silence_s:
            raise DeviceError(
                f"the stage stopped {took_s:.2f} s after the last request, sooner than hardware.drive.silence_s: see "
                "what else stopped it, and try again."
            )
        heard = "the last request (hardware.drive.silence_s)"
        return self._found(StopName.WATCHDOG, took_s, heard, before.position_mm)

    def _refuse_late_beats(self, from_s: float) -> None:
        """End a trial in which the relay may have stopped the drive, because this computer stood still."""
        if self._wired.heartbeat and self._stage.beat_late_since(from_s):
            raise DeviceError("the heartbeat came late and may have stopped the drive: end other programs, try again.")

    def _keep_quiet(self) -> None:
        until_s = time.monotonic() + self._quiet_s
        while time.monotonic() < until_s:
            self._refuse_pressed()
            time.sleep(_POLL_S)

    def _refuse_pressed(self) -> None:
        """End the trial at a switch: it stops the drive too, and nobody else may look meanwhile."""
        pressed = self._lines.read_switches().trip()
        if pressed is not None:
            self._stage.stop()
            raise DeviceError(f"{pressed.message}: remove the cause, and try again.")

    def _await_off(self, within_s: float) -> float | None:
        """Return when the drive was first seen to be off, as of `time.monotonic`; None where it stays on."""
        until_s = time.monotonic() + within_s
        while self._stage.state().enabled:
            self._refuse_pressed()
            if time.monotonic() > until_s:
                return None
            time.sleep(_POLL_S)
        off_s = time.monotonic()
        self._refuse_pressed()
        return off_s

    def _found(self, name: StopName, took_s: float, since: str, from_mm: float) -> RigCheck:
        went = f", and {abs(self._stage.state().position_mm - from_mm):.2f} mm on" if self._in_motion else ""
        verb = "stops by itself" if name is StopName.WATCHDOG else "goes off"
        detail = f"the drive {verb} {took_s:.2f} s after {since}{went}"
        return RigCheck(self._label(name), True, detail, max(took_s, _MIN_SEEN_S))

    def _missing(self, name: StopName, why: str) -> RigCheck:
        self._stage.stop()
        return RigCheck(self._label(name), False, why)

    def _label(self, name: StopName) -> str:
        return name.in_motion if self._in_motion else name.value
