"""What runs cannot answer, a sentence each."""

from collections.abc import Iterator, Sequence

import numpy as np

from dragrig.analysis.gap.sights import Sight
from dragrig.rig.devices import Contact
from dragrig.rig.profile import Phase

FEWEST_RUNS = 4
FEWEST_SPEEDS = 3
MOVED_MM = 0.01


def of_any(sights: Sequence[Sight]) -> Iterator[str]:
    """Say what is left open whatever the model."""
    if len({(one.condition, one.heading) for one in sights}) == len(sights):
        yield "No condition was repeated, so that repeatability is assumed and not seen."
    if len(sights) < FEWEST_RUNS:
        yield "With so few runs none can be kept back, so that no shrink is given."
    if not any(_commanded(one) for one in sights):
        yield "No command was recorded, so that nothing is said of the motor."


def _commanded(one: Sight) -> bool:
    """Tell whether a run has a command of its own, and not the position in its place."""
    trace = one.experiment.run.trace
    return not np.array_equal(np.asarray(trace.command), np.asarray(trace.position), equal_nan=True)


def of_capsule(sights: Sequence[Sight]) -> Iterator[str]:
    """Say what is left open of capsule and gut."""
    kinds = {one.experiment.kind for one in sights}
    speeds = {one.condition[1] for one in sights if one.experiment.kind == "drag"}
    if "relaxation" not in kinds:
        yield "Without relaxations nothing is said of a further relaxation or of stiffening with strain."
    if "drag" not in kinds:
        yield "Without drag runs nothing is said of what needs a closed gut: adhesion, folds, lift-off, inertia."
    elif len(speeds) < FEWEST_SPEEDS:
        yield "With fewer than three speeds of drag, effects of speed cannot be told apart."
    if "blank" not in kinds:
        yield "Without blank runs the rig's own effects are known through the gut alone."
    if "coulomb" not in kinds:
        yield "Without Coulomb runs adhesion cannot be told from friction that falls with speed."


def of_stage(sights: Sequence[Sight]) -> Iterator[str]:
    """Say what is left open of the stage alone."""
    yield "The simulated stage takes no effects, so that no amended model is written."
    velocity = np.concatenate([one.experiment.velocity(one.evidence.blocks.nodes_s) for one in sights])
    speeds = {round(float(one.coordinates.top_speed_mm_s[0]), 1) for one in sights}
    if velocity.min(initial=0.0) >= -MOVED_MM or velocity.max(initial=0.0) <= MOVED_MM:
        yield "All runs go one way, so that friction which differs with direction cannot be told from any other."
    if len(speeds) < FEWEST_SPEEDS:
        yield "With fewer than three speeds, effects of speed cannot be told apart."
    if all(one.experiment.contact is not Contact.NONE for one in sights):
        yield "Without blank runs the stage is known no better than what hangs on it."


def of_own(sights: Sequence[Sight], others: Sequence[str]) -> Iterator[str]:
    """Say what is left open of a model of one's own, of which one channel is explained and `others` are not."""
    rests = any(np.any(one.coordinates.phase == Phase.REST) for one in sights)
    if len({(one.condition, one.heading) for one in sights}) == 1 and not rests:
        yield (
            "All runs go one way at one speed and none rests, so that what a sensor does in time cannot be told from "
            "friction that changes along the way."
        )
    yield (
        "The model does not say which parts its force has, so that only effects of sensor and acquisition were tried; "
        "none of wall, interface, specimen or drive was."
    )
    yield "No amended model is written: the simulator does not know the model."
    for other in others:
        yield f"The model predicts {other} too, which was not looked at."
