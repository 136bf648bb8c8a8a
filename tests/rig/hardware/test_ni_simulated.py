"""The program on a card that NI's own driver simulates: it must run, and must not take such a card for a rig.

By NI's documentation (Reading and Writing Data with NI-DAQmx Simulated Devices) each analog input is a full-scale sine
with 3 % of noise, each digital port a binary counter, and each counter 0.
"""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from itertools import count

import numpy as np
import pytest

from dragrig.config.errors import DeviceError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.commissioning import Watched, judge_push, judge_rest
from dragrig.rig.devices import BackendRequest
from dragrig.rig.hardware.backend import HardwareBackend
from dragrig.rig.profile import FloatArray
from dragrig.sim_backend.doubles.c_library import installed
from dragrig.sim_backend.doubles.card import Card
from dragrig.sim_backend.doubles.simulated_bench import DoubleClock, SimulatedBench

SINE_HZ = 5.0
NOISE = 0.03


class SimulatedByNi(SimulatedBench):
    """What the driver answers in place of a bench."""

    def __init__(self, rig: RigSettings) -> None:
        super().__init__(rig, FrictionModelSettings(), DoubleClock())
        self._reads = count()
        self._rng = np.random.default_rng(6229)

    def sample(self, first: int, end: int) -> Mapping[str, FloatArray]:
        card = self.rig.hardware.card
        time_s = np.arange(first, end) / self.rig.sampling.rate_hz
        sine = np.sin(2 * np.pi * SINE_HZ * time_s)
        noise = NOISE * self._rng.standard_normal(end - first)
        inputs = {"force_V": card.force.range_V, **{extra.name: extra.range_V for extra in card.inputs}}
        volts = {name: np.clip(range_V * (sine + noise), -range_V, range_V) for name, range_V in inputs.items()}
        return {**volts, "encoder_counts": np.zeros(end - first)}

    def read_line(self, line: str) -> bool:
        _, _, bit = line.rpartition("line")
        return bool(next(self._reads) >> int(bit) & 1)


@pytest.fixture
def backend() -> Iterator[HardwareBackend]:
    rig = RigSettings.model_validate({"hardware": {"drive": {"port": "socket://127.0.0.1:9"}}})
    with ExitStack() as stack:
        stack.enter_context(installed(Card(SimulatedByNi(rig))))
        opened = HardwareBackend(BackendRequest(rig, FrictionModelSettings(), connect=False))
        stack.callback(opened.close)
        yield opened


def test_it_is_checked_without_an_error_and_does_not_pass(backend: HardwareBackend) -> None:
    result = {check.name: check for check in backend.examine()}
    assert result["card"].passed
    assert "PCI-6229" in result["card"].detail
    assert result["card's tasks"].passed
    assert not result["force sensor"].passed
    assert not result["drive"].passed


def test_a_look_finds_neither_encoder_nor_switches_right(backend: HardwareBackend) -> None:
    with backend.look() as live:
        views = tuple(live.view() for _ in range(8))
    seen = Watched(views[0], views[1:])
    assert "does not count" in judge_push(seen, live.count_mm, reversed_counts=False).detail
    assert any(not judge_rest(view).passed for view in views)


def test_nothing_moves_on_it(backend: HardwareBackend) -> None:
    with pytest.raises(DeviceError):
        backend.connect()
