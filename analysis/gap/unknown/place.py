"""Where a gap is, as a sentence."""

from collections.abc import Sequence

from dragrig.analysis.gap.unknown.part import MOST, NONE, SOME, kinds_with, span_of
from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.analysis.gap.where.locate import ALPHA
from dragrig.analysis.gap.where.results import Location, Where
from dragrig.rig.devices import Contact

_CALLED = {"coulomb": "Coulomb"}


def place(where: Where, blocks: Sequence[ResidualBlocks]) -> str:
    """Return where the excess is, and in which runs it is not; ranges are told where they are not chance."""
    kinds = kinds_with(where, blocks, SOME)
    absent = [one for one in dict.fromkeys(each.kind for each in blocks) if _share(where, "protocol", one) < NONE]
    said = f"It is in {_channels(where)} of {runs(kinds)}{_speeds(where, blocks)}"
    said += _range(where.location("strain"), "at shear strains of", "")
    said += _range(where.location("position"), "between", " mm of the stroke", joiner="and")
    said += _range(where.location("session"), "between", " s of the session", joiner="and")
    said += f", {span}" if (span := span_of(where)) else ""
    said += _range(where.location("band_hz"), "at", " Hz") if where.domain == "frequency" else ""
    said += f"; not in {runs(absent, 'or')}" if absent else ""
    return f"{said}.{_one_run(blocks)}"


def runs(kinds: Sequence[str], joiner: str = "and") -> str:
    """Return kinds of run in words."""
    called = [_CALLED.get(one, one) for one in kinds]
    listed = f" {joiner} ".join([", ".join(called[:-1]), called[-1]]) if len(called) > 1 else called[0]
    return f"{listed} runs"


def _share(where: Where, axis: str, name: str) -> float:
    return where.location(axis).shares.get(name, 0.0)


def _channels(where: Where) -> str:
    shares = where.location("channel").shares
    named = sorted((one for one in shares if shares[one] >= SOME), key=lambda one: -shares[one])
    named = [one.replace("_", " ") for one in named]
    return "the " + " and the ".join(named) if named else "all channels"


def _speeds(where: Where, blocks: Sequence[ResidualBlocks]) -> str:
    found = where.location("speed_mm_s")
    if found.low is None or found.high is None or found.p >= ALPHA:
        return ""
    levels = {one.speed_mm_s for one in blocks if one.contact is not Contact.STICKING}
    if found.low == found.high:
        return f" at {found.low:g} mm/s"
    if found.high >= max(levels):
        return f" at {found.low:g} mm/s and faster"
    if found.low <= min(levels):
        return f" up to {found.high:g} mm/s"
    return f" at {found.low:g} to {found.high:g} mm/s"


def _range(found: Location, before: str, after: str, joiner: str = "to") -> str:
    if found.low is None or found.high is None or found.p >= ALPHA:
        return ""
    if found.low == found.high:
        return f", {before} {found.low:.4g}{after}"
    return f", {before} {found.low:.4g} {joiner} {found.high:.4g}{after}"


def _one_run(blocks: Sequence[ResidualBlocks]) -> str:
    excess: dict[str, float] = {}
    for one in blocks:
        excess[one.run_id] = excess.get(one.run_id, 0.0) + float(one.excess.sum())
    if len(excess) == 1:
        return ""
    whole = sum(max(one, 0.0) for one in excess.values())
    most = max(excess, key=lambda name: excess[name])
    return f" Nearly all of it is in one run, {most}." if excess[most] >= MOST * whole > 0 else ""
