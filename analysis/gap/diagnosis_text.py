"""The result of a diagnosis in sentences: verdict, location of the gap, gap reduction, recommended run."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

from dragrig.analysis.gap.diagnosis import (
    AxisLocation,
    Diagnosis,
    GapLocation,
    GapReduction,
    ModelPair,
    NextRun,
    RankedHypothesis,
    Verdict,
)
from dragrig.config.plan import PlanStep
from dragrig.sim_backend.effects.base import catalogue

NO_GAP, UNKNOWN = "no_gap", "unknown"
NAMES_WITHOUT_EFFECT = {NO_GAP: "no gap", UNKNOWN: "none of the catalogue"}
UNCALIBRATED_NOTE = "The probabilities are not calibrated: take them for an order, not for chances."


def verdict_sentences(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return the verdict in plain words, with its probability; the first sentence is the answer."""
    text = f"({probability_text(verdict_probability(diagnosis))})"
    match diagnosis.verdict:
        case Verdict.NO_GAP:
            return (f"No gap {text}: {_detection_limit_clause(diagnosis)}.",)
        case Verdict.UNKNOWN:
            gap = diagnosis.unknown
            first = f"A gap that no effect of the catalogue explains {text}."
            told = () if gap is None else (as_sentence(gap.location), as_sentence(gap.dependence))
            return tuple(one for one in (first, *told, *_law_sentences(diagnosis)) if one)
        case Verdict.SEVERAL:
            first = f"{capitalise(join_names([display_name(name) for name in diagnosis.effects]))} act together {text}."
        case Verdict.EFFECT:
            first = f"{capitalise(join_names([display_name(name) for name in diagnosis.effects]))} {text}."
    return first, *_confusable_sentences(diagnosis), *_residual_sentences(diagnosis)


def detection_limit_sentence(diagnosis: Diagnosis) -> str:
    """Say how small an effect these runs would have shown."""
    return f"{capitalise(_detection_limit_clause(diagnosis))}."


def calibration_sentence(diagnosis: Diagnosis) -> str:
    """Say where the probabilities come from."""
    return as_sentence(diagnosis.calibration) or UNCALIBRATED_NOTE


def shrink_sentences(shrink: GapReduction, *, named: bool = True) -> tuple[str, ...]:
    """Say how far the gap closes on runs that took no part; how large it is where no effect is named to close it."""
    runs = f", on {count_text(len(shrink.runs), 'run')} that took no part in fit or choice" if shrink.runs else ""
    floor = f"noise and scatter of repeats alone are {force_text(shrink.noise_floor_mN)}"
    before, after = force_text(shrink.gap_before_mN), force_text(shrink.gap_after_mN)
    sizes = f"Root mean square of the residual{runs}: {before} without the effect, {after} with it; {floor}."
    if not named and shrink.closed is not None:
        return (f"Root mean square of the residual{runs}: {before}; {floor}.",)
    if shrink.closed is None or not isfinite(shrink.closed):
        sizes = f"Root mean square of the residual{runs}: {before}; {floor}."
        return sizes, "That is hardly above them, so that no share of a gap can be said to close."
    text, interval = percent_text(shrink.closed), ""
    if shrink.closed_95ci is not None:
        low, high = shrink.closed_95ci
        interval = f"95 %: {percent_text(low)} to {percent_text(high)}"
    if shrink.closed > 1:
        exactly = "; ".join(name for name in (text, interval) if name)
        return sizes, f"The whole gap closes ({exactly}): less is left than noise and scatter of repeats make."
    closed = f"{text} of the gap closes" + (f" ({interval})" if interval else "")
    return sizes, f"{closed}{': it grows' if shrink.closed < 0 else ''}."


def verdict_probability(diagnosis: Diagnosis) -> float:
    """Return the probability of the verdict; NaN where the ranking does not hold it."""
    hypothesis = next((entry for entry in diagnosis.ranking if is_stated_verdict(entry, diagnosis)), None)
    return float("nan") if hypothesis is None else hypothesis.probability


def is_stated_verdict(ranked: RankedHypothesis, diagnosis: Diagnosis) -> bool:
    """Whether a hypothesis of the ranking is the one that the verdict names."""
    if diagnosis.effects:
        return set(ranked.hypothesis.split("+")) == set(diagnosis.effects)
    return ranked.hypothesis == diagnosis.verdict.value


def display_name(hypothesis: str) -> str:
    """Return what a person calls a hypothesis: an effect by its name, several joined with `and`."""
    if hypothesis in NAMES_WITHOUT_EFFECT:
        return NAMES_WITHOUT_EFFECT[hypothesis]
    known = catalogue()
    names = [known[name].name if name in known else name.replace("_", " ") for name in hypothesis.split("+")]
    return join_names(names)


def effect_description(effect: str) -> str:
    """Say what an effect is and where it acts, from the catalogue."""
    known = catalogue().get(effect)
    if known is None:
        return f"{capitalise(display_name(effect))} is not in this catalogue."
    return (
        f"{capitalise(known.name)}, in the {known.location.value}. {known.summary} What shows it: {known.visible_in}."
    )


def probability_text(probability: float) -> str:
    """Spell a probability with two digits; never as a certainty."""
    if not isfinite(probability):
        return "probability not known"
    if probability > 0.995:
        return "above 0.99"
    return "below 0.01" if probability < 0.005 else f"{probability:.2f}"


def force_text(value: float) -> str:
    """Spell a force."""
    if not isfinite(value):
        return "an unknown force"
    return f"{value:.1f} mN" if abs(value) < 100 else f"{value:.0f} mN"


def percent_text(share: float) -> str:
    """Spell a share: 71 %, 99.3 %."""
    if not isfinite(share):
        return "an unknown share"
    near = 0.9 < share < 1 or 0 < share < 0.01
    return f"{100 * share:.1f} %".replace("-", "−") if near else f"{100 * share:.0f} %".replace("-", "−")


def join_names(names: Sequence[str]) -> str:
    """Join names as in a sentence."""
    if not names:
        return ""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def count_text(number: int, noun: str) -> str:
    """Spell a number of things."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def capitalise(text: str) -> str:
    """Let a sentence begin."""
    return text[:1].upper() + text[1:]


def as_sentence(text: str) -> str:
    """Let a text begin and end as a sentence; nothing of nothing."""
    whole = capitalise(text.strip())
    return whole if not whole or whole.endswith((".", "!", "?")) else f"{whole}."


def _detection_limit_clause(diagnosis: Diagnosis) -> str:
    least = diagnosis.detection_limit_mN
    if not isfinite(least):
        return "how small an effect these runs would have shown is not known"
    return f"an effect above {force_text(least)} would have been seen"


def _confusable_sentences(diagnosis: Diagnosis) -> Iterator[str]:
    left_out = () if diagnosis.decision_inputs is None else diagnosis.decision_inputs.excluded
    it = "it" if len(diagnosis.effects) == 1 else "them"
    alike = [display_name(name) for name in diagnosis.confusable_with if name not in left_out]
    if alike:
        yield f"{capitalise(join_names(alike))} cannot be told from {it} with these runs."
    untried = [display_name(name) for name in diagnosis.confusable_with if name in left_out]
    if untried:
        yield f"Left out of the search, and hardly told from {it}: {join_names(untried)}."


def _residual_sentences(diagnosis: Diagnosis) -> Iterator[str]:
    if not diagnosis.residual_unknown:
        return
    it = "it" if len(diagnosis.effects) == 1 else "them"
    yield f"Something is left beside {it} that no effect of the catalogue explains."
    gap = diagnosis.unknown
    if gap is not None:
        yield from (name for name in (as_sentence(gap.location), as_sentence(gap.dependence)) if name)
        yield from _law_sentences(diagnosis)


def _law_sentences(diagnosis: Diagnosis) -> Iterator[str]:
    gap = diagnosis.unknown
    if gap is None or not gap.expression:
        return
    share = (
        ""
        if gap.held_out_share is None
        else f" explains {percent_text(gap.held_out_share)} of it on runs that took no part"
    )
    yield f"What describes it best, {gap.expression},{share or ' holds up on runs that took no part'}."


MIN_SHOWN_SHARE = 0.01
"""Smaller shares are not told."""
MAX_SHOWN_P = 0.05
NOTHING_SIGNIFICANT = "nothing stands out"


@dataclass(frozen=True, slots=True)
class AxisText:
    """One axis: its name, where on it most of the excess is, and the chance that it stands out so without a gap."""

    axis: str
    where: str
    p: float


_AXIS_UNITS: Mapping[str, tuple[str, str, float]] = {
    "speed_mm_s": ("speed", "mm/s", 1.0),
    "position": ("position", "mm", 1.0),
    "session": ("session", "min", 1 / 60),
    "strain": ("strain", "%", 100.0),
    "band_hz": ("frequency", "Hz", 1.0),
}
"""Name, unit and factor of axes whose bins are ranges."""
DOMAIN_NAMES: Mapping[str, str] = {
    "speed": "speed",
    "position": "position along the stroke",
    "time": "time within the run",
    "session": "the session's clock",
    "frequency": "time at a high frequency",
    "strain": "strain",
    "transient": "what happens when the velocity changes",
}


def axis_texts(where: GapLocation) -> tuple[AxisText, ...]:
    """Return the axes on which a part of the excess lies; none without a gap."""
    if not where.present:
        return ()
    alone = where.runs == 1
    return tuple(
        AxisText(_axis_name(location), text, float("nan") if alone else location.min_p)
        for location in where.locations
        if (text := _axis_text(location, alone=alone))
    )


def domain_sentence(where: GapLocation) -> str:
    """Say what the residual is above all a function of."""
    if not where.present:
        return "No place stands out of noise and repeatability."
    if not where.domain:
        return "What the residual is a function of, these runs do not say of one another."
    score = where.domain_scores.get(where.domain, float("nan"))
    others = "" if where.runs == 1 else " on runs that took no part"
    share = f", which accounts for {100 * score:.0f} % of its squares{others}"
    if not isfinite(score):
        share = ""
    return f"The residual is above all a function of {DOMAIN_NAMES.get(where.domain, where.domain)}{share}."


def _axis_name(location: AxisLocation) -> str:
    return _AXIS_UNITS[location.name][0] if location.name in _AXIS_UNITS else location.name


def _axis_text(location: AxisLocation, *, alone: bool) -> str:
    named = sorted(location.shares.items(), key=lambda pair: -pair[1])
    if named:
        return ", ".join(f"{name} {100 * share:.0f} %" for name, share in named if share >= MIN_SHOWN_SHARE)
    if location.low is None or location.high is None or location.share < MIN_SHOWN_SHARE:
        return ""
    if alone and location.low == location.high:
        return ""
    if location.p > MAX_SHOWN_P and not alone:
        return NOTHING_SIGNIFICANT
    _, unit, factor = _AXIS_UNITS.get(location.name, (location.name, "", 1.0))
    low, high = f"{location.low * factor:.3g}", f"{location.high * factor:.3g}"
    ends = f"at {low}" if low == high else f"{low} to {high}"
    return f"{ends} {unit}".strip() + f": {100 * location.share:.0f} %"


MAX_QUOTED_SHARE = 0.9
"""A rival that leaves more than this share resembles the truth so little that the share is not told."""


def run_text(step: PlanStep) -> str:
    """Say what a run is: a drag at 1 mm/s over 20 mm."""
    settings = step.parameters
    match step.kind:
        case "relaxation":
            strain, hold = settings["shear_strain"], settings["hold_s"]
            assert isinstance(strain, float)  # noqa: S101  # the grid's own
            text = f"a relaxation at {100 * strain:g} % strain, held for {hold:g} s"
        case "motion":
            strokes = settings["strokes"]
            assert isinstance(strokes, list | tuple)  # noqa: S101
            first = strokes[0]
            text = f"a drag of {first['travel_mm']:g} mm and back at {first['speed_mm_s']:g} mm/s in one record"
        case kind:
            what = {"coulomb": "a Coulomb run", "blank": "a blank run"}.get(kind, f"a {kind}")
            text = f"{what} at {settings['speed_mm_s']:g} mm/s over {settings['travel_mm']:g} mm"
            if settings.get("accel_mm_s2", 400.0) != 400.0:
                text += f", accelerated with {settings['accel_mm_s2']:g} mm/s²"
    if step.kind == "drag" and step.wait_s != 60.0:
        text += f" after {step.wait_s:g} s of rest"
    if step.repeats == 1:
        return text
    return f"{text}, twice" if step.repeats == 2 else f"{text}, {step.repeats} times"


def recommendation_reason(run: NextRun, tried: int) -> str:
    """Say why a run is recommended, with numbers, and that it need not be where that is so."""
    text = f"{run_subject(run.step)} {separation_text(run.before, run.after)}"
    return (
        f"{'What is likely is told apart well enough already. ' if run.optional else ''}{text} "
        f"in {run.minutes:.1f} min of rig time, more per minute than any other of {tried} runs that were compared."
    )


def run_subject(step: PlanStep) -> str:
    """Let a sentence begin with a run."""
    return capitalise(run_text(step)) + ("," if step.repeats > 1 else "")


def separation_text(before: ModelPair, after: ModelPair) -> str:
    """Say what a run decides, as the rest of a sentence."""
    grows = f"d′ grows from {before.d_prime:.1f} to {after.d_prime:.1f}"
    if not after.rival:
        return f"would show a smaller {display_name(after.truth)}: its {grows}"
    truth, rival = display_name(after.truth), display_name(after.rival)
    text = f"separates {truth} from {rival}: {grows}"
    if before.remaining_share > MAX_QUOTED_SHARE:
        return text
    shares = f"from {percent_text(before.remaining_share)} to {percent_text(after.remaining_share)}"
    return f"{text}, and what {rival} leaves of {truth} {shares}"
