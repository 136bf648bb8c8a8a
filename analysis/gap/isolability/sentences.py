"""What runs can tell apart, in sentences that stand alike in terminal and page."""

from collections.abc import Iterator

from dragrig.analysis.gap.isolability.results import Isolability, Pair, Visibility
from dragrig.analysis.gap.sentences import capital, counted, listed, name_of

NAMES = {"coulomb": "Coulomb"}


def isolability_sentences(found: Isolability) -> tuple[str, ...]:
    """Return what matters most, the first sentence first."""
    return tuple(_sentences(found))


def least_in_words(one: Visibility) -> str:
    """Spell the smallest size that would be seen, with its unit."""
    if one.least is None:
        return "not at all"
    unit = "" if one.unit == "1" else f" {one.unit}"
    return f"{one.least:.2g}{unit}"


def pair_in_words(one: Pair) -> str:
    """Name two effects and say how far apart they are."""
    return f"{listed([name_of(name) for name in one.effects])} (sin² {one.sin2:.2f}, d′ {one.separation:.0f})"


def _sentences(found: Isolability) -> Iterator[str]:
    made = "would make" if found.planned else "are"
    counts = listed([counted(number, f"{NAMES.get(kind, kind)} run") for kind, number in found.runs.items()])
    time = "" if found.duration_s is None else f" in {found.duration_s / 60:.1f} min of rig time"
    confused = found.confused
    if confused:
        yield (
            f"{counted(len(confused), 'pair')} of effects {'is' if len(confused) == 1 else 'are'} hardly told apart by "
            f"these runs: {listed([pair_in_words(one) for one in confused])}."
        )
    else:
        yield "These runs tell every two effects of the catalogue apart."
    yield f"These {made} {counts}{time}." if not found.planned else f"The plan {made} {counts}{time}."
    if found.unseen:
        yield f"{capital(listed([name_of(one) for one in found.unseen]))} would not be seen at the usual size."
    force = [one for one in found.of_channel("force") if one.least is not None]
    if force:
        weakest = max(force, key=lambda one: (one.least or 0.0) / abs(one.usual))
        yield (
            f"The least visible is {name_of(weakest.effect)}: from {least_in_words(weakest)} on, where it usually is "
            f"{weakest.usual:g}."
        )
