"""Hidden effects of the motor and of the acquisition."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dragrig.sim_backend.blind.effects.base import Draw, Effect, Phase, Scene
from dragrig.sim_backend.blind.effects.linear import delayed, first_order, low_pass
from dragrig.sim_backend.blind.motion import Floats, Motion


@dataclass(frozen=True, slots=True)
class LagSecondOrder(Effect):
    """A stage that follows as a damped second-order system, of whose lag [s] an integrator takes a share away."""

    name, form, channel = "servo_lag", "second order, integrated away", "position"
    amplitude: Annotated[float, Draw(0.030, 0.110, log=True)]
    damping: Annotated[float, Draw(0.9, 1.3)]
    integral_s: Annotated[float, Draw(0.5, 1.5, log=True)]
    share: Annotated[float, Draw(0.45, 0.7)]

    def motion(self, motion: Motion, scene: Scene) -> Motion:
        """Return the true motion."""
        if not self.amplitude:
            return motion
        time_s = self.amplitude / (2 * self.damping)

        def follow(values: Floats) -> Floats:
            behind = values - low_pass(values, time_s, self.damping, motion.t)
            return values - behind + self.share * first_order(behind, self.integral_s, motion.t)

        return Motion(motion.t, follow(motion.p), follow(motion.v), follow(motion.a))


@dataclass(frozen=True, slots=True)
class LagDeadTime(Effect):
    """A stage that starts late and follows through two poles, later at speed as its voltage runs out."""

    name, form, channel = "servo_lag", "dead time, grows with speed", "position"
    amplitude: Annotated[float, Draw(0.030, 0.110, log=True)]
    dead: Annotated[float, Draw(0.2, 0.5)]
    grows: Annotated[float, Draw(0.6, 1.0)]

    def motion(self, motion: Motion, scene: Scene) -> Motion:
        """Return the true motion."""
        if not self.amplitude:
            return motion
        lag = self.amplitude * (scene.run.peak_mm_s / 40.0) ** self.grows
        late, time_s = self.dead * lag, (1 - self.dead) * lag / 2
        p, v, a = (
            low_pass(delayed(one, late, motion.t), time_s, 1.0, motion.t) for one in (motion.p, motion.v, motion.a)
        )
        return Motion(motion.t, p, v, a)


@dataclass(frozen=True, slots=True)
class LagTwoTimes(Effect):
    """A stage that makes most of the way fast and creeps the rest within seconds; the fast lag is the amplitude [s].

    `share_1_s` is the share that creeps over the fast lag.
    """

    name, form, channel = "servo_lag", "fast, with a creeping rest", "position"
    amplitude: Annotated[float, Draw(0.030, 0.110, log=True)]
    share_1_s: Annotated[float, Draw(0.15, 0.3)]
    creep_s: Annotated[float, Draw(1.5, 3.0)]

    def motion(self, motion: Motion, scene: Scene) -> Motion:
        """Return the true motion."""
        if not self.amplitude:
            return motion
        slow = self.share_1_s * self.amplitude

        def follow(values: Floats) -> Floats:
            fast = low_pass(values, self.amplitude / 2, 1.0, motion.t)
            return (1 - slow) * fast + slow * first_order(values, self.creep_s, motion.t)

        return Motion(motion.t, follow(motion.p), follow(motion.v), follow(motion.a))


@dataclass(frozen=True, slots=True)
class RippleHarmonics(Effect):
    """Position error periodic in position, with two harmonics [mm]."""

    name, form, channel = "velocity_ripple", "two harmonics", "position"
    amplitude: Annotated[float, Draw(0.02, 0.08, log=True)]
    period_mm: Annotated[float, Draw(1.5, 6.0, log=True)]
    phase: Phase
    second: Annotated[float, Draw(0.2, 0.4)]
    second_phase: Phase

    def motion(self, motion: Motion, scene: Scene) -> Motion:
        """Return the true motion."""
        k = 2 * np.pi / self.period_mm
        terms = ((k, self.phase, 1.0), (2 * k, self.second_phase, self.second))
        return _rippled(motion, self.amplitude, terms)


@dataclass(frozen=True, slots=True)
class RippleSaw(Effect):
    """Position error that rises slowly and falls fast within each period, as teeth do."""

    name, form, channel = "velocity_ripple", "rounded saw", "position"
    amplitude: Annotated[float, Draw(0.02, 0.07, log=True)]
    period_mm: Annotated[float, Draw(2.0, 6.0, log=True)]
    phase: Phase
    decay: Annotated[float, Draw(0.35, 0.6)]

    def motion(self, motion: Motion, scene: Scene) -> Motion:
        """Return the true motion."""
        k = 2 * np.pi / self.period_mm
        terms = tuple((n * k, n * self.phase, self.decay ** (n - 1) / n) for n in (1, 2, 3, 4))
        return _rippled(motion, self.amplitude, terms)


@dataclass(frozen=True, slots=True)
class RippleTwoPeriods(Effect):
    """Position error of two periods that do not fit each other, of the poles and of the screw."""

    name, form, channel = "velocity_ripple", "two periods", "position"
    amplitude: Annotated[float, Draw(0.02, 0.06, log=True)]
    period_mm: Annotated[float, Draw(1.5, 4.0, log=True)]
    phase: Phase
    ratio: Annotated[float, Draw(1.3, 2.7)]
    second: Annotated[float, Draw(0.2, 0.35)]

    def motion(self, motion: Motion, scene: Scene) -> Motion:
        """Return the true motion."""
        k = 2 * np.pi / self.period_mm
        return _rippled(motion, self.amplitude, ((k, self.phase, 1.0), (k / self.ratio, 0.0, self.second)))


@dataclass(frozen=True, slots=True)
class LatencySpread(Effect):
    """Force late, or early, against position, not by the same time in every run [s]."""

    name, form, channel, rank = "channel_latency", "another in every run", "either", 3
    amplitude: Annotated[float, Draw(0.006, 0.020, log=True, signed=True)]
    spread: Annotated[float, Draw(0.3, 0.55)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        own = 1 + self.spread * scene.random("latency").uniform(-1.0, 1.0)
        return delayed(force, self.amplitude * own, scene.motion.t)


@dataclass(frozen=True, slots=True)
class LatencyAveraged(Effect):
    """Force late against position because the converter averages over some samples before it [s]."""

    name, form, channel, rank = "channel_latency", "moving average", "either", 3
    amplitude: Annotated[float, Draw(0.006, 0.020, log=True)]
    width: Annotated[float, Draw(0.5, 1.0)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        taps = np.linspace(-self.width, self.width, 9) * self.amplitude
        late = [delayed(force, self.amplitude + tap, scene.motion.t) for tap in taps.tolist()]
        return np.asarray(np.mean(late, axis=0))


@dataclass(frozen=True, slots=True)
class LatencyGrows(Effect):
    """Force that falls further behind position while a run lasts, as a filling buffer makes it."""

    name, form, channel, rank = "channel_latency", "growing", "either", 3
    amplitude: Annotated[float, Draw(0.006, 0.018, log=True)]
    time_s: Annotated[float, Draw(2.0, 10.0)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        t = scene.motion.t
        return delayed(force, self.amplitude * (1.5 - np.exp(-t / self.time_s)), t)


@dataclass(frozen=True, slots=True)
class ScaleBent(Effect):
    """Counts that are off by a part which swings along the scale, as a band that is not stuck down evenly has it."""

    name, form, channel = "encoder_scale", "uneven band", "position"
    amplitude: Annotated[float, Draw(0.002, 0.012, log=True, signed=True)]
    swing: Annotated[float, Draw(0.3, 0.5)]
    period_mm: Annotated[float, Draw(9.0, 25.0)]
    phase: Phase

    def position(self, position: Floats, force: Floats, scene: Scene) -> Floats:
        """Return the position the encoder sees."""
        swung = np.sin(2 * np.pi * position / self.period_mm + self.phase)
        return np.asarray(position * (1 + self.amplitude * (1 + self.swing * swung)))


@dataclass(frozen=True, slots=True)
class ScaleWarm(Effect):
    """Counts that are off by a part which grows as the scale warms up during the session."""

    name, form, channel = "encoder_scale", "warming", "position"
    amplitude: Annotated[float, Draw(0.002, 0.012, log=True, signed=True)]
    warming: Annotated[float, Draw(0.7, 0.95)]

    def position(self, position: Floats, force: Floats, scene: Scene) -> Floats:
        """Return the position the encoder sees."""
        return position * (1 + self.amplitude * (1 - self.warming * np.exp(-scene.session_s / 900.0)))


def _rippled(motion: Motion, amplitude: float, terms: tuple[tuple[float, float, float], ...]) -> Motion:
    """Return the motion with a sum of (wave number, phase, weight) added to its position; zero at its start."""
    p, v, a = motion.p.copy(), motion.v.copy(), motion.a.copy()
    for k, phase, weight in terms:
        turn, size = k * motion.p + phase, amplitude * weight
        p += size * (np.cos(turn) - np.cos(phase))
        v -= size * k * np.sin(turn) * motion.v
        a -= size * k * (np.sin(turn) * motion.a + k * np.cos(turn) * motion.v**2)
    return Motion(motion.t, p, v, a)


FORMS: tuple[type[Effect], ...] = (
    LagSecondOrder, LagDeadTime, LagTwoTimes, RippleHarmonics, RippleSaw, RippleTwoPeriods, LatencySpread,
    LatencyAveraged, LatencyGrows, ScaleBent, ScaleWarm,
)  # fmt: skip
