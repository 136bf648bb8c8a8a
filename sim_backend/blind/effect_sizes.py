"""How large hidden effects are: the part of each cause in the runs, and d′, its size against noise and specimens.

d′ is the norm of the whitened signature with every direction projected out in which specimens and runs differ.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.sim_backend.blind.blind_campaign import (
    BlindCampaign,
    HiddenSpecimen,
    NoiseLevels,
    NominalErrors,
    without_effects,
)
from dragrig.sim_backend.blind.plant import ENCODER_COUNT_MM, PlantRecord, noise_free_run
from dragrig.sim_backend.blind.run_plans import RATE_HZ, Floats


def effect_signatures(campaign: BlindCampaign) -> tuple[PlantRecord, ...]:
    """Return the change of each run by the hidden effects, noise-free and on the same specimen.

    Force and position of these records are those with the effects minus those without.
    """
    bare = without_effects(campaign)
    signatures = []
    for index in range(len(campaign.runs)):
        run, nominal = noise_free_run(campaign, index), noise_free_run(bare, index)
        signatures.append(replace(run, force=run.force - nominal.force, position=run.position - nominal.position))
    return tuple(signatures)


COUNT_SD_MM = ENCODER_COUNT_MM / 12**0.5
"""Standard deviation of rounding to counts."""
ZERO_PRIOR_MN = 100.0
"""Prior of a run's zero offset: practically free."""
ZERO_SD_MN, REPEAT_SD_MN = 3.0, 2.0
"""By how much zero offsets and repeats differ: what a refit of the specimen may follow, and how closely."""
STIFFNESS_PRIOR, MU_PRIOR = 0.02, 0.015
"""Relative standard deviations between runs."""
RELATIVE_STEP = 0.001
"""Step of the derivatives."""
ELEMENTS = ("E1", "E2", "E3", "eta1", "eta2")
SPECIMEN_PRIORS = {
    "stiffness": 0.15,
    **dict.fromkeys(ELEMENTS, 0.07),
    "mu": 0.12,
    "mucus": 0.2,
    "angle_deg": 0.7 / 60,
    "gain": 0.005,
    "dwell_s": 0.25,
}
"""Relative standard deviations between specimens."""


@dataclass(frozen=True, slots=True)
class EffectSize:
    """d′ in the force, and in the position with encoder counts as its noise."""

    force: float
    position: float


@dataclass(frozen=True, slots=True)
class NuisanceDirections:
    """Whitened directions that are no gap, in units of their priors: of the specimen, and of every run alone."""

    noise: NoiseLevels
    shared: tuple[Floats, ...]
    own: tuple[Floats, ...]
    rate_hz: float = RATE_HZ


def whiten(values: Floats, noise: NoiseLevels, rate_hz: float = RATE_HZ) -> Floats:
    """Return the values, shape `(N, …)`, whitened for white noise plus an exponentially correlated one."""
    from scipy.signal import lfilter

    decay, theta, scale = _noise_filter(noise, rate_hz)
    return np.asarray(lfilter([1.0, -decay], [1.0, -theta], values, axis=0) / scale)


def _unwhitened(values: Floats, directions: NuisanceDirections) -> Floats:
    from scipy.signal import lfilter

    decay, theta, scale = _noise_filter(directions.noise, directions.rate_hz)
    return np.asarray(lfilter([1.0, -theta], [1.0, -decay], values, axis=0) * scale)


def _noise_filter(noise: NoiseLevels, rate_hz: float) -> tuple[float, float, float]:
    """Return pole, zero and scale of the noise, whose sum is an ARMA(1, 1) process."""
    decay = float(np.exp(-1 / (rate_hz * noise.correlation_s)))
    white, slow = noise.white_mN**2, noise.slow_mN**2 * (1 - decay**2)
    variance, lag = (1 + decay**2) * white + slow, decay * white
    theta = float((variance - np.sqrt(variance**2 - 4 * lag**2)) / (2 * lag))
    return decay, theta, float(np.sqrt(lag / theta))


def nuisance_directions(campaign: BlindCampaign) -> NuisanceDirections:
    """Return the directions in which specimens and runs differ without a gap, about the hidden specimen."""
    plain = without_effects(campaign)
    specimens = [_with_step(campaign.specimen, name) for name in SPECIMEN_PRIORS]
    priors = np.array(list(SPECIMEN_PRIORS.values())) / RELATIVE_STEP
    shared, own, rate = [], [], campaign.runs[0].rate_hz
    for index, variation in enumerate(campaign.variations):
        force = noise_free_run(plain, index).force
        changed = [noise_free_run(replace(plain, specimen=specimen), index).force for specimen in specimens]
        shared.append(whiten((np.column_stack(changed) - force[:, None]) * priors, campaign.noise, rate))
        step = 1 + RELATIVE_STEP
        varied = (replace(variation, stiffness=variation.stiffness * step), replace(variation, mu=variation.mu * step))
        before, after = plain.variations[:index], plain.variations[index + 1 :]
        stiff, slip = (
            (noise_free_run(replace(plain, variations=(*before, run, *after)), index).force - force) / RELATIVE_STEP
            for run in varied
        )
        columns = np.column_stack([np.full_like(force, ZERO_PRIOR_MN), STIFFNESS_PRIOR * stiff, MU_PRIOR * slip])
        own.append(whiten(columns, campaign.noise, rate))
    return NuisanceDirections(campaign.noise, tuple(shared), tuple(own), rate)


def _with_step(specimen: HiddenSpecimen, name: str) -> HiddenSpecimen:
    factor = 1 + RELATIVE_STEP
    if name not in ELEMENTS:
        return replace(specimen, **{name: getattr(specimen, name) * factor})
    E1, E2, E3, eta1, eta2 = (
        scale * factor if element == name else scale
        for element, scale in zip(ELEMENTS, specimen.element_scales, strict=True)
    )
    return replace(specimen, element_scales=(E1, E2, E3, eta1, eta2))


def residual_chi2(directions: NuisanceDirections, residuals: Sequence[Floats]) -> float:
    """Return the squared norm of force residuals, one per run, beyond the directions within their priors."""
    count = directions.shared[0].shape[1]
    total, gram, right = 0.0, np.zeros((count, count)), np.zeros(count)
    for residual, shared, own in zip(residuals, directions.shared, directions.own, strict=True):
        columns = np.column_stack([shared, whiten(residual, directions.noise, directions.rate_hz)])
        inner = np.linalg.inv(np.eye(own.shape[1]) + own.T @ own)
        reduced = columns.T @ columns - (columns.T @ own) @ inner @ (own.T @ columns)
        gram, right, total = gram + reduced[:-1, :-1], right + reduced[:-1, -1], total + float(reduced[-1, -1])
    best = np.linalg.solve(np.eye(len(gram)) + gram, right)
    return total - float(best @ right)


def beyond_specimen(directions: NuisanceDirections, residuals: Sequence[Floats]) -> tuple[Floats, ...]:
    """Return the rest of force residuals [mN], one per run, once the specimen and zero offsets are fitted.

    By least squares of the force itself, every run counting alike, and as exact as repeats are. Stiffness and μ of each
    run are not fitted: they would follow an ageing specimen far beyond how repeats differ.
    """
    count, runs = directions.shared[0].shape[1], len(residuals)
    gram, right, columns = np.eye(count + runs), np.zeros(count + runs), []
    for at, (residual, shared) in enumerate(zip(residuals, directions.shared, strict=True)):
        zero = np.zeros((residual.size, runs))
        zero[:, at] = ZERO_SD_MN
        columns.append(np.column_stack([_unwhitened(shared, directions), zero]))
        weight = 1 / (residual.size * REPEAT_SD_MN**2)
        gram, right = gram + weight * columns[-1].T @ columns[-1], right + weight * columns[-1].T @ residual
    best = np.linalg.solve(gram, right)
    return tuple(residual - column @ best for residual, column in zip(residuals, columns, strict=True))


def effect_size(campaign: BlindCampaign, directions: NuisanceDirections | None = None) -> EffectSize:
    """Return how large the effects of a campaign are."""
    signatures = effect_signatures(campaign)
    force = residual_chi2(directions or nuisance_directions(campaign), [run.force for run in signatures])
    position = sum(float((run.position**2).sum()) for run in signatures) / COUNT_SD_MM**2
    return EffectSize(max(force, 0.0) ** 0.5, position**0.5)


@dataclass(frozen=True, slots=True)
class HiddenShare:
    """The contribution of a hidden cause to the runs, all others there: the plant's own budget."""

    cause: str
    """Id of an effect, `specimen` where it was exchanged and no file says so, or `model` for a wrong nominal model."""
    channel: str
    """`force` or `position`. A cause of the position adds nothing to the force, which follows the measured position."""
    run_rms: tuple[float, ...]
    """Root mean square in each run [mN; mm in the position]."""
    rms: float
    """The same over all runs, each counting alike."""
    refitted_rms: float
    """The same once the specimen, within its prior, and each run's zero offset have been fitted."""
    share: float
    """Of the sum of the squares of `refitted_rms` in its channel."""


def hidden_shares(campaign: BlindCampaign, directions: NuisanceDirections | None = None) -> tuple[HiddenShare, ...]:
    """Return the contribution of each hidden cause to a campaign's runs, noise-free; empty where nothing is hidden."""
    causes = [*_hidden_causes(campaign)]
    if not causes:
        return ()
    whole = [noise_free_run(campaign, index) for index in range(len(campaign.runs))]
    known = directions or nuisance_directions(campaign)
    found = []
    for cause, channel, without in causes:
        bare = [noise_free_run(without, index) for index in range(len(campaign.runs))]
        added = [getattr(run, channel) - getattr(other, channel) for run, other in zip(whole, bare, strict=True)]
        left = added if channel == "position" else beyond_specimen(known, added)
        each = tuple(float(np.sqrt(np.mean(run**2))) for run in added)
        found.append(HiddenShare(cause, channel, each, _rms(added), _rms(left), 0.0))
    squares = {"force": 0.0, "position": 0.0}
    for one in found:
        squares[one.channel] += one.refitted_rms**2
    return tuple(replace(one, share=one.refitted_rms**2 / (squares[one.channel] or 1.0)) for one in found)


def _hidden_causes(campaign: BlindCampaign) -> Iterator[tuple[str, str, BlindCampaign]]:
    """Yield each cause, the channel it shows in, and the campaign without it."""
    for at, effect in enumerate(campaign.effects):
        others = (*campaign.effects[:at], *campaign.effects[at + 1 :])
        sizes = (*campaign.sizes[:at], *campaign.sizes[at + 1 :])
        channel = "position" if effect.channel == "position" else "force"
        yield effect.name, channel, replace(campaign, effects=others, sizes=sizes)
    if campaign.second is not None and not campaign.exchange_recorded:
        yield "specimen", "force", replace(campaign, second=campaign.specimen)
    right = NominalErrors(blunt_s=campaign.nominal_errors.blunt_s)
    if campaign.nominal_errors not in {right, replace(right, shape_form=campaign.nominal_errors.shape_form)}:
        yield "model", "force", replace(campaign, nominal_errors=right)


def _rms(runs: Sequence[Floats]) -> float:
    return float(np.sqrt(np.mean([np.mean(run**2) for run in runs])))
