"""Which runs determine which parameters of the friction model.

    python bench/what_runs_tell.py [--seed 7]

One drawn specimen is simulated at 500 Hz, and the capsule model is fitted to some of its runs at a time. Printed is
`learnt` in percent, the share of what was open before that the runs took away, and for the combinations the half width
of the 95 % interval in percent.
"""

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence

import dragrig
from dragrig.analysis.identification.identification import JointFit
from dragrig.analysis.identification.identify import fit_jointly
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.analysis.selection import select_loaded_runs
from dragrig.config.plan import Plan
from dragrig.rig.runfile.model import Run

RELAXATIONS = {"kind": "relaxation", "shear_strain": [0.5, 1.0, 1.5, 2.0]}
BLANKS = {"kind": "blank", "speed_mm_s": [5.0, 40.0], "travel_mm": 40.0}
COULOMB = {"kind": "coulomb", "speed_mm_s": [0.5, 5.0, 40.0], "travel_mm": 40.0}
DRAGS = {
    "kind": "drag",
    "speed_mm_s": [0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 60.0],
    "travel_mm": 40.0,
    "repeats": 2,
}
SOON = {**DRAGS, "wait_s": 1.0}


def simulate(steps: Iterable[Mapping[str, object]], seed: int) -> tuple[Run, ...]:
    """Make runs of one specimen in memory, ways back unrecorded."""
    plan = Plan.model_validate({"name": "bench", "steps": [{**step, "way_back": "by_hand"} for step in steps]})
    drawn = ("rig.sampling.rate_hz=500", f"rig.simulated.seed={seed}", "rig.simulated.variation.specimen=true")
    return dragrig.simulate(plan, assignments=drawn)


def parts(runs: Sequence[Run], soon: Sequence[Run]) -> Iterator[tuple[str, tuple[Run, ...]]]:
    """Choose runs, and call them something."""

    def of(*kinds: str) -> tuple[Run, ...]:
        return tuple(run for run in runs if run.info.kind in kinds)

    def at(kind: str, name: str, value: float) -> tuple[Run, ...]:
        return tuple(run for run in of(kind) if run.info.header.protocol[name] == value)

    yield "1 relaxation", at("relaxation", "shear_strain", 1.0)
    yield "4 relaxations", of("relaxation")
    yield "Coulomb 0.5", at("coulomb", "speed_mm_s", 0.5)
    yield "3 Coulomb", of("coulomb")
    yield "1 drag", at("drag", "speed_mm_s", 20.0)[:1]
    yield "22 drags", of("drag")
    yield "relax+Coul", of("relaxation", "coulomb")
    yield "relax+drag", of("relaxation", "drag")
    yield "all 31", tuple(runs)
    yield "waits 1 s", tuple(soon)


def table(fits: Mapping[str, JointFit]) -> None:
    """Print a column for each choice of runs."""
    print(f"{'learnt, %':26}" + "".join(f"{name:>14}" for name in fits))
    for index, parameter in enumerate(MODEL.parameters):
        learnt = (100 * fit.parameters[index].learnt for fit in fits.values())
        print(f"{parameter.name:26}" + "".join(f"{entry:14.0f}" for entry in learnt))
    print("half width of the 95 % interval, %")
    for index, combination in enumerate(MODEL.combinations):
        widths = (100 * fit.combinations[index].half_width for fit in fits.values())
        print(f"{combination.name:26}" + "".join(f"{width:14.2g}" for width in widths))
    print(f"{'converged':26}" + "".join(f"{'yes' if fit.converged else 'no':>14}" for fit in fits.values()))


def main() -> None:
    """Fit each choice of runs."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=7)
    seed = parser.parse_args().seed
    runs, soon = simulate((RELAXATIONS, BLANKS, COULOMB, DRAGS), seed), simulate((SOON,), seed)
    print("waits 1 s: 22 drags as the others, but 1 s after the last standstill instead of 60 s")
    table({name: fit_jointly(select_loaded_runs(chosen), MODEL) for name, chosen in parts(runs, soon)})


if __name__ == "__main__":
    main()
