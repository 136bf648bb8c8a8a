"""Doubles in a process of their own, which outlive a program under test that is killed: client and messages.

The control socket carries one JSON object a line, and one back for each.
"""

import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Annotated, Literal

from pydantic import Field, JsonValue, TypeAdapter, ValidationError

from card_server import LOOPBACK
from dragrig.config.errors import DeviceError
from dragrig.config.rig import RigSettings
from dragrig.config.settings import Settings, to_toml
from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.devices import Acquisition, Contact
from dragrig.rig.hardware.dialects.base import Halt
from dragrig.rig.profile import MotionProfile, Phase, Piece


class PieceMessage(Settings):
    """A stretch of constant acceleration."""

    duration_s: float
    acceleration_mm_s2: float
    phase: Phase


class AcquisitionMessage(Settings):
    """An acquisition, as `World.present` takes it."""

    run_id: str
    order: int
    kind: str
    pieces: tuple[PieceMessage, ...]
    capsule: Capsule
    specimen: Specimen
    fixture: Fixture
    contact: Contact
    insertion_dwell_s: float
    shear_strain: float
    sheared_from: float

    @classmethod
    def of(cls, acquisition: Acquisition) -> "AcquisitionMessage":
        """Put an acquisition into words."""
        return cls(
            run_id=acquisition.run_id,
            order=acquisition.order,
            kind=acquisition.kind,
            pieces=tuple(
                PieceMessage(
                    duration_s=piece.duration_s, acceleration_mm_s2=piece.acceleration_mm_s2, phase=piece.phase
                )
                for piece in acquisition.profile.pieces()
            ),
            capsule=acquisition.capsule,
            specimen=acquisition.specimen,
            fixture=acquisition.fixture,
            contact=acquisition.contact,
            insertion_dwell_s=acquisition.insertion_dwell_s,
            shear_strain=acquisition.shear_strain,
            sheared_from=acquisition.sheared_from,
        )

    def acquisition(self) -> Acquisition:
        """Return the acquisition that was put into words."""
        profile = MotionProfile.from_pieces(
            Piece(piece.duration_s, piece.acceleration_mm_s2, piece.phase) for piece in self.pieces
        )
        return Acquisition(
            run_id=self.run_id,
            order=self.order,
            kind=self.kind,
            profile=profile,
            capsule=self.capsule,
            specimen=self.specimen,
            fixture=self.fixture,
            contact=self.contact,
            insertion_dwell_s=self.insertion_dwell_s,
            shear_strain=self.shear_strain,
            sheared_from=self.sheared_from,
        )


class SetFaults(Settings):
    """Let things go wrong from now on, by the names of `Trouble`'s attributes; others stay."""

    ask: Literal["set faults"] = "set faults"
    faults: dict[str, JsonValue]


class PresentAcquisition(Settings):
    """Let the next sampling meet a capsule and a gut."""

    ask: Literal["present"] = "present"
    acquisition: AcquisitionMessage


class GetStageStatus(Settings):
    """Ask how the stage is."""

    ask: Literal["look at stage"] = "look at stage"


class ShutDown(Settings):
    """End the process."""

    ask: Literal["shut down"] = "shut down"


ControlRequest = SetFaults | PresentAcquisition | GetStageStatus | ShutDown
REQUEST_ADAPTER: TypeAdapter[ControlRequest] = TypeAdapter(Annotated[ControlRequest, Field(discriminator="ask")])


class StageStatus(Settings):
    """How the stage is, as a bystander with an eye on the drive's display would see it."""

    position_mm: float
    """From the index pulse."""
    speed_mm_s: float
    moving: bool
    enabled: bool
    homed: bool
    halt: Halt
    """Why the last motion ended; `Halt.NONE` while there is one."""


class ControlReply(Settings):
    """What comes back; `error` is a sentence, empty when all went well."""

    error: str = ""
    stage: StageStatus | None = None


class DoublePorts(Settings):
    """Where doubles in a process of their own are found: the one line that it prints."""

    card: int
    """TCP port of the gRPC device server."""
    drive: str
    """Where pyserial finds the drive."""
    control: int
    """TCP port of the control socket."""


_REPLY_TIMEOUT_S = 600.0
_EXIT_TIMEOUT_S = 10.0
_SERVER = Path(__file__).with_name("remote_server.py")


class ControlClient:
    """A caller of the control socket. One thread at a time."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection((LOOPBACK, port), timeout=_REPLY_TIMEOUT_S)
        self._lines = self._socket.makefile("rb")

    def set_faults(self, **faults: JsonValue) -> None:
        """Let things go wrong from now on, or no longer; those that are not named stay as they are."""
        self._ask(SetFaults(faults=faults))

    def present(self, acquisition: Acquisition) -> None:
        """Let the next sampling meet an acquisition's capsule and gut."""
        self._ask(PresentAcquisition(acquisition=AcquisitionMessage.of(acquisition)))

    def stage(self) -> StageStatus:
        """Look at the stage."""
        look = self._ask(GetStageStatus()).stage
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

    def _ask(self, request: ControlRequest) -> ControlReply:
        try:
            self._socket.sendall(request.model_dump_json().encode() + b"\n")
            line = self._lines.readline()
        except OSError as error:
            raise DeviceError(f"Control of the doubles does not answer ({error}); is their process gone?") from error
        if not line:
            raise DeviceError("Control of the doubles hung up; their process is gone.")
        reply = ControlReply.model_validate_json(line)
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
        self._ports: DoublePorts | None = None
        self._control: ControlClient | None = None

    def __enter__(self) -> "RemoteDoubles":
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def control(self) -> ControlClient:
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
        return with_double_ports(self._given, self._ports)

    def start(self) -> None:
        """Start the process and wait until it is ready; raises `DeviceError` when it does not get there."""
        with tempfile.TemporaryDirectory(prefix="dragrig-") as folder:
            file = Path(folder) / "rig.toml"
            file.write_text(to_toml(self._given), encoding="utf-8")
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    _SERVER,
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
            self._ports = DoublePorts.model_validate_json(line)
            self._control = ControlClient(self._ports.control)
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
            process.wait(_EXIT_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        finally:
            if process.stdout:
                process.stdout.close()


def with_double_ports(rig: RigSettings, ports: DoublePorts) -> RigSettings:
    """Return a rig's settings with card and drive found where the doubles are."""
    card = rig.hardware.card.model_copy(update={"server": f"{LOOPBACK}:{ports.card}"})
    drive = rig.hardware.drive.model_copy(update={"port": ports.drive})
    return rig.model_copy(update={"hardware": rig.hardware.model_copy(update={"card": card, "drive": drive})})
