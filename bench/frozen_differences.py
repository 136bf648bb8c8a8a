"""Compares two records of what the program answered.

Numbers are equal when they differ by no more than the tolerance times the larger of the two. A number that is small
beside its natural scale, the largest magnitude at the same place of the same answer with the positions in lists left
out (`correlation.rows[][]`), is a difference of larger ones and carries their rounding: it may also differ by a
hundredth of the tolerance times that scale, which is 1e-11 of it. Sentences may differ; all else must be the same.
"""

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import isnan

from frozen_values import Json

TOLERANCE = 1e-9
ROUNDING_SHARE = 0.01
"""Share of the tolerance that a number may differ by in terms of its natural scale."""
LONGEST = 160
"""Characters that are shown of a value."""

SENTENCE_KEYS = frozenset({
    "cannot_answer", "condition", "description", "detail", "ends", "exposes", "in_words", "meaning", "message", "note",
    "prompt", "reason", "remark", "remarks", "sentence", "sentences", "summary", "title", "why",
})  # fmt: skip
"""Keys whose texts are written for people. Whether there is a text at all must stay the same."""

SENTENCE_PATHS = re.compile(
    r"""
      effects\[\]\.(?:name|source)$             # the catalogue: an effect's name in words, its literature
    | findings\[\]\.(?:paper|shown|practice|where)$
    | numbers\[\]\.quantity$
    | \.unknown\.(?:lives_in|shape)$
    | check[^.]*\.answer\[\]\.what$             # what was looked at on the rig
    | entry\.note$ | answer\.notes\[\]$         # of a calibration
    | \.answer\[\]\.error$                      # of a campaign that could not be diagnosed
    | \.answer\.calibration$
    | \.campaign\.left_out\[\]\.reason$
    """,
    re.VERBOSE,
)
"""The same, where the key alone does not tell."""


@dataclass(frozen=True, slots=True)
class Difference:
    """A place at which two records disagree."""

    path: str
    before: str
    after: str

    def __str__(self) -> str:
        return f"{self.path}: {_shortened(self.before)} -> {_shortened(self.after)}"


def _shortened(text: str) -> str:
    return text if len(text) <= LONGEST else f"{text[:LONGEST]} …"


@dataclass(slots=True)
class Tally:
    """What a comparison has come to."""

    values: int = 0
    exact: int = 0
    largest_relative: float = 0.0
    small: int = 0
    rounded_arrays: int = 0
    differences: list[Difference] = field(default_factory=list)
    sentences: list[Difference] = field(default_factory=list)
    repaired: list[str] = field(default_factory=list)


def compare(before: Mapping[str, Json], after: Mapping[str, Json], tolerance: float = TOLERANCE) -> Tally:
    """Compare the cases of a stage of two records."""
    tally = Tally()
    for name in sorted({*before, *after}):
        if name not in before or name not in after:
            tally.differences.append(Difference(name, _presence(name in before), _presence(name in after)))
            continue
        _case(name, before[name], after[name], tolerance, tally)
    return tally


def _case(name: str, before: Json, after: Json, tolerance: float, tally: Tally) -> None:
    if isinstance(before, Mapping) and before.get("code") == 1:
        # Exit code 1 is a bug of the program, which may be repaired.
        tally.repaired.append(f"{name}: was a bug (exit code 1)")
        return
    _Comparison(tolerance, _scales(name, before, after), tally).compare(name, before, after)


def _presence(there: bool) -> str:
    return "there" if there else "missing"


def _scales(name: str, *values: Json) -> dict[str, float]:
    scales: dict[str, float] = defaultdict(float)
    for value in values:
        for path, number in _numbers(name, value):
            place = re.sub(r"\[\d+\]", "[]", path)
            if not isnan(number) and abs(number) != float("inf"):
                scales[place] = max(scales[place], abs(number))
    return scales


def _numbers(path: str, value: Json) -> Iterator[tuple[str, float]]:
    if isinstance(value, Mapping):
        for key, content in value.items():
            yield from _numbers(f"{path}.{key}", content)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _numbers(f"{path}[{index}]", item)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path, float(value)


@dataclass(frozen=True, slots=True)
class _Comparison:
    tolerance: float
    scales: Mapping[str, float]
    tally: Tally

    def compare(self, path: str, before: Json, after: Json) -> None:
        """Compare two values at a place, and all that is in them."""
        key = path.rpartition(".")[2].partition("[")[0]
        if key == "command":
            return
        if key in SENTENCE_KEYS or SENTENCE_PATHS.search(re.sub(r"\[\d+\]", "[]", path)):
            self._sentence(path, before, after)
        elif isinstance(before, Mapping) and isinstance(after, Mapping):
            self._mappings(path, before, after)
        elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
            for index, (left, right) in enumerate(zip(before, after, strict=True)):
                self.compare(f"{path}[{index}]", left, right)
        else:
            self._leaf(path, before, after)

    def _mappings(self, path: str, before: Mapping[str, Json], after: Mapping[str, Json]) -> None:
        if "within" in before and "within" in after:
            self._about(path, before, after)
            return
        if "sha256" in before and "sha256" in after:
            before, after = self._arrays(before, after)
        for key in sorted({*before, *after}):
            if key not in before or key not in after:
                self._differ(f"{path}.{key}", _presence(key in before), _presence(key in after))
            else:
                self.compare(f"{path}.{key}", before[key], after[key])

    def _arrays(
        self, before: Mapping[str, Json], after: Mapping[str, Json]
    ) -> tuple[Mapping[str, Json], Mapping[str, Json]]:
        """Return what of two digests is to be compared: only the checksum where it is the same."""
        if before["sha256"] == after["sha256"]:
            return {"sha256": before["sha256"]}, {"sha256": after["sha256"]}
        self.tally.rounded_arrays += 1
        return tuple({key: part[key] for key in part if key != "sha256"} for part in (before, after))  # type: ignore[return-value]

    def _about(self, path: str, before: Mapping[str, Json], after: Mapping[str, Json]) -> None:
        left, right, within = before["about"], after["about"], before["within"]
        assert isinstance(left, int | float)
        assert isinstance(right, int | float)
        assert isinstance(within, int | float)
        self.tally.values += 1
        if not abs(left - right) <= within:
            self._differ(path, f"{left} ± {within}", str(right))

    def _sentence(self, path: str, before: Json, after: Json) -> None:
        if bool(before) != bool(after):
            self._differ(path, repr(before), repr(after))
        elif before != after:
            self.tally.sentences.append(Difference(path, str(before), str(after)))

    def _leaf(self, path: str, before: Json, after: Json) -> None:
        self.tally.values += 1
        if type(before) is type(after) and before == after:
            self.tally.exact += 1
        elif not (_number(before) and _number(after) and self._close(path, float(before), float(after))):  # type: ignore[arg-type]
            self._differ(path, repr(before), repr(after))

    def _close(self, path: str, before: float, after: float) -> bool:
        if before == after or (isnan(before) and isnan(after)):
            return True
        apart = abs(before - after)
        relative = apart / max(abs(before), abs(after))
        if relative <= self.tolerance:
            self.tally.largest_relative = max(self.tally.largest_relative, relative)
            return True
        if apart <= ROUNDING_SHARE * self.tolerance * self.scales[re.sub(r"\[\d+\]", "[]", path)]:
            self.tally.small += 1
            return True
        return False

    def _differ(self, path: str, before: str, after: str) -> None:
        self.tally.differences.append(Difference(path, before, after))


def _number(value: Json) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
