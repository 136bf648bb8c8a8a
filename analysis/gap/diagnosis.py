"""The result of a diagnosis as frozen values: verdict, ranking, location, gap reduction and next runs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from dragrig.analysis.estimates import EstimatedQuantity, Exclusion
from dragrig.analysis.gap.features import DecisionInputs
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.plan import PlanStep
from dragrig.rig.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class AxisBin:
    """A bin of an axis.

    Attributes
    ----------
    name
        Its name, empty where the ends say it.
    low, high
        Its ends in the axis' unit; None where it has a name.
    share
        Its part of the excess on this axis; all are 0 where there is no gap.
    rms
        Root of the mean excess in it, in standard deviations of what is expected.
    p
        Chance that it stands out so without a gap, familywise over the axis.
    """

    name: str
    low: float | None
    high: float | None
    share: float
    rms: float
    p: float


@dataclass(frozen=True, slots=True)
class AxisLocation:
    """One axis.

    Attributes
    ----------
    name
        As in the report.
    bins
        All of them, whose shares sum to 1 or are all 0.
    covered_share
        Part of the whole excess that lies on this axis; where it is small there are no shares.
    low, high
        The narrowest neighbouring bins that have most of the excess; None without a gap and where bins have no order.
    share
        Their part.
    p
        Chance that they stand out so without a gap.
    min_p
        The smallest p-value on the axis.
    """

    name: str
    bins: tuple[AxisBin, ...]
    covered_share: float
    low: float | None
    high: float | None
    share: float
    p: float
    min_p: float

    @property
    def shares(self) -> Mapping[str, float]:
        """Shares of the bins that have a name."""
        return {axis_bin.name: axis_bin.share for axis_bin in self.bins if axis_bin.name}

    def document(self) -> Mapping[str, object]:
        """Return it as the report has it."""
        if self.shares:
            return {name: round(share, 4) for name, share in self.shares.items()}
        bins = [
            {"low": bin_.low, "high": bin_.high, "share": round(bin_.share, 4), "p": round(bin_.p, 4)}
            for bin_ in self.bins
        ]
        return {
            "covered": round(min(self.covered_share, 1.0), 4),
            "low": self.low,
            "high": self.high,
            "share": round(self.share, 4),
            "p": round(self.p, 4),
            "bins": bins,
        }


@dataclass(frozen=True, slots=True)
class PhaseCell:
    """One channel in one phase of one protocol: root of the mean excess, in standard deviations; None if never seen."""

    channel: str
    protocol: str
    phase: str
    rms: float | None


@dataclass(frozen=True, slots=True)
class GapLocation:
    """Where a gap is.

    Attributes
    ----------
    present
        Whether there is one.
    p
        Chance of so much excess, or of so much of it in one place, without a gap.
    rms
        Root of the mean excess of all runs, in standard deviations of what is expected.
    locations
        All axes.
    cells
        Channel, protocol and phase at once.
    domain
        What the residual is above all a function of; empty without a gap.
    domain_scores
        How much of the residual each domain accounts for in runs that took no part, 0 to 1.
    permutations, seed
        Of the p-values.
    runs
        How many runs it was looked for in: with one, nothing was permuted and no other run predicts it.
    """

    present: bool
    p: float
    rms: float
    locations: tuple[AxisLocation, ...]
    cells: tuple[PhaseCell, ...]
    domain: str
    domain_scores: Mapping[str, float]
    permutations: int
    seed: int
    runs: int = 0

    def location(self, name: str) -> AxisLocation:
        """Return an axis by name; raises `KeyError` for one that there is not."""
        locations = {location.name: location for location in self.locations}
        return locations[name]

    def document(self) -> Mapping[str, object]:
        """Return it as the report's `where`."""
        named = {
            location.name: {axis_bin.name: round(axis_bin.p, 4) for axis_bin in location.bins}
            for location in self.locations
            if location.shares
        }
        return {
            **{location.name: location.document() for location in self.locations},
            "domain": self.domain,
            "domain_scores": {name: round(score, 4) for name, score in self.domain_scores.items()},
            "p": round(self.p, 4),
            "p_of": named,
            "excess_sd": round(self.rms, 3),
            "permutations": self.permutations,
            "seed": self.seed,
        }


@dataclass(frozen=True, slots=True)
class ModelPair:
    """Two hypotheses and how far runs set them apart.

    Attributes
    ----------
    truth, rival
        Effects; an empty rival stands for no effect at all.
    d_prime
        d′ between them with the first one there and the second one taking as much of it as it can.
    remaining_share
        Share of the first one's squares that the second one leaves.
    """

    truth: str
    rival: str
    d_prime: float
    remaining_share: float


@dataclass(frozen=True, slots=True)
class NextRun:
    """A run that is recommended.

    Attributes
    ----------
    step
        As a plan has it: kind, settings, repeats and the rest before it.
    minutes
        Rig time with rests and ways back, of all repeats.
    before, after
        The contest that it decides most, without it and with it.
    optional
        Whether all is answered well enough without it.
    """

    step: PlanStep
    minutes: float
    before: ModelPair
    after: ModelPair
    optional: bool = False

    @property
    def settings(self) -> Mapping[str, object]:
        """The protocol's settings by name."""
        return self.step.parameters


@dataclass(frozen=True, slots=True)
class NextExperiment:
    """The run to make next, or several.

    Attributes
    ----------
    runs
        The best first.
    compared
        How many settings were compared.
    reason
        Why, in plain words.
    """

    runs: tuple[NextRun, ...]
    compared: int
    reason: str

    @property
    def minutes(self) -> float:
        """Rig time of all of them."""
        return sum(run.minutes for run in self.runs)


class Verdict(StrEnum):
    """The answer in a word."""

    EFFECT = "effect"
    SEVERAL = "several"
    NO_GAP = "no_gap"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class RankedHypothesis:
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
    parameters: tuple[EstimatedQuantity, ...] = ()
    held_out_improvement: float | None = None


@dataclass(frozen=True, slots=True)
class R2BeforeAfter:
    """A coefficient of determination below and above the speed boundary; None where no drag run lies there."""

    before_below: float | None
    before_above: float | None
    after_below: float | None
    after_above: float | None


@dataclass(frozen=True, slots=True)
class GapReduction:
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
    r2_eq15: R2BeforeAfter
    r2_corr: R2BeforeAfter
    runs: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class RunTraces:
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
class UnexplainedGap:
    """What is known of a gap, or of the rest of one, that no effect of the catalogue explains.

    Attributes
    ----------
    location
        A sentence: where it is.
    dependence
        A sentence: what it depends on.
    expression
        A sparse expression that holds up on runs that took no part; empty where none does.
    held_out_share
        Share of the excess that the expression explains there.
    """

    location: str
    dependence: str
    expression: str = ""
    held_out_share: float | None = None


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
    detection_limit_mN
        Smallest effect that these runs would have shown.
    limitations
        Questions that these runs say nothing about, a sentence each.
    next_experiment
        The run that would separate the leading hypotheses best per minute; None where none is recommended.
    model
        The amended model; None where nothing was named or the nominal model is not the friction model.
    decision_inputs
        What the verdict was made of, to learn from.
    """

    specimen: str
    nominal: str
    runs: int
    used_for_fit: tuple[str, ...]
    held_out: tuple[str, ...]
    left_out: tuple[Exclusion, ...]
    verdict: Verdict
    effects: tuple[str, ...]
    ranking: tuple[RankedHypothesis, ...]
    confusable_with: tuple[str, ...]
    residual_unknown: bool
    detection_limit_mN: float
    tolerance_mN: float
    where: GapLocation
    shrink: GapReduction | None
    unknown: UnexplainedGap | None = None
    model: FrictionModelSettings | None = None
    traces: tuple[RunTraces, ...] = ()
    limitations: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    calibration: str = ""
    decision_inputs: DecisionInputs | None = None
    timings_s: Mapping[str, float] = field(default_factory=dict)
    next_experiment: NextExperiment | None = None
