"""Specimens of one rig together, laid out for a reader: means, spreads between specimens, and a forest plot."""

from collections.abc import Iterator, Mapping, Sequence
from math import isfinite

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture

from dragrig import present
from dragrig.analysis import (
    UNKNOWN,
    EstimatedQuantity,
    Population,
    PopulationParameter,
    count_text,
    range_text,
    significant_text,
    value_with_error,
)
from dragrig.present import (
    BLACK,
    BLUE,
    GREY,
    SMALL_PT,
    Cell,
    Document,
    Field,
    Figure,
    FormattedNumber,
    Items,
    Section,
    Table,
    attributes_json,
    exclusions_json,
    figure_style,
    interval_text,
    left_out_section,
    new_figure,
    p_value_text,
    parameter_symbol,
    quantity_json,
    unit_text,
)
from dragrig.present.identification_figures import PRIOR_COLOUR

MAX_IN_ANSWER = 3
"""Parameters that the first sentences name."""
MAX_DRAWN_SPECIMENS = 40
DRAWN_COLUMNS = 3
NO_SPREAD = "no spread beyond error"


def population_document(population: Population) -> Document:
    """Lay out a population."""
    rig = [parameter for parameter in population.parameters if parameter.of_rig]
    of_specimens = [parameter for parameter in population.parameters if not parameter.of_rig]
    specimens, campaigns = len(population.specimens), len(population.campaigns)
    return Document(
        title=f"{count_text(specimens, 'specimen')} together",
        badges=population.backends,
        answer=_answer(population, of_specimens),
        lead=(
            f"{count_text(campaigns, 'campaign')} of {count_text(specimens, 'specimen')}, {population.nominal} model; "
            f"± is a standard error{'; means are geometric' if population.has_means else ''}; intervals hold 95 %.",
        ),
        sections=(
            Section("population-figure", "", (_figure(population),)),
            Section("population", "Specimens", (_specimens_table(population, of_specimens),)),
            Section("rig", "Rig", (_rig_table(rig),) if rig else ()),
            Section(
                "each",
                "Each specimen",
                tuple(_specimen_table(entry) for entry in of_specimens if entry.determined and population.has_means),
                collapsed=True,
            ),
            left_out_section(population.left_out),
            Section("remarks", "Remarks", (Items(population.remarks, remarks=True),)),
        ),
        data=population_json(population),
    )


def _answer(population: Population, parameters: Sequence[PopulationParameter]) -> str:
    known = [parameter for parameter in parameters if parameter.determined]
    if not known:
        return f"The campaigns determine none of the {population.nominal} model's parameters of specimens."
    if not population.has_means:
        return _difference_sentence(known)
    differing = sorted((entry for entry in known if entry.spreads), key=_relative_spread, reverse=True)
    if not differing:
        return (
            f"The {len(population.specimens)} specimens show {NO_SPREAD} in any of {len(known)} parameters that the "
            "runs determine."
        )
    named = "; ".join(
        f"{parameter_symbol(entry.name)} {_range(entry)} {unit_text(entry.unit)}".rstrip()
        for entry in differing[:MAX_IN_ANSWER]
    )
    alike = len(known) - len(differing)
    rest = f"; {alike} {'has' if alike == 1 else 'have'} {NO_SPREAD}" if alike else ""
    return (
        f"The {len(population.specimens)} specimens differ in {len(differing)} of {len(known)} parameters{rest}. "
        f"The next specimen will have, most spread first: {named}."
    )


def _difference_sentence(known: Sequence[PopulationParameter]) -> str:
    """Say in which parameters two specimens differ."""
    differing = [entry for entry in known if entry.spreads]
    if not differing:
        return f"The 2 specimens agree within their errors in all of {count_text(len(known), 'parameter')} (n = 2)."
    pairs = "; ".join(_pair_text(entry) for entry in sorted(differing, key=lambda entry: entry.spread_p or 0.0))
    alike = len(known) - len(differing)
    rest = f" In {count_text(alike, 'other')} they agree within their errors." if alike else ""
    return f"The 2 specimens differ, and have no mean (n = 2): {pairs}.{rest}"


def _pair_text(parameter: PopulationParameter) -> str:
    own = [value.own for value in parameter.specimens if value.own is not None]
    values = " and ".join(value_with_error(quantity.value, quantity.standard_error) for quantity in own)
    unit = f" {unit_text(parameter.unit)}".rstrip()
    return f"{parameter_symbol(parameter.name)} {values}{unit} ({p_value_text(parameter.spread_p or 0.0)})"


def _relative_spread(parameter: PopulationParameter) -> float:
    """Return the spread relative to the mean; 0 for a parameter around 0, such as an angle's offset."""
    spread = 0.0 if parameter.spread is None else parameter.spread.value
    return spread / abs(parameter.mean.value) if parameter.unit == "1" and parameter.mean.value else 0.0


def _range(parameter: PopulationParameter) -> str:
    """Write where the next specimen will be."""
    following = parameter.next_specimen
    return range_text(following, None if following is None else (following[1] - following[0]) / 4)


def _specimens_table(population: Population, parameters: Sequence[PopulationParameter]) -> Table:
    if population.has_means:
        return _population_table(parameters)

    def own(entry: PopulationParameter, specimen: str) -> FormattedNumber:
        return _value_cell(next((value.own for value in entry.specimens if value.specimen == specimen), None))

    return Table.of(
        "population",
        "Of two specimens there is no interval of the mean; p is the probability of any such difference by chance",
        parameters,
        Field("parameter", "parameter", lambda entry: parameter_symbol(entry.name)),
        Field("first", population.specimens[0], lambda entry: own(entry, population.specimens[0])),
        Field("second", population.specimens[1], lambda entry: own(entry, population.specimens[1])),
        Field("p", "difference", _p_text),
        Field("unit", "unit", lambda entry: unit_text(entry.unit)),
        Field("meaning", "meaning", lambda entry: entry.meaning),
    )


def _population_table(parameters: Sequence[PopulationParameter]) -> Table:
    return Table.of(
        "population",
        f"± is a standard error; “{NO_SPREAD}” where an apparent spread as large has a probability of 5 % or more",
        parameters,
        Field("parameter", "parameter", lambda entry: parameter_symbol(entry.name)),
        Field("mean", "mean", lambda entry: _value_cell(entry.mean if entry.determined else None)),
        Field("mean_95", "95 % interval", lambda entry: interval_text(entry.mean) if entry.determined else ""),
        Field("spread", "spread between specimens", _spread_cell),
        Field("spread_95", "95 % interval of the spread", _spread_interval_text),
        Field("next_95", "next specimen, 95 %", lambda entry: _range(entry) if entry.determined else ""),
        Field("unit", "unit", lambda entry: unit_text(entry.unit)),
        Field("meaning", "meaning", lambda entry: entry.meaning),
    )


def _spread_cell(parameter: PopulationParameter) -> Cell:
    if parameter.spread is None or not parameter.determined:
        return FormattedNumber(None, UNKNOWN)
    if not parameter.spreads:
        return FormattedNumber(parameter.spread.value, NO_SPREAD)
    p_value = 1.0 if parameter.spread_p is None else parameter.spread_p
    text = significant_text(parameter.spread.value, 2)
    return FormattedNumber(parameter.spread.value, f"{text} ({p_value_text(p_value)})")


def _spread_interval_text(parameter: PopulationParameter) -> str:
    if parameter.spread is None or not parameter.determined:
        return ""
    low, high = parameter.spread.interval
    if not parameter.spreads:
        return f"at most {significant_text(high, 2)}"
    return f"{significant_text(low, 2)} to {significant_text(high, 2)}"


def _rig_table(parameters: Sequence[PopulationParameter]) -> Table:
    return Table.of(
        "rig",
        "One value for all campaigns",
        parameters,
        Field("parameter", "parameter", lambda entry: parameter_symbol(entry.name)),
        Field("value", "value", lambda entry: _value_cell(entry.mean if entry.determined else None)),
        Field("interval_95", "95 % interval", lambda entry: interval_text(entry.mean) if entry.determined else ""),
        Field("same_p", "same in all campaigns", _p_text),
        Field("unit", "unit", lambda entry: unit_text(entry.unit)),
        Field("meaning", "meaning", lambda entry: entry.meaning),
    )


def _p_text(parameter: PopulationParameter) -> str:
    return "" if parameter.spread_p is None else p_value_text(parameter.spread_p)


def _specimen_table(parameter: PopulationParameter) -> Table:
    return Table.of(
        f"specimens-{parameter.name}",
        f"{parameter_symbol(parameter.name)}: by the specimen's own runs, and with what the other specimens add",
        parameter.specimens,
        Field("specimen", "specimen", lambda value: value.specimen),
        Field("own", "own runs", lambda value: _value_cell(value.own)),
        Field("own_95", "95 % interval", lambda value: "" if value.own is None else interval_text(value.own)),
        Field("pooled", "with the others", lambda value: _value_cell(value.pooled)),
        Field("pooled_95", "95 % interval", lambda value: interval_text(value.pooled)),
        Field("unit", "unit", lambda _: unit_text(parameter.unit)),
    )


def _value_cell(quantity: EstimatedQuantity | None) -> FormattedNumber:
    if quantity is None:
        return FormattedNumber(None, UNKNOWN)
    return FormattedNumber.with_error(quantity.value, quantity.standard_error)


def _figure(population: Population) -> Figure:
    pooled = ", blue with what the others add; below, the mean and, pale, where the next specimen will be"
    return Figure(
        "population",
        f"Each specimen's parameters: grey by its own runs{pooled if population.has_means else ''}.",
        "Bars are 95 % intervals.",
        lambda: present.population_figure(population),
    )


def population_figure(population: Population) -> Picture:
    """Draw a panel for each parameter of specimens that the campaigns determine: a row for each specimen."""
    shown = [entry for entry in population.parameters if entry.determined and not entry.of_rig]
    specimens = population.specimens[:MAX_DRAWN_SPECIMENS]
    columns = max(min(DRAWN_COLUMNS, len(shown)), 1)
    rows = -(-len(shown) // columns)
    beyond = len(population.specimens) - len(specimens)
    subtitle = f"{count_text(len(population.specimens), 'specimen')}, bars are 95 % intervals" + (
        f"; the first {len(specimens)} are drawn" if beyond else ""
    )
    with figure_style():
        figure = new_figure(
            16.0, max(rows, 1) * (0.24 * len(specimens) + 1.9), f"{population.nominal} model over specimens", subtitle
        )
        panels = figure.subplots(max(rows, 1), columns, squeeze=False)
        for place, axes in enumerate(panels.flat):
            if place < len(shown):
                _draw_parameter(axes, shown[place], specimens, names=place % columns == 0)
            else:
                axes.set_axis_off()
        handles, words = panels[0, 0].get_legend_handles_labels()
        if words:
            figure.legend(handles, words, loc="outside lower left", ncols=len(words))
    return figure


def _draw_parameter(axes: Axes, parameter: PopulationParameter, specimens: Sequence[str], *, names: bool) -> None:
    values = {value.specimen: value for value in parameter.specimens}
    pooled = isfinite(parameter.mean.standard_error)
    mean_row = len(specimens) + 0.5
    if parameter.next_specimen is not None:
        low, high = parameter.next_specimen
        axes.axvspan(low, high, color=PRIOR_COLOUR, linewidth=0, label="next specimen", zorder=0)
    drawn = (
        ("own runs", GREY, -0.15, [(row, values[name].own) for row, name in enumerate(specimens) if name in values]),
        (
            "with the others",
            BLUE,
            0.15,
            [(row, values[name].pooled) for row, name in enumerate(specimens) if name in values],
        ),
        ("mean", BLACK, 0.0, [(mean_row, parameter.mean)]),
    )
    for label, colour, offset, points in drawn:
        known = [(row, quantity) for row, quantity in points if quantity is not None]
        if known and (pooled or label == "own runs"):
            centre = np.array([quantity.value for _, quantity in known])
            ends = np.abs(np.array([quantity.interval for _, quantity in known]).T - centre)
            at = [row + offset for row, _ in known]
            marker = "D" if label == "mean" else "o"
            axes.errorbar(centre, at, xerr=ends, fmt=marker, color=colour, markersize=5, capsize=2, label=label)
    short = (name if len(name) <= 24 else f"{name[:11]}…{name[-12:]}" for name in specimens)
    rows, words = [*range(len(specimens)), mean_row], [*short, "mean"]
    shown = len(rows) if pooled else len(specimens)
    axes.set_yticks(rows[:shown], words[:shown] if names else [], size=SMALL_PT)
    axes.set_ylim(rows[shown - 1] + 0.7, -0.7)
    axes.grid(visible=False, axis="y")
    axes.set_title(parameter_symbol(parameter.name))
    none = NO_SPREAD if parameter.spread_p is not None and not parameter.spreads else ""
    axes.set_xlabel(" · ".join(filter(None, (unit_text(parameter.unit), none))))


def population_json(population: Population) -> Mapping[str, object]:
    """Return a population for JSON."""
    return {
        **attributes_json(population, "nominal", "campaigns", "specimens"),
        "parameters": {parameter.name: dict(_parameter_json(parameter)) for parameter in population.parameters},
        "left_out": exclusions_json(population.left_out),
        "remarks": population.remarks,
    }


def _parameter_json(parameter: PopulationParameter) -> Iterator[tuple[str, object]]:
    known = parameter.determined
    yield from attributes_json(parameter, "unit", "meaning", "of_rig", "determined").items()
    yield "mean", quantity_json(parameter.mean) if known else None
    yield "spread", quantity_json(parameter.spread) if known and parameter.spread is not None else None
    yield "spread_p", parameter.spread_p if known else None
    yield "spreads", parameter.spreads
    yield "next_specimen_95", parameter.next_specimen if known else None
    yield (
        "specimens",
        [
            {
                "specimen": value.specimen,
                "own": None if value.own is None else quantity_json(value.own),
                "pooled": quantity_json(value.pooled),
            }
            for value in parameter.specimens
        ],
    )
