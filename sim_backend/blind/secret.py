"""Everything that is hidden in a campaign, drawn from one seed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np

from dragrig.sim_backend.blind.effects import CATALOGUE, OUTSIDE
from dragrig.sim_backend.blind.effects.base import Effect
from dragrig.sim_backend.blind.programme import Listed, RunPlan, programme
from dragrig.sim_backend.blind.specimen import (
    Noise,
    Rough,
    Specimen,
    Variation,
    draw_noise,
    draw_rough,
    draw_specimen,
    draw_variation,
)

Json = str | float | bool | None | Sequence["Json"] | Mapping[str, "Json"]


@dataclass(frozen=True, slots=True)
class Secret:
    """A campaign with all that is hidden in it; the same seed gives the same campaign."""

    seed: int
    specimen: Specimen
    noise: Noise
    rough: Rough
    effects: tuple[Effect, ...]
    sizes: tuple[float, ...]
    programme: str
    runs: tuple[RunPlan, ...]
    variations: tuple[Variation, ...]
    """What each run has of its own, in the order of `runs`."""


def draw(
    seed: int,
    *,
    effects: Sequence[str] | None = None,
    size: float | Sequence[float] = 1.0,
    rough: bool = False,
    runs: str = "practice",
) -> Secret:
    """Draw a campaign.

    Parameters
    ----------
    effects
        Names from the vocabulary, or of effects that it does not have; none for a campaign without a gap. The form of
        each and its shape come from the seed.
    size
        Factor on the amplitudes, one for all or one each; shapes stay as they are.
    rough
        Whether the nominal equations are slightly wrong.
    runs
        `practice`, or `fresh`: a session of its own with the same specimen and effects at other speeds and strains.

    Raises
    ------
    ValueError
        For a name of an effect or programme that there is not, or sizes that do not match the effects.
    """
    names = tuple(effects or ())
    sizes = tuple(map(float, size)) if isinstance(size, Sequence) else (float(size),) * len(names)
    if len(sizes) != len(names):
        raise ValueError(f"{len(sizes)} sizes for {len(names)} effects; give one for all or one each")
    plans, variations = _session(seed, runs)
    return Secret(
        seed=seed,
        specimen=draw_specimen(_random(seed, "specimen")),
        noise=draw_noise(_random(seed, "noise")),
        rough=draw_rough(_random(seed, "rough")) if rough else Rough(),
        effects=tuple(_draw_effect(seed, name, one) for name, one in zip(names, sizes, strict=True)),
        sizes=sizes,
        programme=runs,
        runs=plans,
        variations=variations,
    )


def another_session(secret: Secret, runs: str | Listed = "fresh") -> Secret:
    """Return a session of another programme with the same specimen and effects, as `draw` has it for `runs`.

    Order and session time begin anew, and so do ageing and preconditioning: it is a parallel session, not a later one.
    """
    plans, variations = _session(secret.seed, runs)
    name = runs if isinstance(runs, str) else runs.name
    return replace(secret, programme=name, runs=plans, variations=variations)


def without_effects(secret: Secret) -> Secret:
    """Return the same campaign with nothing hidden in it."""
    return replace(secret, effects=(), sizes=())


def answer(secret: Secret) -> dict[str, Json]:
    """Return the right verdict and what is behind it, in the form of an entry of `answers.json`."""
    known = [one.name for one in secret.effects if one.name in CATALOGUE]
    foreign = len(known) < len(secret.effects)
    verdict = "no_gap" if not secret.effects else "unknown" if not known else "several" if len(known) > 1 else "effect"
    one = secret.specimen
    nominal: dict[str, Json] = {
        "ksE": one.stiffness,
        "mu": one.mu,
        "ksV": one.mucus,
        "kE": list(one.five),
        "gain": one.gain,
        "T0": one.dwell_s,
        "alpha": float(np.radians(one.angle_deg)),
    }
    return {
        "nominal_slightly_wrong": secret.rough != Rough(),
        "verdict": verdict,
        "effects": list(known),
        "outside": foreign,
        "truth": ", ".join(one.name for one in secret.effects) or "nothing",
        "form": [one.form for one in secret.effects],
        "size": list(secret.sizes),
        "channel": [one.channel for one in secret.effects],
        "parameters": [dict(one.parameters) for one in secret.effects],
        "seed": secret.seed,
        "runs": secret.programme,
        "rough": {name: getattr(secret.rough, name) for name in Rough.__slots__},
        "specimen": nominal,
    }


def _draw_effect(seed: int, name: str, size: float) -> Effect:
    forms = CATALOGUE.get(name) or OUTSIDE.get(name)
    if forms is None:
        raise ValueError(f"{name!r} is no effect; take one of {', '.join([*CATALOGUE, *OUTSIDE])}")
    random = _random(seed, f"effect {name}")
    return forms[int(random.integers(len(forms)))].drawn(random, size)


def _session(seed: int, runs: str | Listed) -> tuple[tuple[RunPlan, ...], tuple[Variation, ...]]:
    name = runs if isinstance(runs, str) else runs.name
    plans = programme(runs, _random(seed, f"programme {runs}")) if isinstance(runs, str) else runs.runs
    varied = _random(seed, f"runs {name}")
    return plans, tuple(draw_variation(varied) for _ in plans)


def _random(seed: int, purpose: str) -> np.random.Generator:
    return np.random.default_rng((seed, crc32(purpose.encode())))
