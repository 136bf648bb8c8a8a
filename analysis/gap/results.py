"""What a diagnosis says, as frozen values; the form of the JSON and of the report comes from here."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from dragrig.analysis.gap.evidence import Evidence
from dragrig.analysis.gap.planning.results import NextExperiment
from dragrig.analysis.gap.where.results import Where
from dragrig.analysis.identification.results import LeftOut, Quantity
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray


class Verdict(StrEnum):
    """The answer in a word."""

    EFFECT = "effect"
    SEVERAL = "several"
    NO_GAP = "no_gap"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Ranked:
    """A hypothesis with how probable it is.

    Attributes
    ----------
    hypothesis
        Id of an effect, several joined with `+`, `no_gap` or `unknown`.
    probability
        Calibrated on simulated campaigns; all of a ranking sum to 1.
    parameters
        Of its effects, refitted with all nuisances; none for `no_gap` and `unknown`.
    held_out_improvement
        Share of the excess squares that it takes away on runs that took no part in its fit; None where it was not
        tried so.
    """

    hypothesis: str
    probability: float
    parameters: tuple[Quantity, ...] = ()
    held_out_improvement: float | None = None


@dataclass(frozen=True, slots=True)
class BeforeAfter:
    """A coefficient of determination below and above the speed boundary; None where no drag run lies there."""

    before_below: float | None
    before_above: float | None
    after_below: float | None
    after_above: float | None


@dataclass(frozen=True, slots=True)
class Shrink:
    """How far the gap shrinks once the effect is in the simulator, on runs that took no part.

    Attributes
    ----------
    gap_before_mN, gap_after_mN
        Root mean square of the residual without and with the effects.
    noise_floor_mN
        Noise at rest and scatter of repeats, fixed before any fit.
    closed
        `1 − (after² − floor²) / (before² − floor²)`; None where there was no gap to close.
    closed_95ci
        Interval by bootstrap over runs.
    boundary_mm_s
        Speed boundary that the coefficients of determination are split at; None without drag runs on both sides.
    r2_eq15, r2_corr
        Of steady drag, by Eq. 15 of the paper and as squared correlation.
    """

    gap_before_mN: float
    gap_after_mN: float
    noise_floor_mN: float
    closed: float | None
    closed_95ci: tuple[float, float] | None
    boundary_mm_s: float | None
    r2_eq15: BeforeAfter
    r2_corr: BeforeAfter
    runs: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class RunView:
    """One run before and after, for pictures: means over `B` blocks."""

    file: str
    kind: str
    label: str
    channel: str
    unit: str
    time_s: FloatArray
    position_mm: FloatArray
    measured: FloatArray
    before: FloatArray
    after: FloatArray


@dataclass(frozen=True, slots=True)
class UnknownGap:
    """What is known of a gap, or of the rest of one, that no effect of the catalogue explains.

    Attributes
    ----------
    lives_in
        A sentence: where it is.
    shape
        A sentence: what it depends on.
    expression
        A sparse expression that holds up on runs that took no part; empty where none does.
    held_out
        Share of the excess that the expression explains there.
    """

    lives_in: str
    shape: str
    expression: str = ""
    held_out: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """All that a diagnosis found.

    Attributes
    ----------
    used_for_fit, held_out
        Files of the runs that gave the final fit, and those that the choice was judged on in turn.
    effects
        The most probable effects; empty for `no_gap` and `unknown`.
    confusable_with
        Effects that these runs cannot tell from them, near-aliases that were left out of the search among them.
    residual_unknown
        Whether something is left beside effects that clearly earn their place.
    would_have_seen_mN
        Smallest effect that these runs would have shown.
    cannot_answer
        Questions that these runs say nothing about, a sentence each.
    next_experiment
        The run that would separate the leading hypotheses best per minute; None where none is recommended.
    model
        The amended model; None where nothing was named or the nominal model is not the friction model.
    evidence
        What the verdict was made of, to learn from.
    """

    specimen: str
    nominal: str
    runs: int
    used_for_fit: tuple[str, ...]
    held_out: tuple[str, ...]
    left_out: tuple[LeftOut, ...]
    verdict: Verdict
    effects: tuple[str, ...]
    ranking: tuple[Ranked, ...]
    confusable_with: tuple[str, ...]
    residual_unknown: bool
    would_have_seen_mN: float
    tolerance_mN: float
    where: Where
    shrink: Shrink | None
    unknown: UnknownGap | None = None
    model: FrictionModelSettings | None = None
    views: tuple[RunView, ...] = ()
    cannot_answer: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    calibration: str = ""
    evidence: Evidence | None = None
    timings_s: Mapping[str, float] = field(default_factory=dict)
    next_experiment: NextExperiment | None = None
