"""The result of a diagnosis as frozen values: verdict, ranking, location, gap reduction and next runs."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from dragrig.analysis import EstimatedQuantity, Exclusion, count_text, join_names
from dragrig.analysis.gap.features import DecisionInputs
from dragrig.config import ModelSettings, PlanStep
from dragrig.rig import FloatArray, as_html
from dragrig.sim_backend.effects import catalogue

ALPHA = 0.05
"""Significance level of a gap, and of a place of it."""


@dataclass(frozen=True, slots=True)
class AxisBin:
    """A bin of an axis."""

    name: str
    """Its name; empty for numeric bins."""
    low: float | None
    """Lower end in the axis' unit; None for named bins."""
    high: float | None
    """Upper end."""
    share: float
    """Share of the excess on this axis; 0 without a gap."""
    rms: float
    """Root mean excess, in expected standard deviations."""
    p: float
    """Familywise p-value."""


@dataclass(frozen=True, slots=True)
class AxisLocation:
    """Location of the excess on one axis."""

    name: str
    """Name in the report."""
    bins: tuple[AxisBin, ...]
    """All bins, whose shares sum to 1 or are all 0."""
    covered_share: float
    """Share of the whole excess on this axis; if small, bins have no shares."""
    low: float | None
    """Begin of the narrowest range of adjacent bins with most of the excess; None without a gap, for named bins."""
    high: float | None
    """End of that range."""
    share: float
    """Share of this range."""
    p: float
    """p-value of the place that is said of the axis: of this range, or of the most significant named bin. Corrected for
    all places compared on the axis."""

    @property
    def significant(self) -> bool:
        """Whether the place that is said of the axis stands out beyond chance."""
        return self.p < ALPHA

    @property
    def shares(self) -> Mapping[str, float]:
        """Shares of the named bins."""
        return {axis_bin.name: axis_bin.share for axis_bin in self.bins if axis_bin.name}

    def document(self) -> Mapping[str, object]:
        """Return it as in the report; empty where the coordinate is not known."""
        if self.shares or not self.bins:
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
    """Root mean excess of a channel in a phase of a protocol, in expected standard deviations; None if never seen."""

    channel: str
    protocol: str
    phase: str
    rms: float | None


@dataclass(frozen=True, slots=True)
class GapLocation:
    """Location of a gap."""

    present: bool
    """Whether there is a gap."""
    p: float
    """p-value of the excess, or of its concentration in one place, corrected for all axes by Bonferroni's method."""
    rms: float
    """Root mean excess of all runs, in expected standard deviations."""
    locations: tuple[AxisLocation, ...]
    """Location on each axis."""
    cells: tuple[PhaseCell, ...]
    """Excess by channel, protocol and phase."""
    domain: str
    """What the residual is mainly a function of; empty without a gap."""
    domain_scores: Mapping[str, float]
    """Share of the residual that each domain explains in held-out runs, 0 to 1."""
    permutations: int
    """Number of those that the p-values rest on."""
    seed: int
    """Of the permutations."""
    runs: int = 0
    """Number of runs; with one, there is no permutation and no prediction from others."""

    def location(self, name: str) -> AxisLocation:
        """Return an axis by name; raises `KeyError` for an unknown one."""
        locations = {location.name: location for location in self.locations}
        return locations[name]

    def document(self) -> Mapping[str, object]:
        """Return it as `where` of the report."""
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
class NextRun:
    """A recommended run."""

    step: PlanStep
    """Step of a plan: kind, settings, repeats and the rest before it."""
    minutes: float
    """Rig time of all repeats, with rests and returns."""
    gain_bits: float | None
    """Information that it is expected to add to the runs before it; None for a motion that nothing is known of yet."""
    about: tuple[str, ...] = ()
    """What it tells most of: the effects whose presence, or which of which, is open."""

    @property
    def settings(self) -> Mapping[str, object]:
        """The protocol's settings by name."""
        return self.step.parameters


@dataclass(frozen=True, slots=True)
class NextExperiment:
    """Recommended runs."""

    runs: tuple[NextRun, ...]
    """Recommended runs, the best first."""
    compared: int
    """Number of candidate runs."""
    reason: str
    """Reason in plain words."""
    open_bits: float | None = None
    """Entropy of the question before these runs; None for a motion that nothing is known of yet."""

    @property
    def minutes(self) -> float:
        """Rig time of all runs."""
        return sum(run.minutes for run in self.runs)


@dataclass(frozen=True, slots=True)
class OpenCauses:
    """What is open about which causes act on the force, sizes included that these runs cannot show."""

    probabilities: Mapping[str, float]
    """Probability that each cause acts: ids of effects, and `unexplained`. Effects that no explanation names are left
    out."""
    none: float
    """Probability that none acts."""
    surest: float
    """Probability of the most likely set of causes."""
    bits: float
    """Entropy of which set of causes acts."""


class Verdict(StrEnum):
    """Verdict of a diagnosis; `open` of runs of a single condition, which the model's own parameters can follow."""

    EFFECT = "effect"
    SEVERAL = "several"
    NO_GAP = "no_gap"
    UNKNOWN = "unknown"
    OPEN = "open"


NO_GAP, UNKNOWN = "no_gap", "unknown"
"""Hypotheses without an effect."""
MIN_PROBABILITY, MAX_PROBABILITY = 0.003, 0.985
"""Limits of all probabilities: simulated campaigns cannot confirm more extreme ones."""


@dataclass(frozen=True, slots=True)
class Classification:
    """A verdict with the probabilities of all relevant hypotheses, and what is confusable with it."""

    verdict: Verdict
    effects: tuple[str, ...]
    probabilities: Mapping[str, float]
    confusable_with: tuple[str, ...]

    def marginal(self, effect: str) -> float:
        """Return the probability of all hypotheses with an effect."""
        return marginal_probability(effect, self.probabilities)


def marginal_probability(effect: str, probabilities: Mapping[str, float]) -> float:
    """Return the probability of all hypotheses, several effects joined with `+`, that contain an effect."""
    return sum(value for names, value in probabilities.items() if effect in names.split("+"))


@dataclass(frozen=True, slots=True)
class RankedHypothesis:
    """A hypothesis with its probability."""

    hypothesis: str
    """Id of an effect, several joined with `+`, `no_gap` or `unknown`."""
    probability: float
    """Probability, calibrated on simulated campaigns; a ranking sums to 1."""
    parameters: tuple[EstimatedQuantity, ...] = ()
    """Fitted parameters of its effects; empty for `no_gap` and `unknown`."""
    held_out_improvement: float | None = None
    """Share of the excess that it explains in held-out runs; None where not evaluated."""


@dataclass(frozen=True, slots=True)
class R2BeforeAfter:
    """Coefficients of determination below and above the speed boundary; None without drag runs there."""

    before_below: float | None
    before_above: float | None
    after_below: float | None
    after_above: float | None


@dataclass(frozen=True, slots=True)
class GapReduction:
    """How far the gap closes with the effects in the simulator, on held-out runs."""

    gap_before_mN: float
    """Rms residual without the effects."""
    gap_after_mN: float
    """Rms residual with them."""
    noise_floor_mN: float
    """Noise at rest and scatter of repeats, fixed before any fit."""
    closed: float | None
    """`1 − (after² − floor²) / (before² − floor²)`; None without a gap to close."""
    closed_95ci: tuple[float, float] | None
    """Bootstrap interval over runs."""
    boundary_mm_s: float | None
    """Speed boundary of the coefficients of determination; None without drag runs on both sides."""
    r2_eq15: R2BeforeAfter
    """Of steady drag forces, by Eq. 15 of the paper."""
    r2_corr: R2BeforeAfter
    """The same as squared correlation."""
    runs: tuple[str, ...] = ()
    position_um: tuple[float, float] | None = None
    """Rms position error without and with the effects [µm], where `closed` is the share of that; else None."""


@dataclass(frozen=True, slots=True)
class SteadyLevels:
    """Steady force of a sliding run, measured and by the model before and after, less the force measured at rest."""

    speed_mm_s: float
    measured_mN: float
    models_mN: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class RunTraces:
    """Measured and modelled force of one run for figures: means over `B` blocks."""

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
    steady: SteadyLevels | None = None


@dataclass(frozen=True, slots=True)
class UnexplainedGap:
    """Description of a gap, or its remainder, that no effect of the catalogue explains."""

    location: str
    """Where it is, in sentences."""
    dependence: str
    """What it depends on, in sentences."""
    expression: str = ""
    """Sparse expression that predicts held-out runs; empty for none."""
    held_out_share: float | None = None
    """Share of the excess that the expression explains there."""


UNEXPLAINED, MODEL, SPECIMEN = "unexplained", "model", "specimen"
"""Causes of a budget beside effects."""
SURE_EXCHANGE = 0.999
"""A specimen exchanged unrecorded is surer than 0.999999 in 14 of 14 simulated campaigns; one that ages gradually is
taken for an exchange with up to 0.97."""
ESTABLISHED = 0.5
"""Probability of presence from which on a cause is named."""


@dataclass(frozen=True, slots=True)
class BudgetEntry:
    """A part of the gap."""

    cause: str
    """Id of an effect, `model`, `specimen` or `unexplained`."""
    channel: str
    """`force` or `position`."""
    share: float
    """Share of the gap in its channel on held-out runs."""
    share_95ci: tuple[float, float] | None
    """Bootstrap interval over runs; None where a single run gives none."""
    rms_mN: float | None
    """Root mean square of its contribution to the force; None in the position."""
    presence: float | None = None
    """Probability that it is there; None for the rest."""
    what: str = ""
    """What the part looks like, in plain words: directions of a model, or what the unexplained rest depends on."""
    not_separable_from: tuple[str, ...] = ()
    """Effects that these runs cannot tell from it, and `model` where its own laws may be in its place."""


@dataclass(frozen=True, slots=True, eq=False)
class RunContributions:
    """The gap of one run and what each part of the budget adds to it, whose shares the budget states."""

    file: str
    kind: str
    label: str
    channel: str
    unit: str
    """Of the gap and the parts: mN of a force, µm of a position."""
    time_s: FloatArray
    """Middle of `B` blocks, shape `(B,)`."""
    width_s: FloatArray
    """Their duration, shape `(B,)`."""
    position_mm: FloatArray
    """Position there, shape `(B,)`."""
    gap: FloatArray
    """What the model without causes leaves of the run, without what the run itself is off by; shape `(B,)`."""
    parts: Mapping[str, FloatArray]
    """What each named cause adds, predicted from fits to other runs where runs were held out; shape `(B,)` each."""
    acting_mN: Mapping[str, float] = field(default_factory=dict)
    """Rms of a cause's own force in the run; what it adds elsewhere is what it makes the nominal parameters miss. Empty
    in the position."""

    def rms(self, cause: str = "") -> float:
        """Return the root mean square over time of a part, or of the gap; 0 for a part that the run lacks."""
        values = self.parts.get(cause) if cause else self.gap
        return 0.0 if values is None else float(np.sqrt(np.average(values**2, weights=self.width_s)))


@dataclass(frozen=True, slots=True)
class GapBudget:
    """The gap of a campaign by causes."""

    presence: Mapping[str, float]
    """Probability that each effect of the catalogue is there, given all else that may be there; of one that shares its
    place with the nominal model, that either of them is."""
    entries: tuple[BudgetEntry, ...]
    """Parts of the gap, the largest first and the unexplained rest last, by channel; empty without a gap."""
    gap_mN: float
    """Root mean square of the force's gap above noise on the runs."""
    held_out: bool
    """Whether shares are of runs that took no part in the fit; False for too few runs."""
    runs: tuple[RunContributions, ...] = ()
    """What each part adds to each run, by channel; empty without a gap. Spectral lines, which block means average out,
    have no part in them."""

    @property
    def shared_with(self) -> Mapping[str, tuple[str, ...]]:
        """Causes that these runs cannot tell from named ones, by their names."""
        return {entry.cause: entry.not_separable_from for entry in self.entries if entry.not_separable_from}

    def leaves_more_than(self, share: float, tolerance_mN: float) -> bool:
        """Whether the unexplained rest of the force is surely there, larger than a share of the gap and a tolerance."""
        rest = [entry for entry in self.entries if entry.cause == UNEXPLAINED and entry.channel == "force"]
        return any(
            entry.share > share
            and (entry.rms_mN or 0.0) > tolerance_mN
            and (entry.share_95ci is None or entry.share_95ci[0] > 0.0)
            for entry in rest
        )


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Diagnosis:
    """Result of a diagnosis."""

    specimen: str
    nominal: str
    runs: int
    used_for_fit: tuple[str, ...]
    """Files of the runs in the final fit."""
    held_out: tuple[str, ...]
    """Files of the runs that were held out in turn."""
    left_out: tuple[Exclusion, ...]
    verdict: Verdict
    effects: tuple[str, ...]
    """Most likely effects; empty for `no_gap`, `unknown` and `open`."""
    ranking: tuple[RankedHypothesis, ...]
    """Hypotheses with their probabilities; empty for `open`."""
    confusable_with: tuple[str, ...]
    """Effects that these runs cannot distinguish from them, excluded ones included."""
    residual_unknown: bool
    """Whether part of the gap remains beside clearly present effects; of `open`, whether there is a gap."""
    detection_limit_mN: float
    """Smallest detectable effect, rms force where it acts."""
    tolerance_mN: float
    where: GapLocation
    shrink: GapReduction | None
    unknown: UnexplainedGap | None = None
    model: ModelSettings | None = None
    """Amended model; None without named effects or for other models than the friction model."""
    traces: tuple[RunTraces, ...] = ()
    limitations: tuple[str, ...] = ()
    """What these runs cannot answer, a sentence each."""
    remarks: tuple[str, ...] = ()
    calibration: str = ""
    decision_inputs: DecisionInputs | None = None
    """Numbers that the verdict is based on, for training."""
    timings_s: Mapping[str, float] = field(default_factory=dict)
    next_experiment: NextExperiment | None = None
    """Runs that separate the leading hypotheses best per minute; None for no recommendation."""
    budget: GapBudget | None = None
    """The gap by causes, with the probability that each effect is there."""
    backends: tuple[str, ...] = ()
    """Where the runs come from: simulated, hardware, external."""
    open_causes: OpenCauses | None = None
    """What is open about the causes; None for other models than the friction model, or where no run was looked for."""
    only_condition: str = ""
    """Condition of the runs in words, as `a drag at 20 mm/s`, where there is no other; else empty."""
    likeliest: "Diagnosis | None" = None
    """Of `open`: the diagnosis as if these runs could tell, for exams."""

    def __repr__(self) -> str:
        verdict = NAMES_WITHOUT_EFFECT.get(self.verdict.value) or " and ".join(self.effects)
        return f"<diagnosis of specimen {self.specimen}, {count_text(self.runs, 'run')}: {verdict}>"

    _repr_html_ = as_html


def left_open(diagnosis: Diagnosis, only_condition: str) -> Diagnosis:
    """Return a diagnosis of runs of a single condition: where they differ from the model, and no cause of it."""
    budget = diagnosis.budget
    return replace(
        diagnosis,
        verdict=Verdict.OPEN,
        effects=(),
        ranking=(),
        confusable_with=(),
        residual_unknown=diagnosis.verdict is not Verdict.NO_GAP,
        model=None,
        budget=None if budget is None else replace(budget, presence={}, entries=(), runs=()),
        only_condition=only_condition,
        likeliest=diagnosis,
    )


NAMES_WITHOUT_EFFECT = {"no_gap": "no gap", "unknown": "none of the catalogue"}


def display_name(hypothesis: str) -> str:
    """Return the name of a hypothesis for a sentence; several effects joined with `and`."""
    if hypothesis in NAMES_WITHOUT_EFFECT:
        return NAMES_WITHOUT_EFFECT[hypothesis]
    known = catalogue()
    names = [known[name].name if name in known else name.replace("_", " ") for name in hypothesis.split("+")]
    return join_names(names)
