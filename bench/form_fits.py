"""The catalogue's effects fitted to what a hidden effect of the plant does, without noise."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
import numpy.typing as npt

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Capsule, Fixture
from dragrig.config.specimen import Specimen as Described
from dragrig.rig.devices import Acquisition, Contact
from dragrig.rig.profile import MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.sim_backend.blind import BlindCampaign, draw_campaign, without_effects
from dragrig.sim_backend.blind.blind_campaign import HiddenSpecimen, RunVariation
from dragrig.sim_backend.blind.effects.hidden_effect import HiddenEffect as Hidden
from dragrig.sim_backend.blind.plant import PlantRecord, noise_free_run
from dragrig.sim_backend.blind.run_plans import RunPlan
from dragrig.sim_backend.effects.base import Channel, Effect, find_effect
from dragrig.sim_backend.effects.run_state import RunState, gut_run_state
from dragrig.sim_backend.friction.motion import ProfileMotion

Floats = npt.NDArray[np.float64]
STARTS, STEPS = 4, 40
WAVES = {"mm": 300, "s": 3000}
"""Periods that are tried, evenly in their inverse: as close as a stroke, or a session, tells apart."""
MET = {
    "drag": (Fixture.FOAM, Contact.SLIDING),
    "coulomb": (Fixture.VACUUM, Contact.SLIDING),
    "relaxation": (Fixture.FOAM, Contact.STICKING),
    "blank": (Fixture.NONE, Contact.NONE),
}
CAPSULE = Capsule(name="plant", surface="smooth", diameter_mm=12.9, length_mm=15.2, mass_g=50.1)


@dataclass(frozen=True)
class Seen:
    """One run of the plant without effects, at chosen samples, and the catalogue's scene of it."""

    index: int
    bare: PlantRecord
    chosen: npt.NDArray[np.intp]

    @property
    def plan(self) -> RunPlan:
        """What is run."""
        return self.bare.run

    @cached_property
    def root(self) -> Floats:
        """Roots of the samples' parts of the run, shape `(n,)`."""
        return np.asarray(np.sqrt(np.gradient(self.bare.time[self.chosen]) / self.bare.time[-1]))

    def everywhere(self, at_chosen: Floats) -> Floats:
        """Return what is known at the chosen samples at all of them, shape `(n,)` to `(N,)`, without overshoot."""
        from scipy.interpolate import PchipInterpolator

        with np.errstate(over="ignore"):  # slopes of what has all but faded
            return np.asarray(PchipInterpolator(self.bare.time[self.chosen], at_chosen)(self.bare.time))

    @cached_property
    def scene(self) -> RunState:
        """What the catalogue sees, times counted from the first sample."""
        plan = self.plan
        moves = trapezoid(plan.travel_mm, plan.speed_mm_s, plan.accel_mm_s2)
        profile = MotionProfile.from_pieces(
            (stationary_piece(plan.rest_s, Phase.REST), *moves, stationary_piece(plan.hold_s, Phase.HOLD))
        )
        fixture, contact = MET[plan.kind]
        specimen = Described(name="plant")
        made = Acquisition(plan.kind, plan.order, plan.kind, profile, CAPSULE, specimen, fixture, contact, 60.0)
        made = replace(made, shear_strain=plan.strain) if plan.strain is not None else made
        times = np.minimum(self.bare.time[self.chosen], profile.duration_s)
        return gut_run_state(made, FrictionModelSettings(), ProfileMotion.of(profile), times, plan.start_s)


def nominal(seed: int) -> BlindCampaign:
    """Return a campaign of the published specimen in which no run has anything of its own."""
    secret = draw_campaign(seed)
    usual = HiddenSpecimen(1.0, (1.0, 1.0, 1.0, 1.0, 1.0), 0.082, 1.0, 60.0, 1.0, 60.0)
    return replace(secret, specimen=usual, variations=tuple(RunVariation(1.0, 1.0, 0.0) for _ in secret.runs))


def seen_of(secret: BlindCampaign, *, fine_s: float, shortest: int | None = None) -> list[Seen]:
    """Return the runs, each condition once, at samples that are close for `fine_s` after each event.

    Relaxations, whose forces are large, and the runs of a choice of the `shortest` have all samples.
    """
    conditions = {(run.kind, run.speed_mm_s, run.strain): at for at, run in reversed(list(enumerate(secret.runs)))}
    indices = sorted(conditions.values(), key=lambda at: secret.runs[at].samples)[:shortest]
    bare = without_effects(secret)
    result = []
    for at in indices:
        trace = noise_free_run(bare, at)
        every = shortest is not None or secret.runs[at].kind == "relaxation"
        chosen = np.arange(trace.time.size) if every else _samples(secret.runs[at], trace.time, fine_s)
        result.append(Seen(at, trace, chosen))
    return result


def _samples(run: RunPlan, times: Floats, fine_s: float) -> npt.NDArray[np.intp]:
    """Return samples that follow every event closely, then further and further apart, and every 0.2 mm of the way."""
    count = np.abs(np.minimum(times, run.bounds_s[3])) * run.peak_mm_s / 0.2 + times / 0.2
    for edge in run.bounds_s:
        since = times - edge
        count = count + np.where(since > -0.004, np.clip(since, 0.0, fine_s) / 0.002, 0.0)
        count = count + np.where(since > fine_s, np.log(np.maximum(since, fine_s) / fine_s) * 60, 0.0)
    about = np.searchsorted(times, run.bounds_s)[:, None] + np.arange(-3, 4)
    chosen = np.flatnonzero(np.diff(np.floor(count), prepend=-1.0) > 0)
    return np.union1d(chosen, np.clip(about, 0, times.size - 1))


def changed(effect: Effect, seen: Seen, values: Mapping[str, float]) -> Floats:
    """Return what the catalogue's effect changes in its channel, shape `(n,)`."""
    run = seen.scene
    if effect.channel is Channel.FORCE:
        return effect.force_change(run, values)
    return effect.position_change(run.time_s, run.position_mm, values)


def hidden_change(secret: BlindCampaign, hidden: Hidden, seen: Seen) -> Floats:
    """Return the signature of a hidden effect in the channel that it shows in, at all `N` samples."""
    with_it = noise_free_run(replace(secret, effects=(hidden,), sizes=(1.0,)), seen.index)
    channel = find_effect(hidden.name).channel
    entry, second = (
        (with_it.force, seen.bare.force) if channel is Channel.FORCE else (with_it.position, seen.bare.position)
    )
    return entry - second


def bounds(effect: Effect) -> tuple[Floats, Floats]:
    """Return the ranges of all parameters: the prior's, for a size of either sign a wide one."""
    low, high = np.array([[parameter.low, parameter.high] for parameter in effect.parameters]).T
    size = [parameter.name for parameter in effect.parameters].index(effect.size.name)
    if low[size] < 0:
        low[size], high[size] = min(low[size], -20 * effect.size.default), max(high[size], 20 * effect.size.default)
    return low, high


def left(effect: Effect, runs: Sequence[Seen], targets: Sequence[Floats]) -> tuple[float, dict[str, float]]:
    """Return the share of the norm that the best fit leaves, and its parameters."""
    from scipy.optimize import least_squares

    names = [parameter.name for parameter in effect.parameters]
    unit = np.array([abs(parameter.default) or 1.0 for parameter in effect.parameters])
    low, high = (bound / unit for bound in bounds(effect))
    size = names.index(effect.size.name)
    target = np.concatenate([run.root * wanted for run, wanted in zip(runs, targets, strict=True)])
    norm = float(np.linalg.norm(target))
    if norm == 0:
        return float("nan"), {}

    def residual(scaled: Floats) -> Floats:
        values = dict(zip(names, (scaled * unit).tolist(), strict=True))
        return np.asarray((np.concatenate([run.root * changed(effect, run, values) for run in runs]) - target) / norm)

    starts: list[tuple[float, Floats]] = []
    for values in _starts(effect):
        scaled = np.array([values[name] for name in names]) / unit
        at_start = residual(scaled) + target / norm
        square = float(at_start @ at_start)
        factor = float(at_start @ target) / norm / square if square > 0 else 1.0
        scaled[size] = np.clip(scaled[size] * factor, low[size], high[size])
        change = scaled[size] * unit[size] / values[effect.size.name] * at_start
        starts.append((float(np.linalg.norm(change - target / norm)), scaled))
    best, fitted = np.inf, starts[0][1]
    inside = 1e-6 * (high - low)
    for scaled in _apart(starts):
        begin = np.clip(scaled, low + inside, high - inside)
        result = least_squares(residual, begin, bounds=(low, high), max_nfev=STEPS, x_scale=np.maximum(abs(begin), 0.1))
        if np.sqrt(2 * result.cost) < best:
            best, fitted = float(np.sqrt(2 * result.cost)), result.x
    return best, dict(zip(names, (fitted * unit).tolist(), strict=True))


def _starts(effect: Effect) -> Iterator[dict[str, float]]:
    """Yield parameters with all shapes that a diagnosis looks at; of what is periodic, many periods and phases."""
    grids = {shape.name: shape.start_values for shape in effect.shapes}
    if effect.phase is not None:
        grids[effect.phase.name] = tuple((np.arange(6) * np.pi / 3 - 0.9 * np.pi).tolist())
        period = effect.shapes[0]
        if period.unit in WAVES:
            grids[period.name] = tuple((1 / np.linspace(1 / period.low, 1 / period.high, WAVES[period.unit])).tolist())
    for chosen in product(*grids.values()):
        yield {**effect.defaults, **dict(zip(grids, chosen, strict=True))}


def _apart(starts: list[tuple[float, Floats]]) -> Iterator[Floats]:
    """Yield the best starts, of those that differ by little only the best."""
    taken: list[Floats] = []
    for _, scaled in sorted(starts, key=lambda first: first[0]):
        if all((np.abs(scaled - second)[1:] > 0.004 * np.abs(second[1:])).any() for second in taken):
            taken.append(scaled)
            yield scaled
        if len(taken) == STARTS:
            return


def left_run_by_run(effect: Effect, runs: Sequence[Seen], targets: Sequence[Floats]) -> tuple[float, dict[str, float]]:
    """Return the share that is left where every run has a phase, and so parameters, of its own."""
    result = [left(effect, [run], [wanted]) for run, wanted in zip(runs, targets, strict=True)]
    squares = np.array([float(np.sum((run.root * two) ** 2)) for run, two in zip(runs, targets, strict=True)])
    shares = np.array([share for share, _ in result])
    return float(np.sqrt((shares**2 @ squares) / squares.sum())), result[0][1]
