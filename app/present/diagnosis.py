"""A gap diagnosis laid out for a reader: where the gap is, which hypothesis explains it, how far it shrinks."""

from collections.abc import Iterable, Mapping, Sequence
from math import isfinite

from dragrig import present
from dragrig.analysis import as_sentence, capitalise, percent_text, rounded_to_error
from dragrig.analysis.gap import (
    Diagnosis,
    GapReduction,
    NextExperiment,
    NextRun,
    R2BeforeAfter,
    RankedHypothesis,
    UnexplainedGap,
    Verdict,
    display_name,
    run_text,
)
from dragrig.analysis.paper import published
from dragrig.config import FrictionModelSettings
from dragrig.present import (
    Cell,
    Code,
    Column,
    Document,
    Facts,
    Field,
    Figure,
    FormattedNumber,
    Items,
    Section,
    Table,
    Text,
    TextKind,
    attributes_json,
    decimals,
    exclusions_json,
    interval_text,
    left_out_table,
    p_value_text,
    percent,
    probability_text,
    round_to_sum,
    shortest,
    unit_text,
)
from dragrig.present.diagnosis_sentences import (
    OVERALL_CORRECTION,
    PLACE_CORRECTION,
    axis_texts,
    calibration_sentence,
    detection_limit_sentence,
    domain_sentence,
    effect_description,
    is_stated_verdict,
    open_text,
    shrink_sentences,
    sizes_differ_sentence,
    verdict_sentences,
)
from dragrig.present.gap_budget import (
    ChannelBudget,
    budget_bars,
    budget_json,
    budget_sentences,
    budget_table,
    budgets_by_channel,
    owner_of_gap,
    presence_json,
)
from dragrig.sim_backend.effects import catalogue

FORMAT, VERSION = "dragrig-gap", 2
NEXT_FORMAT, NEXT_VERSION = "dragrig-next", 2
PROBABILITY_STEPS = 1_000_000
"""JSON has probabilities in millionths."""
MAX_RANKED = 8
"""Hypotheses that a terminal and a window list; those beyond are next to impossible in any campaign seen so far."""
MAX_LEFT_OUT = 12
SCORED = ("verdict", "effects", "ranking", "confusable_with", "presence", "budget")
"""What an exam scores of a diagnosis that a single condition leaves open, as if its runs could tell."""
CAMPAIGN_COLUMNS = (
    Column("campaign", "campaign"),
    Column("verdict", "verdict"),
    Column("probability", "probability"),
    Column("confusable_with", "indistinguishable"),
    Column("gap_mN", "gap, mN", shortest(3)),
    Column("explained", "explained"),
    Column("explained_95", "95 % interval"),
)


def diagnosis_document(
    diagnosis: Diagnosis,
    *,
    source: str = "",
    model: str | None = None,
    run_ids: Mapping[str, str] | None = None,
) -> Document:
    """Lay out a diagnosis.

    Parameters
    ----------
    source
        The campaign.
    model
        The file that the amended model was written to; None where there is none.
    run_ids
        Ids of the runs by the names of their files, for the JSON; a file without one is named.
    """
    parts, verdict = budget_sentences(diagnosis.budget), verdict_sentences(diagnosis)
    # The conclusion and its probability come first, what limits them after that.
    answer, *lead = (*parts[:1], *verdict[:1], *parts[1:], *verdict[1:])
    alike = diagnosis.verdict is Verdict.NO_GAP and diagnosis.traces
    return Document(
        title=f"Gap diagnosis: {diagnosis.specimen}",
        badges=diagnosis.backends,
        answer=answer,
        lead=tuple(lead),
        sections=(
            _budget_section(diagnosis),
            Section("speed", "Steady force against speed", _speed_figures(diagnosis)),
            Section("no-gap", "The runs and the model", (_before_after_figure(diagnosis),) if alike else ()),
            _confidence_section(diagnosis, source),
            _location_section(diagnosis),
            _ranking_section(diagnosis),
            _size_section(diagnosis, model),
            _runs_section(diagnosis),
        ),
        data=diagnosis_json(diagnosis, model=model, run_ids=run_ids),
    )


SETTLED_EXPLAINED = "What a run is expected to settle comes on top of what the runs above it settle."
NOTHING_NEXT = "Nothing: no run would change the answer."


def settled_cell(gain_bits: float | None, open_bits: float | None) -> FormattedNumber | str:
    """Write the share of the open question that is expected to be settled; nothing where it is not known."""
    if gain_bits is None or not open_bits:
        return ""
    return FormattedNumber(gain_bits / open_bits, percent_text(gain_bits / open_bits))


def next_text(diagnosis: Diagnosis) -> str:
    """Say which run to make next, or that none is worth making; nothing where none was looked for."""
    if diagnosis.next_experiment is not None:
        return diagnosis.next_experiment.reason
    return "" if diagnosis.open_causes is None else NOTHING_NEXT


def next_experiment_document(recommendation: NextExperiment | None) -> Document:
    """Lay out which runs to make next."""
    if recommendation is None:
        return Document(title="Next runs", answer=NOTHING_NEXT, data=next_experiment_json(None))

    caption = f"{recommendation.minutes:.1f} min of rig time in all"

    def settled(run: NextRun) -> FormattedNumber | str:
        return settled_cell(run.gain_bits, recommendation.open_bits)

    return Document(
        title="Next runs",
        answer=recommendation.reason,
        sections=(
            Section(
                "runs",
                "Recommended runs",
                (
                    Table.of(
                        "next-runs",
                        caption,
                        recommendation.runs,
                        Field("run", "run", lambda run: run_text(run.step)),
                        Field("minutes", "min", lambda run: run.minutes, decimals(1)),
                        Field("settled", "expected to settle of what is open", settled),
                        Field("about", "above all", lambda run: display_name("+".join(run.about))),
                    ),
                    Text(SETTLED_EXPLAINED, TextKind.EXPLANATION),
                ),
            ),
        ),
        data=next_experiment_json(recommendation),
    )


def campaigns_document(diagnoses: Sequence[tuple[str, Diagnosis | None, str]]) -> Document:
    """Lay out the diagnoses of several campaigns: folder, diagnosis, and why there is none."""
    rows = tuple(_campaign_row(*entry) for entry in diagnoses)
    table = Table("campaigns", "", CAMPAIGN_COLUMNS, rows)
    return Document(title=f"{len(rows)} campaigns", sections=(Section("campaigns", "", (table,)),))


def _budget_section(diagnosis: Diagnosis) -> Section:
    """Lay out the parts of the gap; nothing without a gap."""
    budget = diagnosis.budget
    if budget is None or not budget.entries:
        return Section("budget", "The budget", ())
    basis = (
        "Shares of the gap above noise on runs that took no part in the fit, with 95 % intervals over runs. They sum "
        "to 100 % in each channel."
    )
    several = any(entry.channel == "position" for entry in budget.entries)
    in_position = "Those in the position are of the runs that were fitted." if several else ""
    fitted = "There are too few runs to hold any out: the shares are of the runs that were fitted, and flatter them."
    return Section(
        "budget",
        "The budget",
        (
            Figure(
                "budget",
                "A bar of the gap, cut into its named parts and the rest; below it, gap and parts in some runs.",
                "The gap by its parts; hatched: unexplained. Below, the runs in which a part acts most: in grey what "
                "the model leaves of a run when fitted to the others, in the bar's colours what each part adds.",
                lambda: present.budget_figure(budget),
                bars=budget_bars(budget),
            ),
            Text(basis if budget.held_out else "", TextKind.EXPLANATION),
            Text(in_position if budget.held_out else "", TextKind.EXPLANATION),
            Text("" if budget.held_out else fitted, TextKind.CAUTION),
            budget_table(diagnosis),
        ),
    )


def _speed_figures(diagnosis: Diagnosis) -> tuple[Figure, ...]:
    if not any(view.steady is not None for view in diagnosis.traces):
        return ()
    floor_mN = None if diagnosis.shrink is None else diagnosis.shrink.noise_floor_mN
    return (
        Figure(
            "steady-force",
            "Steady force against speed, measured with intervals and by the model; below, measured less the model.",
            "Large markers are means, small ones runs; bars are 95 % intervals by Student's t over repeats. The model, "
            "without an effect and with those named, predicts each run from the others, but for what a run is off by "
            "itself. The grey band is noise and scatter of repeats.",
            lambda: present.diagnosis_speed_figure(diagnosis.traces, floor_mN, named=bool(diagnosis.effects)),
        ),
    )


def _before_after_figure(diagnosis: Diagnosis) -> Figure:
    floor_mN = None if diagnosis.shrink is None else diagnosis.shrink.noise_floor_mN
    named = bool(diagnosis.effects)
    return Figure(
        "before-after",
        "A row for each run: left, the measurement and what the model says; right, the residual.",
        "Drags at the lowest, a middle and the highest speed, and of each other kind the run that the model without "
        "an effect explains worst. The grey band is noise and scatter of repeats.",
        lambda: present.before_after_figure(present.representative_runs(diagnosis.traces), floor_mN, named=named),
    )


def _confidence_section(diagnosis: Diagnosis, source: str) -> Section:
    nine_of_ten = "A probability of 0.9 means that nine of ten such verdicts were right on those campaigns."
    limit = "" if diagnosis.verdict in {Verdict.NO_GAP, Verdict.OPEN} else detection_limit_sentence(diagnosis)
    learnt = (calibration_sentence(diagnosis), nine_of_ten if diagnosis.calibration else "")
    calibration = (*(learnt if diagnosis.ranking else ()), limit)
    used = len({*diagnosis.used_for_fit, *diagnosis.held_out})
    return Section(
        "confidence",
        "What these runs show" if diagnosis.verdict is Verdict.OPEN else "Confidence",
        (
            *(Text(effect_description(effect)) for effect in diagnosis.effects),
            Text(" ".join(filter(None, calibration)), TextKind.CAUTION),
            Section("open", "Open questions", (Items(tuple(map(as_sentence, diagnosis.limitations))),)),
            Section("next", "What to run next", (Text(next_text(diagnosis)),)),
            Facts(
                {
                    "Campaign": source,
                    "Specimen": diagnosis.specimen,
                    "Nominal model": diagnosis.nominal,
                    "Runs": f"{used} used ({len(diagnosis.used_for_fit)} in the fit, {len(diagnosis.held_out)} held "
                    f"out in turn), {len(diagnosis.left_out)} left out",
                    "Tolerance": f"{diagnosis.tolerance_mN:g} mN; smaller gaps are ignored (--tolerance)",
                }
            ),
            Items(diagnosis.remarks, remarks=True),
        ),
    )


def _location_section(diagnosis: Diagnosis) -> Section:
    basis = (
        "Excess is what exceeds noise and scatter of repeats once the model's own parameters fit this specimen. The "
        f"p-value of a place is the probability of so much excess there by chance, {PLACE_CORRECTION}; that of the "
        f"excess anywhere is {OVERALL_CORRECTION}."
    )

    return Section(
        "where",
        "1. Where",
        (
            Text(domain_sentence(diagnosis.where)),
            Text(basis if diagnosis.where.present else "", TextKind.EXPLANATION),
            Figure(
                "location",
                "A map of channels, protocols and phases; below it, shares of the excess along speed, position, "
                "session, strain and frequency.",
                "Above, how far each channel exceeds noise and scatter of repeats, in standard deviations, and how "
                "much of the residual each coordinate predicts. Below, shares of the excess, in colour where "
                "significant: "
                f"p-values are {PLACE_CORRECTION}.",
                lambda: present.location_figure(diagnosis.where),
            ),
            Table.of(
                "location",
                f"The p-value of a place is {PLACE_CORRECTION}; that of the excess anywhere is {OVERALL_CORRECTION}",
                axis_texts(diagnosis.where),
                Field("axis", "axis", lambda axis: axis.axis),
                Field("where", "most of the excess", lambda axis: axis.where),
                Field("p", "p-value", lambda axis: FormattedNumber(axis.p, p_value_text(axis.p))),
            ),
        ),
    )


def _ranking_section(diagnosis: Diagnosis) -> Section:
    figure = Figure(
        "ranking",
        "Horizontal bars: the probability of each hypothesis, the most probable first.",
        "Probability of each hypothesis; those near zero are left out.",
        lambda: present.ranking_figure(diagnosis),
    )
    return Section(
        "which",
        "2. Which",
        (
            *((figure, ranking_table(diagnosis)) if diagnosis.ranking else ()),
            Section("unknown", "What no effect of the catalogue explains", _unknown_blocks(diagnosis.unknown)),
        ),
    )


def ranking_table(diagnosis: Diagnosis) -> Table:
    """Tabulate the hypotheses, the most probable first."""
    ranked = sorted(diagnosis.ranking, key=lambda hypothesis: -hypothesis.probability)

    return Table.of(
        "ranking",
        "",
        ranked,
        Field("name", "hypothesis", lambda hypothesis: capitalise(display_name(hypothesis.hypothesis))),
        Field("hypothesis", "id", lambda hypothesis: hypothesis.hypothesis),
        Field(
            "probability",
            "probability",
            lambda hypothesis: FormattedNumber(hypothesis.probability, probability_text(hypothesis.probability)),
        ),
        Field(
            "held_out_improvement",
            "gap explained on held-out runs",
            lambda hypothesis: hypothesis.held_out_improvement,
            percent(),
        ),
        Field("role", "", lambda hypothesis: hypothesis_role(hypothesis, diagnosis)),
        brief_rows=MAX_RANKED,
    )


def hypothesis_role(hypothesis: RankedHypothesis, diagnosis: Diagnosis) -> str:
    """Return the role of a hypothesis in the diagnosis: the verdict, indistinguishable from it, or ""."""
    if is_stated_verdict(hypothesis, diagnosis):
        return "verdict"
    untried = () if diagnosis.decision_inputs is None else diagnosis.decision_inputs.excluded
    alike = set(hypothesis.hypothesis.split("+")) & (set(diagnosis.confusable_with) - set(untried))
    return "indistinguishable with these runs" if alike else ""


def _unknown_blocks(unknown: UnexplainedGap | None) -> tuple[Text | Code, ...]:
    if unknown is None:
        return ()
    whole = Text(f"{unknown.location} {unknown.dependence}".strip())
    if not unknown.expression:
        return (whole,)
    share = (
        ""
        if unknown.held_out_share is None
        else f"It explains {percent_text(unknown.held_out_share)} of it on held-out runs. "
    )
    return whole, Code(unknown.expression), Text(f"{share}It is descriptive and names no cause.", TextKind.EXPLANATION)


def _size_section(diagnosis: Diagnosis, model: str | None) -> Section:
    shrink, named = diagnosis.shrink, bool(diagnosis.effects)
    sizes = () if shrink is None else shrink_sentences(shrink, named=named)
    # The budget says what share of the force's gap each part has.
    told = bool(_budgets_of_force(diagnosis)) and shrink is not None and shrink.position_um is None
    reduction = " ".join(sizes[:1] if told else sizes)
    drawn_here = diagnosis.traces and diagnosis.verdict is not Verdict.NO_GAP
    simulated = isinstance(diagnosis.model, FrictionModelSettings)
    dry_run = "A dry run with it contains the effect, and fresh" if simulated else "Fresh"
    commands = (f"dragrig run drag --model {model}",) if simulated else ()
    amended = (
        Text(
            f"The amended model is in `{model}`. {dry_run} runs on the same specimen at other speeds show whether the "
            "gap shrinks as predicted:"
        ),
        Code("\n".join((*commands, f"dragrig gap evaluate {model} FRESH_RUNS"))),
    )
    return Section(
        "how-much",
        "3. How much",
        (
            _parameter_table(diagnosis),
            Text(sizes_differ_sentence(diagnosis), TextKind.EXPLANATION),
            Text(reduction or "Too few runs to hold any out: how much of a gap closes is not known."),
            Section("model", "The model with the effect", amended if model else ()),
            *((_before_after_figure(diagnosis),) if drawn_here else ()),
            *(() if shrink is None else (r2_table(shrink, named=named),)),
        ),
    )


def _parameter_table(diagnosis: Diagnosis) -> Table:
    verdict = _stated_hypothesis(diagnosis)

    return Table.of(
        "parameters",
        "Refitted with all parameters of the specimen",
        () if verdict is None else verdict.parameters,
        Field("parameter", "parameter", lambda parameter: parameter.name),
        Field(
            "value",
            "value",
            lambda parameter: FormattedNumber(
                parameter.value, rounded_to_error(parameter.value, parameter.standard_error)
            ),
        ),
        Field("interval_95", "95 % interval", interval_text),
        Field("unit", "unit", lambda parameter: unit_text(parameter.unit)),
        Field("meaning", "meaning", lambda parameter: _parameter_meaning(parameter.name, diagnosis)),
    )


def _stated_hypothesis(diagnosis: Diagnosis) -> RankedHypothesis | None:
    return next((ranked for ranked in diagnosis.ranking if is_stated_verdict(ranked, diagnosis)), None)


def _parameter_meaning(parameter: str, diagnosis: Diagnosis) -> str:
    """Return the meaning of a parameter; nothing where several effects have one of its name."""
    known = [catalogue()[effect] for effect in diagnosis.effects if effect in catalogue()]
    meanings = [own.meaning for effect in known for own in effect.parameters if parameter.endswith(own.name)]
    return meanings[0] if len(meanings) == 1 else ""


def r2_table(shrink: GapReduction, *, named: bool) -> Table:
    """Tabulate R² of steady drag beside the values that the paper prints; empty where the runs give none."""
    boundary = published.BOUNDARY_MM_S if shrink.boundary_mm_s is None else shrink.boundary_mm_s
    columns = (
        Column("form", "R² of steady drag"),
        Column("model", "model"),
        Column("below", f"up to {boundary:g} mm/s", decimals(4)),
        Column("above", "above", decimals(4)),
    )
    rows: list[tuple[Cell, ...]] = []
    for form, r2 in (("Eq. 15", shrink.r2_eq15), ("correlation²", shrink.r2_corr)):
        rows.append((form, "without the effect" if named else "model", r2.before_below, r2.before_above))
        if named:
            rows.append((form, "with it", r2.after_below, r2.after_above))
    if all(value is None for row in rows for value in row[2:]):
        rows = []
    else:
        rows.append(("as printed", "in the paper", published.R2_BELOW, published.R2_ABOVE))
    return Table("r2", "Eq. 15 of the paper may exceed 1; the paper's values are for another gut", columns, tuple(rows))


def _runs_section(diagnosis: Diagnosis) -> Section:
    fitted, held = set(diagnosis.used_for_fit), set(diagnosis.held_out)
    uses = {"fit and held out in turn": fitted & held, "fit only": fitted - held, "held out only": held - fitted}
    columns = (Column("use", "use"), Column("runs", "runs", shortest()), Column("files", "files"))
    rows = tuple((use, len(files), ", ".join(sorted(files))) for use, files in uses.items() if files)

    return Section(
        "runs",
        "4. The runs",
        (
            Section("used", "Runs used", (Table("runs", "", columns, rows),), collapsed=True),
            left_out_table("left-out", "file", diagnosis.left_out, MAX_LEFT_OUT),
        ),
    )


def _campaign_row(source: str, diagnosis: Diagnosis | None, why_not: str) -> tuple[Cell, ...]:
    if diagnosis is None:
        return source, f"not diagnosed: {why_not}", "", "", "", "", ""
    verdict = _stated_hypothesis(diagnosis)
    rest = next((here.rest for here in _budgets_of_force(diagnosis) if here.named), None)
    interval = None if rest is None else rest.share_95ci
    return (
        source,
        " + ".join(diagnosis.effects) or _verdict_without_effect(diagnosis),
        "" if verdict is None else FormattedNumber(verdict.probability, probability_text(verdict.probability)),
        ", ".join(diagnosis.confusable_with),
        diagnosis.budget.gap_mN if diagnosis.budget is not None and diagnosis.budget.entries else "",
        "" if rest is None else FormattedNumber(1.0 - rest.share, percent_text(1.0 - rest.share)),
        "" if interval is None else f"{percent_text(1.0 - interval[1])} to {percent_text(1.0 - interval[0])}",
    )


def _budgets_of_force(diagnosis: Diagnosis) -> tuple[ChannelBudget, ...]:
    return tuple(here for here in budgets_by_channel(diagnosis.budget) if here.channel == "force")


def _verdict_without_effect(diagnosis: Diagnosis) -> str:
    if diagnosis.verdict is Verdict.OPEN:
        return f"open: the runs {open_text(diagnosis)}"
    owner = owner_of_gap(diagnosis.budget) if diagnosis.verdict is Verdict.UNKNOWN else ""
    return owner or diagnosis.verdict.value.replace("_", " ")


def diagnosis_json(
    diagnosis: Diagnosis, *, model: str | None = None, run_ids: Mapping[str, str] | None = None
) -> Mapping[str, object]:
    """Return a diagnosis for the JSON of a gap report; as `diagnosis_document`."""
    ids = run_ids or {}
    likeliest = None if diagnosis.likeliest is None else diagnosis_json(diagnosis.likeliest, run_ids=ids)
    return {
        "format": FORMAT,
        "version": VERSION,
        "campaign": {
            **attributes_json(diagnosis, "specimen", "nominal", "runs"),
            "used_for_fit": [ids.get(file, file) for file in diagnosis.used_for_fit],
            "held_out": [ids.get(file, file) for file in diagnosis.held_out],
            "left_out": exclusions_json(diagnosis.left_out),
        },
        "verdict": diagnosis.verdict.value,
        "in_words": (*budget_sentences(diagnosis.budget), *verdict_sentences(diagnosis)),
        "only_condition": diagnosis.only_condition or None,
        "likeliest": None if likeliest is None else {name: likeliest[name] for name in SCORED},
        "ranking": _ranking_json(diagnosis.ranking),
        **attributes_json(diagnosis, "effects", "confusable_with", "residual_unknown", "tolerance_mN", "timings_s"),
        "presence": presence_json(diagnosis.budget),
        "shared_with": {} if diagnosis.budget is None else diagnosis.budget.shared_with,
        "budget": budget_json(diagnosis, ids),
        "unknown": None
        if diagnosis.unknown is None
        else {
            **attributes_json(diagnosis.unknown, location="lives_in", dependence="shape", held_out_share="held_out"),
            "expression": diagnosis.unknown.expression or None,
        },
        "would_have_seen_mN": diagnosis.detection_limit_mN,
        "where": diagnosis.where.document(),
        "shrink": None if diagnosis.shrink is None else shrink_json(diagnosis.shrink),
        "model": model,
        "next_experiment": _next_run_json(diagnosis.next_experiment),
        "cannot_answer": diagnosis.limitations,
        **attributes_json(diagnosis, "remarks", "calibration"),
        "evidence": None if diagnosis.decision_inputs is None else diagnosis.decision_inputs.document(),
    }


def next_experiment_json(recommendation: NextExperiment | None) -> Mapping[str, object]:
    """Return the recommended runs as a JSON document of their own."""
    runs = () if recommendation is None else recommendation.runs
    return {
        "format": NEXT_FORMAT,
        "version": NEXT_VERSION,
        "why": NOTHING_NEXT if recommendation is None else recommendation.reason,
        "minutes": None if recommendation is None else recommendation.minutes,
        "open_bits": None if recommendation is None else recommendation.open_bits,
        "tried": 0 if recommendation is None else recommendation.compared,
        "runs": [_planned_run_json(run) for run in runs],
    }


def round_probabilities(probabilities: Sequence[float]) -> tuple[float, ...]:
    """Round probabilities to millionths that sum to 1, by largest remainders; what is not finite counts as 0."""
    known = [max(probability, 0.0) if isfinite(probability) else 0.0 for probability in probabilities]
    total = sum(known)
    if not total > 0:
        return tuple(0.0 for _ in known)
    steps = round_to_sum([PROBABILITY_STEPS * probability / total for probability in known])
    return tuple(count / PROBABILITY_STEPS for count in steps)


def _ranking_json(ranking: Iterable[RankedHypothesis]) -> list[Mapping[str, object]]:
    hypotheses = tuple(ranking)
    probabilities = round_probabilities([hypothesis.probability for hypothesis in hypotheses])
    return [
        {
            "hypothesis": hypothesis.hypothesis,
            "probability": probability,
            "parameters": {
                parameter.name: attributes_json(parameter, "value", "unit", standard_error="sd", interval="interval_95")
                for parameter in hypothesis.parameters
            },
            "held_out_improvement": hypothesis.held_out_improvement,
        }
        for hypothesis, probability in zip(hypotheses, probabilities, strict=True)
    ]


def _next_run_json(recommendation: NextExperiment | None) -> Mapping[str, object] | None:
    if recommendation is None:
        return None
    first = _planned_run_json(recommendation.runs[0])
    return {**first, "tried": recommendation.compared, "why": recommendation.reason}


def _planned_run_json(run: NextRun) -> Mapping[str, object]:
    return {
        "protocol": run.step.kind,
        **run.settings,
        **attributes_json(run.step, "wait_s", "repeats"),
        **attributes_json(run, "minutes", "gain_bits", "about"),
    }


def shrink_json(shrink: GapReduction) -> Mapping[str, object]:
    """Return how far a gap shrinks as JSON."""

    def sides(r2: R2BeforeAfter) -> Mapping[str, object]:
        return {
            "before": {"below": r2.before_below, "above": r2.before_above},
            "after": {"below": r2.after_below, "above": r2.after_above},
        }

    return {
        **attributes_json(shrink, "gap_before_mN", "gap_after_mN", "noise_floor_mN", "position_um"),
        **attributes_json(shrink, "closed", "closed_95ci", "boundary_mm_s"),
        "r2_eq15": sides(shrink.r2_eq15),
        "r2_corr": sides(shrink.r2_corr),
        "runs": shrink.runs,
    }
