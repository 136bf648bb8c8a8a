"""What a comparison says, as values. A difference is always B − A; forces in mN."""

from collections.abc import Callable
from dataclasses import dataclass, field

from dragrig.analysis.comparison.conditions import Condition
from dragrig.analysis.comparison.measured import Difference, Verdict, judged, main_measures
from dragrig.analysis.comparison.overlay import Overlay, lay_over
from dragrig.analysis.identification.results import LeftOut
from dragrig.rig.runfile.model import Run, RunInfo


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """A run of one side: its attributes, and how to get at its samples, which are not kept."""

    info: RunInfo
    read: Callable[[], Run]
    remark: str = ""

    @property
    def file(self) -> str:
        """Name of the run's file."""
        return self.info.path.name


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """One of the two that are compared: its runs in order, and what is left out with the reason."""

    name: str
    runs: tuple[Source, ...]
    left_out: tuple[LeftOut, ...] = ()
    specimens: tuple[str, ...] = ()
    is_model: bool = False


@dataclass(frozen=True, slots=True)
class PhaseDifference:
    """The difference of the filtered traces while both runs are in one phase; `at_s` counts from the start of motion.

    `phase` is `all` for the whole run.
    """

    phase: str
    samples: int
    mean_mN: float
    rms_mN: float
    largest_mN: float
    at_s: float


@dataclass(frozen=True, slots=True)
class Following:
    """Position minus command of one run in motion; `lag_s` is by how long steady motion comes late."""

    rms_mm: float
    largest_mm: float
    lag_s: float | None


@dataclass(frozen=True, slots=True)
class MotionDifference:
    """Position against command of both runs, None where no command was recorded, and position B − A on one clock."""

    a: Following | None
    b: Following | None
    rms_mm: float | None
    largest_mm: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two runs in which the same was done.

    Attributes
    ----------
    shift_s
        What was added to the times of B so that both begin to move together; None where that cannot be told.
    differences
        The measures side by side.
    phases
        The filtered traces by phase; empty where they cannot be laid over each other, with the reason in `remarks`.
    """

    condition: Condition
    a: Source
    b: Source
    shift_s: float | None
    differences: tuple[Difference, ...]
    phases: tuple[PhaseDifference, ...]
    motion: MotionDifference
    remarks: tuple[str, ...] = ()
    b_is_model: bool = False

    @property
    def main(self) -> tuple[Difference, ...]:
        """The measures that a run of this kind is made for."""
        wanted = main_measures(self.condition.kind)
        return tuple(one for one in self.differences if one.measure in wanted)

    @property
    def verdict(self) -> Verdict:
        """The most serious verdict on a main measure."""
        found = {one.verdict for one in self.main}
        order = (Verdict.BEYOND, Verdict.SCATTER, Verdict.NOISE)
        return next((one for one in order if one in found), Verdict.UNKNOWN)

    def overlay(self) -> Overlay:
        """Read both runs and lay their traces over each other; raises `AnalysisError` where that cannot be done."""
        return lay_over(self.a.read(), self.b.read())


@dataclass(frozen=True, slots=True)
class GroupDifference:
    """What the pairs of one condition say together of one measure.

    Attributes
    ----------
    a, b
        Means of both sides, zeros taken off where the pairs' are.
    value, noise, error
        Mean of B − A, its standard error by noise alone, and by noise and scatter.
    relative
        The difference over A; None where A is hardly a force at all.
    rms_mN
        Of the difference of the filtered traces, over all pairs.
    """

    condition: Condition
    measure: str
    pairs: int
    a: float
    b: float
    value: float
    noise: float
    error: float
    relative: float | None
    rms_mN: float | None

    @property
    def verdict(self) -> Verdict:
        """As of a pair."""
        return judged(self.value, self.noise, self.error)

    @property
    def times_error(self) -> float:
        """The difference in standard errors; infinite where runs without any error differ."""
        if self.error > 0:
            return abs(self.value) / self.error
        return float("inf") if self.value else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """All that was compared.

    Attributes
    ----------
    pairs
        In the order of A's runs.
    alone_a, alone_b
        Runs without a partner, and why.
    zero_mN
        Standard deviation of a sensor's unknown zero that is allowed for where the rest does not show it.
    groups
        The largest differences first.
    sentences
        What a person at the rig needs to know.
    """

    a: Side
    b: Side
    pairs: tuple[Pair, ...]
    alone_a: tuple[LeftOut, ...]
    alone_b: tuple[LeftOut, ...]
    zero_mN: float
    groups: tuple[GroupDifference, ...]
    remarks: tuple[str, ...] = ()
    sentences: tuple[str, ...] = field(default=())
