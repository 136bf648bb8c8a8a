"""Plans: a session, step by step.

A step names a kind of run. Its own keys are defined here; the keys of its protocol (`speed_mm_s`, `shear_strain`, …)
stand beside them in the file, are collected in `parameters`, and are validated by the protocol. Where a key of the
protocol takes one number, a list of numbers makes one run of each.
"""

from collections.abc import Mapping
from enum import StrEnum

from pydantic import Field

from dragrig.config.settings import GatheredSettings, Settings
from dragrig.config.specimen import Fixture

DEFAULT_DRIFT_PERCENT = 10.0
"""Allowed drift of a sentinel where a plan gives none."""


class RunOrder(StrEnum):
    """Order of a step's runs."""

    LISTED = "listed"
    REVERSED = "reversed"
    RANDOM = "random"
    RANDOM_WITHIN_REPEAT = "random_within_repeat"


class ReturnMode(StrEnum):
    """How the capsule returns to the start of the step's runs."""

    DRIVEN = "driven"
    """By the stage, recorded as a run of kind `return`."""
    BY_HAND = "by_hand"
    """By a person, who is prompted; the stage follows unrecorded."""
    STAY = "stay"
    """Not at all: the next run begins at the end of this one."""


class PlannedKind(GatheredSettings):
    """A kind of run in a plan, with its parameters and the parts mounted for it."""

    kind: str = Field(min_length=1)
    """Kind of run: relaxation, coulomb, drag, blank, motion, …."""
    parameters: Mapping[str, object] = {}
    """The protocol's keys; in a file they are written beside the other keys."""
    capsule: str = ""
    """Name of a capsule, or its file (default: the protocol's capsule)."""
    fixture: Fixture | None = None
    """What holds the gut (default: the protocol's fixture)."""


class PlanStep(PlannedKind):
    """One step of a plan."""

    repeats: int = Field(default=1, ge=1, le=1000)
    """Number of times that each run of the step is made."""
    order: RunOrder = RunOrder.LISTED
    """Order of the step's runs."""
    wait_s: float = Field(default=60.0, ge=0, le=86_400)
    """Rest before each run, counted from the last standstill; with a capsule in the gut, the age of the contact."""
    way_back: ReturnMode = ReturnMode.DRIVEN
    """How the capsule returns to the start of the step's runs."""
    way_back_speed_mm_s: float = Field(default=20.0, ge=1e-4, le=5000)
    """Speed of a driven return stroke."""
    start_mm: float | None = None
    """Start of the runs, absolute or from the contact (stage.start_from of the rig; default: stage.start_mm)."""
    tare_s: float = Field(default=0.0, ge=0, le=60)
    """Duration of a tare before each run, with the capsule out of contact; 0 for no tare."""
    prompt: str = ""
    """Prompt to the operator before the step's first run."""
    prompt_each: bool = False
    """Show the prompt before every run of the step."""
    note: str = ""
    """Note stored in the run files of the step."""


class SentinelSettings(PlannedKind):
    """A run that is made again and again between the others, to see how far the specimen has drifted since the first.

    It is made where its capsule and fixture are mounted: before the first such run, after the last, and between them.
    """

    kind: str = Field(default="drag", min_length=1)
    """Kind of run, one whose capsule slides: drag or coulomb."""
    every: int = Field(default=0, ge=0, le=10_000)
    """Number of runs between two sentinels; 0 for none between the first and the last."""
    drift_percent: float | None = Field(default=None, gt=0, le=1000)
    """Drift of the steady force beyond which the operator is asked (default: 10, unless drift_errors is given)."""
    drift_errors: float | None = Field(default=None, gt=0, le=1000)
    """The same in standard errors of the drift; where both are given, a drift beyond both asks."""
    wait_s: float = Field(default=60.0, ge=0, le=86_400)
    """Rest before each sentinel, counted from the last standstill."""
    start_mm: float | None = None
    """Start, absolute or from the contact (default: stage.start_mm of the rig); the stage drives the capsule back."""

    @property
    def bounds(self) -> tuple[float, float]:
        """Allowed drift in per cent and in standard errors; 0 where a bound is not given."""
        if self.drift_percent is None and self.drift_errors is None:
            return DEFAULT_DRIFT_PERCENT, 0.0
        return self.drift_percent or 0.0, self.drift_errors or 0.0


class Plan(Settings):
    """A session's programme."""

    name: str = Field(min_length=1, pattern=r"^[\w.-]+$")
    description: str = ""
    seed: int = Field(default=0, ge=0, lt=2**63)
    """Seed of random orders."""
    sentinel: SentinelSettings | None = None
    """Run that shows how far the specimen has drifted."""
    steps: tuple[PlanStep, ...] = Field(min_length=1)
