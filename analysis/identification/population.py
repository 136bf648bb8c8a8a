"""The common part of specimens of one rig: means and spreads of their parameters, from the fits of their campaigns.

A parameter of a specimen is the population's mean plus a deviation of its own, normally distributed where each
parameter is standard normal a priori; a parameter of the rig is the same in all campaigns. Means and the rig's
parameters have the prior that a single specimen has, once. From each campaign's fit
its prior is taken out again, so that it counts once, and the fit's word on all parameters and their correlations
enters as a Gaussian likelihood. The deviations are integrated out; spreads maximise the restricted likelihood (REML),
the means being integrated out as well. The model is that of Laird and Ware, Biometrics 38 (1982) 963. The uncertainty
of a spread is that of its likelihood under a flat prior, as Gelman, Bayesian Analysis 1 (2006) 515, has it for few
groups; mean and next specimen are averaged over it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import hypot

import numpy as np

from dragrig.analysis import (
    NORMAL_95,
    EstimatedQuantity,
    Exclusion,
    Parameter,
    PriorScales,
    count_text,
    join_names,
)
from dragrig.analysis.identification.identification import MIN_LEARNT, Identification, JointFit
from dragrig.analysis.identification.identify import correlated_groups
from dragrig.config import AnalysisError
from dragrig.rig import BoolArray, FloatArray

MIN_SPECIMENS = 3
"""Fewer do not bound a spread from above."""
MAX_SPREAD = 6.0
"""Largest spread that is considered, in prior standard deviations."""
MAX_NO_SPREAD_P = 0.05
"""Significance level of a spread."""
MAX_SAME_RIG_P = 0.01
"""Significance level at which a parameter of the rig differs between campaigns."""
_SPREADS = np.concatenate(([0.0], np.geomspace(0.01, MAX_SPREAD, 50)))
_PREDICTION_PROBABILITIES = (0.025, 0.5, 0.975)


@dataclass(frozen=True, slots=True, eq=False)
class SpecimenFit:
    """The identification of one campaign for a population."""

    source: str
    """The campaign's folder."""
    specimen: str
    """Its specimen; campaigns with the same one count as one specimen."""
    identification: Identification
    rig: str = ""
    """Name of the rig that the runs state."""
    sensor: str = ""
    """Serial numbers of its force sensor."""


@dataclass(frozen=True, slots=True, eq=False)
class SpecimenValue:
    """A parameter of one specimen: as its own runs have it, and with the population's contribution.

    `own` is None where its runs do not determine it. Of two specimens, `pooled` is `own`, or NaN.
    """

    specimen: str
    own: EstimatedQuantity | None
    pooled: EstimatedQuantity


@dataclass(frozen=True, slots=True, eq=False)
class PopulationParameter:
    """A parameter over specimens, or of the rig."""

    name: str
    unit: str
    meaning: str
    of_rig: bool
    mean: EstimatedQuantity
    """Of the population (of a positive parameter the median), or the rig's value. Of two specimens, whose spread nobody
    knows, it has neither error nor interval: both are NaN."""
    determined: bool
    """Whether the campaigns narrowed it."""
    spread: EstimatedQuantity | None
    """Standard deviation between specimens with its 95 % interval, in the parameter's unit; None for a parameter of the
    rig, and where specimens are too few."""
    spread_p: float | None
    """Probability of an apparent spread as large where there is none; of a parameter of the rig, of such a difference
    between campaigns; of two specimens, of such a difference in any of the parameters that are compared."""
    next_specimen: tuple[float, float] | None
    """Holds the value of a further specimen with 95 % probability; None as `spread`."""
    specimens: tuple[SpecimenValue, ...]

    @property
    def spreads(self) -> bool:
        """Whether specimens differ by more than their errors."""
        return not self.of_rig and self.spread_p is not None and self.spread_p < MAX_NO_SPREAD_P


@dataclass(frozen=True, slots=True, eq=False)
class Population:
    """Specimens of one rig together."""

    nominal: str
    campaigns: tuple[str, ...]
    specimens: tuple[str, ...]
    parameters: tuple[PopulationParameter, ...]
    left_out: tuple[Exclusion, ...] = ()
    remarks: tuple[str, ...] = ()
    backends: tuple[str, ...] = ()

    @property
    def has_means(self) -> bool:
        """Whether the specimens are so many that their mean has an interval."""
        return len(self.specimens) >= MIN_SPECIMENS


def pool_specimens(
    fits: Sequence[SpecimenFit], parameters: Sequence[Parameter], left_out: Sequence[Exclusion] = ()
) -> Population:
    """Pool the joint fits of campaigns, and their friction coefficients by the Coulomb test.

    Parameters
    ----------
    parameters
        Of the nominal model that was fitted.
    left_out
        Campaigns and runs that do not take part.

    Raises
    ------
    AnalysisError
        When fewer than two specimens have a fit that converged, or the campaigns are of several rigs.
    """
    excluded = list(left_out)
    usable: list[tuple[SpecimenFit, JointFit]] = []
    for fit in fits:
        joint = fit.identification.joint
        if joint is None or not joint.converged:
            reason = "there is no joint fit" if joint is None else "its joint fit did not converge"
            excluded.append(Exclusion(fit.source, reason))
        else:
            usable.append((fit, joint))
    specimens = tuple(dict.fromkeys(fit.specimen for fit, _ in usable))
    if len(specimens) < 2:
        raise AnalysisError(
            f"{count_text(len(specimens), 'specimen')} of {count_text(len(fits), 'campaign')} can be used; a "
            "population needs at least two: runs of the same specimen id count as one specimen."
        )
    _require_one_rig([fit for fit, _ in usable])
    pooled, inseparable = _pool_joint_fits(usable, specimens, parameters)
    if len(specimens) < MIN_SPECIMENS:
        pooled, inseparable = tuple(_compared(pooled)), ()
    coulomb = tuple(_pool_coulomb(usable, specimens))
    return Population(
        nominal=usable[0][1].nominal,
        campaigns=tuple(fit.source for fit, _ in usable),
        specimens=specimens,
        parameters=(*pooled, *coulomb),
        left_out=tuple(excluded),
        remarks=(*_remarks(usable, specimens, pooled), *inseparable),
        backends=tuple(dict.fromkeys(name for fit, _ in usable for name in fit.identification.backends)),
    )


def _compared(parameters: Sequence[PopulationParameter]) -> Iterator[PopulationParameter]:
    """Compare two specimens in place of pooling them: the spread that their mean stands on is not known."""
    from scipy.special import chdtrc

    pairs = [
        [value.own for value in parameter.specimens if value.own is not None]
        for parameter in parameters
        if not parameter.of_rig
    ]
    tests = sum(len(pair) == 2 for pair in pairs)
    unknown = (np.nan, np.nan)
    for parameter in parameters:
        own = [value.own for value in parameter.specimens if value.own is not None]
        if parameter.of_rig:
            yield parameter
            continue
        middle, p_value = np.nan, None
        if len(own) == 2:
            first, second = (quantity.value for quantity in own)
            middle = float(np.sqrt(first * second)) if first > 0 < second else 0.5 * (first + second)
            sd = hypot(*(quantity.standard_error for quantity in own))
            p_value = min(float(tests * chdtrc(1, ((first - second) / sd) ** 2)), 1.0)
        nothing = EstimatedQuantity(parameter.name, parameter.unit, np.nan, np.nan, unknown)
        yield replace(
            parameter,
            mean=replace(nothing, value=middle),
            determined=len(own) == 2,
            spread_p=p_value,
            specimens=tuple(replace(value, pooled=value.own or nothing) for value in parameter.specimens),
        )


def _require_one_rig(fits: Sequence[SpecimenFit]) -> None:
    by_rig: dict[str, list[str]] = {}
    for fit in fits:
        if fit.rig:
            by_rig.setdefault(fit.rig, []).append(fit.source)
    if len(by_rig) > 1:
        rigs = "; ".join(f"{rig}: {', '.join(sources)}" for rig, sources in by_rig.items())
        raise AnalysisError(f"the campaigns are of several rigs ({rigs}); what is of a rig cannot be one set for all.")


@dataclass(frozen=True, eq=False)
class Likelihoods:
    """The information of the runs of each of `S` specimens on `P` parameters in prior units, without any prior.

    The likelihood of a specimen's parameters `z` is exp(h·z - z·L·z / 2).
    """

    matrices: FloatArray
    """`L`, shape `(S, P, P)`."""
    vectors: FloatArray
    """`h`, shape `(S, P)`."""
    mean_prior_sd: FloatArray
    """Of the population's means and the rig's values, shape `(P,)`."""

    def conditional(self, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return `C` and `c` of each specimen, its deviations with this spread integrated out, as `L` and `h`."""
        precision, at = self._deviations(spread)
        scaled = self.matrices * spread
        return (
            self.matrices - scaled @ np.linalg.solve(precision, np.swapaxes(scaled, 1, 2)),
            self.vectors - np.einsum("spq,sq->sp", scaled, np.linalg.solve(precision, at[..., None])[..., 0]),
        )

    def _deviations(self, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
        identity = np.eye(len(spread))
        return identity + spread[:, None] * self.matrices * spread, self.vectors * spread

    def log_likelihood(self, spread: FloatArray) -> float:
        """Return the restricted log likelihood of the spreads, shape `(P,)`."""
        precision, at = self._deviations(spread)
        matrices, vectors = self.conditional(spread)
        total = np.diag(self.mean_prior_sd**-2.0) + matrices.sum(axis=0)
        vector = vectors.sum(axis=0)
        deviations = np.einsum("sp,sp->", at, np.linalg.solve(precision, at[..., None])[..., 0])
        determinants = float(np.sum(np.linalg.slogdet(precision)[1])) + float(np.linalg.slogdet(total)[1])
        return 0.5 * float(deviations + vector @ np.linalg.solve(total, vector) - determinants)

    def mean(self, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the means, shape `(P,)`, and their covariance, given the spreads."""
        matrices, vectors = self.conditional(spread)
        covariance = np.linalg.inv(np.diag(self.mean_prior_sd**-2.0) + matrices.sum(axis=0))
        return np.asarray(covariance @ vectors.sum(axis=0)), np.asarray(covariance)

    def specimens(self, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the specimens' own parameters and standard deviations given the spreads, shape `(S, P)` each."""
        mean, mean_covariance = self.mean(spread)
        precision, at = self._deviations(spread)
        inverse = np.linalg.inv(precision)
        scaled = spread[:, None] * self.matrices
        # A deviation is D (h - L mean), with D = spread (1 + spread L spread)^-1 spread.
        gain = np.eye(len(spread)) - spread[:, None] * (inverse @ scaled)
        deviations = spread * np.einsum("spq,sq->sp", inverse, at - np.einsum("spq,q->sp", scaled, mean))
        own = np.einsum("p,spp,p->sp", spread, inverse, spread)
        of_mean = np.einsum("spq,qr,spr->sp", gain, mean_covariance, gain)
        return mean + deviations, np.sqrt(own + of_mean)

    @cached_property
    def informed(self) -> FloatArray:
        """Likelihoods of all specimens on each parameter were all others known, shape `(P,)`."""
        return np.asarray(np.einsum("spp->p", self.matrices))


def _information_of(joint: JointFit, scales: PriorScales) -> tuple[FloatArray, FloatArray]:
    """Return the likelihood of a fit's parameters: its posterior without the prior, which is standard normal."""
    values = np.array([parameter.value for parameter in joint.parameters])
    sd = np.array([parameter.standard_error for parameter in joint.parameters]) / scales.slopes(values)
    precision = np.linalg.inv(joint.correlation * np.outer(sd, sd))
    gained, directions = np.linalg.eigh(precision - np.eye(len(sd)))
    # Where errors were widened for a misfit, less is known than the prior says: then nothing is.
    known = directions[:, gained > 0]
    return known @ np.diag(gained[gained > 0]) @ known.T, known @ (known.T @ (precision @ scales.deviations(values)))


def _restricted_maximum(information: Likelihoods, free: BoolArray) -> FloatArray:
    """Return the spreads of largest restricted likelihood; only those that are free are not 0."""
    from scipy.optimize import minimize

    spread = np.zeros(len(free))
    places = np.flatnonzero(free)
    if not places.size:
        return spread

    def cost(values: FloatArray) -> float:
        spread[places] = values
        return -information.log_likelihood(spread)

    found = minimize(cost, np.full(places.size, 0.5), method="L-BFGS-B", bounds=[(0.0, MAX_SPREAD)] * places.size)
    spread[places] = found.x
    return spread


@dataclass(frozen=True, slots=True)
class _Spread:
    """The likelihood of one parameter's spread with all others at their best, on `_SPREADS`."""

    weights: FloatArray
    """Probabilities under a flat prior, shape `(G,)`."""
    p_value: float

    @classmethod
    def of(cls, information: Likelihoods, best: FloatArray, place: int) -> "_Spread":
        from scipy.special import chdtrc

        spread = best.copy()
        likelihoods = np.empty(_SPREADS.size)
        for number, value in enumerate(_SPREADS):
            spread[place] = value
            likelihoods[number] = information.log_likelihood(spread)
        highest = float(likelihoods.max())
        gained = 2 * (highest - float(likelihoods[0]))
        # At the edge of what is possible, half of the cases have no gain at all.
        p_value = 0.5 * float(chdtrc(1, gained)) if gained > 1e-6 else 1.0
        widths = np.gradient(_SPREADS)
        weights = np.exp(likelihoods - highest) * widths
        return cls(weights / weights.sum(), p_value)

    @property
    def interval(self) -> tuple[float, float]:
        """The shortest interval with 95 % of the probability."""
        order = np.argsort(self.weights / np.gradient(_SPREADS))[::-1]
        inside = order[: int(np.searchsorted(np.cumsum(self.weights[order]), 0.95)) + 1]
        return float(_SPREADS[inside.min()]), float(_SPREADS[inside.max()])


def _mixture_quantiles(weights: FloatArray, means: FloatArray, sds: FloatArray) -> tuple[float, float, float]:
    """Return the quantiles of a mixture of normal distributions that enclose 95 %, and the median between."""
    from scipy.optimize import brentq
    from scipy.special import ndtr

    low, high = float(np.min(means - 10 * sds)), float(np.max(means + 10 * sds))

    def excess(value: float, probability: float) -> float:
        return float(weights @ ndtr((value - means) / sds)) - probability

    lower, middle, upper = (float(brentq(excess, low, high, args=(share,))) for share in _PREDICTION_PROBABILITIES)
    return lower, middle, upper


def _pool_joint_fits(
    usable: Sequence[tuple[SpecimenFit, JointFit]], specimens: Sequence[str], parameters: Sequence[Parameter]
) -> tuple[tuple[PopulationParameter, ...], Sequence[str]]:
    scales = PriorScales.of(parameters)
    shape = (len(specimens), len(parameters))
    matrices, vectors = np.zeros((*shape, shape[1])), np.zeros(shape)
    own: list[dict[str, EstimatedQuantity]] = [{} for _ in specimens]
    for fit, joint in usable:
        place = specimens.index(fit.specimen)
        matrix, vector = _information_of(joint, scales)
        matrices[place] += matrix
        vectors[place] += vector
        known = {estimate.name: estimate for estimate in joint.parameters if estimate.determined}
        # Of a specimen's campaigns the one that knows it best is shown as its own.
        own[place] |= {
            name: estimate
            for name, estimate in known.items()
            if name not in own[place] or estimate.standard_error < own[place][name].standard_error
        }
    information = Likelihoods(matrices, vectors, np.ones(len(parameters)))
    best, pooled = _pooled_parameters(information, parameters, scales, specimens, own)
    return pooled, tuple(_inseparable(information, best, parameters))


def _inseparable(information: Likelihoods, best: FloatArray, parameters: Sequence[Parameter]) -> Iterator[str]:
    _, covariance = information.mean(best)
    sd = np.sqrt(np.diag(covariance))
    for group in correlated_groups(covariance / np.outer(sd, sd)):
        yield (
            f"the means of {join_names([parameters[place].name for place in group])} can hardly be separated by these "
            "runs: their product is known better than each of them"
        )


def _pooled_parameters(
    information: Likelihoods,
    parameters: Sequence[Parameter],
    scales: PriorScales,
    specimens: Sequence[str],
    own: Sequence[dict[str, EstimatedQuantity]],
) -> tuple[FloatArray, tuple[PopulationParameter, ...]]:
    """Return the spreads of largest restricted likelihood, shape `(P,)`, and the parameters."""
    of_rig = np.array([parameter.of_rig for parameter in parameters])
    # Nothing is known of what no run depends on: it has neither mean nor spread.
    free = np.asarray(~of_rig & (information.informed > 0) & (len(specimens) >= MIN_SPECIMENS))
    best = _restricted_maximum(information, free)
    values, sds = information.specimens(best)
    return best, tuple(
        _PooledParameter(information, best, place, parameter, scales).result(
            is_free=bool(free[place]),
            specimens=[
                (specimen, known.get(parameter.name), float(values[number, place]), float(sds[number, place]))
                for number, (specimen, known) in enumerate(zip(specimens, own, strict=True))
            ],
        )
        for place, parameter in enumerate(parameters)
    )


@dataclass(frozen=True, slots=True, eq=False)
class _PooledParameter:
    information: Likelihoods
    best: FloatArray
    place: int
    parameter: Parameter
    scales: PriorScales

    def result(
        self, *, is_free: bool, specimens: Sequence[tuple[str, EstimatedQuantity | None, float, float]]
    ) -> PopulationParameter:
        parameter = self.parameter
        spread = _Spread.of(self.information, self.best, self.place)
        tried, weights = (_SPREADS, spread.weights) if is_free else (self.best[[self.place]], np.ones(1))
        means, sds = self._means(tried)
        low, middle, high = _mixture_quantiles(weights, means, sds)
        mean_sd = (high - low) / (2 * NORMAL_95)
        mean = self._quantity(middle, mean_sd, (low, high))
        between = following = None
        if is_free:
            between = self._spread_quantity(mean.value, spread)
            lower, _, upper = _mixture_quantiles(weights, means, np.hypot(sds, tried))
            following = self._value(lower), self._value(upper)
        return PopulationParameter(
            name=parameter.name,
            unit=parameter.unit,
            meaning=parameter.meaning,
            of_rig=parameter.of_rig,
            mean=mean,
            determined=mean_sd < (1 - MIN_LEARNT) * float(self.information.mean_prior_sd[self.place]),
            spread=between,
            spread_p=spread.p_value if is_free or parameter.of_rig else None,
            next_specimen=following,
            specimens=tuple(
                SpecimenValue(
                    specimen, known, self._quantity(value, sd, (value - NORMAL_95 * sd, value + NORMAL_95 * sd))
                )
                for specimen, known, value, sd in specimens
            ),
        )

    def _means(self, spreads: FloatArray) -> tuple[FloatArray, FloatArray]:
        spread = self.best.copy()
        means, sds = np.empty(spreads.size), np.empty(spreads.size)
        for number, value in enumerate(spreads):
            spread[self.place] = value
            mean, covariance = self.information.mean(spread)
            means[number], sds[number] = mean[self.place], np.sqrt(covariance[self.place, self.place])
        return means, sds

    def _value(self, z: float) -> float:
        nominal, sd = float(self.scales.nominal[self.place]), float(self.scales.sd[self.place])
        return nominal * float(np.exp(sd * z)) if self.parameter.positive else nominal + sd * z

    def _slope(self, value: float) -> float:
        return float(self.scales.sd[self.place]) * (value if self.parameter.positive else 1.0)

    def _quantity(self, z: float, sd: float, interval: tuple[float, float]) -> EstimatedQuantity:
        value, (low, high) = self._value(z), (self._value(end) for end in interval)
        return EstimatedQuantity(self.parameter.name, self.parameter.unit, value, self._slope(value) * sd, (low, high))

    def _spread_quantity(self, mean: float, spread: _Spread) -> EstimatedQuantity:
        slope, (low, high) = self._slope(mean), spread.interval
        average = float(spread.weights @ _SPREADS)
        error = float(np.sqrt(spread.weights @ (_SPREADS - average) ** 2))
        best = float(self.best[self.place])
        ends = (slope * min(low, best), slope * max(high, best))
        return EstimatedQuantity(self.parameter.name, self.parameter.unit, slope * best, slope * error, ends)


def _pool_coulomb(
    usable: Sequence[tuple[SpecimenFit, JointFit]], specimens: Sequence[str]
) -> Iterator[PopulationParameter]:
    """Pool the friction coefficients that Coulomb tests give without the joint fit."""
    for name, meaning in (
        ("mu", "μ of the Coulomb test, all of its force as friction"),
        ("mu_without_viscous", "μ of the Coulomb test without its viscous part"),
    ):
        estimates: dict[str, EstimatedQuantity] = {}
        for fit, _ in usable:
            coulomb = fit.identification.coulomb
            estimate = None if coulomb is None else getattr(coulomb, name)
            if estimate is not None and estimate.value is not None and estimate.standard_error:
                found = EstimatedQuantity.normal(name, "1", estimate.value, estimate.standard_error)
                estimates.setdefault(fit.specimen, found)
        if len(estimates) < MIN_SPECIMENS:
            continue
        tested = [specimen for specimen in specimens if specimen in estimates]
        values = np.array([[estimates[specimen].value] for specimen in tested])
        errors = np.array([[estimates[specimen].standard_error] for specimen in tested])
        # Friction that noise makes negative has no logarithm.
        positive, nominal = bool((values > 0).all()), float(np.median(values))
        unit = float(np.hypot(np.std(values), np.median(errors))) / (nominal if positive else 1.0)
        parameter = Parameter(name, "1", nominal, unit, positive=positive, meaning=meaning)
        scales = PriorScales.of([parameter])
        precision = (scales.slopes(values) / errors) ** 2
        information = Likelihoods(precision[:, :, None], precision * scales.deviations(values), np.full(1, 100.0))
        own = [{name: estimates[specimen]} for specimen in tested]
        yield from _pooled_parameters(information, [parameter], scales, tested, own)[1]


def _remarks(
    usable: Sequence[tuple[SpecimenFit, JointFit]],
    specimens: Sequence[str],
    parameters: Sequence[PopulationParameter],
) -> Iterator[str]:
    if len(specimens) < MIN_SPECIMENS:
        yield f"n = {len(specimens)}: no interval of the mean, for the spread between specimens is not known"
    if len(usable) > len(specimens):
        yield f"{len(usable)} campaigns are of {len(specimens)} specimens; what those of one specimen say is joined"
    sensors = sorted({fit.sensor for fit, _ in usable if fit.sensor})
    if len(sensors) > 1:
        yield (
            f"the force was measured with several sensors ({', '.join(sensors)}), and force_gain is fitted as that of "
            "one"
        )
    doubtful = [fit.source for fit, joint in usable if not joint.holds]
    if doubtful:
        yield (
            f"the model leaves more than noise in {join_names(doubtful)}: their parameters absorb some of an effect "
            "that it does not contain; dragrig gap diagnose says which"
        )
    for parameter in parameters:
        if parameter.of_rig and parameter.spread_p is not None and parameter.spread_p < MAX_SAME_RIG_P:
            yield (
                f"{parameter.name} is the rig's, yet differs between the campaigns by more than their errors "
                f"(p = {parameter.spread_p:.2g}): was something calibrated, exchanged or mounted anew between them?"
            )
