"""What a nominal model says of itself, checked before anything is asked of it."""

from collections.abc import Iterator, Sequence
from math import isfinite

from dragrig.analysis.nominal.protocol import Combination, NominalModel, Parameter, Variation
from dragrig.config.loading import nearest


def wrong_declarations(model: NominalModel) -> Iterator[str]:
    """Yield what is wrong with name, parameters, variations, combinations and zeros, a clause each."""
    name: object = model.name
    if not isinstance(name, str) or not name:
        yield f"its name is {name!r}, and must be some text"
    members = (("parameters", Parameter), ("variations", Variation), ("combinations", Combination))
    for attribute, kind in members:
        yield from _not_of(attribute, getattr(model, attribute), kind)


def wrong_numbers(model: NominalModel) -> Iterator[str]:
    """Yield what is wrong with numbers and names of a model whose declarations are of the right types."""
    if not model.parameters:
        yield "it has no parameters, so that there is nothing to identify"
    for what, named in (("parameter", model.parameters), ("variation", model.variations)):
        yield from _not_unique(what, [one.name for one in named])
    for parameter in model.parameters:
        yield from _wrong_parameter(parameter)
    for variation in model.variations:
        if not _above_zero(variation.sd):
            yield f"variation {variation.name} has sd = {variation.sd!r}, which must be above 0"
    for combination in model.combinations:
        yield from _wrong_combination(combination, [one.name for one in model.parameters if one.positive])
    for channel, sd in model.zero_sd.items():
        if not _above_zero(sd):
            yield f"zero_sd of {channel} is {sd!r}, and must be above 0"


def _not_of(attribute: str, members: object, kind: type) -> Iterator[str]:
    if not isinstance(members, Sequence):
        yield f"its {attribute} are a {type(members).__name__}, and must be a tuple of {kind.__name__}"
        return
    for one in members:
        if not isinstance(one, kind):
            yield f"{one!r:.60} among its {attribute} is no {kind.__name__}"


def _not_unique(what: str, names: Sequence[str]) -> Iterator[str]:
    for name in dict.fromkeys(one for one in names if names.count(one) > 1):
        yield f"{what} {name} is there {names.count(name)} times; each name may be used once"


def _wrong_parameter(parameter: Parameter) -> Iterator[str]:
    name = parameter.name
    if not _above_zero(parameter.prior_sd):
        yield f"parameter {name} has prior_sd = {parameter.prior_sd!r}, which must be above 0"
    if not _number(parameter.nominal):
        yield f"parameter {name} has nominal = {parameter.nominal!r}, which is no finite number"
    elif parameter.positive and parameter.nominal <= 0:
        yield f"parameter {name} has nominal = {parameter.nominal!r}; give one above 0, or positive=False"


def _wrong_combination(combination: Combination, positive: Sequence[str]) -> Iterator[str]:
    for factor in combination.powers:
        if factor not in positive:
            hint = nearest(factor, positive).rstrip(".")
            yield f"combination {combination.name} is made of {factor}, which is no positive parameter; {hint}"


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def _above_zero(value: object) -> bool:
    return isinstance(value, int | float) and _number(value) and value > 0
