"""What the tests of the simulated rig share: a session, acquisitions, and reading to the end."""

import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.config.friction_model import FrictionModelSettings, parse_effects
from dragrig.config.rig import RigSettings
from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.devices import Acquisition, Backend, BackendRequest, Block, Contact
from dragrig.rig.profile import AnyFloatArray, MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.sim_backend.devices import SimulatedBackend, open_backend
from sim_faults import Faults

CAPSULE = Capsule(name="smooth", surface="smooth", diameter_mm=12.9, length_mm=15.2, mass_g=50.1)
NEVER = threading.Event()
QUICK = ("travel_mm=5", "hold_s=0.5", "rest_s=0.5")
"""Assignments that make a drag run of a second."""
PATIENT = {
    "guard": {"stale_data_s": 5.0},
    "hardware": {"hang_s": 5.0, "drive": {"reply_s": 2.0, "silence_s": 5.0}},
}
"""Settings of a rig that waits as long as may be set, for a busy machine is no fault."""


def stroke(
    travel_mm: float = 5.0, speed_mm_s: float = 50.0, accel_mm_s2: float = 2000.0, rest_s: float = 0.05,
    hold_s: float = 0.05,
) -> MotionProfile:  # fmt: skip
    return MotionProfile.from_pieces(
        (
            stationary_piece(rest_s, Phase.REST),
            *trapezoid(travel_mm, speed_mm_s, accel_mm_s2),
            stationary_piece(hold_s, Phase.HOLD),
        )
    )


class Handed(SimulatedBackend):
    """A simulated rig that asks for a person's hands, as the real one does."""

    @property
    def needs_hands(self) -> bool:
        return True


def rest(duration_s: float) -> MotionProfile:
    return MotionProfile.from_pieces([stationary_piece(duration_s, Phase.REST)])


def acquire(
    profile: MotionProfile, order: int = 0, kind: str = "drag", contact: Contact = Contact.SLIDING
) -> Acquisition:
    fixture = Fixture.NONE if contact is Contact.NONE else Fixture.FOAM
    return Acquisition(
        f"run-{order}-{kind}", order, kind, profile, CAPSULE, Specimen(name="jejunum"), fixture, contact, 60.0
    )


def settings(rate_hz: float = 1000.0, **groups: object) -> RigSettings:
    return RigSettings.model_validate({"sampling": {"rate_hz": rate_hz}, **groups})


def session(
    rig: RigSettings | None = None, faults: Faults | None = None, real_time: bool = False, effects: Sequence[str] = ()
) -> Backend:
    """A simulated rig, switched on and homed."""
    model = FrictionModelSettings(effects=parse_effects(effects))
    request = BackendRequest(rig or settings(), model, real_time=real_time)
    backend = open_backend(request, faults or Faults())
    backend.stage.enable()
    backend.stage.home()
    return backend


def begin(backend: Backend, acquisition: Acquisition) -> None:
    backend.sampler.arm(acquisition)
    backend.stage.move(acquisition.profile)
    backend.sampler.start()


def blocks(backend: Backend) -> Iterable[Block]:
    while (block := backend.sampler.read(NEVER)) is not None:
        yield block


@dataclass(repr=False)
class Recorded:
    """Blocks put together."""

    blocks: list[Block]

    def __getitem__(self, channel: str) -> AnyFloatArray:
        return np.concatenate([block.channels[channel] for block in self.blocks])

    @property
    def index(self) -> np.ndarray:
        return np.concatenate([np.arange(block.first_index, block.end_index) for block in self.blocks])

    def same_as(self, second: "Recorded") -> bool:
        names = self.blocks[0].channels.keys()
        return names == second.blocks[0].channels.keys() and all(
            self[name].dtype == second[name].dtype and np.array_equal(self[name], second[name]) for name in names
        )


def record(backend: Backend, acquisition: Acquisition, between: Callable[[int], None] = lambda _: None) -> Recorded:
    """Run an acquisition to its end; `between` is called with the number of blocks read so far."""
    begin(backend, acquisition)
    got = []
    for block in blocks(backend):
        got.append(block)
        between(len(got))
    backend.sampler.stop()
    return Recorded(got)
