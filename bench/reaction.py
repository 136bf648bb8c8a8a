"""How long the guard takes on the real rig's code, on doubles: from a condition to the stop command at the drive.

An e-stop, a limit switch and an alarm stop the drive by itself; here only the program's own command counts.

Run `python bench/reaction.py [--rounds 20]`. The bar is one block, 50 ms, and one round trip on the serial link.

With `--signals` it prints, for each fault of force input and encoder, how it is found, and how long and how far the
stage goes on at 20 mm/s, the median of the rounds (docs/faults.md has the table). The bar is 0.6 s: the default of
`hardware.drive.silence_s`, and 100 ms.

With `--wires` it prints, for each wiring of what stops the stage without its program, what `dragrig check --live` finds
missing, for how long and how far the stage goes on at 40 mm/s once the serial cable or the program fails, what `dragrig
check` says of it, and whether `dragrig run` refuses the stroke. The bar is what `check` says.
"""

import argparse
import re
import threading
import time
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import Calibration, CommissioningRecord, RigSettings
from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.commissioning import wiring_key
from dragrig.rig.devices import Acquisition, BackendRequest, Contact, stage_limits
from dragrig.rig.engine import AcquisitionOutcome, Engine
from dragrig.rig.guard import Guard
from dragrig.rig.hardware.dialects.base import Command
from dragrig.rig.hardware.drive.stage_base import MonitoredStage
from dragrig.rig.profile import MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.rig.stops import Failure, RunOn, assess_stops
from dragrig.sim_backend.doubles.backend import DoubleBackend

SPEED_MM_S = 20.0
CONDITIONS: Mapping[str, Mapping[str, float | str]] = {
    "force over the limit": {"force_added_mN": 9000.0},
    "sensor open": {"sensor_open": True},
    "e-stop": {"e_stop_pressed": True},
    "upper limit switch": {"limit_high_pressed": True},
    "drive alarm": {"drive_alarm": "overcurrent"},
}
RIG = RigSettings.model_validate({"stage": {"start_mm": 5.0}, "hardware": {"drive": {"homing_speed_mm_s": 50.0}}})
ACQUISITION = Acquisition(
    run_id="bench",
    order=0,
    kind="drag",
    profile=MotionProfile.from_pieces(
        (stationary_piece(0.2, Phase.REST), *trapezoid(60.0, SPEED_MM_S, 1000.0), stationary_piece(0.3, Phase.HOLD))
    ),
    capsule=Capsule(name="smooth", surface="smooth", diameter_mm=12.9, length_mm=15.2, mass_g=50.1),
    specimen=Specimen(name="none"),
    fixture=Fixture.NONE,
    contact=Contact.NONE,
    insertion_dwell_s=0.0,
)


def reaction_s(double: DoubleBackend, guard: Guard, condition: Mapping[str, float | str], wait_s: float) -> float:
    """Start a motion, let something go wrong in the middle of it, and wait for the stop."""
    stops = count_stops(double)
    worker = threading.Thread(target=lambda: Engine(double, RIG, guard).acquire(replace(ACQUISITION)))
    worker.start()
    while double.bench.speed_mm_s() < SPEED_MM_S - 0.1:
        time.sleep(0.001)
    time.sleep(wait_s)
    struck_s = time.perf_counter()
    double.bench.faults.inject(**condition)
    while count_stops(double) == stops:
        time.sleep(0.0002)
    took_s = time.perf_counter() - struck_s
    worker.join()
    return took_s


def count_stops(double: DoubleBackend) -> int:
    """How many stop commands the drive has heard."""
    return sum(request.command is Command.STOP for request in double.drive.requests)


LIVING = Calibration(
    id="bench", made_at=datetime(2026, 1, 1, tzinfo=UTC), quantity="force", gain=1000.0, noise_uV=700.0
)
"""The noise of the simulated sensor, as `dragrig calibrate force` would note it."""
SIGNALS: Mapping[str, Mapping[str, float | str]] = {
    "force input constant, 0 V": {"force_constant_V": 1e-9},
    "force input constant, 4.9 V": {"force_constant_V": 4.9},
    "force input frozen": {"force_frozen": True},
    "force amplifier off: 0 V and the converter's noise": {"force_dead": True},
    "amplifier saturated at 5 V, rail not set": {"force_rail_V": 5.0, "force_added_mN": 7000.0},
    "amplifier saturated at 5 V, `rail_V = 5`": {"force_rail_V": 5.0, "force_added_mN": 7000.0},
    "force cable pulled, pull-up": {"sensor_open": True},
    "force cable pulled, pull-down": {"sensor_open": True},
    "force cable pulled, floating at 350 mN": {"force_floats_mN": 350.0},
    "force cable pulled, floating with 35 mN of hum": {"force_floats_mN": 350.0, "force_floats_hum_mN": 50.0},
    "force sensor's wires swapped": {"force_inverted": True},
    "tone of 200 mN at 16 kHz": {"force_tone_mN": 200.0, "force_tone_hz": 16_000.0},
    "100 counts lost": {"encoder_added_counts": -100},
    "100 counts twice": {"encoder_added_counts": 100},
    "400 counts lost": {"encoder_added_counts": -400},
    "400 counts twice": {"encoder_added_counts": 400},
    "1 % of the counts lost": {"encoder_lost_share": 0.01},
    "counts jitter by 200": {"encoder_jitter_counts": 200},
    "encoder stuck": {"encoder_stuck": True},
    "encoder's error line": {"encoder_error": True},
}
WIRING: Mapping[str, Mapping[str, object]] = {
    "amplifier saturated at 5 V, `rail_V = 5`": {"rail_V": 5.0},
    "force cable pulled, pull-down": {"unplugged": "zero"},
}

PATIENT = {"stale_data_s": 2.0, "following_error_mm": 50.0, "encoder_silent_mm": 50.0}
"""A busy computer is none of the faults."""


@dataclass(frozen=True, slots=True)
class Found:
    """How a fault was found, and how long and how far the stage went on; NaN where nothing stopped it."""

    by: str
    stood_after_s: float
    travel_mm: float


def open_double(rig: RigSettings) -> DoubleBackend:
    """Open a rig on doubles that is calibrated, but for what its checks say of it."""
    return DoubleBackend(BackendRequest(rig, FrictionModelSettings(), calibrations={"force": LIVING}))


def wired(force: Mapping[str, object], guard: Mapping[str, object], mode: str) -> RigSettings:
    """Return the rig with its force input wired so, and the encoder's error line."""
    lines: dict[str, object] = {"encoder_error": "port1/line5"}
    if mode == "velocity":
        lines |= {"heartbeat": "port1/line4", "heartbeat_s": 1.0}
    drive = {"homing_speed_mm_s": 50.0, "mode": mode, "reply_s": 2.0, "silence_s": 5.0}
    hardware = {"drive": drive, "card": {"force": force, "lines": lines}, "hang_s": 5.0}
    return RigSettings.model_validate({"stage": {"start_mm": 5.0}, "guard": guard, "hardware": hardware})


def failed_checks(rig: RigSettings, faults: Mapping[str, float | str]) -> str:
    """Name the checks that find a fault at rest."""
    double = DoubleBackend(BackendRequest(rig, FrictionModelSettings(), calibrations={"force": LIVING}, connect=False))
    double.bench.faults.inject(**faults)
    try:
        return ", ".join(check.name for check in double.examine() if not check.passed)
    finally:
        double.close()


def struck_in_motion(rig: RigSettings, faults: Mapping[str, float | str], wait_s: float) -> Found:
    """Let a fault happen in the middle of a motion, or have it there from the beginning where it is one of wires."""
    double, outcomes = open_double(rig), list[AcquisitionOutcome]()
    try:
        double.bench.place(1.0)
        guard = Guard(rig.guard, 1e-3 * rig.encoder.resolution_um)
        guard.reset(double.stage.state())
        double.stage.enable()
        double.stage.home()
        touching = replace(ACQUISITION, fixture=Fixture.FOAM, contact=Contact.SLIDING, insertion_dwell_s=60.0)
        if standing := bool({"force_inverted", "encoder_lost_share", "force_tone_mN"} & set(faults)):
            double.bench.faults.inject(**faults)
        worker = threading.Thread(target=lambda: outcomes.append(Engine(double, rig, guard).acquire(touching)))
        worker.start()
        while double.bench.speed_mm_s() < SPEED_MM_S - 0.1:
            time.sleep(0.001)
        time.sleep(wait_s)
        struck_s, struck_mm = time.perf_counter(), double.bench.position_mm()
        if not standing:
            double.bench.faults.inject(**faults)
        while double.bench.speed_mm_s() > 0.5:
            time.sleep(0.0005)
        stood_s, stood_mm = time.perf_counter(), double.bench.position_mm()
        worker.join()
    finally:
        double.close()
    (outcome,) = outcomes
    if outcome.reason:
        return Found(f"trip ({outcome.reason.partition(':')[0]})", stood_s - struck_s, stood_mm - struck_mm)
    marks = ", ".join(re.split(r" by |[,:]| when ", text)[0] for text in outcome.checks.warnings)
    return Found(f"mark ({marks})" if marks else "-", float("nan"), float("nan"))


def print_signals(rounds: int, mode: str) -> None:
    """Print a row of a table for each fault of the signals."""
    random = np.random.default_rng(2)
    print(f"| fault ({mode} mode, {SPEED_MM_S:g} mm/s) | `dragrig check` | run | standstill after | distance |")
    print("|---|---|---|---|---|")
    for name, faults in ({"none": {}} | dict(SIGNALS)).items():
        guard = {"stale_data_s": 2.0} if "encoder_stuck" in faults else PATIENT
        rig = wired(WIRING.get(name, {}), guard, mode)
        found = [struck_in_motion(rig, faults, float(random.uniform(0.0, 0.3))) for _ in range(rounds)]
        ends = " or ".join(sorted({each.by for each in found}))
        after_s, travel_mm = np.median([(each.stood_after_s, each.travel_mm) for each in found], axis=0)
        went = "| |" if np.isnan(after_s) else f"| {1000 * after_s:.0f} ms | {travel_mm:.1f} mm |"
        print(f"| {name} | {failed_checks(rig, faults) or '-'} | {ends} {went}", flush=True)


BEATING = {"heartbeat": "port1/line4"}
WIRES: Mapping[str, tuple[Mapping[str, str], Mapping[str, float | str]]] = {
    "all of them": (BEATING, {}),
    "drive's silence timeout alone": ({"enable": ""}, {}),
    "enable line alone": ({}, {"drive_unwatched": True}),
    "enable line alone, relay of 0.3 s": ({}, {"drive_unwatched": True, "enable_opens_s": 0.3}),
    "heartbeat relay alone, three beats": ({"enable": "", **BEATING}, {"drive_unwatched": True}),
    "heartbeat relay alone, 0.4 s": ({"enable": "", **BEATING}, {"drive_unwatched": True, "relay_opens_s": 0.4}),
    "none that is connected": (
        BEATING,
        {"drive_unwatched": True, "enable_not_wired": True, "relay_not_wired": True},
    ),
}
"""Lines of the settings, and what is wrong behind them."""
FAST_MM_S = 40.0
STROKE = MotionProfile.from_pieces((stationary_piece(0.1, Phase.REST), *trapezoid(130.0, FAST_MM_S, 1000.0)))
FROM_MM = 10.0


def look(double: DoubleBackend, rig: RigSettings) -> CommissioningRecord:
    """Return what a person's look would record of the stops, tried at a standstill and in motion."""
    found = (*double.try_stops(in_motion=False), *double.try_stops(in_motion=True))
    return CommissioningRecord(made_at=datetime.now(UTC), made_on="bench", wiring=wiring_key(rig), signals=tuple(found))


def way_after(double: DoubleBackend, failure: Failure, wait_s: float) -> tuple[float, float]:
    """Return how long and how far the stage goes on once its link or its program has failed."""
    stage, bench = double.stage, double.bench
    assert isinstance(stage, MonitoredStage)
    stage.enable()
    stage.home()
    bench.place(FROM_MM)
    stage.move(STROKE)
    while bench.speed_mm_s() < FAST_MM_S - 0.1:
        time.sleep(0.001)
    time.sleep(wait_s)
    from_s, from_mm = time.perf_counter(), bench.position_mm()
    dead = stage.withholding(polls=True, beats=True) if failure is Failure.PROGRAM else nullcontext()
    with dead:
        if failure is Failure.LINK:
            bench.faults.inject(drive_cut_off=True)
        while bench.moving:
            time.sleep(0.0005)
    return time.perf_counter() - from_s, bench.position_mm() - from_mm


def print_wires(rounds: int) -> None:
    """Print a row of a table for each wiring: the longest way after each failure, and what is said of it."""
    random = np.random.default_rng(3)
    run = f"run, {FAST_MM_S:g} mm/s, {FROM_MM:g} to {FROM_MM + STROKE.extremes().highest_mm:g} mm"
    print(f"| wired | found missing | cable fails | said | program killed | said | {run} |")
    print("|---|---|---|---|---|---|---|")
    for name, (lines, faults) in WIRES.items():
        drive = {"homing_speed_mm_s": 50.0}
        hardware = {"drive": drive, "card": {"lines": lines}}
        rig = RigSettings.model_validate({"stage": {"start_mm": FROM_MM}, "hardware": hardware})
        cells, missing, refused = list[str](), set[str](), False
        for failure in (Failure.LINK, Failure.PROGRAM):
            ways = list[tuple[float, float]]()
            for _ in range(rounds):
                double = DoubleBackend(BackendRequest(rig, FrictionModelSettings()))
                double.bench.faults.inject(**faults)
                try:
                    record = look(double, rig)
                    ways.append(way_after(double, failure, float(random.uniform(0.0, 0.3))))
                finally:
                    double.close()
                missing |= {signal.name.split()[0] for signal in record.signals if not signal.passed}
                stops = assess_stops(rig, record, has_timeout=True)
            stop = stops.on_link if failure is Failure.LINK else stops.on_program
            on, limits = RunOn.of(STROKE, rig, stop), stage_limits(rig.stage)
            refused = refused or any(on.violations(failure, STROKE.extremes(), FROM_MM, limits))
            after_s, way_mm = np.max(ways, axis=0)
            said = "end of the stroke" if stop.by_hand else f"{stop.way_mm(FAST_MM_S):.1f} mm"
            cells += [f"{after_s:.2f} s, {way_mm:.1f} mm", said]
        found = ", ".join(sorted(missing)) or "-"
        print(f"| {name} | {found} | {' | '.join(cells)} | {'refused' if refused else 'made'} |", flush=True)


def main() -> None:
    """Print the reaction to each condition."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--rounds", type=int, default=20)
    options.add_argument(
        "--signals", action="store_true", help="faults of force input and encoder in place of the rest"
    )
    options.add_argument("--wires", action="store_true", help="what stops the stage without its program")
    options.add_argument("--mode", choices=("position", "velocity"), default="position", help="for --signals")
    chosen = options.parse_args()
    rounds = chosen.rounds
    if chosen.signals:
        print_signals(rounds, chosen.mode)
        return
    if chosen.wires:
        print_wires(rounds)
        return
    random = np.random.default_rng(1)
    for name, condition in CONDITIONS.items():
        took = []
        for _ in range(rounds):
            double = DoubleBackend(BackendRequest(RIG, FrictionModelSettings()))
            double.bench.place(1.0)
            guard = Guard(RIG.guard)
            guard.reset(double.stage.state())
            double.stage.enable()
            double.stage.home()
            took.append(reaction_s(double, guard, condition, float(random.uniform(0.0, 0.1))))
            double.close()
        times_ms = 1000 * np.array(took)
        print(
            f"{name:22} median {np.median(times_ms):5.1f} ms, worst {times_ms.max():5.1f} ms, in {rounds} rounds; "
            f"{SPEED_MM_S * times_ms.max() / 1000:.2f} mm at {SPEED_MM_S:g} mm/s"
        )


if __name__ == "__main__":
    main()
