"""Diagnose measured traces from elsewhere, none of them of intestine, whose causes are published.

`python bench/elsewhere.py DATA [NAME…]` imports the traces of a folder, all or those named, and prints what
`docs/elsewhere.md` tells. DATA holds `velocity-steps/` and `cogging/` with the files that `SOURCES` names.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import sys
from dataclasses import dataclass
from math import pi, sqrt
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import dragrig

RADIUS_MM = 10.0
SLIP = {"time": "Time:s", "position": "Displ:um", "force": "Friction:1*1000"}
TURN = {"time": "Time:s", "position": f"Position:rad*{RADIUS_MM:g}", "motor_force": "Iq:A*1000"}
TREND = str(Path(__file__).with_name("linear_trend.py"))
PIECE_S = 1.4
UNCOMPENSATED, COMPENSATED = (0.5, 1.9, 3.3, 4.7, 6.1), (9.0, 10.4, 11.8, 13.2, 14.6)


@dataclass(frozen=True)
class Source:
    """A trace: where it is, what its columns are, which stretches of it are runs, and what is expected of it."""

    name: str
    file: str
    columns: dict[str, str]
    nominal: str
    resample_hz: float
    stretches_s: tuple[tuple[float | None, float | None], ...]
    steady: bool = False


def pieces(starts_s: tuple[float, ...]) -> tuple[tuple[float | None, float | None], ...]:
    """Return stretches of one length."""
    return tuple((start, round(start + PIECE_S, 3)) for start in starts_s)


STEPS, MOTOR = "velocity-steps", "cogging/speed_test.txt"
SEPIOLITE = f"{STEPS}/velstep3_TR2_exp013_sepiolite.txt"
SOURCES = (
    Source("sepiolite", SEPIOLITE, SLIP, TREND, 1.0, ((21326.0, None),)),
    Source("sepiolite from the step on", SEPIOLITE, SLIP, TREND, 1.0, ((21318.9, None),)),
    Source("sepiolite from 40 µm on", SEPIOLITE, SLIP, TREND, 1.0, ((21339.0, None),)),
    Source("basalt", f"{STEPS}/velstep4_BRAVA_expb819_basalt.txt", SLIP, TREND, 10.0, ((11676.5, None),)),
    Source("motor", MOTOR, TURN, "drive", 1000.0, pieces(UNCOMPENSATED)),
    Source("motor, compensated", MOTOR, TURN, "drive", 1000.0, pieces(COMPENSATED)),
    Source("motor against its set speed", MOTOR, TURN, "drive", 1000.0, pieces(UNCOMPENSATED), steady=True),
    Source("the same, compensated", MOTOR, TURN, "drive", 1000.0, pieces(COMPENSATED), steady=True),
)


def diagnosed(source: Source, data: Path, folder: Path) -> None:
    """Import a trace, diagnose it, and print what is said."""
    began = perf_counter()
    for from_s, to_s in source.stretches_s:
        dragrig.import_run(
            data / source.file,
            folder,
            source.columns,
            resample_hz=source.resample_hz,
            specimen=source.name,
            steady=source.steady,
            from_s=from_s,
            to_s=to_s,
        )
    imported = perf_counter()
    diagnosis = dragrig.gap_diagnose(folder, nominal=source.nominal)
    done = perf_counter()
    print(f"\n{source.name}: {diagnosis.verdict.value} {' and '.join(diagnosis.effects)}".rstrip())
    for hypothesis in diagnosis.ranking[:3]:
        values = ", ".join(f"{parameter.name} {parameter.value:.4g}" for parameter in hypothesis.parameters)
        print(f"    {hypothesis.hypothesis} {hypothesis.probability:.2f} {values}".rstrip())
    if diagnosis.unknown is not None:
        unknown = diagnosis.unknown
        print(f"    {unknown.location}\n    {unknown.dependence}\n    {unknown.expression}".rstrip())
    if diagnosis.shrink is not None:
        print(
            f"    motor force: {diagnosis.shrink.gap_before_mN:.0f} mN, noise {diagnosis.shrink.noise_floor_mN:.1f} mN"
        )
    if source.steady:
        print(f"    position less command: {1000 * strays_mm(folder) / RADIUS_MM:.1f} mrad")
    seconds = f"{imported - began:.1f} s to import, {done - imported:.1f} s to diagnose"
    print(f"    would have seen {diagnosis.detection_limit_mN:.0f} mN; {seconds}", flush=True)


def strays_mm(folder: Path) -> float:
    """Return the root mean square by which runs stray from their commands."""
    runs = [dragrig.load(path) for path in sorted(folder.glob("*.h5"))]
    squares = [float(((run.trace.position - run.trace.command) ** 2).mean()) for run in runs]
    return sqrt(sum(squares) / len(squares))


def main(data: Path, names: list[str]) -> None:
    """Diagnose all, or those named."""
    print(f"72 periods a turn are {2 * pi * RADIUS_MM / 72:.4f} mm long")
    for source in (source for source in SOURCES if not names or source.name in names):
        with TemporaryDirectory() as folder:
            diagnosed(source, data, Path(folder))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
