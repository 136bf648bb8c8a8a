"""The simulator with what was found in it, ready to be run."""

import numpy as np

from dragrig.analysis.gap.explanation import Explanation
from dragrig.analysis.gap.findings import Findings
from dragrig.analysis.gap.judging import Judgement
from dragrig.analysis.gap.lines import Lines
from dragrig.analysis.gap.position.finding import PositionFinding
from dragrig.analysis.gap.results import Shrink
from dragrig.analysis.gap.study import Study
from dragrig.config.diagnosed import DiagnosedSettings
from dragrig.config.effects import EffectSettings
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray

MAINS_HUM = "mains_hum"
DIGITS = 6


def amended_model(
    study: Study,
    chosen: Explanation | None,
    position: PositionFinding,
    lines: Lines,
    judged: Judgement,
    found: Findings,
    shrink: Shrink | None,
    specimen: str,
) -> FrictionModelSettings | None:
    """Return this specimen's friction model with the effects that were named; None where none was or can be."""
    if not judged.effects:
        return None
    z = found.nominal.z if chosen is None else chosen.point.z
    settings = study.simulator(z)
    if settings is None:
        return None
    effects = list(settings.effects)
    if chosen is not None:
        effects += [one.settings for one in chosen.point.candidates]
    if position.candidate is not None and position.candidate.effect.id in judged.effects:
        effects.append(position.candidate.settings)
    if MAINS_HUM in judged.effects:
        hum = {"amplitude_mN": lines.mains.amplitude, "frequency_hz": lines.mains.frequency_hz}
        effects.append(EffectSettings(id=MAINS_HUM, parameters=hum))
    rounded = [
        EffectSettings(id=one.id, parameters={name: _rounded(value) for name, value in one.parameters.items()})
        for one in effects
    ]
    diagnosed = DiagnosedSettings(
        specimen=specimen,
        verdict=judged.verdict.value,
        effects=judged.effects,
        probability=_rounded(judged.probabilities.get("+".join(judged.effects), 0.0)),
        runs=len(study.sights),
        promised=None if shrink is None or shrink.closed is None else _rounded(shrink.closed),
        nominal=_values(study, found.nominal.z),
    )
    return settings.model_copy(
        update={
            **_values(study, z),
            "name": "amended",
            "effects": tuple(rounded),
            "diagnosed": diagnosed,
            "identified": None,
        }
    )


def _values(study: Study, z: FloatArray) -> dict[str, float]:
    return {name: _rounded(value) for name, value in study.values(z).items()}


def _rounded(value: float) -> float:
    return float(np.format_float_scientific(value, precision=DIGITS)) if value else 0.0
