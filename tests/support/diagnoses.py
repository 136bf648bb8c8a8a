"""Made-up diagnoses, one for each verdict, for what presents them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from filelock import FileLock

from dragrig.analysis.estimates import EstimatedQuantity, Exclusion
from dragrig.analysis.gap.diagnosis import (
    AxisBin,
    AxisLocation,
    BudgetEntry,
    Diagnosis,
    GapBudget,
    GapLocation,
    GapReduction,
    PhaseCell,
    R2BeforeAfter,
    RankedHypothesis,
    RunContributions,
    RunTraces,
    SteadyLevels,
    UnexplainedGap,
    Verdict,
)
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.present.diagnosis import diagnosis_document
from dragrig.present.document import Document
from dragrig.present.files import svg_text
from dragrig.present.html_page import render_page

BLANK = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1 1" width="1" height="1"/>'


def without_pictures(document: Document, but: str = "") -> Document:
    """Return the document with blank figures but one, for tests of its words: to draw takes most of a page's time."""
    return document.with_drawings(
        {figure.name: svg_text(figure) if figure.name == but else BLANK for figure in document.figures()}
    )


KINDS = ("drag", "coulomb", "relaxation", "blank")
PHASES = ("rest", "accelerate", "steady", "decelerate", "hold")
SPEEDS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0)
FILES = tuple(f"{number:03d}-drag.h5" for number in range(18))


def quantity(name: str, unit: str, value: float, error: float) -> EstimatedQuantity:
    return EstimatedQuantity(name, unit, value, error, (value - 1.96 * error, value + 1.96 * error))


def named(name: str, shares: dict[str, float], p: float = 0.001) -> AxisLocation:
    bins = tuple(
        AxisBin(key, None, None, share, 3.0 * share, p if share > 0.5 else 1.0) for key, share in shares.items()
    )
    return AxisLocation(name, bins, 1.0, None, None, 0.0, p)


def ranged(name: str, edges: list[tuple[float, float]], shares: list[float], p: float = 0.002) -> AxisLocation:
    bins = tuple(AxisBin("", low, high, share, 4.0 * share, p if share > 0.2 else 1.0)
                 for (low, high), share in zip(edges, shares, strict=True))  # fmt: skip
    inside = [at for at, share in enumerate(shares) if share > 0.1]
    if not inside:
        return AxisLocation(name, bins, 1.0, None, None, 0.0, 1.0)
    low, high = edges[inside[0]][0], edges[inside[-1]][1]
    return AxisLocation(name, bins, 0.95, low, high, sum(shares[inside[0] : inside[-1] + 1]), p)


def cells(loud: bool) -> tuple[PhaseCell, ...]:
    rms = {"rest": 0.1, "accelerate": 1.0, "steady": 4.2, "decelerate": 0.9, "hold": 0.2}
    quiet = {"drag": 1.0, "coulomb": 0.5, "relaxation": 0.05, "blank": 0.0}
    return tuple(
        PhaseCell(
            channel, kind, phase, (rms[phase] * quiet[kind] if loud else 0.1) * (1.0 if channel == "force" else 0.1)
        )
        for channel in ("force", "position")
        for kind in KINDS
        for phase in PHASES
    )


def where(present: bool = True) -> GapLocation:
    part = 1.0 if present else 0.0
    speeds = [share * part for share in (0.4, 0.25, 0.14, 0.09, 0.05, 0.03, 0.02, 0.01, 0.01)]
    tenth = [(4.0 * at, 4.0 * at + 4.0) for at in range(10)]
    eighth = [(400.0 * at, 400.0 * at + 400.0) for at in range(8)]
    strains = [(entry, entry) for entry in (0.5, 1.0, 1.5, 2.0)]
    bands = [(0.1, 0.3), (0.3, 1.0), (1.0, 3.0), (3.0, 10.0), (10.0, 100.0)]
    return GapLocation(
        present=present,
        p=0.0005 if present else 0.62,
        rms=3.1 if present else 0.2,
        locations=(
            named("channel", {"force": 0.98 * part, "position": 0.02 * part}),
            named("protocol", {"drag": 0.9 * part, "coulomb": 0.1 * part, "relaxation": 0.0, "blank": 0.0}),
            named("phase", {"rest": 0.0, "accelerate": 0.1 * part, "steady": 0.9 * part, "decelerate": 0, "hold": 0}),
            ranged("speed_mm_s", [(entry, entry) for entry in SPEEDS], speeds),
            ranged("position", tenth, [0.1 * part + 0.001] * 10, 0.6),
            ranged("session", eighth, [0.125 * part] * 8, 0.7),
            ranged("strain", strains, [0.0] * 4),
            ranged("band_hz", bands, [0.7 * part, 0.2 * part, 0.1 * part, 0.0, 0.0]),
        ),
        cells=cells(present),
        domain="speed" if present else "",
        domain_scores={"speed": 0.71, "position": 0.2, "time": 0.1} if present else {},
        permutations=2000,
        seed=0,
    )


def shrink(closed: float | None = 0.993) -> GapReduction:
    return GapReduction(
        gap_before_mN=9.1 if closed is not None else 1.5,
        gap_after_mN=1.6 if closed is not None else 1.5,
        noise_floor_mN=1.4,
        closed=closed,
        closed_95ci=None if closed is None else (0.985, 0.998),
        boundary_mm_s=20.0,
        r2_eq15=R2BeforeAfter(0.7, 0.4, 0.98, 0.97),
        r2_corr=R2BeforeAfter(0.8, None, 0.99, None),
        runs=FILES[:8],
    )


def view(file: str, kind: str, speed_mm_s: float, level_mN: float, gap_mN: float) -> RunTraces:
    travel, rest, hold = (5.0, 1.0, 20.0) if kind == "relaxation" else (40.0, 1.0, 3.0)
    duration = travel / speed_mm_s
    resting, sliding, holding = np.linspace(0.05, 1, 10), np.linspace(0.002, 1, 90), np.linspace(0.01, 1, 50)
    time = np.concatenate([rest * resting, rest + duration * sliding, rest + duration + hold * holding])
    position = np.clip((time - rest) * speed_mm_s, 0.0, travel)
    moving = (time > rest) & (time <= rest + duration)
    after = level_mN * np.where(moving, 1.0, 0.7 * np.exp(-(time - rest - duration) / 3.0) * (time > rest))
    before = after - gap_mN * moving
    measured = after + np.random.default_rng(int(10 * speed_mm_s)).normal(0.0, 0.8, time.size)
    label = {"drag": f"drag at {speed_mm_s:g} mm/s", "coulomb": f"Coulomb friction at {speed_mm_s:g} mm/s",
             "relaxation": "relaxation at 200 %", "blank": f"blank run at {speed_mm_s:g} mm/s"}[kind]  # fmt: skip
    level = level_mN + measured[moving].mean() - after[moving].mean()
    steady = None if kind == "relaxation" else SteadyLevels(speed_mm_s, level, (level_mN - gap_mN, level_mN))
    return RunTraces(file, kind, label, "force", "mN", time, position, measured, before, after, steady)


VIEWS = (
    view("000-relaxation.h5", "relaxation", 20.0, 190.0, 0.0),
    view("004-blank.h5", "blank", 40.0, 0.0, 0.0),
    view("006-coulomb.h5", "coulomb", 0.5, 55.0, 14.0),
    view("008-coulomb.h5", "coulomb", 40.0, 48.0, 0.5),
    *(view(file, "drag", speed, 90.0 + speed / 2, 18.0 * float(np.exp(-speed / 3)))
      for file, speed in zip(FILES, SPEEDS, strict=False)),
)  # fmt: skip

RATIO, SPEED = quantity("ratio", "1", 0.41, 0.05), quantity("speed_mm_s", "mm/s", 2.9, 0.6)

STRIBECK = Diagnosis(
    specimen="jejunum",
    nominal="capsule",
    runs=19,
    used_for_fit=FILES,
    held_out=FILES[:8],
    left_out=(Exclusion("018-drag.h5", "it is marked bad: the gut slipped off the foam"),),
    verdict=Verdict.EFFECT,
    effects=("stribeck",),
    ranking=(
        RankedHypothesis("stribeck", 0.93, (RATIO, SPEED), 0.71),
        RankedHypothesis("adhesion", 0.04, (quantity("force_mN", "mN", 21.0, 4.0),), 0.55),
        RankedHypothesis("film_depletion", 0.02, (), 0.31),
        RankedHypothesis("unknown", 0.009),
        RankedHypothesis("no_gap", 0.001),
    ),
    confusable_with=("adhesion", "film_depletion"),
    residual_unknown=False,
    detection_limit_mN=2.14,
    tolerance_mN=3.0,
    where=where(),
    shrink=shrink(),
    model=FrictionModelSettings(name="paper-jejunum"),
    traces=VIEWS,
    limitations=(
        "No relaxation is held long enough to say anything of extra relaxation.",
        "There is no blank run: payload inertia cannot be told from what the gut does.",
    ),
    remarks=("two runs have no noted contact age",),
    calibration="calibrated on 400 simulated campaigns, each with its own specimen and seed",
)

NO_GAP = replace(
    STRIBECK,
    left_out=(),
    verdict=Verdict.NO_GAP,
    effects=(),
    ranking=(
        RankedHypothesis("no_gap", 0.971),
        RankedHypothesis("unknown", 0.02),
        RankedHypothesis("stribeck", 0.009, (quantity("ratio", "1", 0.01, 0.03),), -0.02),
    ),
    confusable_with=(),
    where=where(present=False),
    shrink=shrink(None),
    model=None,
    limitations=(),
    remarks=(),
)

UNKNOWN = replace(
    STRIBECK,
    verdict=Verdict.UNKNOWN,
    effects=(),
    ranking=(
        RankedHypothesis("unknown", 0.88),
        RankedHypothesis("stribeck", 0.08, (RATIO, SPEED), 0.2),
        RankedHypothesis("no_gap", 0.04),
    ),
    confusable_with=(),
    shrink=None,
    model=None,
    unknown=UnexplainedGap(
        "It lives in the steady force of drag runs, from 0.5 to 5 mm/s",
        "It falls with speed and grows along the stroke",
        "4.1 mN · x / 40 mm − 1.2 mN · ln(v / 1 mm/s)",
        0.62,
    ),
)

TOGETHER = replace(
    STRIBECK,
    verdict=Verdict.SEVERAL,
    effects=("stribeck", "velocity_ripple"),
    ranking=(
        RankedHypothesis(
            "velocity_ripple+stribeck", 0.9996, (RATIO, SPEED, quantity("period_mm", "mm", 20.0, 0.1)), 0.83
        ),
        RankedHypothesis("stribeck", 0.0004, (RATIO, SPEED), 0.5),
    ),
    confusable_with=("adhesion",),
    residual_unknown=True,
    unknown=UnexplainedGap("It lives in the hold after the stop", "It decays with time"),
)

ALL = {"effect": STRIBECK, "no_gap": NO_GAP, "unknown": UNKNOWN, "several": TOGETHER}


def entry(
    cause: str,
    share: float,
    rms_mN: float | None = 5.0,
    presence: float | None = 0.98,
    channel: str = "force",
    what: str = "",
    rivals: tuple[str, ...] = (),
) -> BudgetEntry:
    return BudgetEntry(cause, channel, share, (share - 0.06, share + 0.05), rms_mN, presence, what, rivals)


def contributions(run: RunTraces, channel: str, entries: tuple[BudgetEntry, ...]) -> RunContributions:
    """Return a run whose gap has the parts of a budget, each in proportion to its share."""
    gap = run.after - run.before
    parts = {entry.cause: entry.share * gap for entry in entries if entry.cause != "unexplained"}
    noise, unit = run.measured - run.after, "mN" if channel == "force" else "µm"
    width_s, label = np.gradient(run.time_s), run.label.rpartition(" at ")[2]
    return RunContributions(
        run.file, run.kind, label, channel, unit, run.time_s, width_s, run.position_mm, gap + noise, parts
    )


def budget(*entries: BudgetEntry, gap_mN: float = 12.04) -> GapBudget:
    """Return a budget with its parts in every run of `VIEWS`."""
    presence = {"stribeck": 0.981, "adhesion": 0.12, "velocity_ripple": 0.97}
    channels = {entry.channel: tuple(one for one in entries if one.channel == entry.channel) for entry in entries}
    runs = tuple(contributions(run, channel, here) for channel, here in channels.items() for run in VIEWS)
    return GapBudget(presence, entries, gap_mN, held_out=True, runs=runs)


RIPPLE_AND_AGEING = budget(
    entry("velocity_ripple", 0.5512, 8.9),
    entry("tissue_ageing", 0.2, 5.4, 0.93, rivals=("preconditioning",)),
    entry("unexplained", 0.2488, 6.0, None, what="speed"),
)
STRIBECK_ALONE = budget(
    entry("stribeck", 0.83, 11.0, rivals=("adhesion",)),
    entry("model", 0.06, 3.0, 0.8, what="parameters of the model"),
    entry("unexplained", 0.11, 4.0, None),
)


def page_file(verdict: str, shared: Path) -> Path:
    """Return the page of a verdict with its figures, drawn once for all processes that share a folder."""
    file = shared / f"page of {verdict}.html"
    with FileLock(file.with_suffix(".lock")):
        if not file.exists():
            document = diagnosis_document(ALL[verdict], source="runs/first", model="amended.toml")
            begun = file.with_suffix(".begun")
            begun.write_text(render_page(document), "utf-8")
            begun.rename(file)
    return file
