"""`dragrig gap effects`."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.console import result, result_json
from dragrig.cli.wording import columns

if TYPE_CHECKING:
    from dragrig.sim_backend.effects.base import Effect, EffectParameter


@click.command("effects")
@options.as_json
def command(as_json: bool) -> None:
    """List what the friction model leaves out and a rig or a gut can have.

    By place: each effect's id, what it is and what exposes it, its parameters with unit, usual value and prior range,
    what is hardly told from it, and where its form comes from. A simulated rig has an effect with, for instance,
    --effect stribeck:ratio=0.4,speed_mm_s=2.
    """
    from dragrig.sim_backend.effects.catalogue import catalogue

    known = catalogue().values()
    if as_json:
        result_json({"effects": [_plain(one) for one in known]})
    else:
        result(_text(known))


def _text(effects: "Iterable[Effect]") -> str:
    from dragrig.sim_backend.effects.base import Place

    known = tuple(effects)
    places = ((place, [one for one in known if one.place is place]) for place in Place)
    return "\n\n".join("\n\n".join((f"{place.upper()}", *map(_paragraph, there))) for place, there in places if there)


def _paragraph(effect: "Effect") -> str:
    header = ("parameter", "unit", "usual", "from", "to", "")
    table = columns(header, (_row(one) for one in effect.parameters))
    lines = [effect.id, f"  {effect.summary}", f"  shows in: {effect.exposes} ({effect.channel})"]
    lines += [f"    {line}" for line in table.splitlines()]
    if effect.aliases:
        lines.append(f"  hardly told from: {', '.join(effect.aliases)}")
    if effect.nominal:
        lines.append(f"  for the model: {effect.nominal}")
    return "\n".join((*lines, f"  source: {effect.source}"))


def _row(parameter: "EffectParameter") -> tuple[str, ...]:
    unit = "" if parameter.unit == "1" else parameter.unit
    numbers = (parameter.usual, parameter.low, parameter.high)
    return (parameter.name, unit, *(f"{one:g}" for one in numbers), f"{parameter.role}: {parameter.meaning}")


def _plain(effect: "Effect") -> dict[str, object]:
    return {
        "id": effect.id,
        "name": effect.name,
        "place": effect.place,
        "domain": effect.domain,
        "summary": effect.summary,
        "exposes": effect.exposes,
        "channel": effect.channel,
        "parameters": effect.parameters,
        "aliases": effect.aliases,
        "nominal": effect.nominal or None,
        "source": effect.source,
    }
