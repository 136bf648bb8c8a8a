"""Plans: what a session does, step by step.

A step names a kind of run. Its own keys are defined here; the keys of its protocol (`speed_mm_s`, `shear_strain`, …)
stand beside them in the file, are collected in `parameters`, and are validated by the protocol. Where a key of the
protocol takes one number, a list of numbers makes one run of each.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import Self

from pydantic import Field, ModelWrapValidatorHandler, model_validator

from dragrig.config.settings import Settings
from dragrig.config.specimen import Fixture


class RunOrder(StrEnum):
    """In which order the runs of a step are made."""

    LISTED = "listed"
    REVERSED = "reversed"
    RANDOM = "random"
    RANDOM_WITHIN_REPEAT = "random_within_repeat"


class ReturnMode(StrEnum):
    """How the capsule gets back to where the step's runs begin."""

    DRIVEN = "driven"
    """By the stage, recorded as a run of kind `return`."""
    BY_HAND = "by_hand"
    """By a person, who is prompted; the stage then follows unrecorded."""
    STAY = "stay"
    """Not at all: the next run begins where this one ended."""


class PlanStep(Settings):
    """One step of a plan."""

    kind: str = Field(min_length=1)
    """Kind of run: relaxation, coulomb, drag, blank, motion, ….."""
    parameters: Mapping[str, object] = {}
    """The protocol's keys; in a file they stand beside the step's own."""
    capsule: str = ""
    """Name of a capsule, or its file; the protocol's usual one unless given."""
    fixture: Fixture | None = None
    """What holds the gut; the protocol's usual one unless given."""
    repeats: int = Field(default=1, ge=1, le=1000)
    """How often each run of the step is made."""
    order: RunOrder = RunOrder.LISTED
    """In which order the runs of the step are made."""
    wait_s: float = Field(default=60.0, ge=0, le=86_400)
    """Rest before each run, from the last standstill on; with a capsule in the gut, the age of the contact."""
    way_back: ReturnMode = ReturnMode.DRIVEN
    """How the capsule gets back to where the step's runs begin."""
    way_back_speed_mm_s: float = Field(default=20.0, gt=0)
    """Speed of a driven way back."""
    start_mm: float | None = None
    """Where the runs begin, absolute or from the contact (stage.start_from of the rig); the rig's own unless given."""
    tare_s: float = Field(default=0.0, ge=0, le=60)
    """Take the sensor's zero for so long before each run, with the capsule out of contact; 0 takes none."""
    prompt: str = ""
    """What to ask a person to do before the step's first run."""
    prompt_each: bool = False
    """Ask before every run of the step."""
    note: str = ""
    """Kept in the run files of the step."""

    @model_validator(mode="wrap")
    @classmethod
    def _gather_parameters(cls, data: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if not isinstance(data, Mapping):
            return handler(data)
        own = {key: value for key, value in data.items() if key in cls.model_fields}
        rest = {key: value for key, value in data.items() if key not in cls.model_fields}
        if rest:
            given = own.get("parameters", {})
            own["parameters"] = {**given, **rest} if isinstance(given, Mapping) else given
        return handler(own)


class Plan(Settings):
    """A session's programme."""

    name: str = Field(min_length=1, pattern=r"^[\w.-]+$")
    description: str = ""
    seed: int = Field(default=0, ge=0, lt=2**63)
    """Seed of the random orders."""
    steps: tuple[PlanStep, ...] = Field(min_length=1)
