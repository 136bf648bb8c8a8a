"""Everything hidden in a campaign, drawn from one seed: specimens, noise, errors of the nominal model, effects.

`CONDITIONS` are circumstances that are no gap, or none of the rig's: incomplete campaigns, an exchanged specimen, other
programmes, rates and capsules, a nominal model that is off, and noise of another kind. They combine.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from zlib import crc32

import numpy as np

from dragrig.sim_backend.blind.effects import CATALOGUE, DRAWN, OUTSIDE
from dragrig.sim_backend.blind.effects.hidden_effect import HiddenEffect, OneOf
from dragrig.sim_backend.blind.run_plans import CapsuleDummy, RunList, RunPlan, StageLoop, draw_programme, in_session


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
    """How the nominal equations are wrong; zeros, and ones of factors, where they are not.

    `blunt_s`: jerk-limited motion over that time. `shape` and `shape_form`: part by which the moduli differ at the ends
    of the strain axis. `ramp_step_s`: step of a first-order rule for the relaxation's ramp. `panels`: midpoints of a
    coarse rule for the contact. `angle_deg`: added to the contact angle.

    `elements`: factors on E1, E2, E3, η1 and η2. `viscous` and `side`: factors on the viscous force and on the wall's
    normal force. `viscous_power`: added to the exponent of speed, about 10 mm/s. `stretch`: exponent on age over time
    constant in both branches. `slant`: added to the exponent of the wall's slant. `thinning`: exponent of the wall's
    circumference by which its pressure falls. `slip_speed`: factor on the speed over which friction changes sign.
    """

    blunt_s: float = 0.0
    shape: float = 0.0
    shape_form: str = "linear"
    ramp_step_s: float = 0.0
    panels: int = 0
    angle_deg: float = 0.0
    elements: tuple[float, float, float, float, float] = (1.0, 1.0, 1.0, 1.0, 1.0)
    viscous: float = 1.0
    side: float = 1.0
    viscous_power: float = 0.0
    stretch: float = 1.0
    slant: float = 0.0
    thinning: float = 0.0
    slip_speed: float = 1.0


@dataclass(frozen=True, slots=True)
class RunVariation:
    """Variation of one run: factors on stiffness and μ, and the zero offset [mN]."""

    stiffness: float
    mu: float
    zero_mN: float


@dataclass(frozen=True, slots=True)
class NoiseLevels:
    """The additions of sensor, converter and clock to a record.

    White and slow noise: standard deviations [mN] and the slow one's correlation time [s]. `pink_mN`: standard
    deviation of noise whose power falls as 1/f to the power `pink_power`. `hum_mN`, `hum_hz`: amplitude and frequency
    of mains pick-up. `bits`: of the converter over ±10 N. `jitter_s`: standard deviation of the samples' instants.
    `impulses_per_s`, `impulse_mN`: how often a sample or a few are off, and by how much. `dropouts_per_s`, `dropout_s`,
    `dropout`: how often and how long the force is missing, and the values there: `held`, `zero`, or nothing (`lost`).
    """

    white_mN: float
    slow_mN: float
    correlation_s: float
    pink_mN: float = 0.0
    pink_power: float = 1.0
    hum_mN: float = 0.0
    hum_hz: float = 50.0
    bits: int = 16
    jitter_s: float = 0.0
    impulses_per_s: float = 0.0
    impulse_mN: float = 0.0
    dropouts_per_s: float = 0.0
    dropout_s: float = 0.0
    dropout: str = "held"


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


@dataclass(frozen=True, slots=True)
class Setting:
    """The circumstances of a campaign, without its specimens and effects."""

    runs: tuple[RunPlan, ...]
    noise: NoiseLevels
    errors: NominalErrors = NominalErrors()
    capsule: CapsuleDummy = field(default_factory=CapsuleDummy)
    exchange_recorded: bool = True
    """Whether the files say which specimen a run was made on, where it was exchanged."""
    stage: StageLoop | None = None
    """None where the stage goes exactly where it is commanded."""


def _only(setting: Setting, _: np.random.Generator, *, kinds: frozenset[str]) -> Setting:
    return replace(setting, runs=in_session([run for run in setting.runs if run.kind in kinds]))


def _three_speeds(setting: Setting, random: np.random.Generator) -> Setting:
    speeds = np.array(sorted({run.speed_mm_s for run in setting.runs if run.kind == "drag"}))
    # One of each third, so that low and high speed are there.
    chosen = {float(random.choice(part)) for part in np.array_split(speeds, 3) if part.size}
    runs = [run for run in setting.runs if run.kind != "drag" or run.speed_mm_s in chosen]
    return replace(setting, runs=in_session(runs))


def _one_run(setting: Setting, random: np.random.Generator) -> Setting:
    drags = [run for run in setting.runs if run.kind == "drag" and 1.0 <= run.speed_mm_s <= 20.0]
    return replace(setting, runs=in_session([drags[int(random.integers(len(drags)))]]))


def _exchanged(setting: Setting, random: np.random.Generator, *, recorded: bool) -> Setting:
    runs, at = setting.runs, round(len(setting.runs) * float(random.uniform(0.4, 0.7)))
    later_s = float(random.uniform(300.0, 1200.0))
    if not recorded:
        late = [replace(run, start_s=run.start_s + later_s, specimen=1) for run in runs[at:]]
        return replace(setting, runs=(*runs[:at], *_mounted(late)), exchange_recorded=False)
    # What a second specimen is measured with: every kind again, and as many drags as would have been left.
    first = {run.kind: run for run in runs if run.kind in {"relaxation", "coulomb"}}
    again = [run for run in runs if run.kind == "relaxation"] + [
        run for kind, run in first.items() if kind == "coulomb"
    ]
    drags = [run for run in runs if run.kind == "drag"]
    again += [drags[place] for place in random.permutation(len(drags))[: max(len(runs) - at, 6)].tolist()]
    begin = runs[at].start_s + later_s if at < len(runs) else later_s
    late = [replace(run, specimen=1) for run in in_session(again, begin)]
    return replace(setting, runs=(*runs[:at], *_mounted(late)))


def _mounted(runs: list[RunPlan]) -> list[RunPlan]:
    return [replace(run, mounted_s=runs[0].start_s) for run in runs] if runs else runs


def _at_rate(setting: Setting, _: np.random.Generator, *, rate_hz: float) -> Setting:
    # At 10 kHz the slowest strokes would be most of the files and show nothing that 2 mm/s does not.
    slowest = 2.0 if rate_hz >= 10_000 else 0.0
    kept = [run for run in setting.runs if run.speed_mm_s >= slowest] or list(setting.runs)
    return replace(setting, runs=tuple(replace(run, rate_hz=rate_hz) for run in kept))


def _other_programme(setting: Setting, random: np.random.Generator) -> Setting:
    return replace(setting, runs=draw_programme("other", random))


def _other_capsule(setting: Setting, random: np.random.Generator) -> Setting:
    capsule = CapsuleDummy(
        radius_mm=float(random.uniform(5.0, 7.0)),
        length_mm=float(random.uniform(12.0, 26.0)),
        mass_g=float(random.uniform(15.0, 80.0)),
        angle_deg=float(random.uniform(54.0, 64.0)),
    )
    return replace(setting, capsule=capsule)


def _nominal_off(setting: Setting, random: np.random.Generator, *, by: float, what: str) -> Setting:
    def off() -> float:
        return float(random.choice([-1.0, 1.0]) * by * random.uniform(0.6, 1.2))

    errors = setting.errors
    if what in {"parameters", "both"}:
        chosen = (off(), off(), off(), off(), off())
        factors = (1 + chosen[0], 1 + chosen[1], 1 + chosen[2], 1 + chosen[3], 1 + chosen[4])
        errors = replace(errors, elements=factors, viscous=1 + 2 * off(), side=1 + off())
    if what in {"laws", "both"}:
        ways = set(random.permutation(["shape", "viscous", "stretch", "slant", "thinning", "slip"])[:3].tolist())
        errors = replace(
            errors,
            shape=off() if "shape" in ways else errors.shape,
            shape_form=str(random.choice(["linear", "arched", "wave"])) if "shape" in ways else errors.shape_form,
            viscous_power=off() if "viscous" in ways else 0.0,
            stretch=1 + off() if "stretch" in ways else 1.0,
            slant=off() if "slant" in ways else 0.0,
            thinning=off() if "thinning" in ways else 0.0,
            slip_speed=1 + 2 * off() if "slip" in ways else 1.0,
        )
    return replace(setting, errors=errors)


def _jerk_limited(setting: Setting, random: np.random.Generator) -> Setting:
    return replace(setting, errors=replace(setting.errors, blunt_s=0.005 * 12.0 ** float(random.random())))


def _position_loop(setting: Setting, random: np.random.Generator) -> Setting:
    stage = StageLoop(
        natural_hz=20.0 * 10.0 ** float(random.random()),
        damping=float(random.uniform(0.5, 1.0)),
        mass_kg=float(random.uniform(0.5, 3.0)),
        scale_error_mm=5e-5 * 10.0 ** float(random.random()),
    )
    return replace(_jerk_limited(setting, random), stage=stage)


_Change = Callable[[Setting, np.random.Generator], Setting]


def _noise(change: Callable[[NoiseLevels, np.random.Generator], NoiseLevels]) -> _Change:
    """Make a condition of its changes to the noise."""
    return lambda setting, random: replace(setting, noise=change(setting.noise, random))


def _pink(noise: NoiseLevels, random: np.random.Generator) -> NoiseLevels:
    size, power = float(random.uniform(0.4, 1.0)), float(random.uniform(0.8, 1.2))
    return replace(noise, pink_mN=size * noise.white_mN, pink_power=power)


def _hum(noise: NoiseLevels, random: np.random.Generator) -> NoiseLevels:
    size, hertz = float(random.uniform(0.3, 1.0)), float(random.choice([50.0, 60.0]))
    return replace(noise, hum_mN=size * noise.white_mN, hum_hz=hertz)


def _bits(noise: NoiseLevels, _: np.random.Generator, *, bits: int) -> NoiseLevels:
    return replace(noise, bits=bits)


def _impulses(noise: NoiseLevels, random: np.random.Generator) -> NoiseLevels:
    often, size = 0.03 * 10.0 ** random.random(), 20.0 * 10.0 ** random.random()
    return replace(noise, impulses_per_s=float(often), impulse_mN=float(size))


def _dropouts(noise: NoiseLevels, random: np.random.Generator) -> NoiseLevels:
    often, length = 0.02 * 5.0 ** random.random(), 0.01 * 10.0 ** random.random()
    kind = str(random.choice(["held", "zero", "lost"]))
    return replace(noise, dropouts_per_s=float(often), dropout_s=float(length), dropout=kind)


RATES_HZ = (50.0, 100.0, 250.0, 1000.0, 2000.0, 10_000.0)
PROGRAMME_CONDITIONS: Mapping[str, _Change] = MappingProxyType(
    {
        "other programme": _other_programme,
        "three speeds": _three_speeds,
        "no relaxations": partial(_only, kinds=frozenset({"drag", "coulomb", "blank"})),
        "no blanks": partial(_only, kinds=frozenset({"drag", "coulomb", "relaxation"})),
        "drags only": partial(_only, kinds=frozenset({"drag"})),
        "one run": _one_run,
        "exchanged": partial(_exchanged, recorded=True),
        "exchanged, not recorded": partial(_exchanged, recorded=False),
        **{f"{rate:g} Hz": partial(_at_rate, rate_hz=rate) for rate in RATES_HZ},
    }
)
"""Conditions that change which runs are made and how."""
CONDITIONS: Mapping[str, _Change] = MappingProxyType(
    {
        **PROGRAMME_CONDITIONS,
        "other capsule": _other_capsule,
        "jerk-limited": _jerk_limited,
        "position loop": _position_loop,
        **{
            f"{what} {part} % off": partial(_nominal_off, by=part / 100, what=what)
            for what in ("parameters", "laws", "both")
            for part in (5, 10, 20)
        },
        "1/f noise": _noise(_pink),
        "hum": _noise(_hum),
        **{f"{bits} bits": _noise(partial(_bits, bits=bits)) for bits in (12, 13, 14, 15)},
        "jitter": _noise(lambda noise, _: replace(noise, jitter_s=0.0002)),
        "impulses": _noise(_impulses),
        "dropouts": _noise(_dropouts),
    }
)
"""All conditions by name, in the order in which they are applied."""


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
    plant: str = "written"
    conditions: tuple[str, ...] = ()
    capsule: CapsuleDummy = field(default_factory=CapsuleDummy)
    second: HiddenSpecimen | None = None
    """The specimen that took the first one's place midway; None where it was not exchanged."""
    exchange_recorded: bool = True
    stage: StageLoop | None = None

    def specimen_of(self, run: RunPlan) -> HiddenSpecimen:
        """Return the specimen that a run is made on."""
        return self.second if run.specimen and self.second is not None else self.specimen


PLANTS = ("written", "drawn")


def draw_campaign(
    seed: int,
    *,
    effects: Sequence[str] | None = None,
    size: float | Sequence[float] = 1.0,
    rough: bool = False,
    runs: str = "practice",
    plant: str = "written",
    conditions: Sequence[str] = (),
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
    plant
        `written`: each effect has one of the two or three forms that are written down. `drawn`: its law is a function
        drawn at random, and so is the force that it scales.
    conditions
        Names from `CONDITIONS`, in any order, as `["drags only", "100 Hz", "1/f noise"]`.

    Raises
    ------
    ValueError
        For an unknown effect, programme, plant or condition, or sizes that do not match the effects.
    """
    names = tuple(effects or ())
    sizes = tuple(map(float, size)) if isinstance(size, Sequence) else (float(size),) * len(names)
    if len(sizes) != len(names):
        raise ValueError(f"{len(sizes)} sizes for {len(names)} effects; give one for all or one each")
    if plant not in PLANTS:
        raise ValueError(f"{plant!r} is not a plant; choose one of {', '.join(PLANTS)}")
    setting, variations = _session(
        seed, runs, draw_nominal_errors(_random(seed, "rough")) if rough else None, conditions
    )
    specimen = _on_capsule(draw_hidden_specimen(_random(seed, "specimen")), setting.capsule)
    exchanged = any(run.specimen for run in setting.runs)
    second = _on_capsule(draw_hidden_specimen(_random(seed, "second specimen")), setting.capsule) if exchanged else None
    return BlindCampaign(
        seed=seed,
        specimen=specimen,
        noise=setting.noise,
        nominal_errors=setting.errors,
        effects=tuple(
            _draw_effect(seed, name, factor, plant, setting.runs) for name, factor in zip(names, sizes, strict=True)
        ),
        sizes=sizes,
        programme=runs,
        runs=setting.runs,
        variations=variations,
        plant=plant,
        conditions=tuple(conditions),
        capsule=setting.capsule,
        second=second,
        exchange_recorded=setting.exchange_recorded,
        stage=setting.stage,
    )


def parallel_session(campaign: BlindCampaign, runs: str | RunList = "fresh") -> BlindCampaign:
    """Return a session of another programme with the same specimen and effects, as `draw_campaign` has it for `runs`.

    Order and session time begin anew, and so do ageing and preconditioning: the session is parallel, not later. Of the
    conditions that change the programme it keeps the sampling rate; it is made on the first specimen.
    """
    kept = [name for name in campaign.conditions if name not in PROGRAMME_CONDITIONS or name.endswith("Hz")]
    setting, variations = _session(campaign.seed, runs, campaign.nominal_errors, kept)
    name = runs if isinstance(runs, str) else runs.name
    return replace(campaign, programme=name, runs=setting.runs, variations=variations, second=None)


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
        "form": [effect.described for effect in campaign.effects],
        "size": list(campaign.sizes),
        "channel": [effect.channel for effect in campaign.effects],
        "parameters": [dict(effect.parameters) for effect in campaign.effects],
        **_conditions_answer(campaign),
        "seed": campaign.seed,
        "runs": campaign.programme,
        "rough": {
            name: value
            for name in NominalErrors.__slots__
            if (value := getattr(campaign.nominal_errors, name)) != getattr(NominalErrors(), name) or name in _ROUGH
        },
        "specimen": nominal,
    }


_ROUGH = ("blunt_s", "shape", "shape_form", "ramp_step_s", "panels", "angle_deg")
"""Errors that every answer has; others are there where they differ from none."""


def _conditions_answer(campaign: BlindCampaign) -> dict[str, Json]:
    if campaign.plant == PLANTS[0] and not campaign.conditions:
        return {}
    laws: list[Json] = [
        {name: {"course": law.course, "values": list(law.values)} for name, law in effect.laws.items()}
        for effect in campaign.effects
    ]
    off = any(name.endswith("% off") for name in campaign.conditions)
    exchanged = campaign.second is not None and not campaign.exchange_recorded
    also_right = (["specimen", "model"] if off or exchanged else []) + (["mains_hum"] if campaign.noise.hum_mN else [])
    return {
        "plant": campaign.plant,
        "conditions": list(campaign.conditions),
        "also_right": also_right,
        "laws": laws,
    }


def _draw_effect(seed: int, name: str, size: float, plant: str, runs: Sequence[RunPlan]) -> HiddenEffect:
    random = _random(seed, f"effect {name}")
    if plant == "drawn" and name in DRAWN:
        kinds = DRAWN[name]
        effect = kinds[int(OneOf(tuple(kind.weight for kind in kinds))(random)) if len(kinds) > 1 else 0].drawn(
            random, size
        )
        # What laws of position and of the session's time refer to: the first session's own stroke and length.
        stroke = max(run.travel_mm for run in runs if run.strain is None or len(runs) == 1)
        length = max(600.0, *(run.session_s for run in runs))
        return replace(effect, parameters={**effect.parameters, "stroke_mm": stroke, "session_s": length})
    forms = CATALOGUE.get(name) or OUTSIDE.get(name)
    if forms is None:
        raise ValueError(f"{name!r} is no effect; take one of {', '.join([*CATALOGUE, *OUTSIDE])}")
    return forms[int(random.integers(len(forms)))].drawn(random, size)


def _session(
    seed: int, runs: str | RunList, errors: NominalErrors | None, conditions: Sequence[str]
) -> tuple[Setting, tuple[RunVariation, ...]]:
    unknown = sorted(set(conditions) - set(CONDITIONS))
    if unknown:
        raise ValueError(f"{unknown[0]!r} is no condition; take one of {', '.join(CONDITIONS)}")
    name = runs if isinstance(runs, str) else runs.name
    plans = draw_programme(runs, _random(seed, f"programme {runs}")) if isinstance(runs, str) else runs.runs
    setting = Setting(plans, draw_noise_levels(_random(seed, "noise")), errors or NominalErrors())
    for condition, change in CONDITIONS.items():
        if condition in conditions:
            setting = change(setting, _random(seed, f"condition {condition}"))
    random = _random(seed, f"runs {name}")
    return setting, tuple(draw_run_variation(random) for _ in setting.runs)


def _on_capsule(specimen: HiddenSpecimen, capsule: CapsuleDummy) -> HiddenSpecimen:
    """Return the specimen on another capsule, whose contact angle its own differs from alike."""
    return replace(specimen, angle_deg=specimen.angle_deg + capsule.angle_deg - CapsuleDummy().angle_deg)


def _random(seed: int, purpose: str) -> np.random.Generator:
    return np.random.default_rng((seed, crc32(purpose.encode())))
