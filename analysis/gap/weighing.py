"""The features by which explanations of a force are weighed against each other and against the unknown."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import log, sqrt
from types import MappingProxyType

from dragrig.analysis.gap.calibration import OF_EFFECT, OF_FURTHER
from dragrig.analysis.gap.evidence import Evidence, Nameless, Tried
from dragrig.sim_backend.effects.catalogue import near_aliases

ALIKE = frozenset(
    frozenset(pair)
    for pair in (
        ("arm_compliance", "channel_latency"),
        ("arm_compliance", "payload_inertia"),
        ("channel_latency", "payload_inertia"),
        ("payload_inertia", "stribeck"),
        ("payload_inertia", "wall_lift_off"),
        ("stribeck", "adhesion"),
        ("stribeck", "breakaway"),
        ("stribeck", "wall_inertia"),
        ("presliding", "breakaway"),
        ("wall_lift_off", "wall_inertia"),
        ("wall_lift_off", "peristalsis"),
        ("mesentery_tether", "folds"),
        ("mesentery_tether", "peristalsis"),
        ("force_drift", "peristalsis"),
        ("folds", "peristalsis"),
        ("force_hysteresis", "force_nonlinearity"),
    )
)
"""Effects that act on the same: what another form of one leaves, the other may pass for."""
SAME_LAW: Mapping[str, frozenset[str]] = MappingProxyType(
    {
        "place in the gut": frozenset({"mesentery_tether"}),
        "load": frozenset({"force_nonlinearity"}),
        "session": frozenset({"force_drift"}),
    }
)
"""Effects that are such a law without a name themselves: it says nothing against them."""
CHANCE, NOISE_SHARE = 2.5, 0.06
"""Squares above noise that are chance: standard deviations of χ², and the share to which noise is known at all."""
FORM = 0.12
"""How much less, relative, the right effect may take away than a wrong one because its form is another."""
CLEAR = 0.37, 55.0
"""Between these the excess over what may be chance says more, the larger it is."""
ABRUPT = frozenset({"arm_compliance", "channel_latency", "payload_inertia"})
"""Effects that act where the force is steepest, of which another form leaves much; of any other it leaves little."""
ABRUPT_COUNTS = 0.4
"""Part of what they take away that counts for a gap: jerk of a motion and steps of a programme resemble them there."""
ALL_BUT = 0.95
"""An effect as large as it can be that explains more than this share, just as it is, is the right one nevertheless."""
MUCH = 1.0, 100.0
"""Squares above noise per block from which on what is left of a gap is more than a form makes."""
NAMELESS = 10.0
"""Half squares that a law without a name takes away by chance."""
SEEN_BESIDE = 5.0, 60.0
"""Half squares between which a further effect becomes sure, as far as noise goes."""
SOFT = 0.02
"""Shares within this of 0 and 1 are not told from them."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Effects that may be the ones, with what speaks for and against them."""

    effects: tuple[str, ...]
    features: Mapping[str, float]
    share: float


def hypotheses(found: Evidence, tolerance_mN: float) -> tuple[Hypothesis, ...]:
    """Return the explanations that change the force by more than what does not matter, and are no larger than can be.

    What would have to be larger than it can be is something else that resembles it, unless that leaves next to nothing.
    Several are not thought of where one of them resembles an effect that was left out of the search.
    """
    tried = [one for one in found.tried if one.changed_mN >= tolerance_mN and _possible(one, found)]
    best = max((one.gain for one in tried if len(one.effects) == 1), default=0.0)
    return tuple(_weighed(one, found, best) for one in tried)


def _possible(one: Tried, found: Evidence) -> bool:
    return (not one.at_limit or share(one.plain, found) > ALL_BUT) and not _in_place_of_one(one, found)


def _in_place_of_one(one: Tried, found: Evidence) -> bool:
    """Return whether several effects may do together what a single one does that was left out of the search."""
    alike = {other for name in one.effects for other in near_aliases(name)}
    return len(one.effects) > 1 and bool(alike & set(found.without))


def chance(found: Evidence) -> float:
    """Return squares above the number of blocks that may be chance."""
    return max(CHANCE * sqrt(2.0 * found.blocks), NOISE_SHARE * found.blocks)


def share(squares: float, found: Evidence) -> float:
    """Return the share of the excess that is explained when so many squares remain, chance not counted as left."""
    gained = max(found.squares - squares, 0.0)
    return gained / max(gained + _left(squares, found), 1.0)


def _left(squares: float, found: Evidence) -> float:
    """Return the squares that remain above what may be chance."""
    return max(squares - found.blocks - chance(found), 0.0)


def _weighed(one: Tried, found: Evidence, best: float) -> Hypothesis:
    flexible = share(one.flexible, found)
    plain = flexible if one.periodic else share(one.plain, found)
    by_form, clear = _log_odds(flexible), _log(found.excess / chance(found), *CLEAR)
    features = {
        "known": 1.0,
        "known, in a clear gap": clear,
        "plain": _log_odds(plain),
        "plain, below half": min(_log_odds(plain), 0.0),
        "plain, in a clear gap": clear * _log_odds(plain),
        "flexible": by_form,
        "flexible, below half": min(by_form, 0.0),
        "flexible, in a clear gap": clear * by_form,
        "left elsewhere": log(1.0 + max(one.elsewhere, 0.0)),
        "left, much": 0.0 if ABRUPT & set(one.effects) else _log(_left(one.flexible, found) / found.blocks, *MUCH),
    }
    features |= _nameless(one, found)
    features |= {f"{OF_EFFECT}{one.effects[0]}": 1.0, **{f"{OF_FURTHER}{name}": 1.0 for name in one.effects[1:]}}
    if len(one.effects) == 1:
        features["behind"] = (best - one.gain) / (1.0 + FORM * best)
    else:
        features |= _further(one, found)
    return Hypothesis(one.effects, features, 0.5 * (plain + flexible))


def counts(effect: str) -> float:
    """Return the part of what an effect takes away that counts for a gap."""
    return ABRUPT_COUNTS if effect in ABRUPT else 1.0


def largest_gain(found: Evidence, tolerance_mN: float) -> float:
    """Return half the squares that the best explanation takes away, with a name or without, of those that matter."""
    named = [one.gain * counts(one.effects[-1]) for one in found.tried if one.changed_mN >= tolerance_mN]
    nameless = [0.5 * (found.squares - one.squares) for one in found.nameless if one.changed_mN >= tolerance_mN]
    return max((*named, *nameless, 0.0))


def _nameless(one: Tried, found: Evidence) -> dict[str, float]:
    """Return by how much a law without a name does better, or worse, than the effects in any form."""
    squares = min(_squares_of(found.nameless, one.effects), default=found.squares)
    gain, nameless = (0.5 * max(found.squares - each, 0.0) for each in (one.flexible, squares))
    over = _log((nameless + NAMELESS) / (gain + NAMELESS), 0.1, 10.0)
    fewer = (_left(one.flexible, found) + chance(found)) / (_left(min(squares, found.squares), found) + chance(found))
    return {"nameless": over, "nameless, better": max(over, 0.0), "nameless, leaves less": _log(fewer, 1.0, 100.0)}


def _squares_of(laws: Iterable[Nameless], effects: Sequence[str]) -> list[float]:
    """Return the squares that laws without a name leave, of those that none of the effects is."""
    return [law.squares for law in laws if not SAME_LAW.get(law.law, frozenset()) & set(effects)]


def _further(one: Tried, found: Evidence) -> dict[str, float]:
    """Return what tells a further effect from what a foreign form of those before leaves."""
    *before, last = one.effects
    alike = any({name, last} in ALIKE for name in before)
    by_law = 0.5 * (one.left - min(_squares_of(one.laws, [last]), default=one.left))
    over_law = _log(one.gain / max(by_law, NAMELESS), 0.1, 1.0) if one.laws else 0.0
    return {
        "further": 1.0,
        "third": float(len(one.effects) > 2),
        "further: share of excess": _log(2 * one.gain / max(found.excess, 1.0), 1e-3, 1.0),
        "further: over its rival": _log(one.gain / max(one.rival_gain, 1.0), 0.3, 5.0),
        "further: worse than a law": over_law,
        "further: gain": _log(one.gain, *SEEN_BESIDE),
        "further: alike": float(alike),
    }


def _log(value: float, low: float, high: float) -> float:
    return log(min(max(value, low), high))


def _log_odds(value: float) -> float:
    within = min(max(value, 0.0), 1.0)
    return log((within + SOFT) / (1.0 - within + SOFT))
