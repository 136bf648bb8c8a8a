"""The serial port as pyserial opens it, and what it raises when its cable is pulled."""

import os
import sys

import serial

from dragrig.config.errors import DeviceError
from dragrig.config.hardware import DriveSettings

if sys.platform != "win32":
    import termios

    CABLE_ERRORS: tuple[type[Exception], ...] = (OSError, termios.error)
else:
    CABLE_ERRORS = (OSError,)
"""What a pulled cable raises: SerialException is an OSError, a terminal's error is not."""

_OPENING_ERRORS: tuple[type[Exception], ...] = (*CABLE_ERRORS, ValueError)
WRITE_TIMEOUT = serial.SerialTimeoutException
"""What a write raises that took too long; to a socket, even though all of it was sent."""
_PARITIES = {"none": serial.PARITY_NONE, "even": serial.PARITY_EVEN, "odd": serial.PARITY_ODD}
_STOP_BITS = {1: serial.STOPBITS_ONE, 2: serial.STOPBITS_TWO}
_READS_PER_REPLY = 5


def open_port(settings: DriveSettings) -> serial.Serial:
    """Open the drive's port for this program alone, where the system can do that.

    Raises
    ------
    DeviceError
        When there is no such port, or another program has it.
    """
    try:
        return serial.serial_for_url(
            settings.port,
            baudrate=settings.baud,
            bytesize=serial.EIGHTBITS,
            parity=_PARITIES[settings.parity],
            stopbits=_STOP_BITS[settings.stop_bits],
            timeout=settings.reply_s / _READS_PER_REPLY,
            write_timeout=settings.reply_s,
            exclusive=True,
        )
    except _OPENING_ERRORS as error:
        number = error.errno if isinstance(error, OSError) else None
        why = os.strerror(number) if number else str(error)
        raise DeviceError(
            f"the drive's port {settings.port} cannot be opened ({why}): connect it, close other programs that use "
            "it, or correct hardware.drive.port of the rig file."
        ) from error


def close_port(port: serial.Serial) -> None:
    """Close a port, whose cable may be gone."""
    # pyserial forgets to close its socket when the other side was first.
    connection = getattr(port, "_socket", None)
    port.close()
    if connection is not None:
        connection.close()
