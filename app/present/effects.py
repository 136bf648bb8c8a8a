"""The catalogue of effects laid out for a reader, by the place where they act."""

from collections.abc import Mapping, Sequence

from dragrig.present import Document, Facts, Field, Section, Table, Text, shortest, to_json_object, unit_text
from dragrig.sim_backend.effects import Effect, EffectParameter, Location


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
            "id": effect.id,
            "name": effect.name,
            "place": effect.location,
            "domain": effect.coordinate,
            "summary": effect.summary,
            "exposes": effect.visible_in,
            "channel": effect.channel,
            "parameters": [_parameter_json(parameter) for parameter in effect.parameters],
            "aliases": effect.confused_with,
            "nominal": effect.nominal or None,
            "source": effect.source,
        }
        for effect in effects
    ]
    return Document(
        title=f"{len(effects)} effects that the friction model leaves out",
        sections=tuple(sections),
        data=to_json_object({"effects": data}),
    )


def _parameter_json(parameter: EffectParameter) -> Mapping[str, object]:
    return {
        "name": parameter.name,
        "unit": parameter.unit,
        "role": parameter.role,
        "usual": parameter.default,
        "low": parameter.low,
        "high": parameter.high,
        "meaning": parameter.meaning,
        "tried": parameter.grid,
        "possible": parameter.bounds,
    }


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
