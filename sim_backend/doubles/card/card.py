"""The PCI-6229's double: what NI's driver does with it, call for call, on a `Bench`.

`c_abi` and the gRPC server are thin fronts on it. Handles are positive integers. Every method raises `CardError`, which
carries the driver's status code; any thread may call any method.
"""

import math
import time

from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.sim_backend.doubles.card import channels, generating
from dragrig.sim_backend.doubles.card.answers import Answers
from dragrig.sim_backend.doubles.card.attributes import Chan, Device
from dragrig.sim_backend.doubles.card.daqmx import Action, CardError, ChannelKind, Code
from dragrig.sim_backend.doubles.card.engine import Engine
from dragrig.sim_backend.doubles.card.generating import Listener, deaf
from dragrig.sim_backend.doubles.card.reading import Reading
from dragrig.sim_backend.doubles.card.tasks import Channel, Value
from dragrig.sim_backend.doubles.card.timing import timing_of
from dragrig.sim_backend.doubles.card.wires import Bench
from dragrig.sim_backend.doubles.card.writing import Writing

__all__ = ["Card", "CardError", "Value"]

_LOOK_AGAIN_S = 0.02


class Card:
    """One card in a computer with NI's driver.

    Parameters
    ----------
    bench
        What the card is wired to.
    listener
        Told what analog outputs do; see `generating.Listener`.
    """

    def __init__(self, bench: Bench, listener: Listener = deaf) -> None:
        self._engine = Engine(bench, listener)
        self._device = self._engine.wiring.device
        self._reading = Reading(self._engine)
        self._writing = Writing(self._engine)
        self._answers = Answers(self._engine)

    def create_task(self, name: str) -> int:
        """Return the handle of a new task; an empty name lets the driver choose one."""
        with self._engine.changed:
            return self._engine.create(name)

    def clear_task(self, task: int) -> None:
        """Stop a task, release what it holds and forget it."""
        with self._engine.changed:
            self._engine.forget(self._engine.task(task))

    def start(self, task: int) -> None:
        """Start a task."""
        with self._engine.changed:
            self._engine.start(self._engine.task(task))

    def stop(self, task: int) -> None:
        """Stop a task, release what it holds, keep its configuration."""
        with self._engine.changed:
            self._engine.stop(self._engine.task(task))
            self._engine.touch()

    def control(self, task: int, action: int) -> None:
        """Start, stop, verify, commit, reserve, unreserve or abort a task; see `daqmx.Action`."""
        with self._engine.changed:
            told = self._engine.task(task)
            match action:
                case Action.START:
                    self._engine.start(told)
                case Action.STOP | Action.ABORT:
                    self._engine.stop(told)
                case Action.RESERVE | Action.COMMIT:
                    self._engine.reserve(told)
                    told.reserved = True
                case Action.UNRESERVE:
                    told.reserved = False
                    self._engine.stop(told)
                case Action.VERIFY:
                    self._engine.verify(told)
                case _:
                    raise CardError(Code.INVALID_ATTRIBUTE_VALUE, f"There is no action {action}.")

    def is_task_done(self, task: int) -> bool:
        """Return whether a task is not running or has taken all its samples."""
        with self._engine.changed:
            return self._engine.done(self._engine.task(task))

    def wait_until_done(self, task: int, timeout_s: float) -> None:
        """Wait until a task is done; a negative timeout waits for ever."""
        with self._engine.changed:
            deadline_s = math.inf if timeout_s < 0 else time.perf_counter() + timeout_s
            told = self._engine.task(task)
            while not self._engine.done(told):
                self._engine.touch()
                if time.perf_counter() >= deadline_s:
                    raise CardError(Code.NOT_DONE, f"Task is not done.\n\nTask Name: {told.name}")
                self._engine.changed.wait(_LOOK_AGAIN_S)

    def create_ai_voltage_chan(
        self, task: int, physical: str, name: str, terminals: int, min_V: float, max_V: float, units: int, scale: str
    ) -> None:
        """Add analog inputs."""
        del scale
        self._add(task, channels.analog_inputs(self._device, physical, name, terminals, min_V, max_V, units))

    def create_ao_voltage_chan(
        self, task: int, physical: str, name: str, min_V: float, max_V: float, units: int, scale: str
    ) -> None:
        """Add analog outputs."""
        del scale
        self._add(task, channels.analog_outputs(self._device, physical, name, min_V, max_V, units))

    def create_ci_lin_encoder_chan(
        self,
        task: int,
        counter: str,
        name: str,
        decoding: int,
        z_enable: bool,
        z_value: float,
        z_phase: int,
        units: int,
        distance_per_pulse: float,
        initial_position: float,
        scale: str,
    ) -> None:
        """Add a counter that follows a linear encoder."""
        del scale
        properties: dict[int, Value] = {
            Chan.CI_DECODING: decoding,
            Chan.CI_Z_ENABLE: z_enable,
            Chan.CI_Z_VALUE: z_value,
            Chan.CI_Z_PHASE: z_phase,
            Chan.CI_UNITS: units,
            Chan.CI_DISTANCE_PER_PULSE: distance_per_pulse,
            Chan.CI_INITIAL_POSITION: initial_position,
        }
        self._add(task, channels.encoder_counter(self._device, counter, name, properties))

    def create_di_chan(self, task: int, lines: str, name: str, grouping: int) -> None:
        """Add digital inputs."""
        self._add(task, channels.digital_lines(self._device, lines, name, grouping, ChannelKind.DIGITAL_INPUT))

    def create_do_chan(self, task: int, lines: str, name: str, grouping: int) -> None:
        """Add digital outputs."""
        self._add(task, channels.digital_lines(self._device, lines, name, grouping, ChannelKind.DIGITAL_OUTPUT))

    def cfg_samp_clk_timing(
        self, task: int, source: str, rate_hz: float, edge: int, quantity: int, samples: int
    ) -> None:
        """Give a task a sample clock; see `daqmx.Quantity`."""
        del edge
        with self._engine.changed:
            told = self._engine.idle(task)
            told.timing = timing_of(told, self._device, source, rate_hz, quantity, samples)

    def cfg_dig_edge_start_trig(self, task: int, source: str, _edge: int) -> None:
        """Let an edge of a terminal start a task."""
        with self._engine.changed:
            generating.arm(self._engine.idle(task), self._device, source)

    def read_analog_f64(self, task: int, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        """Read volts into `out`, C-contiguous of any shape; return the samples per channel.

        `samples` −1 reads what is there (a finite task: all), a negative timeout waits for ever. On an error the
        samples read so far are in `out`, and their number in `CardError.samples`.
        """
        return self._reading.analog(task, samples, timeout_s, fill, out)

    def read_counter_f64(self, task: int, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        """Read positions into `out`, otherwise as `read_analog_f64`."""
        return self._reading.counter(task, samples, timeout_s, fill, out)

    def read_analog_scalar_f64(self, task: int, timeout_s: float) -> float:
        """Read one sample of a task with one channel."""
        return self._reading.scalar(self._reading.analog, task, timeout_s)

    def read_counter_scalar_f64(self, task: int, timeout_s: float) -> float:
        """Read one position."""
        return self._reading.scalar(self._reading.counter, task, timeout_s)

    def read_digital_lines(self, task: int, samples: int, fill: int, out: BoolArray) -> tuple[int, int]:
        """Read levels, one element a line; return samples per channel and lines per channel."""
        return self._reading.lines(task, samples, fill, out)

    def read_digital_u32(self, task: int, samples: int, fill: int) -> list[int]:
        """Return one word per channel, line 0 in bit 0."""
        return self._reading.words(task, samples, fill)

    def write_digital_lines(self, task: int, samples: int, auto_start: bool, layout: int, data: BoolArray) -> int:
        """Set levels, one element a line; return the samples written per channel."""
        return self._writing.lines(task, samples, auto_start, layout, data)

    def write_digital_u32(self, task: int, samples: int, auto_start: bool, layout: int, data: list[int]) -> int:
        """Set levels, one word per channel; return the samples written per channel."""
        return self._writing.words(task, samples, auto_start, layout, data)

    def write_analog_f64(
        self, task: int, samples: int, auto_start: bool, timeout_s: float, layout: int, data: FloatArray
    ) -> int:
        """Set voltages, or add to a waveform; return the samples written per channel."""
        return self._writing.analog(task, samples, auto_start, timeout_s, layout, data)

    def get_attribute(self, group: str, subject: int | str, attribute: int, channel: str = "") -> Value:
        """Return an attribute.

        Parameters
        ----------
        group
            Which of DAQmx's `Get…Attribute` asks: task, chan, read, write, buffer, timing, device or system.
        subject
            A task's handle; the name of a device or physical channel; anything for the system.
        channel
            Virtual channels, for `chan`.
        """
        with self._engine.changed:
            return self._answers.get(group, subject, attribute, channel)

    def set_attribute(self, group: str, task: int, attribute: int, value: Value, channel: str = "") -> None:
        """Set an attribute of a task or its channels."""
        with self._engine.changed:
            self._answers.set(group, task, attribute, value, channel)

    def reset_attribute(self, group: str, task: int, attribute: int, channel: str = "") -> None:
        """Put an attribute back to what the driver has for it."""
        del channel
        with self._engine.changed:
            self._answers.reset(group, task, attribute)

    def reset_device(self, device: str) -> None:
        """Abort the device's tasks and put it into its initial state."""
        with self._engine.changed:
            self._answers.get("device", device, Device.PRODUCT, "")
            for task in self._engine.tasks.values():
                task.reserved = False
                self._engine.stop(task)

    def voltage(self, output: str) -> float:
        """Return what an analog output, such as ao0, is at now; it holds its last voltage when its task ends."""
        return self._writing.voltage(output)

    def _add(self, task: int, added: list[Channel]) -> None:
        with self._engine.changed:
            self._engine.find()
            self._engine.idle(task).add(added)
