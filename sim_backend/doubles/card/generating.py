"""Running an analog output's waveform: when it begins, what waits for a trigger, and who is told of the voltages."""

from collections.abc import Callable, Iterable

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.doubles.card import pci6229
from dragrig.sim_backend.doubles.card.daqmx import CardError, ChannelKind, Code
from dragrig.sim_backend.doubles.card.tasks import Task

Listener = Callable[[str, FloatArray, float, float], None]
"""Told an output's name, its voltages to come, their rate, and the clock's reading at which the first is put out.

At rate 0 there is one voltage, which the output holds from then on.
"""

INPUTS_START = "ai/StartTrigger"


def deaf(output: str, volts: FloatArray, rate_hz: float, at_s: float) -> None:
    """Listen to nothing."""
    del output, volts, rate_hz, at_s


def arm(task: Task, device: str, source: str) -> None:
    """Let an edge of a terminal start a task; raises `CardError` for one that the double cannot do."""
    place = pci6229.terminal(source, device)
    if task.kind is not ChannelKind.ANALOG_OUTPUT or place != INPUTS_START:
        raise CardError(
            Code.ATTRIBUTE_NOT_SUPPORTED, f"Only outputs can be triggered here, by {INPUTS_START}, not by {place}."
        )
    task.trigger = place


def start(task: Task, now_s: float, hear: Listener) -> None:
    """Begin a task's waveform, or let it wait for its trigger."""
    waveform = task.waveform
    if waveform is None:
        return
    waveform.refuse_empty()
    if not task.trigger:
        waveform.start(now_s)
        tell(task, waveform.kept(), 0, hear)


def trigger(tasks: Iterable[Task], now_s: float, hear: Listener) -> None:
    """Begin the waveforms that wait for the inputs to start."""
    for task in tasks:
        waveform = task.waveform
        if task.running and task.trigger == INPUTS_START and waveform is not None and not waveform.has_begun:
            waveform.start(now_s)
            tell(task, waveform.kept(), 0, hear)


def tell(task: Task, volts: FloatArray, first: int, hear: Listener) -> None:
    """Tell of voltages, shape `(channels, n)`, whose first one is sample `first`; of none before the waveform began."""
    waveform = task.waveform
    if waveform is None or not waveform.has_begun or not volts.shape[1]:
        return
    for channel, row in zip(task.channels, volts, strict=True):
        hear(channel.physical, np.array(row), waveform.rate_hz, waveform.due_s(first))


def hold(task: Task, now_s: float, held_volts: dict[str, float], hear: Listener) -> None:
    """End a waveform: each output holds what it is at."""
    volts = task.waveform.volts(now_s) if task.waveform is not None else None
    if volts is None:
        return
    for channel, held in zip(task.channels, volts.tolist(), strict=True):
        held_volts[channel.physical] = held
        hear(channel.physical, np.array([held]), 0.0, now_s)
