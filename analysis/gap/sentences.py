"""What a diagnosis says, in the sentences that a person at the rig reads first."""

from collections.abc import Iterator, Sequence
from math import isfinite

from dragrig.analysis.gap.results import Diagnosis, Ranked, Shrink, Verdict
from dragrig.sim_backend.effects.catalogue import catalogue

NO_GAP, UNKNOWN = "no_gap", "unknown"
WITHOUT_A_NAME = {NO_GAP: "no gap", UNKNOWN: "none of the catalogue"}
UNCALIBRATED = "The probabilities are not calibrated: take them for an order, not for chances."


def verdict_sentences(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return the verdict in plain words, with its probability; the first sentence is the answer."""
    said = f"({chance_in_words(verdict_probability(diagnosis))})"
    match diagnosis.verdict:
        case Verdict.NO_GAP:
            return (f"No gap {said}: {_seen(diagnosis)}.",)
        case Verdict.UNKNOWN:
            found = diagnosis.unknown
            first = f"A gap that no effect of the catalogue explains {said}."
            told = () if found is None else (sentence(found.lives_in), sentence(found.shape))
            return tuple(one for one in (first, *told, *_expression(diagnosis)) if one)
        case Verdict.SEVERAL:
            first = f"{capital(listed([name_of(one) for one in diagnosis.effects]))} act together {said}."
        case Verdict.EFFECT:
            first = f"{capital(listed([name_of(one) for one in diagnosis.effects]))} {said}."
    return first, *_confusable(diagnosis), *_beside(diagnosis)


def would_have_seen(diagnosis: Diagnosis) -> str:
    """Say how small an effect these runs would have shown."""
    return f"{capital(_seen(diagnosis))}."


def meaning_of_probabilities(diagnosis: Diagnosis) -> str:
    """Say where the probabilities come from."""
    return sentence(diagnosis.calibration) or UNCALIBRATED


def shrink_sentences(shrink: Shrink, *, named: bool = True) -> tuple[str, ...]:
    """Say how far the gap closes on runs that took no part; how large it is where no effect is named to close it."""
    runs = f", on {counted(len(shrink.runs), 'run')} that took no part in fit or choice" if shrink.runs else ""
    floor = f"noise and scatter of repeats alone are {millinewton(shrink.noise_floor_mN)}"
    before, after = millinewton(shrink.gap_before_mN), millinewton(shrink.gap_after_mN)
    sizes = f"Root mean square of the residual{runs}: {before} without the effect, {after} with it; {floor}."
    if not named and shrink.closed is not None:
        return (f"Root mean square of the residual{runs}: {before}; {floor}.",)
    if shrink.closed is None or not isfinite(shrink.closed):
        sizes = f"Root mean square of the residual{runs}: {before}; {floor}."
        return sizes, "That is hardly above them, so that no share of a gap can be said to close."
    said, interval = percent(shrink.closed), ""
    if shrink.closed_95ci is not None:
        low, high = shrink.closed_95ci
        interval = f"95 %: {percent(low)} to {percent(high)}"
    if shrink.closed > 1:
        exactly = "; ".join(one for one in (said, interval) if one)
        return sizes, f"The whole gap closes ({exactly}): less is left than noise and scatter of repeats make."
    closed = f"{said} of the gap closes" + (f" ({interval})" if interval else "")
    return sizes, f"{closed}{': it grows' if shrink.closed < 0 else ''}."


def verdict_probability(diagnosis: Diagnosis) -> float:
    """Return the probability of the verdict; NaN where the ranking does not hold it."""
    found = next((one for one in diagnosis.ranking if is_verdict(one, diagnosis)), None)
    return float("nan") if found is None else found.probability


def is_verdict(ranked: Ranked, diagnosis: Diagnosis) -> bool:
    """Whether a hypothesis of the ranking is the one that the verdict names."""
    if diagnosis.effects:
        return set(ranked.hypothesis.split("+")) == set(diagnosis.effects)
    return ranked.hypothesis == diagnosis.verdict.value


def name_of(hypothesis: str) -> str:
    """Return what a person calls a hypothesis: an effect by its name, several joined with `and`."""
    if hypothesis in WITHOUT_A_NAME:
        return WITHOUT_A_NAME[hypothesis]
    known = catalogue()
    names = [known[one].name if one in known else one.replace("_", " ") for one in hypothesis.split("+")]
    return listed(names)


def what_it_is(effect: str) -> str:
    """Say what an effect is and where it acts, from the catalogue."""
    known = catalogue().get(effect)
    if known is None:
        return f"{capital(name_of(effect))} is not in this catalogue."
    return f"{capital(known.name)}, in the {known.place.value}. {known.summary} What shows it: {known.exposes}."


def chance_in_words(probability: float) -> str:
    """Spell a probability with two digits; never as a certainty."""
    if not isfinite(probability):
        return "probability not known"
    if probability > 0.995:
        return "above 0.99"
    return "below 0.01" if probability < 0.005 else f"{probability:.2f}"


def millinewton(value: float) -> str:
    """Spell a force."""
    if not isfinite(value):
        return "an unknown force"
    return f"{value:.1f} mN" if abs(value) < 100 else f"{value:.0f} mN"


def percent(share: float) -> str:
    """Spell a share: 71 %, 99.3 %."""
    if not isfinite(share):
        return "an unknown share"
    near = 0.9 < share < 1 or 0 < share < 0.01
    return f"{100 * share:.1f} %".replace("-", "−") if near else f"{100 * share:.0f} %".replace("-", "−")


def listed(names: Sequence[str]) -> str:
    """Join names as in a sentence."""
    if not names:
        return ""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def counted(number: int, noun: str) -> str:
    """Spell a number of things."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def capital(text: str) -> str:
    """Let a sentence begin."""
    return text[:1].upper() + text[1:]


def sentence(text: str) -> str:
    """Let a text begin and end as a sentence; nothing of nothing."""
    whole = capital(text.strip())
    return whole if not whole or whole.endswith((".", "!", "?")) else f"{whole}."


def _seen(diagnosis: Diagnosis) -> str:
    least = diagnosis.would_have_seen_mN
    if not isfinite(least):
        return "how small an effect these runs would have shown is not known"
    return f"an effect above {millinewton(least)} would have been seen"


def _confusable(diagnosis: Diagnosis) -> Iterator[str]:
    left_out = () if diagnosis.evidence is None else diagnosis.evidence.without
    it = "it" if len(diagnosis.effects) == 1 else "them"
    alike = [name_of(one) for one in diagnosis.confusable_with if one not in left_out]
    if alike:
        yield f"{capital(listed(alike))} cannot be told from {it} with these runs."
    untried = [name_of(one) for one in diagnosis.confusable_with if one in left_out]
    if untried:
        yield f"Left out of the search, and hardly told from {it}: {listed(untried)}."


def _beside(diagnosis: Diagnosis) -> Iterator[str]:
    if not diagnosis.residual_unknown:
        return
    it = "it" if len(diagnosis.effects) == 1 else "them"
    yield f"Something is left beside {it} that no effect of the catalogue explains."
    found = diagnosis.unknown
    if found is not None:
        yield from (one for one in (sentence(found.lives_in), sentence(found.shape)) if one)
        yield from _expression(diagnosis)


def _expression(diagnosis: Diagnosis) -> Iterator[str]:
    found = diagnosis.unknown
    if found is None or not found.expression:
        return
    share = "" if found.held_out is None else f" explains {percent(found.held_out)} of it on runs that took no part"
    yield f"What describes it best, {found.expression},{share or ' holds up on runs that took no part'}."
