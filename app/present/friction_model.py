"""The friction model laid out for a reader: forces at steady speed, and the disagreement of Eq. 14 and Table 1."""

from collections.abc import Sequence
from operator import itemgetter

from dragrig import present
from dragrig.analysis.paper import WALL_UNITS
from dragrig.config import Capsule, FrictionModelSettings
from dragrig.present import (
    Document,
    Field,
    Figure,
    Section,
    Table,
    Text,
    decimals,
    percent_difference,
    shortest,
    shortest_percent,
)

WALL_TEXTS = {"eq14": "Eq. 14, as printed", "table1": "the least-squares quadratic through Table 1"}


def model_document(
    rows: Sequence[dict[str, float]],
    model: FrictionModelSettings,
    capsule: Capsule,
    wall_thickness_mm: float,
) -> Document:
    """Lay out a friction model: `rows` are its forces at steady speed, by the names of the columns."""
    speeds = [row["speed_mm_s"] for row in rows]
    speed = Field("speed_mm_s", "v, mm/s", itemgetter("speed_mm_s"), shortest())
    parts = (name for name in rows[0] if name != "speed_mm_s")
    fields = (Field(name, name.replace("_mN", ", mN"), itemgetter(name), decimals(2)) for name in parts)
    forces = Table.of("forces", "", rows, speed, *fields)
    wall = WALL_TEXTS.get(model.wall, "the model's own polynomials")

    return Document(
        title=f"Friction model {model.name}",
        sections=(
            Section(
                "steady",
                "Forces at steady speed",
                (
                    forces,
                    Figure(
                        "model-forces",
                        "Forces against speed.",
                        "f_e, f_v, f_c and their sum.",
                        lambda: present.forces_figure(model, capsule, wall_thickness_mm, speeds),
                    ),
                    Figure(
                        "model-skew",
                        "Skew resistance along the capsule.",
                        "At several speeds.",
                        lambda: present.skew_figure(model, capsule, wall_thickness_mm, speeds),
                    ),
                ),
            ),
            Section(
                "wall",
                "Wall parameters",
                (
                    Text(
                        "Eq. 14 (wall eq14) differs from Table 1; a least-squares quadratic through Table 1 (wall "
                        f"table1) is closer. Differences are from Table 1. The forces above use {wall}."
                    ),
                    _wall_table(),
                    Figure("model-wall", "Wall parameters against strain.", "Eq. 14 and Table 1.", present.wall_figure),
                ),
            ),
        ),
        data={"forces": list(rows)},
    )


def _wall_table() -> Table:
    from dragrig.sim_backend.friction import parameter_set_differences

    order = list(WALL_UNITS)

    return Table.of(
        "wall-parameters",
        "",
        sorted(parameter_set_differences(), key=lambda entry: order.index(entry.parameter)),
        Field("element", "element", lambda entry: entry.parameter.replace("eta", "η")),
        Field("unit", "unit", lambda entry: WALL_UNITS[entry.parameter]),
        Field("strain", "strain", lambda entry: entry.strain, shortest_percent),
        Field("table1", "Table 1", lambda entry: entry.table1, shortest()),
        Field("eq14", "Eq. 14", lambda entry: entry.eq14, shortest(4)),
        Field("eq14_difference", "difference", lambda entry: entry.eq14_difference, percent_difference),
        Field("quadratic", "quadratic", lambda entry: entry.quadratic, shortest(4)),
        Field("quadratic_difference", "difference", lambda entry: entry.quadratic_difference, percent_difference),
    )
