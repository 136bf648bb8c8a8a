"""Effects laid out for a reader: the catalogue, by the place where they act, and what a set of runs can distinguish."""

from collections.abc import Sequence
from pathlib import Path

from dragrig import present
from dragrig.analysis import as_sentence, capitalise
from dragrig.analysis.gap import (
    CONFUSED_POSITION_SIN2,
    CONFUSED_SIN2,
    DETECTABLE_D_PRIME,
    Isolability,
    display_name,
    isolability_sentences,
)
from dragrig.present import (
    Document,
    Facts,
    Field,
    Figure,
    Items,
    Section,
    Table,
    Text,
    TextKind,
    attributes_json,
    decimals,
    shortest,
    significant,
    unit_text,
)
from dragrig.sim_backend.effects import Effect, Location

FORMAT, VERSION = "dragrig-isolability", 1
MAX_PAIRS = 20
"""Pairs that a terminal lists."""


def isolability_document(isolability: Isolability) -> Document:
    """Lay out which effects runs can distinguish."""
    answer, *lead = isolability_sentences(isolability)
    angles = (
        "The parameters of the specimen, what differs from run to run, and details that any model is a little wrong in "
        "have taken from each effect what they can. What remains of one effect has an angle to the best that another "
        f"can do. Marked are a sin² below {CONFUSED_SIN2:.2f} of effects on the force, by which a real effect differs "
        f"from the catalogue's form of it, one below {CONFUSED_POSITION_SIN2:.2f} of effects on the position, and a d′ "
        f"below {DETECTABLE_D_PRIME:g}."
    )
    visibility = (
        "d′ is the norm of what remains of an effect, in standard deviations of noise. From "
        f"{DETECTABLE_D_PRIME:.0f} on it is nearly always detected. The smallest size is where d′ comes to that, and "
        "never below the force that is too small to matter."
    )
    matrix = Figure(
        "matrix",
        "A matrix of effects: below the diagonal sin² of the angle between each two, above it d′ between them.",
        "Below the diagonal: sin² of the angle between what two effects can do to the force, in hundredths; dark where "
        "they are similar. Above: d′ between them at their default sizes. On it: the number beside each name.",
        lambda: present.isolability_figure(isolability),
    )
    return Document(
        title=f"Effects that {Path(isolability.source).absolute().name} can distinguish",
        badges=isolability.backends,
        answer=answer,
        lead=tuple(lead),
        sections=(
            Section(
                "apart",
                "1. What can be distinguished",
                (matrix, Text(angles, TextKind.EXPLANATION), _pair_table(isolability)),
            ),
            Section(
                "seen",
                "2. What can be detected",
                (Text(visibility, TextKind.EXPLANATION), _effect_table(isolability)),
            ),
            Section("limits", "3. Limits", (Items(tuple(map(as_sentence, isolability.remarks)), remarks=True),)),
        ),
        data={
            "format": FORMAT,
            "version": VERSION,
            **attributes_json(isolability, "source", "planned", "runs", "duration_s"),
            "in_words": isolability_sentences(isolability),
            "seen_from_d_prime": DETECTABLE_D_PRIME,
            "close_below_sin2": CONFUSED_SIN2,
            "summary": isolability.summary(),
            "effects": [
                {
                    **attributes_json(effect, "channel", "usual", "unit", "d_prime", effect="id"),
                    **attributes_json(effect, smallest="least_seen", smallest_mN="least_seen_mN"),
                }
                for effect in isolability.effects
            ],
            **attributes_json(isolability, "pairs", "remarks"),
        },
    )


def _effect_table(isolability: Isolability) -> Table:
    return Table.of(
        "effects",
        "Similar effects are neighbours",
        isolability.effects,
        Field("effect", "effect", lambda effect: capitalise(display_name(effect.effect))),
        Field("id", "id", lambda effect: effect.effect),
        Field("channel", "channel", lambda effect: effect.channel),
        Field("d_prime", "d′ at the default size", lambda effect: effect.d_prime, decimals(0)),
        Field("usual", "default size", lambda effect: effect.usual, shortest()),
        Field(
            "least",
            "smallest detected",
            lambda effect: "never" if effect.smallest is None else effect.smallest,
            significant(2),
        ),
        Field("unit", "unit", lambda effect: unit_text(effect.unit)),
        Field("least_mN", "as force, mN", lambda effect: effect.smallest_mN, significant(2)),
    )


def _pair_table(isolability: Isolability) -> Table:
    return Table.of(
        "pairs",
        "Pairs of effects, the most similar first",
        isolability.pairs,
        Field("first", "first", lambda pair: capitalise(display_name(pair.effects[0]))),
        Field("second", "second", lambda pair: capitalise(display_name(pair.effects[1]))),
        Field("sin2", "sin²", lambda pair: pair.sin2, decimals(2)),
        Field("first_by_second", "first by second", lambda pair: pair.typical_sin2[0], decimals(2)),
        Field("second_by_first", "second by first", lambda pair: pair.typical_sin2[1], decimals(2)),
        Field("d_prime", "d′", lambda pair: pair.separation, decimals(0)),
        Field("confused", "", lambda pair: "not told apart" if pair.confused else ""),
        brief_rows=MAX_PAIRS,
    )


def effects_document(effects: Sequence[Effect]) -> Document:
    """Lay out what the friction model leaves out and a rig or a gut can have."""
    sections = (
        Section(
            place.value,
            place.value.capitalize(),
            tuple(_effect_section(effect) for effect in effects if effect.location is place),
        )
        for place in Location
    )
    data = [
        {
            **attributes_json(effect, "id", "name", "summary", "channel", location="place", coordinate="domain"),
            **attributes_json(effect, "source", visible_in="exposes", confused_with="aliases"),
            "parameters": [
                {
                    **attributes_json(parameter, "name", "unit", "role", "low", "high", "meaning"),
                    **attributes_json(parameter, default="usual", grid="tried", bounds="possible"),
                }
                for parameter in effect.parameters
            ],
            "nominal": effect.nominal or None,
        }
        for effect in effects
    ]
    return Document(
        title=f"{len(effects)} effects that the friction model leaves out",
        sections=tuple(sections),
        data={"effects": data},
    )


def _effect_section(effect: Effect) -> Section:
    facts = {
        "visible in": f"{effect.visible_in} ({effect.channel})",
        "confused with": ", ".join(effect.confused_with),
        "nominal model": effect.nominal,
        "source": effect.source,
    }
    return Section(
        effect.id,
        effect.id,
        (
            Text(effect.summary),
            Table.of(
                f"{effect.id}-parameters",
                "",
                effect.parameters,
                Field("parameter", "parameter", lambda parameter: parameter.name),
                Field("unit", "unit", lambda parameter: unit_text(parameter.unit)),
                Field("usual", "default", lambda parameter: parameter.default, shortest()),
                Field("low", "from", lambda parameter: parameter.low, shortest()),
                Field("high", "to", lambda parameter: parameter.high, shortest()),
                Field("meaning", "", lambda parameter: f"{parameter.role}: {parameter.meaning}"),
            ),
            Facts(facts),
        ),
    )
