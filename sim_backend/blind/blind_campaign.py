"""Everything hidden in a campaign, drawn from one seed: specimen, noise, errors of the nominal model, effects."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np

from dragrig.sim_backend.blind.effects import CATALOGUE, OUTSIDE
from dragrig.sim_backend.blind.effects.hidden_effect import HiddenEffect
from dragrig.sim_backend.blind.run_plans import RunList, RunPlan, draw_programme


@dataclass(frozen=True, slots=True)
class HiddenSpecimen:
    """Scales of a specimen against the published values, and quantities unknown to the rig.

    `element_scales` scale E1, E2, E3, η1 and η2 on top of `stiffness`; `gain` is that of the force calibration,
    `dwell_s` the true contact age at the first sample.
    """

    stiffness: float
    element_scales: tuple[float, float, float, float, float]
    mu: float
    mucus: float
    angle_deg: float
    gain: float
    dwell_s: float


@dataclass(frozen=True, slots=True)
class NominalErrors:
    """How the nominal equations are slightly wrong; zeros where they are not.

    `blunt_s`: jerk-limited motion over that time. `shape` and `shape_form`: part by which the moduli differ at the ends
    of the strain axis. `ramp_step_s`: step of a first-order rule for the relaxation's ramp. `panels`: midpoints of a
    coarse rule for the contact. `angle_deg`: added to the contact angle.
    """

    blunt_s: float = 0.0
    shape: float = 0.0
    shape_form: str = "linear"
    ramp_step_s: float = 0.0
    panels: int = 0
    angle_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class RunVariation:
    """Variation of one run: factors on stiffness and μ, and the zero offset [mN]."""

    stiffness: float
    mu: float
    zero_mN: float


@dataclass(frozen=True, slots=True)
class NoiseLevels:
    """White and slow force noise: standard deviations [mN] and the slow one's correlation time [s]."""

    white_mN: float
    slow_mN: float
    correlation_s: float


def draw_hidden_specimen(random: np.random.Generator) -> HiddenSpecimen:
    """Draw a specimen with the spread that specimens have."""

    def about(value: float, part: float) -> float:
        return float(value * (1 + part * np.clip(random.standard_normal(), -2.5, 2.5)))

    return HiddenSpecimen(
        stiffness=about(1.0, 0.15),
        element_scales=(about(1, 0.07), about(1, 0.07), about(1, 0.07), about(1, 0.07), about(1, 0.07)),
        mu=about(0.082, 0.12),
        mucus=about(1.0, 0.20),
        angle_deg=60.0 + about(0.7, 1.0) - 0.7,
        gain=about(1.0, 0.005),
        dwell_s=about(60.0, 0.25),
    )


def draw_nominal_errors(random: np.random.Generator) -> NominalErrors:
    """Draw one to all of the ways in which the nominal equations can be slightly wrong."""
    ways = ("motion", "shape", "quadrature", "angle")
    chosen = set(random.permutation(ways)[: random.integers(1, len(ways) + 1)].tolist())
    sign = float(random.choice([-1.0, 1.0]))
    in_ramp, at_contact = bool(random.random() < 0.7), bool(random.random() < 0.5)
    return NominalErrors(
        blunt_s=float(random.uniform(0.010, 0.040)) if "motion" in chosen else 0.0,
        shape=sign * float(random.uniform(0.015, 0.025)) if "shape" in chosen else 0.0,
        shape_form=str(random.choice(["linear", "arched", "wave"])),
        ramp_step_s=float(random.choice([0.002, 0.004, 0.006, 0.008])) if "quadrature" in chosen and in_ramp else 0.0,
        panels=int(random.integers(5, 11)) if "quadrature" in chosen and (at_contact or not in_ramp) else 0,
        angle_deg=float(random.choice([-1.0, 1.0]) * random.uniform(0.7, 1.1)) if "angle" in chosen else 0.0,
    )


def draw_run_variation(random: np.random.Generator) -> RunVariation:
    """Draw the variation of one run."""
    stiffness, mu, zero = random.standard_normal(3).tolist()
    return RunVariation(1 + 0.02 * stiffness, 1 + 0.015 * mu, 3.0 * zero)


def draw_noise_levels(random: np.random.Generator) -> NoiseLevels:
    """Draw the noise of the sensor in a campaign."""
    white = float(random.uniform(1.0, 2.0))
    return NoiseLevels(white, white / 3, float(random.uniform(0.1, 0.4)))


Json = str | float | bool | None | Sequence["Json"] | Mapping[str, "Json"]


@dataclass(frozen=True, slots=True)
class BlindCampaign:
    """A campaign with everything hidden in it; the same seed gives the same campaign."""

    seed: int
    specimen: HiddenSpecimen
    noise: NoiseLevels
    nominal_errors: NominalErrors
    effects: tuple[HiddenEffect, ...]
    sizes: tuple[float, ...]
    programme: str
    runs: tuple[RunPlan, ...]
    variations: tuple[RunVariation, ...]
    """Variation of each run, in the order of `runs`."""


def draw_campaign(
    seed: int,
    *,
    effects: Sequence[str] | None = None,
    size: float | Sequence[float] = 1.0,
    rough: bool = False,
    runs: str = "practice",
) -> BlindCampaign:
    """Draw a campaign.

    Parameters
    ----------
    effects
        Ids from the catalogue, or of effects outside it; none for a campaign without a gap. The seed determines the
        form of each and its shape.
    size
        Factor on the amplitudes, one for all or one each; shapes are not scaled.
    rough
        Whether the nominal equations are slightly wrong.
    runs
        `practice`, or `fresh`: another session with the same specimen and effects at other speeds and strains.

    Raises
    ------
    ValueError
        For an unknown effect or programme, or sizes that do not match the effects.
    """
    names = tuple(effects or ())
    sizes = tuple(map(float, size)) if isinstance(size, Sequence) else (float(size),) * len(names)
    if len(sizes) != len(names):
        raise ValueError(f"{len(sizes)} sizes for {len(names)} effects; give one for all or one each")
    plans, variations = _session(seed, runs)
    return BlindCampaign(
        seed=seed,
        specimen=draw_hidden_specimen(_random(seed, "specimen")),
        noise=draw_noise_levels(_random(seed, "noise")),
        nominal_errors=draw_nominal_errors(_random(seed, "rough")) if rough else NominalErrors(),
        effects=tuple(_draw_effect(seed, name, factor) for name, factor in zip(names, sizes, strict=True)),
        sizes=sizes,
        programme=runs,
        runs=plans,
        variations=variations,
    )


def parallel_session(campaign: BlindCampaign, runs: str | RunList = "fresh") -> BlindCampaign:
    """Return a session of another programme with the same specimen and effects, as `draw_campaign` has it for `runs`.

    Order and session time begin anew, and so do ageing and preconditioning: the session is parallel, not later.
    """
    plans, variations = _session(campaign.seed, runs)
    name = runs if isinstance(runs, str) else runs.name
    return replace(campaign, programme=name, runs=plans, variations=variations)


def without_effects(campaign: BlindCampaign) -> BlindCampaign:
    """Return the same campaign without hidden effects."""
    return replace(campaign, effects=(), sizes=())


def true_answer(campaign: BlindCampaign) -> dict[str, Json]:
    """Return the true verdict and its background as an entry of `answers.json`."""
    known = [effect.name for effect in campaign.effects if effect.name in CATALOGUE]
    foreign = len(known) < len(campaign.effects)
    verdict = (
        "no_gap" if not campaign.effects else "unknown" if not known else "several" if len(known) > 1 else "effect"
    )
    specimen = campaign.specimen
    nominal: dict[str, Json] = {
        "ksE": specimen.stiffness,
        "mu": specimen.mu,
        "ksV": specimen.mucus,
        "kE": list(specimen.element_scales),
        "gain": specimen.gain,
        "T0": specimen.dwell_s,
        "alpha": float(np.radians(specimen.angle_deg)),
    }
    return {
        "nominal_slightly_wrong": campaign.nominal_errors != NominalErrors(),
        "verdict": verdict,
        "effects": list(known),
        "outside": foreign,
        "truth": ", ".join(effect.name for effect in campaign.effects) or "nothing",
        "form": [effect.form for effect in campaign.effects],
        "size": list(campaign.sizes),
        "channel": [effect.channel for effect in campaign.effects],
        "parameters": [dict(effect.parameters) for effect in campaign.effects],
        "seed": campaign.seed,
        "runs": campaign.programme,
        "rough": {name: getattr(campaign.nominal_errors, name) for name in NominalErrors.__slots__},
        "specimen": nominal,
    }


def _draw_effect(seed: int, name: str, size: float) -> HiddenEffect:
    forms = CATALOGUE.get(name) or OUTSIDE.get(name)
    if forms is None:
        raise ValueError(f"{name!r} is no effect; take one of {', '.join([*CATALOGUE, *OUTSIDE])}")
    random = _random(seed, f"effect {name}")
    return forms[int(random.integers(len(forms)))].drawn(random, size)


def _session(seed: int, runs: str | RunList) -> tuple[tuple[RunPlan, ...], tuple[RunVariation, ...]]:
    name = runs if isinstance(runs, str) else runs.name
    plans = draw_programme(runs, _random(seed, f"programme {runs}")) if isinstance(runs, str) else runs.runs
    random = _random(seed, f"runs {name}")
    return plans, tuple(draw_run_variation(random) for _ in plans)


def _random(seed: int, purpose: str) -> np.random.Generator:
    return np.random.default_rng((seed, crc32(purpose.encode())))
