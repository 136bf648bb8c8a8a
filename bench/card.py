"""Sample at the card's full rate through the C-ABI double: losses, processor time, memory.

    python bench/card.py [--minutes 10]

Three analog inputs at 83,333 samples a second each, 250 kS/s in all, and the encoder. Every sample tells its own index,
so that a lost, doubled or shifted one shows. The bar: none is lost, less than a quarter of one core, flat memory. Then,
what filtering oversampled inputs costs.
"""

import argparse
import time
from collections.abc import Callable, Mapping
from threading import Event
from typing import cast

import numpy as np
import psutil

from dragrig.config.rig import RigSettings
from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.devices import Acquisition, Contact, WallClock
from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.card.oversampling import AntiAliasFilter, OversampledFetcher
from dragrig.rig.hardware.card.sampler import CardSampler
from dragrig.rig.hardware.card.scaling import ForceInputMonitor, NoiseLimits
from dragrig.rig.hardware.card.tasks import SampleBatch, SampleFetcher
from dragrig.rig.hardware.sync import MotionSamplingSync
from dragrig.rig.profile import FloatArray, MotionProfile, Phase, stationary_piece
from dragrig.sim_backend.doubles import c_library
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.simulated_bench import FaultInjector, SimulatedBench

RATE_HZ = 83_333.0
STEP_V = 20.0 / 2**16
"""What the card's converter rounds to at ±10 V."""
PERIOD = 8192
INPUTS = ("motor_force", "temperature")


class CountingBench:
    """A bench whose every sample is made of its index, so that it costs next to nothing and nothing can be mixed up."""

    def __init__(self, rig: RigSettings) -> None:
        self.rig = rig
        self.clock = _PacedWallClock()
        self.faults = FaultInjector()
        self._began_s: float | None = None
        self._rate_hz = 0.0

    def position_mm(self) -> float:
        """Stand still."""
        return 0.0

    def counts(self, position_mm: FloatArray) -> FloatArray:
        """Return counts at rest."""
        return np.zeros_like(position_mm)

    def begin_sampling(self, rate_hz: float) -> None:
        """Take sample 0 now."""
        self._began_s, self._rate_hz = self.clock.monotonic(), rate_hz

    @property
    def began_s(self) -> float:
        """When sample 0 was taken."""
        return self.clock.monotonic() if self._began_s is None else self._began_s

    def available(self) -> int:
        """Return how many samples were taken."""
        if self._began_s is None:
            return 0
        return int((self.clock.monotonic() - self._began_s) * self._rate_hz) + 1

    def sample(self, first: int, end: int) -> Mapping[str, FloatArray]:
        """Return samples made of their indices."""
        index = np.arange(first, end, dtype=np.float64)
        volts = (index % PERIOD) * STEP_V
        return {"force_V": volts, "encoder_counts": index, **dict.fromkeys(INPUTS, volts)}

    def end_sampling(self) -> None:
        """Take no further sample."""
        self._began_s = None

    def read_line(self, line: str) -> bool:
        """Return that no switch is pressed."""
        del line
        return True

    def write_line(self, line: str, high: bool) -> None:
        """Take no notice."""
        del line, high


class _PacedWallClock(WallClock):
    pace = 1.0


class Stopwatch:
    """Adds up the processor time that a card's methods take, in whatever thread calls them."""

    def __init__(self, card: Card) -> None:
        self.spent_s = 0.0
        for name in dir(card):
            if not name.startswith("_") and callable(getattr(card, name)):
                setattr(card, name, self._timed(getattr(card, name)))

    def _timed(self, method: Callable[..., object]) -> Callable[..., object]:
        def timed(*text: object) -> object:
            began_s = time.thread_time()
            try:
                return method(*text)
            finally:
                self.spent_s += time.thread_time() - began_s

        return timed


def main() -> None:
    """Sample, then print what it took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    duration_s = 60.0 * parser.parse_args().minutes
    inputs = [{"name": name, "channel": f"ai{place}", "unit": "V"} for place, name in enumerate(INPUTS, 1)]
    rig = RigSettings.model_validate({"sampling": {"rate_hz": RATE_HZ}, "hardware": {"card": {"inputs": inputs}}})
    card = Card(cast("SimulatedBench", CountingBench(rig)))
    double = Stopwatch(card)
    process = psutil.Process()
    with c_library.installed(card):
        sampler = CardSampler(Connection(rig.hardware.card), rig, {}, MotionSamplingSync(), WallClock())
        sampler.arm(_acquisition(duration_s))
        sampler.start()
        began_s, used_s, in_double_s = time.perf_counter(), time.process_time(), double.spent_s
        memory: list[float] = []
        lost = wrong = samples = 0
        while (block := sampler.read(Event())) is not None:
            lost += block.first_index - samples - lost
            samples += block.samples
            index = np.arange(block.first_index, block.end_index)
            steps = block.channels["force"] / (STEP_V * rig.hardware.card.force.per_V)
            wrong += int(np.count_nonzero(block.channels["position"] != index * 0.001))
            wrong += int(np.count_nonzero(np.rint(steps) != index % PERIOD))
            if block.first_index // round(RATE_HZ) >= len(memory):
                memory.append(process.memory_info().rss / 1e6)
        took_s = time.perf_counter() - began_s
        used_s, in_double_s = time.process_time() - used_s, double.spent_s - in_double_s
        sampler.stop()
    print(f"{samples:,} samples of {2 + len(INPUTS)} channels in {took_s:.1f} s; lost {lost:,}, wrong {wrong:,}")
    print(f"processor, whole process: {100 * used_s / took_s:.1f} % of one core")
    print(f"processor, without the double: {100 * (used_s - in_double_s) / took_s:.1f} % of one core")
    print(f"memory: {memory[min(5, len(memory) - 1)]:.1f} MB at 5 s, {memory[-1]:.1f} MB at the end")
    print_oversampling(1, 1000.0, 25)
    print_oversampling(3, 1000.0, 23)
    print_oversampling(1, 10_000.0, 25)


class RandomCard:
    """Delivers noise as fast as it is asked for."""

    def __init__(self, inputs: int) -> None:
        self._noise = np.random.default_rng(1).normal(size=(inputs, 100_000))
        self.next_index = self.lost = 0
        self.acquired = 1 << 60

    def fetch(self, samples: int) -> SampleBatch:
        """Return the next samples."""
        first, self.next_index = self.next_index, self.next_index + samples
        volts = self._noise[:, :samples]
        return SampleBatch(first, 0, volts, np.arange(first, self.next_index, dtype=np.float64), volts[0])


def print_oversampling(inputs: int, rate_hz: float, factor: int, duration_s: float = 60.0) -> None:
    """Print what filtering the card's samples to recorded ones, and judging them, costs."""
    anti_alias = AntiAliasFilter.of(factor)
    fetcher = OversampledFetcher(cast("SampleFetcher", RandomCard(inputs)), anti_alias, inputs)
    monitor = ForceInputMonitor(RigSettings(), NoiseLimits(RigSettings(), 0.0, rate_hz * factor), rate_hz * factor)
    block, samples = round(0.048 * rate_hz), 0
    used_s = time.process_time()
    while samples < duration_s * rate_hz:
        batch = fetcher.fetch(block)
        monitor.add(batch.force_input)
        samples += batch.samples
    used_s = time.process_time() - used_s
    card_rate = f"{inputs} × {factor * rate_hz:,.0f} samples a second, {factor} for each recorded one"
    print(f"filter and monitor, {card_rate}: {100 * used_s / duration_s:.2f} % of one core")


def _acquisition(duration_s: float) -> Acquisition:
    return Acquisition(
        run_id="bench",
        order=0,
        kind="blank",
        profile=MotionProfile.from_pieces([stationary_piece(duration_s, Phase.REST)]),
        capsule=Capsule(name="none", surface="smooth", diameter_mm=12.9, length_mm=15.2, mass_g=50.0),
        specimen=Specimen(name="none"),
        fixture=Fixture.NONE,
        contact=Contact.NONE,
        insertion_dwell_s=0.0,
    )


if __name__ == "__main__":
    main()
