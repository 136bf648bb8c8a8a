"""What was done in a run, as far as two runs must agree in it to be compared."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import isfinite

import numpy as np

from dragrig.analysis.phases import in_phase
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Attribute, Run, RunInfo

SAME = 0.01
"""Settings that differ by a smaller share are the same."""
SAME_MEASURED = 0.03
"""The same of speeds and ways that no protocol names and that are taken from the recorded positions."""
SIZES = {"diameter_mm": "mm in diameter", "length_mm": "mm long", "mass_g": "g", "contact_angle_deg": "° contact angle"}
FURTHER = {
    "accel_mm_s2": "acceleration",
    "ramp_accel_mm_s2": "acceleration of the ramp",
    "rest_s": "rest",
    "hold_s": "hold",
}
"""Settings that may differ between runs that are compared, but are told of."""


@dataclass(frozen=True, slots=True)
class Condition:
    """Kind, speed, strain, way, capsule and fixture of a run; None where the run does not say.

    Attributes
    ----------
    speed_mm_s
        Without sign; `measured` where no protocol names it.
    travel_mm
        With the sign of its direction.
    capsule
        Diameter [mm], length [mm], mass [g] and contact angle [deg].
    """

    kind: str
    signal: str
    fixture: str
    speed_mm_s: float | None
    shear_strain: float | None
    travel_mm: float | None
    capsule: tuple[float | None, ...]
    measured: bool = False

    def __str__(self) -> str:
        """In words: drag at 5 mm/s, relaxation at 50 %."""
        if self.shear_strain is not None:
            return f"{self.kind} at {100 * self.shear_strain:.3g} %"
        back = " back" if (self.travel_mm or 0.0) < 0 else ""
        return self.kind if self.speed_mm_s is None else f"{self.kind} at {self.speed_mm_s:.3g} mm/s{back}"

    def differs_from(self, other: "Condition") -> tuple[str, ...]:
        """Say in words in what two conditions differ; empty where the runs may be compared."""
        return tuple(_differences(self, other))


def condition_of(run: Run) -> Condition:
    """Gather what was done in a run; what no protocol names comes from the recorded positions."""
    header = run.info.header
    protocol = header.protocol
    speed = _number(protocol, "speed_mm_s", "ramp_speed_mm_s")
    travel, strain = _number(protocol, "travel_mm"), _number(protocol, "shear_strain")
    measured = strain is None and (speed is None or travel is None)
    if measured:
        seen_speed, seen_travel = _recorded(run)
        speed, travel = speed or seen_speed, travel or seen_travel
    return Condition(
        kind=header.kind,
        signal=run.trace.signal,
        fixture=str(header.specimen.get("fixture", "")),
        speed_mm_s=None if speed is None else abs(speed),
        shear_strain=strain,
        travel_mm=travel,
        capsule=tuple(_number(header.capsule, key) for key in SIZES),
        measured=measured,
    )


def further_differences(a: RunInfo, b: RunInfo) -> tuple[str, ...]:
    """Say in which further settings two runs differ that are compared all the same."""
    found = []
    for key, word in FURTHER.items():
        values = _number(a.header.protocol, key), _number(b.header.protocol, key)
        if not _same(*values, SAME):
            found.append(f"{word} {_words(values[0])} against {_words(values[1])} {key.rsplit('_', 1)[-1]}")
    return tuple(one.replace("mm_s2", "mm/s²").replace(" s2", " mm/s²") for one in found)


def _differences(one: Condition, other: Condition) -> Iterator[str]:
    for word, mine, theirs in (
        ("kind", one.kind, other.kind),
        ("signal", one.signal, other.signal),
        ("fixture", one.fixture, other.fixture),
    ):
        if mine != theirs:
            yield f"{word} {mine or 'not said'} against {theirs or 'not said'}"
    share = SAME_MEASURED if one.measured or other.measured else SAME
    for mine_, theirs_, factor, unit in (
        (one.speed_mm_s, other.speed_mm_s, 1.0, "mm/s"),
        (one.shear_strain, other.shear_strain, 100.0, "% strain"),
        (one.travel_mm, other.travel_mm, 1.0, "mm of travel"),
        *((m, t, 1.0, unit) for m, t, unit in zip(one.capsule, other.capsule, SIZES.values(), strict=True)),
    ):
        if not _same(mine_, theirs_, share):
            yield f"{_words(mine_, factor)} against {_words(theirs_, factor)} {unit}"


def _same(one: float | None, other: float | None, share: float) -> bool:
    if one is None or other is None:
        return one is other
    return abs(one - other) <= share * max(abs(one), abs(other))


def _words(value: float | None, factor: float = 1.0) -> str:
    return "not said" if value is None else f"{factor * value:.4g}"


def _recorded(run: Run) -> tuple[float | None, float | None]:
    """Speed of the steady phase and way of the whole run, both signed."""
    position, time = np.asarray(run.trace.position, dtype=np.float64), run.trace.time
    seen = np.isfinite(position)
    if np.count_nonzero(seen) < 2:
        return None, None
    travel = float(position[seen][-1] - position[seen][0])
    steady = seen & in_phase(run.trace, Phase.STEADY)
    if np.count_nonzero(steady) < 2:
        return None, travel
    took = float(time[steady][-1] - time[steady][0])
    return float(position[steady][-1] - position[steady][0]) / took if took > 0 else None, travel


def _number(attributes: Mapping[str, Attribute], *keys: str) -> float | None:
    for key in keys:
        value = attributes.get(key)
        if isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value):
            return float(value)
    return None
