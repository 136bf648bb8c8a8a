"""Effects that a model has beside the nominal friction, by id; what there is and what it takes is the simulator's."""

from collections.abc import Mapping, Sequence
from typing import Self

from pydantic import Field, ModelWrapValidatorHandler, model_serializer, model_validator

from dragrig.config.base import Settings
from dragrig.config.errors import SettingsError


class EffectSettings(Settings):
    """An effect that is switched on. Its parameters stand beside the id, in a file as here; the usual for none."""

    id: str = Field(min_length=1)
    parameters: Mapping[str, float] = {}

    @model_validator(mode="wrap")
    @classmethod
    def _gather_parameters(cls, data: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if not isinstance(data, Mapping):
            return handler(data)
        given = data.get("parameters", {})
        rest = {key: value for key, value in data.items() if key not in cls.model_fields}
        if rest and isinstance(given, Mapping):
            own = {key: value for key, value in data.items() if key not in rest}
            data = {**own, "parameters": {**given, **rest}}
        return handler(data)

    @model_serializer
    def _beside_the_id(self) -> dict[str, str | float]:
        return {"id": self.id, **self.parameters}


def effects_of(given: Sequence[str | EffectSettings]) -> tuple[EffectSettings, ...]:
    """Return effects as they are typed, `stribeck` or `stribeck:ratio=0.4,speed_mm_s=2`, or as they are.

    Raises
    ------
    SettingsError
        For a text that is not of this form.
    """
    return tuple(one if isinstance(one, EffectSettings) else _parsed(one) for one in _listed(given))


def _listed(given: Sequence[str | EffectSettings]) -> Sequence[str | EffectSettings]:
    return (given,) if isinstance(given, str | EffectSettings) else given


def _parsed(text: str) -> EffectSettings:
    name, colon, listed = text.partition(":")
    values: dict[str, float] = {}
    for part in listed.split(",") if colon else ():
        key, _, value = part.partition("=")
        number = _number(value)
        if not name.strip() or not key.strip() or number is None:
            raise SettingsError(
                f"--effect {text}: is not of the form id:parameter=number,…, as in stribeck:ratio=0.4,speed_mm_s=2."
            )
        values[key.strip()] = number
    if not name.strip():
        raise SettingsError(f"--effect {text}: names no effect; dragrig gap effects lists them.")
    return EffectSettings(id=name.strip(), parameters=values)


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if abs(number) < float("inf") else None
