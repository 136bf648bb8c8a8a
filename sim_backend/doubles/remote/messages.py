"""What is said to doubles in a process of their own: one JSON object a line, and one back for each."""

from typing import Annotated, Literal

from pydantic import Field, JsonValue, TypeAdapter

from dragrig.config.base import Settings
from dragrig.config.capsule import Capsule
from dragrig.config.specimen import Fixture, Specimen
from dragrig.rig.devices import Acquisition, Contact
from dragrig.rig.hardware.dialects.base import Halt
from dragrig.rig.profile import MotionProfile, Phase, Piece

LOOPBACK = "127.0.0.1"
"""Where all of it happens."""


class PieceMessage(Settings):
    """A stretch of constant acceleration."""

    duration_s: float
    acceleration_mm_s2: float
    phase: Phase


class Presented(Settings):
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
    def of(cls, acquisition: Acquisition) -> "Presented":
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


class SetMishaps(Settings):
    """Let things go wrong from now on, by the names of `Trouble`'s attributes; others stay."""

    ask: Literal["set mishaps"] = "set mishaps"
    mishaps: dict[str, JsonValue]


class Present(Settings):
    """Let the next sampling meet a capsule and a gut."""

    ask: Literal["present"] = "present"
    acquisition: Presented


class LookAtStage(Settings):
    """Ask how the stage is."""

    ask: Literal["look at stage"] = "look at stage"


class ShutDown(Settings):
    """End the process."""

    ask: Literal["shut down"] = "shut down"


Request = SetMishaps | Present | LookAtStage | ShutDown
REQUEST: TypeAdapter[Request] = TypeAdapter(Annotated[Request, Field(discriminator="ask")])


class StageLook(Settings):
    """How the stage is, as a bystander with an eye on the drive's display would see it."""

    position_mm: float
    """From the index pulse."""
    speed_mm_s: float
    moving: bool
    enabled: bool
    homed: bool
    halt: Halt
    """Why the last motion ended; `Halt.NONE` while there is one."""


class Reply(Settings):
    """What comes back; `error` is a sentence, empty when all went well."""

    error: str = ""
    stage: StageLook | None = None


class Ports(Settings):
    """Where doubles in a process of their own are found: the one line that it prints."""

    card: int
    """TCP port of the gRPC device server."""
    drive: str
    """Where pyserial finds the drive."""
    control: int
    """TCP port of the control socket."""
