"""The PCI-6229's double: what NI's driver does with it, call for call, on a `Bench`.

`c_abi` and the gRPC server are thin fronts on it. Handles are positive integers. Every method raises `CardError`, which
carries the driver's status code; any thread may call any method.
"""

from dragrig.config.hardware import CardSettings
from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.sim_backend.doubles.bench import Bench
from dragrig.sim_backend.doubles.daqmx import CardError

__all__ = ["Card", "CardError"]


class Card:
    """One card in a computer with NI's driver.

    Parameters
    ----------
    bench
        What the card is wired to.
    wiring
        Which of the bench's signals are on which terminal.
    """

    def __init__(self, bench: Bench, wiring: CardSettings | None = None) -> None:
        self.wiring = wiring or CardSettings()
        self._bench = bench

    def create_task(self, name: str) -> int:
        """Return the handle of a new task; an empty name lets the driver choose one."""
        raise NotImplementedError

    def clear_task(self, task: int) -> None:
        """Stop a task, release what it holds and forget it."""
        raise NotImplementedError

    def start(self, task: int) -> None:
        """Start a task."""
        raise NotImplementedError

    def stop(self, task: int) -> None:
        """Stop a task, release what it holds, keep its configuration."""
        raise NotImplementedError

    def control(self, task: int, action: int) -> None:
        """Start, stop, verify, commit, reserve, unreserve or abort a task; see `daqmx.Action`."""
        raise NotImplementedError

    def is_task_done(self, task: int) -> bool:
        """Return whether a task is not running or has taken all its samples."""
        raise NotImplementedError

    def wait_until_done(self, task: int, timeout_s: float) -> None:
        """Wait until a task is done; a negative timeout waits for ever."""
        raise NotImplementedError

    def create_ai_voltage_chan(
        self, task: int, physical: str, name: str, terminals: int, min_V: float, max_V: float, units: int, scale: str
    ) -> None:
        """Add analog inputs."""
        raise NotImplementedError

    def create_ao_voltage_chan(
        self, task: int, physical: str, name: str, min_V: float, max_V: float, units: int, scale: str
    ) -> None:
        """Add analog outputs."""
        raise NotImplementedError

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
        raise NotImplementedError

    def create_di_chan(self, task: int, lines: str, name: str, grouping: int) -> None:
        """Add digital inputs."""
        raise NotImplementedError

    def create_do_chan(self, task: int, lines: str, name: str, grouping: int) -> None:
        """Add digital outputs."""
        raise NotImplementedError

    def cfg_samp_clk_timing(
        self, task: int, source: str, rate_hz: float, edge: int, quantity: int, samples: int
    ) -> None:
        """Give a task a sample clock; see `daqmx.Quantity`."""
        raise NotImplementedError

    def read_analog_f64(self, task: int, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        """Read volts into `out`, C-contiguous of any shape; return the samples per channel.

        `samples` −1 reads what is there (a finite task: all), a negative timeout waits for ever. On an error the
        samples read so far are in `out`, and their number in `CardError.samples`.
        """
        raise NotImplementedError

    def read_counter_f64(self, task: int, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        """Read positions into `out`, otherwise as `read_analog_f64`."""
        raise NotImplementedError

    def read_analog_scalar_f64(self, task: int, timeout_s: float) -> float:
        """Read one sample of a task with one channel."""
        raise NotImplementedError

    def read_counter_scalar_f64(self, task: int, timeout_s: float) -> float:
        """Read one position."""
        raise NotImplementedError

    def read_digital_lines(self, task: int, samples: int, fill: int, out: BoolArray) -> tuple[int, int]:
        """Read levels, one element a line; return samples per channel and lines per channel."""
        raise NotImplementedError

    def read_digital_u32(self, task: int, samples: int, fill: int) -> list[int]:
        """Return one word per channel, line 0 in bit 0."""
        raise NotImplementedError

    def write_digital_lines(self, task: int, samples: int, auto_start: bool, layout: int, data: BoolArray) -> int:
        """Set levels, one element a line; return the samples written per channel."""
        raise NotImplementedError

    def write_digital_u32(self, task: int, samples: int, auto_start: bool, layout: int, data: list[int]) -> int:
        """Set levels, one word per channel; return the samples written per channel."""
        raise NotImplementedError

    def write_analog_f64(
        self, task: int, samples: int, auto_start: bool, timeout_s: float, layout: int, data: FloatArray
    ) -> int:
        """Set voltages, or add to a waveform; return the samples written per channel."""
        raise NotImplementedError

    def get_attribute(self, group: str, subject: int | str, attribute: int, channel: str = "") -> "Value":
        """Return an attribute.

        Parameters
        ----------
        group
            Which of DAQmx's `Get…Attribute` asks: task, chan, read, write, buffer, timing, device, system or
            physical_chan.
        subject
            A task's handle; the name of a device or physical channel; anything for the system.
        channel
            Virtual channels, for `chan`.
        """
        raise NotImplementedError

    def set_attribute(self, group: str, task: int, attribute: int, value: "Value", channel: str = "") -> None:
        """Set an attribute of a task or its channels."""
        raise NotImplementedError

    def reset_attribute(self, group: str, task: int, attribute: int, channel: str = "") -> None:
        """Put an attribute back to what the driver has for it."""
        raise NotImplementedError

    def reset_device(self, device: str) -> None:
        """Abort the device's tasks and put it into its initial state."""
        raise NotImplementedError


Value = int | float | bool | str | list[float] | list[int]
"""What an attribute holds."""
