"""How numbers, times, sizes and titles of runs are written for a reader; exact values stay in JSON, CSV and run files.

`to_json_value` gives values as JSON knows them: dataclasses become objects, NaN and infinities null.
"""

import re
from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from datetime import date
from functools import partial
from math import floor, inf, isfinite
from typing import TYPE_CHECKING, TypeAlias

from dragrig.analysis import UNKNOWN, range_text, significant_text, value_with_error, with_minus_sign

if TYPE_CHECKING:
    from dragrig.analysis import Estimate, EstimatedQuantity, Exclusion
    from dragrig.rig import Attribute, RunInfo


NumberFormat: TypeAlias = Callable[[float], str]
"""Functions of modules and partials of them, which a process can send to another."""


def significant(digits: int) -> NumberFormat:
    """Return a format with so many significant digits and no exponent: 0.0816, 113, −7.2."""
    return partial(significant_text, digits=digits)


def decimals(digits: int, *, signed: bool = False) -> NumberFormat:
    """Return a format with so many decimal places; `signed` writes the plus sign too."""
    return partial(_format_text, f"{'+' if signed else ''}z.{digits}f")


def shortest(digits: int = 6) -> NumberFormat:
    """Return a format with at most so many digits and no trailing zeros: 0.5, 11."""
    return partial(_format_text, f".{digits}g")


def percent(digits: int = 0) -> NumberFormat:
    """Return a format for shares: 71 %."""
    return partial(_format_text, f"z.{digits}f", factor=100.0, unit=" %")


def shortest_percent(value: float) -> str:
    """Write a share with the digits that it has: 150 %, 2.5 %."""
    return with_minus_sign(f"{100 * value:g} %")


def percent_difference(value: float) -> str:
    """Write a relative difference with its sign: +20 %, −0.4 %."""
    digits = 1 if abs(value) < 0.0095 else 2
    return f"{'+' if value > 0 else ''}{significant(digits)(100 * value)} %"


def round_to_sum(values: Sequence[float]) -> tuple[int, ...]:
    """Round values to whole numbers that sum to their rounded sum, by largest remainders."""
    steps = [floor(value) for value in values]
    by_remainder = sorted(range(len(values)), key=lambda at: steps[at] - values[at])
    for at in by_remainder[: round(sum(values)) - sum(steps)]:
        steps[at] += 1
    return tuple(steps)


def estimate_text(estimate: "Estimate") -> str:
    """Write an estimate with its error and its 95 % interval, or why there is none."""
    if estimate.value is None:
        return f"{UNKNOWN} ({estimate.reason})" if estimate.reason else UNKNOWN
    interval = range_text(estimate.interval, estimate.standard_error)
    return value_with_error(estimate.value, estimate.standard_error) + (f" (95 %: {interval})" if interval else "")


def interval_text(quantity: "EstimatedQuantity") -> str:
    """Write the 95 % interval of a quantity."""
    return range_text(quantity.interval, quantity.standard_error)


def unit_text(unit: str) -> str:
    """Write a unit; nothing for a pure number."""
    return {"1": "", "deg": "°"}.get(unit, unit)


def probability_text(probability: float) -> str:
    """Return a probability with two digits, never as certainty."""
    if not isfinite(probability):
        return "probability not known"
    if probability > 0.995:
        return "above 0.99"
    return "below 0.01" if probability < 0.005 else f"{probability:.2f}"


_LEAST_TENTH_MN = 0.05
"""A smaller force would be written as 0.0 mN."""


def force_text(value: float) -> str:
    """Return a force with its unit."""
    if not isfinite(value):
        return "an unknown force"
    if 0 < abs(value) < _LEAST_TENTH_MN:
        return f"{value:.1g} mN"
    return f"{value:.1f} mN" if abs(value) < 100 else f"{value:.0f} mN"


def p_value_text(p_value: float) -> str:
    """Write a p-value: p = 0.39, p < 0.0001; nothing where there is none."""
    if not isfinite(p_value):
        return ""
    return "p < 0.0001" if p_value < 1e-4 else f"p = {p_value:.2g}"


def duration_text(seconds: float) -> str:
    """Write a time: 850 ms, 12.3 s, 4 min 10 s, 2 h 05 min."""
    if seconds < 0.9995:
        return f"{1000 * seconds:.0f} ms"
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


_PACE_KNOWN_FROM = 0.1
"""From this share on the time left is said."""
_OVERDUE_S = 1.0
_FEW_S, _MINUTE_S = 5.0, 59.5
"""The end is loading, drawing and writing, which nobody can foretell to the second: then a bound is said."""


class TimeLeft:
    """How long a work still takes, at the pace of the latter half of its finished part.

    The first half may have been loading and starting processes, or another kind of work.
    """

    def __init__(self) -> None:
        self._course: list[tuple[float, float]] = [(0.0, 0.0)]
        """Shares of the work and when they were done, rising."""
        self._ends_s: float | None = None

    def at(self, share: float, elapsed_s: float) -> None:
        """Take note of how much is done after a time; before a tenth nobody knows the pace."""
        if share > self._course[-1][0]:
            self._course.append((share, elapsed_s))
        self._ends_s = None
        if _PACE_KNOWN_FROM <= share < 1.0:
            half, half_s = self._course[max(0, bisect_right(self._course, (share / 2, inf)) - 1)]
            self._ends_s = elapsed_s + (elapsed_s - half_s) / (share - half) * (1.0 - share)

    def text(self, elapsed_s: float) -> str:
        """Say how much time is left now; a step in progress may have taken longer than all was to take."""
        if self._ends_s is None:
            return ""
        left_s = self._ends_s - elapsed_s
        if left_s < -_OVERDUE_S:
            return "takes longer than expected"
        if left_s < _FEW_S:
            return f"less than {_FEW_S:.0f} s left"
        return f"{f'{left_s:.0f} s' if left_s < _MINUTE_S else duration_text(left_s)} left"


def size_text(count: float) -> str:
    """Write a number of bytes: 820 B, 4.2 kB, 31 MB."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if count >= 10 or unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


def _format_text(specification: str, value: float, *, factor: float = 1.0, unit: str = "") -> str:
    return with_minus_sign(f"{factor * value:{specification}}{unit}")


def to_json_value(value: object) -> object:
    """Turn a value into what JSON knows; what is neither a number, a text nor a collection becomes its text."""
    if hasattr(value, "tolist"):  # NumPy scalars and arrays, without importing NumPy
        value = value.tolist()
    match value:
        case Mapping():
            return {str(key): to_json_value(item) for key, item in value.items()}
        case list() | tuple() | set() | frozenset():
            return [to_json_value(item) for item in value]
        case _ if is_dataclass(value):
            return {item.name: to_json_value(getattr(value, item.name)) for item in fields(value)}
        case float() if not isfinite(value):
            return None
        case None | bool() | int() | float():
            return value
        case _:
            return value.isoformat() if isinstance(value, date) else str(value)


def attributes_json(record: object, /, *names: str, **renamed: str) -> dict[str, object]:
    """Return attributes of a value for a JSON object: under their own names, and then some under other names."""
    return {name: getattr(record, own) for own, name in (*zip(names, names, strict=True), *renamed.items())}


def grouped_files(files: Sequence[str]) -> str:
    """Name the first of some files, and how many more there are."""
    return files[0] if len(files) == 1 else f"{files[0]} and {len(files) - 1} more"


def listed_exclusions(left_out: "Sequence[Exclusion]") -> "tuple[Exclusion, ...]":
    """Return what was left out as listed for a reader: a line for each reason, ways back last."""
    from dragrig.analysis import RETURN_REASON

    items: dict[str, list[Exclusion]] = {}
    for exclusion in sorted(left_out, key=lambda exclusion: exclusion.reason == RETURN_REASON):
        items.setdefault(exclusion.reason, []).append(exclusion)
    return tuple(
        replace(
            alike[0],
            item=grouped_files([exclusion.item for exclusion in alike]),
            reason=reason if len(alike) == 1 else reason.replace("it is", "each is", 1),
        )
        for reason, alike in items.items()
    )


def exclusions_json(left_out: "Iterable[Exclusion]") -> list[dict[str, object]]:
    """Return what was left out, and why."""
    return [{"what": exclusion.item, "reason": exclusion.reason} for exclusion in left_out]


def quantity_json(quantity: "Estimate | EstimatedQuantity") -> dict[str, object]:
    """Return a number with its error and interval."""
    return {"value": quantity.value, "standard_error": quantity.standard_error, "interval_95": quantity.interval}


_KIND_TITLES = {
    "drag": "Drag",
    "coulomb": "Coulomb friction",
    "blank": "Blank run",
    "return": "Return",
    "motion": "Motion",
    "relaxation": "Relaxation",
}


def run_title(info: "RunInfo") -> str:
    """Say in a few words what a run is: its kind, its speed or strain, its specimen."""
    kind = _KIND_TITLES.get(info.kind, info.kind.replace("_", " ").capitalize())
    parameters = info.header.protocol
    speed, strain = _numeric_attribute(parameters, "speed_mm_s"), _numeric_attribute(parameters, "shear_strain")
    if info.kind == "relaxation" and strain is not None:
        kind += f" at {100 * strain:g} % shear strain"
    elif speed is not None:
        kind += f" at {speed:g} mm/s"
    name = str(info.header.specimen.get("name", "")).strip()
    return f"{kind} · {name}" if name else kind


def run_subtitle(info: "RunInfo") -> str:
    """Say when a run began and which file it is."""
    began = info.header.start_time.strftime("%Y-%m-%d %H:%M:%S")
    offset = info.header.start_time.isoformat()[-6:]
    return f"{began} {offset}  ·  run {info.header.run_id[:8]}  ·  {info.path.name}"


def run_problem(info: "RunInfo", bad_reason: str | None = None) -> str:
    """Say what is wrong with a run: that it was marked bad, or how it ended early; empty for a good one."""
    if bad_reason is not None:
        return f"marked bad: {bad_reason}"
    from dragrig.rig import RunStatus  # loads numpy, which a command line's help has no use for

    if info.status is RunStatus.COMPLETE:
        return ""
    return f"{info.status}: {info.reason}" if info.reason else str(info.status)


_SYMBOLS = {
    "friction_coefficient": "μ", "friction_shown": "μ · gain", "mucus_scale": "mucus viscosity ×",
    "mucus_shown": "mucus viscosity · gain ×", "stiffness_scale": "wall stiffness ×", "fast_time_scale": "τ1 ×",
    "slow_time_scale": "τ2 ×", "insertion_dwell_scale": "contact age ×", "force_gain": "force gain",
    "contact_angle_offset_deg": "contact angle offset",
}  # fmt: skip
_WALL_PARAMETER = re.compile(r"(eta|tau|E|e)(\d)(_scale|_shown)?")


def parameter_symbol(name: str) -> str:
    """Return a parameter as on paper, a factor with ×: μ, η1, τ2, E1 ×; a name that is none of these as it is."""
    if (wall := _WALL_PARAMETER.fullmatch(name)) is None:
        return _SYMBOLS.get(name, name)
    letter, number, kind = wall.groups()
    symbol = {"eta": "η", "tau": "τ"}.get(letter, "E") + number
    return symbol + {"_scale": " ×", "_shown": " · gain ×"}.get(kind or "", "")


def start_position_mm(info: "RunInfo") -> float:
    """Return the absolute position of a run's start; 0 where it is not known, as of an imported run."""
    return _numeric_attribute(info.header.entry, "origin_mm") or 0.0


def _numeric_attribute(parameters: "Mapping[str, Attribute]", name: str) -> float | None:
    value = parameters.get(name)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
