"""The result of a diagnosis in sentences: verdict, location of the gap, gap reduction."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import isfinite, log, nan

from dragrig.analysis import as_sentence, capitalise, count_text, join_names, percent_text
from dragrig.analysis.gap import (
    ALPHA,
    MODEL,
    AxisLocation,
    Diagnosis,
    GapLocation,
    GapReduction,
    RankedHypothesis,
    Verdict,
    display_name,
)
from dragrig.present import force_text, probability_text, significant
from dragrig.present.gap_budget import owner_of_gap
from dragrig.sim_backend.effects import catalogue

ABOVE_ALL = 0.9995
"""Shares from here to the whole are written as "above 99.9 %"."""
MAIN_SCORE, MIN_SCORE = 0.5, 0.1
"""Share of the residual's squares from which on it is mainly a function of a coordinate, and below which of none."""
SAME_SIZE = 1.2
"""Ratio up to which two sizes of a gap look alike to a reader."""
UNCALIBRATED_NOTE = "The probabilities are not calibrated: use them as a ranking only."


def verdict_sentences(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return the verdict with its probability; the first sentence is the answer."""
    probability = f"({_verdict_probability_text(diagnosis)})"
    match diagnosis.verdict:
        case Verdict.OPEN:
            return tuple(_open_sentences(diagnosis))
        case Verdict.NO_GAP:
            return (f"No gap {probability}: {_detection_limit_clause(diagnosis)}.",)
        case Verdict.UNKNOWN:
            gap = diagnosis.unknown
            place, shape = ("", "") if gap is None else (as_sentence(gap.location), as_sentence(gap.dependence))
            first = f"A gap that no effect of the catalogue explains {probability}."
            if owner_of_gap(diagnosis.budget):
                first = f"No effect of the catalogue is established ({_verdict_probability_text(diagnosis)} for none)."
                place = place.replace("It ", "The gap ", 1)
            return tuple(sentence for sentence in (first, place, shape, *_law_sentences(diagnosis)) if sentence)
        case Verdict.SEVERAL:
            names = join_names([display_name(name) for name in diagnosis.effects])
            first = f"{capitalise(names)} act together {probability}."
        case Verdict.EFFECT:
            first = f"Most likely: {join_names([display_name(name) for name in diagnosis.effects])} {probability}."
    return first, *_confusable_sentences(diagnosis), *_residual_sentences(diagnosis)


def _open_sentences(diagnosis: Diagnosis) -> Iterator[str]:
    """Say what runs of a single condition exclude there, or that the model misses them, without a cause."""
    if not diagnosis.residual_unknown:
        yield f"One condition cannot show whether there is a gap: these runs {open_text(diagnosis)}."
        return
    yield f"These runs {open_text(diagnosis)}; one condition does not show the cause."
    if diagnosis.unknown is not None and diagnosis.unknown.location:
        yield as_sentence(diagnosis.unknown.location)


def open_text(diagnosis: Diagnosis) -> str:
    """Say what runs of a single condition show: `exclude an effect above 5.2 mN in a drag at 20 mm/s, and …`."""
    budget, limit_mN = diagnosis.budget, diagnosis.detection_limit_mN
    if diagnosis.residual_unknown:
        in_force = budget is not None and budget.gap_mN > diagnosis.tolerance_mN
        size = f" by {force_text(budget.gap_mN)} (rms)" if budget is not None and in_force else ""
        return f"differ from the model in {diagnosis.only_condition}{size}"
    effect = f"an effect above {force_text(limit_mN)}" if isfinite(limit_mN) else "no effect of a known size"
    return f"exclude {effect} in {diagnosis.only_condition}, and nothing elsewhere"


def _verdict_probability_text(diagnosis: Diagnosis) -> str:
    """Return the probability of the verdict; of one effect, that it is there, and then that it is so alone."""
    probability = verdict_probability(diagnosis)
    alone = probability_text(probability)
    if not isfinite(probability):
        return alone
    presence = {} if diagnosis.budget is None else diagnosis.budget.presence
    there = probability_text(presence.get(diagnosis.effects[0], nan)) if len(diagnosis.effects) == 1 else alone
    if there == alone or not isfinite(presence.get(diagnosis.effects[0], nan)):
        return f"probability {alone}"
    there_or_model = "it is there, or the model itself is off" if _model_is_alike(diagnosis) else "it is there"
    return f"probability {there} that {there_or_model}, {alone} that it is the only effect"


def detection_limit_sentence(diagnosis: Diagnosis) -> str:
    """Say how small an effect these runs would have shown."""
    return f"{capitalise(_detection_limit_clause(diagnosis))}."


def calibration_sentence(diagnosis: Diagnosis) -> str:
    """Say where the probabilities come from."""
    return as_sentence(diagnosis.calibration) or UNCALIBRATED_NOTE


def shrink_sentences(shrink: GapReduction, *, named: bool = True) -> tuple[str, ...]:
    """Say how large the residual of held-out runs is, and what share of the gap closes where an effect is named."""
    runs = f" on {count_text(len(shrink.runs), 'run')} held out of fit and model choice" if shrink.runs else ""
    floor = f"noise and scatter of repeats alone: {force_text(shrink.noise_floor_mN)}"
    before, after = force_text(shrink.gap_before_mN), force_text(shrink.gap_after_mN)
    sizes = f"Residual (rms){runs}: {before} without the effect, {after} with it; {floor}."
    if shrink.position_um is not None:
        without, with_effects = (f"{value:.3g} µm" for value in shrink.position_um)
        sizes = f"Position error (rms){runs}: {without} without the effect, {with_effects} with it."
    if not named and shrink.closed is not None:
        return (f"Residual (rms){runs}: {before}; {floor}.",)
    if shrink.closed is None or not isfinite(shrink.closed):
        sizes = f"Residual (rms){runs}: {before}; {floor}."
        return sizes, "This is too close to noise to say what share of a gap closes."
    share, interval = percent_text(shrink.closed), _closed_interval_text(shrink)
    if shrink.closed > 1:
        details = "; ".join(detail for detail in (share, interval) if detail)
        return sizes, f"The whole gap closes ({details}): the residual is below noise."
    closed = f"{capitalise(share)} of the gap closes" + (f" ({interval})" if interval else "")
    return sizes, f"{closed}{': it grows' if shrink.closed < 0 else ''}."


def _closed_interval_text(shrink: GapReduction) -> str:
    if shrink.closed_95ci is None:
        return ""
    low, high = shrink.closed_95ci
    low_text, high_text = "below −100 %" if low < -1 else percent_text(low), percent_text(high)
    # "above 99.9 % to 100 %" says nothing that its lower end does not.
    whole = low >= ABOVE_ALL and high_text in {low_text, "100 %"}
    return f"95 % interval: {low_text}{'' if whole else f' to {high_text}'}"


def sizes_differ_sentence(diagnosis: Diagnosis) -> str:
    """Say why the residual before is not the gap of the budget, where a reader would wonder."""
    budget, shrink = diagnosis.budget, diagnosis.shrink
    if budget is None or not budget.entries or shrink is None or shrink.position_um is not None:
        return ""
    if not budget.gap_mN > 0 or abs(log(shrink.gap_before_mN / budget.gap_mN)) < log(SAME_SIZE):
        return ""
    return (
        f"Gap ({significant(2)(budget.gap_mN)} mN): what the causes add to the force, at all times. Residual: what a "
        "run leaves after factors of its own, noise included, at times that tell effects apart."
    )


def verdict_probability(diagnosis: Diagnosis) -> float:
    """Return the probability of the verdict; NaN where the ranking lacks it."""
    hypothesis = next((entry for entry in diagnosis.ranking if is_stated_verdict(entry, diagnosis)), None)
    return float("nan") if hypothesis is None else hypothesis.probability


def is_stated_verdict(ranked: RankedHypothesis, diagnosis: Diagnosis) -> bool:
    """Whether a hypothesis of the ranking is the verdict."""
    if diagnosis.effects:
        return set(ranked.hypothesis.split("+")) == set(diagnosis.effects)
    return ranked.hypothesis == diagnosis.verdict.value


def effect_description(effect: str) -> str:
    """Describe an effect of the catalogue and where it acts."""
    known = catalogue().get(effect)
    if known is None:
        return f"{capitalise(display_name(effect))} is not in this catalogue."
    return f"{capitalise(known.name)}, in the {known.location.value}. {known.summary} Visible in: {known.visible_in}."


def _detection_limit_clause(diagnosis: Diagnosis) -> str:
    limit_mN = diagnosis.detection_limit_mN
    if not isfinite(limit_mN):
        return "the detection limit of these runs is not known"
    return f"an effect above {force_text(limit_mN)} would have been detected"


def _model_is_alike(diagnosis: Diagnosis) -> bool:
    """Whether the nominal model's own laws may be in the place of a named effect."""
    alike = () if diagnosis.budget is None else diagnosis.budget.shared_with.items()
    return any(MODEL in others for effect, others in alike if effect in diagnosis.effects)


def _confusable_sentences(diagnosis: Diagnosis) -> Iterator[str]:
    excluded = () if diagnosis.decision_inputs is None else diagnosis.decision_inputs.excluded
    it = "it" if len(diagnosis.effects) == 1 else "them"
    confusable = [display_name(name) for name in diagnosis.confusable_with if name not in excluded]
    confusable += ["the nominal model itself"] * _model_is_alike(diagnosis)
    if confusable:
        yield f"{capitalise(join_names(confusable))} cannot be distinguished from {it} with these runs."
    excluded_names = [display_name(name) for name in diagnosis.confusable_with if name in excluded]
    if excluded_names:
        yield f"These runs would hardly tell {it} from {join_names(excluded_names)}, left out of the search."


def _residual_sentences(diagnosis: Diagnosis) -> Iterator[str]:
    if not diagnosis.residual_unknown:
        return
    yield "Part of the gap remains that no effect of the catalogue explains."
    gap = diagnosis.unknown
    if gap is not None:
        yield from (sentence for sentence in (as_sentence(gap.location), as_sentence(gap.dependence)) if sentence)
        yield from _law_sentences(diagnosis)


def _law_sentences(diagnosis: Diagnosis) -> Iterator[str]:
    gap = diagnosis.unknown
    if gap is None or not gap.expression:
        return
    share = (
        ""
        if gap.held_out_share is None
        else f"; it explains {percent_text(gap.held_out_share)} of this gap on held-out runs"
    )
    yield f"Best description: {gap.expression}{share}."


MIN_SHOWN_SHARE = 0.01
"""Smaller shares are omitted."""
NOT_SIGNIFICANT = " (not significant)"
SMALL_RMS = 0.05
"""Root mean excess, in standard deviations, up to which a gap is called small."""
ANYWHERE = "anywhere"
PLACE_CORRECTION = "corrected for all places of its axis by max-T permutation of whole runs (Westfall and Young)"
OVERALL_CORRECTION = "corrected for all axes by Bonferroni's method"
"""How p-values are corrected, named alike in text, table and figure."""


@dataclass(frozen=True, slots=True)
class AxisText:
    """An axis of the location: its name, where most of the excess is, and the p-value of that place."""

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
"""Name, unit and factor of axes with numeric bins."""
DOMAIN_NAMES: Mapping[str, str] = {
    "speed": "speed",
    "position": "position along the stroke",
    "time": "time within the run",
    "session": "session time",
    "frequency": "time, at high frequency",
    "strain": "strain",
    "transient": "changes of velocity",
}


def axis_texts(where: GapLocation) -> tuple[AxisText, ...]:
    """Return the excess as a whole, and the axes with a part of it; nothing without a gap."""
    if not where.present:
        return ()
    alone = where.runs == 1
    whole = AxisText(ANYWHERE, excess_text(where), where.p)
    return whole, *(
        AxisText(_AXIS_UNITS.get(location.name, (location.name,))[0], text, nan if alone else location.p)
        for location in where.locations
        if (text := place_text(location, alone=alone))
    )


def excess_text(where: GapLocation, p_text: str = "") -> str:
    """Say how large the excess of all runs is over noise, repeatability and tolerance, and how sure it is."""
    if where.rms < SMALL_RMS:
        sure = f"real{f' ({p_text})' if p_text else ''}" if where.p < ALPHA else "not sure"
        return f"the gap is {sure}, but small: below {SMALL_RMS:g} of noise and scatter"
    return f"{significant(2)(where.rms)} times noise and scatter of repeats{f', {p_text}' if p_text else ''}"


def domain_sentence(where: GapLocation) -> str:
    """Say what the residual is mainly a function of."""
    if not where.present:
        return "Nowhere does the residual exceed noise and scatter of repeats."
    if not where.domain and where.runs == 1:
        return "A single run does not show what the residual is a function of."
    if not where.domain:
        return "No coordinate predicts the residual of held-out runs."
    score, name = where.domain_scores.get(where.domain, nan), DOMAIN_NAMES.get(where.domain, where.domain)
    basis = "" if where.runs == 1 else " on held-out runs"
    if not isfinite(score):
        return f"The residual is mainly a function of {name}."
    share = f"which explains {100 * score:.0f} % of it{basis}"
    if score < MIN_SCORE:
        return "The gap does not follow speed, position, strain or time alone."
    return f"The residual {'is mainly a function of' if score >= MAIN_SCORE else 'depends most on'} {name}, {share}."


def place_text(location: AxisLocation, *, alone: bool = False) -> str:
    """Return where on an axis most of the excess is; nothing where it has no part of it.

    `alone`: of a single run, which has no repeats to test a place against.
    """
    chance = "" if alone or location.significant else NOT_SIGNIFICANT
    named = sorted(location.shares.items(), key=lambda pair: -pair[1])
    if named:
        shown = ", ".join(f"{name} {100 * share:.0f} %" for name, share in named if share >= MIN_SHOWN_SHARE)
        return f"{shown}{chance}" if shown else ""
    if location.low is None or location.high is None or location.share < MIN_SHOWN_SHARE:
        return ""
    if alone and location.low == location.high:
        return ""
    _, unit, factor = _AXIS_UNITS.get(location.name, (location.name, "", 1.0))
    low, high = f"{location.low * factor:.3g}", f"{location.high * factor:.3g}"
    ends = f"at {low}" if low == high else f"{low} to {high}"
    return f"{ends} {unit}".strip() + f": {100 * location.share:.0f} %{chance}"
