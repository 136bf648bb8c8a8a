"""Moving the stage by hand from a program: the rig opened, a person asked, and everything switched off at the end."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import TypeVar, Unpack

from dragrig.backends import open_backend
from dragrig.config.errors import AbortedError, DeviceError, SettingsError
from dragrig.config.lab import ContactPoint
from dragrig.hosting import HandedOver, host
from dragrig.pacing import Pace, pacing
from dragrig.rig import contact
from dragrig.rig.backend import Backend, BackendRequest
from dragrig.rig.devices import Side
from dragrig.rig.engine import Engine
from dragrig.rig.guard import Guard
from dragrig.rig.manual import Manual, require_approach, require_jog
from dragrig.rig.people import Nobody, Operator
from dragrig.rig.readiness import park
from dragrig.rig.trips import Trip
from dragrig.rigs import RigChoices, RigSetup, resolve_rig

ResultT = TypeVar("ResultT")


@dataclass(frozen=True, slots=True)
class Bench:
    """An open rig, and what moves it by hand."""

    setup: RigSetup
    backend: Backend
    manual: Manual


@dataclass(frozen=True, slots=True)
class Moved:
    """Where the stage is [mm], and what the guard is tripped on still."""

    position_mm: float
    trip: Trip | None = None


def home(
    *,
    override: Side | None = None,
    pace: Pace | None = None,
    person: Operator | None = None,
    **choices: Unpack[RigChoices],
) -> Moved:
    """Find the stage's origin.

    Parameters
    ----------
    override
        Side whose limit switch is pressed and may be.
    pace
        Of a simulated rig, or of a double.
    person
        Who is asked before anything moves; nobody unless given, which will not do where hands are needed.
    choices
        As of `examine`.

    Raises
    ------
    AbortedError, TrippedError, DeviceError, SettingsError
        With the stage stopped and switched off.
    """

    def work(bench: Bench) -> Moved:
        if override is None:
            bench.manual.reset()
        return Moved(bench.manual.home(override), bench.manual.trip)

    return at_the_bench(work, resolve_rig(**choices), pace, person)


def jog(
    distance_mm: float,
    speed_mm_s: float | None = None,
    *,
    override: Side | None = None,
    pace: Pace | None = None,
    person: Operator | None = None,
    **choices: Unpack[RigChoices],
) -> Moved:
    """Move the stage by a signed distance; the rest as of `home` and `Manual.jog`."""

    def work(bench: Bench) -> Moved:
        if override is None:
            bench.manual.reset()
        return Moved(bench.manual.jog(distance_mm, speed_mm_s, override), bench.manual.trip)

    setup = resolve_rig(**choices)
    # Looked at before anybody is asked to do anything; so below.
    require_jog(distance_mm, speed_mm_s, override, setup.limits)
    return at_the_bench(work, setup, pace, person)


def touch_off(
    most_mm: float,
    *,
    force_mN: float = 20.0,
    speed_mm_s: float = 1.0,
    back_mm: float = 0.0,
    operator: str = "",
    pace: Pace | None = None,
    person: Operator | None = None,
    **choices: Unpack[RigChoices],
) -> ContactPoint:
    """Approach slowly until the force changes, and keep the contact in the lab folder; the rest as of `home`.

    Raises
    ------
    SettingsError
        Outside of a lab folder, too: nothing moves then.
    """
    setup = resolve_rig(**choices)
    folder = setup.rig_folder
    if folder is None:
        raise SettingsError("touch-off: there is no lab folder to keep the contact in; make one with dragrig init.")
    require_approach(force_mN, speed_mm_s, most_mm, back_mm, setup.limits)

    def work(bench: Bench) -> ContactPoint:
        bench.manual.reset()
        found = bench.manual.touch_off(force_mN, speed_mm_s, most_mm, back_mm)
        now = bench.backend.clock.now()
        kept = ContactPoint(
            position_mm=round(found.position_mm, 4), made_at=now, force_mN=round(found.force_mN, 2), operator=operator
        )
        contact.write(folder, kept)
        return kept

    return at_the_bench(work, setup, pace, person)


def at_the_bench(
    work: Callable[[Bench], ResultT], setup: RigSetup, pace: Pace | None = None, person: Operator | None = None
) -> ResultT:
    """Open a rig, do some work on it with Ctrl-C heard and people asked on the calling thread, and switch it off.

    Raises
    ------
    AbortedError
        When somebody ended it.
    DragrigError
        What the work raises; when the rig cannot be opened or switched off, too.
    """
    paced, operator = pacing(pace, double=setup.double), HandedOver(person or Nobody())
    request = BackendRequest(
        setup.rig, setup.model, paced.real_time, None, setup.calibrations(), pace=paced.times_faster
    )
    with closing(open_backend(setup.backend, request, double=setup.double)) as backend:
        guard = Guard(setup.rig.guard, 1e-3 * setup.rig.encoder.resolution_um)
        engine = Engine(backend, setup.rig, guard)
        bench = Bench(setup, backend, Manual(backend, guard, engine, operator))
        try:
            done = host(lambda: work(bench), engine.abort, operator)
        except (AbortedError, DeviceError) as error:
            if engine.cancelled.is_set():
                raise AbortedError(f"ended early ({engine.abort_reason}): the stage is stopped, and off.") from error
            raise
        finally:
            failures = park(backend)
        if failures:
            raise DeviceError(f"{'; '.join(failures)}.")
        return done
