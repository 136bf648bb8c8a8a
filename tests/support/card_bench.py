"""What the card's tests share: the real sampler before the card's double, and a witness of what the double gave."""

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field

import numpy as np

from card_server import CardServer
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import Calibration, RigSettings
from dragrig.rig.devices import Block
from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.card.sampler import CardSampler
from dragrig.rig.hardware.sync import MotionSamplingSync
from dragrig.rig.profile import AnyFloatArray, FloatArray, MotionProfile
from dragrig.sim_backend.doubles import c_library
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.simulated_bench import DoubleClock, SimulatedBench
from simulated import NEVER, acquire


class Witness(SimulatedBench):
    """A bench that keeps every sample that it was asked for."""

    seen: dict[str, dict[int, float]]

    def begin_sampling(self, rate_hz: float) -> None:
        self.seen = {}
        super().begin_sampling(rate_hz)

    def sample(self, first: int, end: int) -> Mapping[str, FloatArray]:
        sample = super().sample(first, end)
        for name, values in sample.items():
            self.seen.setdefault(name, {}).update(zip(range(first, end), values.tolist(), strict=True))
        return sample

    def at(self, name: str, index: np.ndarray) -> np.ndarray:
        return np.array([self.seen[name][entry] for entry in index.tolist()])


@dataclass
class CardRig:
    """A sampler, and a stage that follows by itself from the first sample on."""

    rig: RigSettings
    bench: Witness
    connection: Connection
    sampler: CardSampler
    sync: MotionSamplingSync
    _stages: list[threading.Thread] = field(default_factory=list)

    def begin(self, profile: MotionProfile, *, moves: bool = True) -> None:
        self.sampler.arm(acquire(profile))
        if moves:
            self.sync.set_moving(True)
            self._stages.append(threading.Thread(target=self._follow, args=(profile,)))
            self._stages[-1].start()
        self.sampler.start()

    def blocks(self) -> Iterator[Block]:
        while (block := self.sampler.read(NEVER)) is not None:
            yield block

    def record(self, profile: MotionProfile, between: Callable[[Block], None] = lambda _: None) -> list[Block]:
        self.begin(profile)
        got = []
        for block in self.blocks():
            got.append(block)
            between(block)
        self.sampler.stop()
        self.settle()
        return got

    def stop_stage(self) -> None:
        self.sync.set_stop_requested()
        self.bench.brake(self.rig.stage.stop_accel_mm_s2)

    def settle(self) -> None:
        for stage in self._stages:
            stage.join()

    def _follow(self, profile: MotionProfile) -> None:
        if self.sync.await_first_sample(NEVER) is not None:
            self.bench.follow(profile.pieces())
            while self.bench.moving:
                self.bench.clock.sleep(0.005, NEVER)
        self.sync.set_moving(False)


@contextmanager
def card_rig(
    rig: RigSettings,
    calibrations: Mapping[str, Calibration] | None = None,
    card: Callable[[SimulatedBench], Card] | None = None,
    pace: float = 1.0,
    *,
    remote: bool = False,
) -> Iterator[CardRig]:
    bench = Witness(rig, FrictionModelSettings(), DoubleClock(pace))
    made = Card(bench) if card is None else card(bench)
    with ExitStack() as stack:
        if remote:
            rig = served(rig, stack.enter_context(CardServer(made)).port)
        else:
            stack.enter_context(c_library.installed(made))
        sync = MotionSamplingSync()
        connection = Connection(rig.hardware.card)
        stack.callback(connection.close)
        sampler = CardSampler(connection, rig, calibrations or {}, sync, bench.clock)
        under_test = CardRig(rig, bench, connection, sampler, sync)
        try:
            yield under_test
        finally:
            bench.faults.clear()
            sampler.stop()
            under_test.settle()


def served(rig: RigSettings, port: int) -> RigSettings:
    card = rig.hardware.card.model_copy(update={"server": f"127.0.0.1:{port}"})
    return rig.model_copy(update={"hardware": rig.hardware.model_copy(update={"card": card})})


def joined(blocks: list[Block], channel: str) -> AnyFloatArray:
    return np.concatenate([block.channels[channel] for block in blocks])


def indices(blocks: list[Block]) -> np.ndarray:
    return np.concatenate([np.arange(block.first_index, block.end_index) for block in blocks])
