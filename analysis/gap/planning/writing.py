"""What is recommended, as a plan that a rig carries out."""

from collections.abc import Iterator, Sequence

from dragrig.analysis.gap.planning.results import NextExperiment
from dragrig.config.plan import Order, Plan, Step

ORDER = ("relaxation", "blank", "coulomb", "drag", "motion")
PROMPTS = {
    "relaxation": "Fit the specimen in the vacuum fixture and insert the rough capsule",
    "blank": "Take the capsule off the sensor",
    "coulomb": "Open the gut to 13 mm in the vacuum fixture and insert the smooth capsule",
    "drag": "Lay the gut on the foam, fix one side and the mesentery, and insert the capsule",
}
SWEPT = "speed_mm_s"


def plan_of(found: NextExperiment, name: str = "next") -> Plan:
    """Return a plan of the runs, those of one fixture together so that hands are needed as seldom as can be.

    Strokes that differ in their speed alone become one step with its speeds in random order.
    """
    steps = sorted((one.step for one in found.runs), key=lambda step: ORDER.index(step.kind))
    return Plan(name=name, description=found.why, seed=1, steps=tuple(_prompted(_merged(steps))))


def _merged(steps: Sequence[Step]) -> Iterator[Step]:
    groups: dict[tuple[object, ...], list[Step]] = {}
    for one in steps:
        rest = tuple(sorted((key, str(value)) for key, value in one.parameters.items() if key != SWEPT))
        groups.setdefault((one.kind, one.repeats, one.wait_s, SWEPT in one.parameters, rest), []).append(one)
    for alike in groups.values():
        first = alike[0]
        if len(alike) == 1 or SWEPT not in first.parameters:
            yield from alike
            continue
        speeds = [one.parameters[SWEPT] for one in alike]
        update = {"parameters": {**first.parameters, SWEPT: speeds}, "order": Order.RANDOM_WITHIN_REPEAT}
        yield first.model_copy(update=update)


def _prompted(steps: Iterator[Step]) -> Iterator[Step]:
    before = ""
    for one in steps:
        fixture = "drag" if one.kind == "motion" else one.kind
        yield one if fixture == before else one.model_copy(update={"prompt": PROMPTS[fixture]})
        before = fixture
