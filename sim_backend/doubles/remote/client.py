"""Doubles in a process of their own, which outlive a program under test that is killed."""

import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from types import TracebackType

from pydantic import JsonValue, ValidationError

from dragrig.config.errors import DeviceError
from dragrig.config.loading import to_toml
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import Acquisition
from dragrig.sim_backend.doubles.remote.messages import (
    LOOPBACK,
    LookAtStage,
    Ports,
    Present,
    Presented,
    Reply,
    Request,
    SetMishaps,
    ShutDown,
    StageLook,
)

_REPLY_S = 20.0
_END_S = 10.0
_SERVE = "dragrig.sim_backend.doubles.remote.serve"


class Control:
    """A caller of the control socket. One thread at a time."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection((LOOPBACK, port), timeout=_REPLY_S)
        self._lines = self._socket.makefile("rb")

    def set_mishaps(self, **mishaps: JsonValue) -> None:
        """Let things go wrong from now on, or no longer; those that are not named stay as they are."""
        self._ask(SetMishaps(mishaps=mishaps))

    def present(self, acquisition: Acquisition) -> None:
        """Let the next sampling meet an acquisition's capsule and gut."""
        self._ask(Present(acquisition=Presented.of(acquisition)))

    def stage(self) -> StageLook:
        """Look at the stage."""
        look = self._ask(LookAtStage()).stage
        if look is None:
            raise DeviceError("Control of the doubles: the reply does not say how the stage is.")
        return look

    def shut_down(self) -> None:
        """End the process."""
        self._ask(ShutDown())

    def close(self) -> None:
        """Hang up."""
        self._lines.close()
        self._socket.close()

    def _ask(self, request: Request) -> Reply:
        try:
            self._socket.sendall(request.model_dump_json().encode() + b"\n")
            line = self._lines.readline()
        except OSError as error:
            raise DeviceError(f"Control of the doubles does not answer ({error}); is their process gone?") from error
        if not line:
            raise DeviceError("Control of the doubles hung up; their process is gone.")
        reply = Reply.model_validate_json(line)
        if reply.error:
            raise DeviceError(reply.error)
        return reply


class RemoteDoubles:
    """Card, drive and their bench in a process of their own, from `start` to `stop` or as a context.

    The process ends with the one that started it, however that ends.

    Parameters
    ----------
    rig
        The rig that they double.
    pace
        How many times faster than the wall's their clock runs.
    """

    def __init__(self, rig: RigSettings, pace: float = 1.0) -> None:
        self._given = rig
        self._pace = pace
        self._process: subprocess.Popen[bytes] | None = None
        self._ports: Ports | None = None
        self._control: Control | None = None

    def __enter__(self) -> "RemoteDoubles":
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def control(self) -> Control:
        """The control socket."""
        if self._control is None:
            raise DeviceError("The doubles are not running; start them first.")
        return self._control

    @property
    def process_id(self) -> int:
        """The process that the doubles live in."""
        if self._process is None:
            raise DeviceError("The doubles are not running; start them first.")
        return self._process.pid

    def rig(self) -> RigSettings:
        """Return the rig's settings with card and drive found at the doubles' ports."""
        if self._ports is None:
            raise DeviceError("The doubles are not running; start them first.")
        return reached_at(self._given, self._ports)

    def start(self) -> None:
        """Start the process and wait until it is ready; raises `DeviceError` when it does not get there."""
        with tempfile.TemporaryDirectory(prefix="dragrig-") as folder:
            file = Path(folder) / "rig.toml"
            file.write_text(to_toml(self._given), encoding="utf-8")
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "dragrig.sim_backend.doubles.remote.serve",
                    "--rig",
                    file,
                    "--pace",
                    str(self._pace),
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,  # a Ctrl-C at the terminal is meant for the program, not for the rig
            )
            line = self._process.stdout.readline() if self._process.stdout else b""
        try:
            self._ports = Ports.model_validate_json(line)
            self._control = Control(self._ports.control)
        except (ValidationError, OSError) as error:
            self.stop()
            raise DeviceError("The doubles' process ended before it was ready; its own message says why.") from error

    def stop(self) -> None:
        """End the process. Safe to call twice."""
        if self._control is not None:
            self._control.close()
        self._control = None
        if self._process is None:
            return
        process, self._process = self._process, None
        if process.stdin:
            process.stdin.close()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        finally:
            if process.stdout:
                process.stdout.close()


def reached_at(rig: RigSettings, ports: Ports) -> RigSettings:
    """Return a rig's settings with card and drive found where the doubles are."""
    card = rig.hardware.card.model_copy(update={"server": f"{LOOPBACK}:{ports.card}"})
    drive = rig.hardware.drive.model_copy(update={"port": ports.drive})
    return rig.model_copy(update={"hardware": rig.hardware.model_copy(update={"card": card, "drive": drive})})
