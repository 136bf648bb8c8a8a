"""A rig as a whole: what a backend offers, and what its factory is given."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Protocol, runtime_checkable

from dragrig.config.lab import Calibration
from dragrig.config.model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import Clock, Sampler, Stage


@dataclass(frozen=True, slots=True)
class Finding:
    """What a look at one device found, in a person's words."""

    what: str
    fine: bool
    detail: str


@runtime_checkable
class Backend(Protocol):
    """A rig: its devices, its clock and its name in run files."""

    @property
    def name(self) -> str:
        """Name that the run files carry: simulated, hardware, …."""
        ...

    @property
    def stage(self) -> Stage:
        """The axis."""
        ...

    @property
    def sampler(self) -> Sampler:
        """The acquisition."""
        ...

    @property
    def needs_hands(self) -> bool:
        """Whether a person has to be at the rig: one has to look before the guard is reset, and hands do the rest."""
        ...

    @property
    def clock(self) -> Clock:
        """The time that this rig lives in."""
        ...

    def description(self) -> Mapping[str, str | float | int | bool]:
        """Return what run files say of the devices, as attributes of `/entry`: sensor_serial, seed, …."""
        ...

    def examine(self) -> Iterator[Finding]:
        """Look at every device in turn without moving anything; what a finding needs before it is connected for it."""
        ...

    def close(self) -> None:
        """Release every device. Must be safe to call twice."""
        ...


@runtime_checkable
class Handled(Protocol):
    """A backend without a bench, which has to be told what hands do there: doubles of the hardware."""

    def hang(self, load_mN: float) -> None:
        """Take a load to hang on the force sensor, in place of the one before."""
        ...

    def push(self, distance_mm: float, within_s: float) -> None:
        """Take the carriage, switched off, to be pushed by a signed distance during the next measurement."""
        ...


@dataclass(frozen=True, slots=True)
class BackendRequest:
    """What a backend's factory is given.

    A factory is what an entry point of the group `dragrig.backends` names: a callable that takes one of
    these and returns a `Backend`, raising `SettingsError` or `DeviceError`.
    """

    rig: RigSettings
    model: FrictionModelSettings
    real_time: bool = False
    """Whether a simulated clock runs at the pace of the wall's."""
    origin: datetime | None = None
    """Time of day at which a simulated session begins; now unless given."""
    calibrations: Mapping[str, Calibration] = field(default_factory=dict)
    """The calibration that holds now, by quantity (force, encoder)."""
    connect: bool = True
    """Whether the devices are to be connected at once; `Backend.examine` connects those that it looks at."""
    pace: float = 1.0
    """How many times faster than the wall's clock a double of the hardware lives."""
    first_run_at: datetime | None = None
    """When the campaign's first run began, in a session that goes on with it."""
