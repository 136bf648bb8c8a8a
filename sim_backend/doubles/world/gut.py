"""The force on the sensor during one sampling, for a motion that becomes known only as it happens."""

from collections.abc import Mapping

from dragrig.config.capsule import Capsule
from dragrig.config.model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.config.specimen import Fixture, Specimen
from dragrig.rig.arrays import AnyFloatArray
from dragrig.rig.devices import Acquisition, Contact
from dragrig.rig.profile import MotionProfile, Phase, still
from dragrig.sim_backend.devices.axis import Track
from dragrig.sim_backend.devices.faults import NO_FAULTS
from dragrig.sim_backend.devices.signals import Signals
from dragrig.sim_backend.doubles.world.carriage import Carriage

_AHEAD_S = 0.25
_FOREVER_S = 36_000.0


class Gut:
    """The simulated rig's force sensor and motor, fed with what the carriage really does.

    Parameters
    ----------
    acquisition
        What touches what; its profile says which way the first motion will go, and no more.
    """

    def __init__(self, rig: RigSettings, model: FrictionModelSettings, acquisition: Acquisition) -> None:
        self._rate_hz = rig.sampling.rate_hz
        self.acquisition = acquisition
        """What touches what."""
        self._signals = Signals(rig, model, acquisition, NO_FAULTS)
        self._fresh = True
        self._seen: Carriage | None = None
        self._waits_until_s = 0.0

    def fits(self, rate_hz: float) -> bool:
        """Whether it is for this sample rate and no sample was computed yet."""
        return rate_hz == self._rate_hz and self._fresh

    def compute(self, first: int, end: int, carriage: Carriage) -> Mapping[str, AnyFloatArray]:
        """Return force and motor force [mN] of samples `first` to before `end`; `first` never goes back."""
        self._fresh = False
        until_s = end / self._rate_hz
        if carriage.has_moved:
            if carriage is not self._seen:
                self._seen = carriage
                pieces = (*carriage.profile.pieces(), still(_FOREVER_S, Phase.HOLD))
                self._follow(MotionProfile.from_pieces(pieces))
        elif until_s > self._waits_until_s:
            self._expect_motion_after(until_s)
        return self._signals.compute(first, end, carriage.origin_mm)

    def _expect_motion_after(self, time_s: float) -> None:
        # A rest has the sign of the motion to come, so the plan's first motion is expected until it happens.
        planned = self.acquisition.profile.pieces()
        moving = [place for place, piece in enumerate(planned) if piece.acceleration_mm_s2]
        before = sum(piece.duration_s for piece in planned[: moving[0]]) if moving else 0.0
        self._waits_until_s = max(before, time_s + _AHEAD_S)
        rest = still(self._waits_until_s, Phase.REST)
        to_come = planned[moving[0] :] if moving else ()
        self._follow(MotionProfile.from_pieces((rest, *to_come, still(_FOREVER_S, Phase.HOLD))))

    def _follow(self, profile: MotionProfile) -> None:
        self._signals.follow(Track(profile, 0.0))


def alone() -> Acquisition:
    """Return what is sampled when nobody says what: a capsule that touches nothing."""
    return Acquisition(
        run_id="",
        order=0,
        kind="alone",
        profile=MotionProfile.from_pieces([still(1.0, Phase.REST)]),
        capsule=Capsule(name="none", surface="smooth", diameter_mm=12.9, length_mm=15.2, mass_g=50.0),
        specimen=Specimen(name="none"),
        fixture=Fixture.NONE,
        contact=Contact.NONE,
        insertion_dwell_s=0.0,
    )
