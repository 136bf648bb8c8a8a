"""Campaigns of one rig together, laid out for a reader: which effect is where, how sure, and how large in each."""

from collections.abc import Mapping

from dragrig import present
from dragrig.analysis import capitalise, join_names, value_with_error
from dragrig.analysis.gap import CampaignEvidence, PooledDiagnosis, PooledEffect, PopulationSize, Where, display_name
from dragrig.present import (
    Document,
    Field,
    Figure,
    FormattedNumber,
    Items,
    Section,
    Table,
    Text,
    TextKind,
    attributes_json,
    exclusions_json,
    probability_text,
    shortest,
    significant,
    unit_text,
)
from dragrig.sim_backend.effects import catalogue

FORMAT, VERSION = "dragrig-gap-together", 1
MAX_LISTED = 10
"""Effects that a terminal lists; the page has all."""
MAX_NAMED_CAMPAIGNS = 4
_ROUGH = significant(2)
MIN_LIKELY = 0.1
"""Where nothing is established, the most probable effect is told from this probability on."""


def pooled_document(pooled: PooledDiagnosis) -> Document:
    """Lay out the diagnosis of several campaigns together."""
    answer, *lead = (
        *(_effect_sentence(effect, pooled) for effect in pooled.established),
        *_nothing_sentences(pooled),
        *map(_size_sentence, pooled.established),
    )
    count = len(pooled.campaigns)
    return Document(
        title=f"Gap diagnosis of {count} campaigns together",
        badges=tuple(dict.fromkeys(backend for campaign in pooled.campaigns for backend in campaign.backends)),
        answer=answer,
        lead=(*filter(None, lead), *_unnamed_sentences(pooled)),
        sections=(
            Section("campaigns", "Which campaign has which effect", (_campaign_table(pooled), _alone_text(pooled))),
            Section("sizes", "How large in each campaign", (*_sizes_section(pooled),)),
            Section("effects", "All effects", (*_effects_section(pooled),)),
            Section("remarks", "Remarks", (Items(tuple(map(capitalise, pooled.remarks)), remarks=True),)),
        ),
        data=pooled_json(pooled),
    )


def where_text(effect: PooledEffect, pooled: PooledDiagnosis) -> str:
    """Say in which campaigns an effect is: `all 5`, `some: A, C`, `one: B`."""
    if effect.where is Where.ALL:
        return f"all {len(pooled.campaigns)}"
    names = [pooled.campaigns[at].source for at in effect.members]
    return f"{effect.where.value}: {_listed(names)}"


def _listed(names: list[str]) -> str:
    if len(names) <= MAX_NAMED_CAMPAIGNS:
        return join_names(names) or "not known which"
    return f"{', '.join(names[: MAX_NAMED_CAMPAIGNS - 1])} and {len(names) - MAX_NAMED_CAMPAIGNS + 1} more"


def _effect_sentence(effect: PooledEffect, pooled: PooledDiagnosis) -> str:
    name, count = capitalise(display_name(effect.effect)), len(pooled.campaigns)
    # A name that several pieces have is no piece's.
    specimens = len({campaign.specimen for campaign in pooled.campaigns})
    members = "campaigns" if effect.of_rig or specimens < len(pooled.campaigns) else "specimens"
    names = [pooled.campaigns[at].source for at in effect.members]
    if effect.where is Where.ALL:
        place = ("the rig's, " if effect.of_rig else "") + f"in all {count} {members}"
    elif effect.where is Where.SOME:
        place = f"in {len(names)} of {count} campaigns, {_listed(names)}"
    else:
        place = f"only in {_listed(names)}"
    sure, there = f"probability {probability_text(effect.probability)}", effect.where_probabilities[effect.where]
    if there < effect.probability:
        just = {Where.ALL: "in all", Where.SOME: "just in these"}.get(effect.where, "only there")
        sure += f"; {probability_text(there)} that it is {just}"
    alike = f"; not told from {join_names([display_name(rival) for rival in effect.confusable_with])}"
    return f"{name}: {place} ({sure}){alike if effect.confusable_with else ''}."


def _size_sentence(effect: PooledEffect) -> str:
    size = effect.size
    if size is None:
        return ""
    unit = unit_text(size.unit)
    mean = f"{value_with_error(size.mean, size.standard_error)} {unit}".rstrip()
    text = f"Size of {display_name(effect.effect)} in the population (`{size.parameter}`): {mean}"
    if len(effect.members) < 2:
        return f"{text}."
    spread = (
        f"a spread of {_ROUGH(size.spread)} {unit}".rstrip() if size.spread > 0 else "no spread beyond their errors"
    )
    return f"{text} in the mean, with {spread} between campaigns."


def _nothing_sentences(pooled: PooledDiagnosis) -> tuple[str, ...]:
    if pooled.established:
        return ()
    best = pooled.effects[0] if pooled.effects else None
    text = f"No effect of the catalogue is established in these {len(pooled.campaigns)} campaigns together"
    if pooled.only_condition:
        return (f"{text}: all are of one condition, {pooled.only_condition}, which does not show a cause.",)
    if best is None or best.probability < MIN_LIKELY:
        return (f"{text}.",)
    return (f"{text}; most probable is {display_name(best.effect)} ({probability_text(best.probability)}).",)


def _unnamed_sentences(pooled: PooledDiagnosis) -> tuple[str, ...]:
    if not pooled.unnamed:
        return ()
    causes = join_names([f"{name} ({probability_text(value)})" for name, value in pooled.unnamed.items()])
    return (f"All campaigns also share a deviation that no effect explains, best described by: {causes}.",)


def _effects_section(pooled: PooledDiagnosis) -> tuple[Text | Table, ...]:
    basis = (
        "Rig: it has one set of parameters for all campaigns. Gut: a population of specimens with a spread, of which "
        "the size is the mean. The probability together weighs all campaigns at once, beside every other cause that "
        "they may share; the best one alone is the highest that any single campaign gives."
    )
    named = pooled.established
    table = Table.of(
        "effects",
        "",
        pooled.effects,
        Field("name", "effect", lambda effect: capitalise(display_name(effect.effect))),
        Field("belongs_to", "belongs to", lambda effect: "rig" if effect.of_rig else "gut"),
        Field("where", "where", lambda effect: where_text(effect, pooled) if effect in named else ""),
        Field("probability", "together", lambda effect: _probability(effect.probability)),
        Field("alone", "best one alone", lambda effect: _probability(max(effect.alone, default=0.0))),
        Field("size", "mean size ± error", lambda effect: _size_cell(effect.size if effect in named else None)),
        Field("confusable", "not told from", lambda effect: ", ".join(map(display_name, effect.confusable_with))),
        brief_rows=max(MAX_LISTED, len(named)),
    )
    return Text(basis, TextKind.EXPLANATION), table


def _probability(value: float) -> FormattedNumber:
    return FormattedNumber(value, probability_text(value))


def _size_cell(size: PopulationSize | None) -> FormattedNumber | str:
    if size is None:
        return ""
    unit = unit_text(size.unit)
    return FormattedNumber(size.mean, f"{value_with_error(size.mean, size.standard_error)} {unit}".rstrip())


def _sizes_section(pooled: PooledDiagnosis) -> tuple[Figure, ...]:
    shown = [effect for effect in pooled.established if effect.size is not None]
    if not shown:
        return ()
    return (
        Figure(
            "sizes",
            "A panel for each effect: its size in each campaign with an error bar, and a band for the population.",
            "Filled points have the effect. Bars hold 95 % and allow for forms other than the catalogue's: the size "
            "in a campaign's own diagnosis, by that form, is narrower. The line is the mean of the population, the "
            "band holds 95 % of its specimens.",
            lambda: present.pooled_sizes_figure(pooled),
        ),
    )


def _campaign_table(pooled: PooledDiagnosis) -> Table:
    def dots(effect: PooledEffect) -> Field[CampaignEvidence]:
        having = [pooled.campaigns[at] for at in effect.members]
        name = display_name(effect.effect)
        return Field(effect.effect, name, lambda campaign: "●" if campaign in having else "○")

    return Table.of(
        "campaigns",
        "",
        pooled.campaigns,
        Field("campaign", "campaign", lambda campaign: campaign.source),
        Field("specimen", "specimen", lambda campaign: campaign.specimen),
        Field("runs", "runs", lambda campaign: campaign.runs, shortest()),
        Field(
            "verdict",
            "verdict alone",
            lambda each: " + ".join(map(display_name, each.effects)) or each.verdict.value.replace("_", " "),
        ),
        Field("probability", "probability", lambda campaign: _probability(campaign.probability)),
        *map(dots, pooled.established),
        brief_rows=MAX_LISTED,
    )


def _alone_text(pooled: PooledDiagnosis) -> Text:
    first = pooled.campaigns[0].source if pooled.campaigns else "CAMPAIGN"
    return Text(f"`dragrig gap diagnose {first}` shows one of them in full, with the sizes of its effects.")


def pooled_json(pooled: PooledDiagnosis) -> Mapping[str, object]:
    """Return the diagnosis of several campaigns together as JSON."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "campaigns": [
            {
                **attributes_json(campaign, "source", "specimen", "runs", "nominal", "verdict", "effects"),
                **attributes_json(campaign, "probability", "remarks"),
                "left_out": exclusions_json(campaign.left_out),
            }
            for campaign in pooled.campaigns
        ],
        "effects": [_effect_json(effect, pooled) for effect in pooled.effects],
        **attributes_json(pooled, "unnamed", "remarks"),
    }


def _effect_json(effect: PooledEffect, pooled: PooledDiagnosis) -> Mapping[str, object]:
    size = effect.size
    return {
        **attributes_json(effect, "effect", "probability", "where", "where_probabilities", "presence"),
        **attributes_json(effect, "confusable_with", alone="presence_alone"),
        "belongs_to": "rig" if effect.of_rig else "gut",
        "established": effect in pooled.established,
        "campaigns": [pooled.campaigns[at].source for at in effect.members] if effect in pooled.established else [],
        "size": None
        if size is None
        else {
            **attributes_json(size, "parameter", "unit", "mean", "interval_95", "spread", standard_error="sd"),
            "campaigns": [None if own is None else {"value": own[0], "sd": own[1]} for own in size.campaigns],
        },
        "summary": catalogue()[effect.effect].summary if effect.effect in catalogue() else "",
    }
