"""Size of hidden effects: d′, the norm of the whitened signature with every nominal direction projected out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dragrig.sim_backend.blind import BlindCampaign, effect_signatures, without_effects
from dragrig.sim_backend.blind.blind_campaign import HiddenSpecimen, NoiseLevels
from dragrig.sim_backend.blind.plant import noise_free_run

Floats = npt.NDArray[np.float64]
SAMPLE_RATE_HZ = 500.0
COUNT_SD_MM = 0.001 / 12**0.5
ZERO_PRIOR_MN = 100.0
"""Prior of a run's zero offset: free."""


@dataclass(frozen=True, slots=True)
class EffectSize:
    """d′ in the force, and in the position with encoder counts as its noise."""

    force: float
    position: float


@dataclass(frozen=True, slots=True)
class NuisanceDirections:
    """Whitened directions that are no gap, each times its prior: of the specimen, and of every run alone."""

    noise: NoiseLevels
    shared: tuple[Floats, ...]
    own: tuple[Floats, ...]


def whiten(values: Floats, noise: NoiseLevels) -> Floats:
    """Return the values, shape `(N, …)`, as they are seen through white noise plus an exponentially correlated one.

    The sum is an ARMA(1, 1) process; its inverse filter leaves unit white noise.
    """
    from scipy.signal import lfilter

    kept = float(np.exp(-1 / (SAMPLE_RATE_HZ * noise.correlation_s)))
    white, slow = noise.white_mN**2, noise.slow_mN**2 * (1 - kept**2)
    both, lag = (1 + kept**2) * white + slow, kept * white
    theta = (both - np.sqrt(both**2 - 4 * lag**2)) / (2 * lag)
    return np.asarray(lfilter([1.0, -kept], [1.0, -theta], values, axis=0) / np.sqrt(lag / theta))


def nuisance_directions(secret: BlindCampaign) -> NuisanceDirections:
    """Return what specimens and runs may differ in without a gap, about the hidden specimen."""
    plain = without_effects(secret)
    runs = range(len(secret.runs))
    base = [noise_free_run(plain, at).force for at in runs]
    changes = [(_changed_specimen(secret.specimen, name, step), factor) for name, step, factor in _SPECIMEN_STEPS]
    shared, own = [], []
    for at in runs:
        columns = [
            (noise_free_run(replace(plain, specimen=one), at).force - base[at]) * factor for one, factor in changes
        ]
        shared.append(whiten(np.column_stack(columns), secret.noise))
        variation = secret.variations[at]
        loose = [
            tuple(one if here == at else other for here, other in enumerate(plain.variations))
            for one in (
                replace(variation, stiffness=variation.stiffness * 1.001),
                replace(variation, mu=variation.mu * 1.001),
            )
        ]
        stiff, slip = ((noise_free_run(replace(plain, variations=one), at).force - base[at]) * 1000 for one in loose)
        alone = np.column_stack([np.full_like(base[at], ZERO_PRIOR_MN), 0.02 * stiff, 0.015 * slip])
        own.append(whiten(alone, secret.noise))
    return NuisanceDirections(secret.noise, tuple(shared), tuple(own))


_SPECIMEN_STEPS = (
    ("stiffness", 0.001, 150.0),
    ("E1", 0.001, 70.0),
    ("E2", 0.001, 70.0),
    ("E3", 0.001, 70.0),
    ("eta1", 0.001, 70.0),
    ("eta2", 0.001, 70.0),
    ("mu", 0.001, 120.0),
    ("mucus", 0.001, 200.0),
    ("angle_deg", 0.001, 0.7 / 60 * 1000),
    ("gain", 0.001, 5.0),
    ("dwell_s", 0.001, 250.0),
)
"""Name, relative step, and standard deviation between specimens over the step."""


def _changed_specimen(specimen: HiddenSpecimen, name: str, step: float) -> HiddenSpecimen:
    five = ("E1", "E2", "E3", "eta1", "eta2")
    if name in five:
        scales = list(specimen.five)
        scales[five.index(name)] *= 1 + step
        return replace(specimen, five=(scales[0], scales[1], scales[2], scales[3], scales[4]))
    return replace(specimen, **{name: getattr(specimen, name) * (1 + step)})


def residual_chi2(found: NuisanceDirections, residuals: Sequence[Floats]) -> float:
    """Return the squared norm of force residuals, one per run, beyond the directions within their priors."""
    parameters = found.shared[0].shape[1]
    total, gram, right = 0.0, np.zeros((parameters, parameters)), np.zeros(parameters)
    for residual, shared, own in zip(residuals, found.shared, found.own, strict=True):
        seen = whiten(residual, found.noise)
        inner = np.linalg.inv(np.eye(own.shape[1]) + own.T @ own)
        kept = np.column_stack([shared, seen])
        kept = kept.T @ kept - (kept.T @ own) @ inner @ (own.T @ kept)
        gram, right, total = gram + kept[:-1, :-1], right + kept[:-1, -1], total + float(kept[-1, -1])
    best = np.linalg.solve(np.eye(len(gram)) + gram, right)
    return total - float(best @ right)


def effect_size(secret: BlindCampaign, found: NuisanceDirections | None = None) -> EffectSize:
    """Return how large the effects of a campaign are."""
    marks = effect_signatures(secret)
    force = residual_chi2(found or nuisance_directions(secret), [one.force for one in marks])
    position = sum(float((one.position**2).sum()) for one in marks) / COUNT_SD_MM**2
    return EffectSize(max(force, 0.0) ** 0.5, position**0.5)
