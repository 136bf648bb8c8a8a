"""How a relaxation should be made: half widths of the elements' 95 % intervals, in percent, for one run of each kind.

    python bench/what_relaxations_tell.py

Simulated at 100 % strain with the paper's values and the default noise; the time constants are 23 ms and 0.4 s.
"""

import dragrig
from dragrig.analysis.identification.relaxation_elements import identify_relaxation
from dragrig.analysis.selection import select_loaded_runs

USUAL = {"hold_s": 20.0, "ramp_speed_mm_s": 20.0, "rate_hz": 500.0}
CHANGES: tuple[dict[str, float], ...] = (
    {},
    {"hold_s": 300.0},
    {"hold_s": 5.0},
    {"hold_s": 2.0},
    {"hold_s": 1.0},
    {"hold_s": 0.5},
    {"ramp_speed_mm_s": 60.0},
    {"ramp_speed_mm_s": 5.0},
    {"ramp_speed_mm_s": 1.0},
    {"rate_hz": 5000.0},
    {"rate_hz": 100.0},
    {"rate_hz": 20.0},
)


def main() -> None:
    """Print a row for each kind of run."""
    print(f"{'':28}" + "".join(f"{name:>8}" for name in ("E1", "E2", "E3", "η1", "η2")))
    for change in CHANGES:
        chosen = {**USUAL, **change}
        assignments = [f"{key}={value}" for key, value in chosen.items() if key != "rate_hz"]
        runs = dragrig.simulate(
            "relaxation",
            assignments=[*assignments, "shear_strain=1.0", f"rig.sampling.rate_hz={chosen['rate_hz']}"],
        )
        (fit,) = identify_relaxation(select_loaded_runs(run for run in runs if run.info.kind == "relaxation")).fits
        name = ", ".join(f"{key} {value:g}" for key, value in change.items()) or "20 s, 20 mm/s, 500 Hz"
        widths = "".join(f"{100 * element.half_width:8.2g}" for element in fit.elements)
        print(f"{name:28}{widths or '  none: ' + fit.remark}")


if __name__ == "__main__":
    main()
