"""What stops a stage past its serial link: proven by taking it away, told where it is not, and runs refused without."""

import re
import threading
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import CommissioningRecord, RigCheck, RigSettings
from dragrig.rig.commissioning import MOTION_PROMPT, STANDSTILL_PROMPT, look_at_rig
from dragrig.rig.devices import BackendRequest, StageLimits
from dragrig.rig.hardware.drive.stage_base import MonitoredStage
from dragrig.rig.hardware.lines import CardLines
from dragrig.rig.operator import Answer, Prompt
from dragrig.rig.stops import HAND_S, RELEASE_S, RunOn, Stops, assess_stops, check_stops
from dragrig.sim_backend.doubles.backend import DoubleBackend
from dragrig.sim_backend.doubles.simulated_bench import FaultInjector
from driving import Stall, driven, unhindered, until
from property_tests import thorough
from simulated import stroke

HEARTBEAT = {"heartbeat": "port1/line4"}
LIMITS = StageLimits(0.0, 150.0, 100.0, 3000.0)


def rig_of(silence_s: float = 0.5, mode: str = "position", **lines: object) -> RigSettings:
    hardware = {"drive": {"silence_s": silence_s, "mode": mode, "reply_s": 0.2}, "card": {"lines": lines}}
    return RigSettings.model_validate({"hardware": hardware})


def record(**seen_s: float) -> CommissioningRecord:
    """What a look found: the time of each stop, 0 for one that was not tried, negative for one that is missing."""
    signals = [
        RigCheck(name=name, passed=took_s >= 0, detail="", after_s=max(took_s, 0.0)) for name, took_s in seen_s.items()
    ]
    return CommissioningRecord(
        made_at=datetime(2026, 1, 1, tzinfo=UTC), made_on="hardware", wiring="", signals=tuple(signals)
    )


def assessed(rig: RigSettings, *, has_timeout: bool = True, **seen_s: float) -> Stops:
    return assess_stops(rig, record(**seen_s) if seen_s else None, has_timeout=has_timeout)


def beyond(stops: Stops, rig: RigSettings, start_mm: float, travel_mm: float, speed_mm_s: float) -> list[str]:
    """Why a stroke is refused."""
    profile = stroke(travel_mm, speed_mm_s, 500.0)
    return [
        text
        for failure, stop in stops
        for text in RunOn.of(profile, rig, stop).violations(failure, profile.extremes(), start_mm, LIMITS)
    ]


# ---- what a record makes of the settings -------------------------------------------------------------------------


def test_before_anybody_has_looked_the_settings_claim_the_drives_own_timeout() -> None:
    stops = assessed(rig_of(**HEARTBEAT))
    assert stops.on_link == stops.on_program
    assert (stops.on_link.after_s, stops.on_link.proven) == (0.5, False)


def test_of_what_is_proven_the_soonest_counts_and_what_is_missing_does_not() -> None:
    rig = rig_of(**HEARTBEAT)
    stops = assessed(rig, watchdog=0.5, relay=0.15, enable=0.01)
    assert (stops.on_program.after_s, stops.on_link.after_s) == (0.15, 0.5)
    stops = assessed(rig, watchdog=-1, relay=0.4, enable=-1)
    # With the link gone, the relay sees no edge only once the drive was not heard for its time.
    assert (stops.on_program.after_s, stops.on_link.after_s) == (0.4, pytest.approx(0.5 + RELEASE_S + 0.4))
    assert stops.on_link.proven
    stops = assessed(rig, watchdog=-1, relay=-1, enable=0.01)
    assert stops.on_program.by_hand
    assert stops.on_link.after_s == pytest.approx(0.5 + RELEASE_S + 0.01)


def test_a_stop_that_failed_once_in_motion_or_at_rest_is_missing() -> None:
    rig = rig_of(enable="")
    assert assessed(rig, **{"watchdog": 0.0, "watchdog in motion": 0.5}).on_link.proven
    missing = assessed(rig, **{"watchdog": 0.0, "watchdog in motion": -1}).on_link
    assert missing.by_hand
    assert "its silence timeout did not stop it, no heartbeat relay is set, no enable line is set" in missing.ends


def test_a_drive_without_a_timeout_is_left_to_what_is_wired() -> None:
    stops = assessed(rig_of(**HEARTBEAT), has_timeout=False)
    assert stops.on_program.after_s == pytest.approx(0.15)
    bare = assessed(rig_of(enable=""), has_timeout=False)
    assert bare.on_link.by_hand
    assert "the drive has no silence timeout" in bare.on_link.ends


# ---- what is refused ----------------------------------------------------------------------------------------------


def test_where_nothing_is_proven_missing_a_stroke_ends_where_it_was_sent() -> None:
    rig = rig_of()
    assert beyond(assessed(rig), rig, 5.0, 140.0, 40.0) == []


def test_where_nothing_stops_the_drive_a_run_is_refused_with_the_speed_that_is_allowed_and_the_wire_to_add() -> None:
    rig = rig_of(enable="")
    (text,) = beyond(assessed(rig, watchdog=-1), rig, 5.0, 130.0, 20.0)
    assert "would go on to 235.4 mm, beyond the limit of 150 mm" in text
    assert "the program is stopped or killed, or the serial cable fails" in text
    assert f"for which {HAND_S:g} s count" in text
    assert "lower its speed to 2.9 mm/s" in text
    assert "wire a heartbeat relay into its power (hardware.card.lines.heartbeat)" in text
    assert beyond(assessed(rig, watchdog=-1), rig, 5.0, 130.0, 2.9) == []


def test_a_relays_own_time_is_part_of_the_way() -> None:
    rig = rig_of(**HEARTBEAT)
    slow = assessed(rig, watchdog=-1, relay=0.4, enable=-1)
    # 1.0 s after the cable, and what the stage coasts.
    assert slow.on_link.way_mm(40.0) == pytest.approx(40.0 + 3.2)
    (text,) = beyond(slow, rig, 20.0, 100.0, 40.0)
    assert "would go on to 1" in text
    assert "its heartbeat relay opens, 0.4 s after the last edge" in text
    assert "a faster relay" in text
    assert beyond(slow, rig, 20.0, 80.0, 40.0) == []
    assert beyond(assessed(rig, watchdog=-1, relay=0.15, enable=-1), rig, 20.0, 100.0, 40.0) == []


@given(
    relay_s=st.floats(0.3, 3.0), speed_mm_s=st.floats(1.0, 100.0), travel_mm=st.floats(-60.0, 60.0),
    start_mm=st.floats(61.0, 89.0), mode=st.sampled_from(["position", "velocity"]),
)  # fmt: skip
def test_the_speed_that_a_refusal_names_is_allowed(
    relay_s: float, speed_mm_s: float, travel_mm: float, start_mm: float, mode: str
) -> None:
    rig = rig_of(mode=mode, **HEARTBEAT)
    stops = assessed(rig, watchdog=-1, relay=relay_s, enable=-1)
    if abs(travel_mm) < 1.0:
        return
    for text in beyond(stops, rig, start_mm, travel_mm, speed_mm_s):
        named = re.search(r"lower its speed to ([\d.]+) mm/s", text)
        if named is not None:
            allowed = float(named[1])
            assert 0 < allowed < speed_mm_s
            assert len(beyond(stops, rig, start_mm, travel_mm, allowed)) < len(
                beyond(stops, rig, start_mm, travel_mm, speed_mm_s)
            )


def test_the_check_of_a_rig_fails_where_nothing_but_a_person_is_left() -> None:
    rig = rig_of(enable="")
    untried = check_stops(rig, assessed(rig))
    assert untried.passed
    assert "52 mm" in untried.detail
    assert "untried: without it to an end of its travel" in untried.detail
    proven = check_stops(rig, assessed(rig, watchdog=0.5))
    assert proven.passed
    assert "untried" not in proven.detail
    bare = check_stops(rig, assessed(rig, watchdog=-1))
    assert not bare.passed
    assert "to an end of its travel" in bare.detail
    assert "wire a heartbeat relay" in bare.detail


# ---- what is said is what happens ---------------------------------------------------------------------------------

WIRINGS: list[tuple[dict[str, object], dict[str, float | bool], dict[str, float]]] = [
    ({"enable": ""}, {}, {"watchdog": 0.5}),
    ({"enable": "port1/line0"}, {"drive_unwatched": True}, {"watchdog": -1, "enable": 0.01}),
    thorough(
        {"enable": "port1/line0"},
        {"drive_unwatched": True, "enable_opens_s": 0.3},
        {"watchdog": -1, "enable": 0.3},
    ),
    (
        {"enable": "", **HEARTBEAT},
        {"drive_unwatched": True, "relay_opens_s": 0.4},
        {"watchdog": -1, "relay": 0.4},
    ),
]


@pytest.mark.parametrize(("lines", "faults", "seen_s"), WIRINGS)
def test_the_way_after_a_dead_cable_is_what_the_check_says(
    lines: dict[str, object], faults: dict[str, float | bool], seen_s: dict[str, float]
) -> None:
    speed_mm_s = 40.0

    def measured_way() -> tuple[float, float]:
        with driven(lines=lines, silence_s=0.5, reply_s=0.1) as rig:
            rig.bench.faults.inject(**faults)
            rig.ready().stage.move(stroke(travel_mm=145.0, speed_mm_s=speed_mm_s))
            until(lambda: rig.bench.speed_mm_s() > 0.99 * speed_mm_s)
            at_mm = rig.bench.position_mm()
            rig.bench.faults.inject(drive_cut_off=True)
            until(lambda: not rig.bench.moving)
            way_mm = rig.bench.position_mm() - at_mm
            return way_mm, assessed(rig.bench.rig, **seen_s).on_link.way_mm(speed_mm_s)

    way_mm, said_mm = unhindered(measured_way, lambda ways: 0.7 * ways[1] < ways[0] <= ways[1])
    assert 0.7 * said_mm < way_mm <= said_mm + 0.02 * speed_mm_s


def test_without_any_of_them_a_dead_cable_leaves_the_stage_to_the_end_of_its_stroke() -> None:
    with driven(lines={"enable": "port1/line0"}, silence_s=0.5, reply_s=0.1) as rig:
        rig.bench.faults.inject(drive_unwatched=True, enable_not_wired=True)
        rig.ready().stage.move(stroke(travel_mm=60.0, speed_mm_s=50.0))
        until(lambda: rig.bench.speed_mm_s() > 45.0)
        rig.bench.faults.inject(drive_cut_off=True)
        until(lambda: not rig.bench.moving)
        assert rig.bench.position_mm() == pytest.approx(60.0, abs=0.01)
        assert assessed(rig.bench.rig, watchdog=-1, enable=-1).on_link.by_hand


# ---- how it is proven ---------------------------------------------------------------------------------------------


class Looked:
    """A look at a rig on doubles, or its trials alone, and how far the stage moved in the longest of these."""

    def __init__(
        self,
        rig: RigSettings,
        *,
        trials: Sequence[bool] = (),
        skip: bool = False,
        homed: bool = False,
        pace: float = 1.0,
        **faults: float | bool,
    ) -> None:
        injector = FaultInjector()
        backend = DoubleBackend(BackendRequest(rig, FrictionModelSettings(), connect=homed, pace=pace), injector)
        self.asked: list[str] = []
        positions_mm: list[float] = []

        def answer(prompt: Prompt) -> Answer:
            self.asked.append(prompt.text)
            if prompt.text == STANDSTILL_PROMPT:
                positions_mm[:] = [backend.bench.position_mm()]
            return Answer.SKIP if skip and prompt.can_skip else Answer.DONE

        try:
            if homed:
                backend.bench.place(3.0)
                backend.stage.enable()
                backend.stage.home()
                backend.stage.disable()
            injector.inject(**faults)
            self.found: dict[str, RigCheck] = {}
            positions_mm.append(backend.bench.position_mm())
            alone = (finding for in_motion in trials for finding in backend.try_stops(in_motion=in_motion))
            for finding in alone if trials else look_at_rig(backend, rig, answer):
                self.found[finding.name] = finding
                positions_mm.append(backend.bench.position_mm())
            assert not backend.drive.status.enabled
            assert not backend.bench.moving
        finally:
            backend.close()
        self.furthest_mm = max(abs(end - begin) for begin, end in pairwise(positions_mm))


LATE_BEATS = "the heartbeat came late"


def looked_in_time(late: str = "", **choices: Any) -> Looked:
    """Look again where this busy machine held the heartbeat up by itself, as a person is told to."""
    for _ in range(8):
        looked = Looked(rig_of(**HEARTBEAT), **choices)
        late_names = {name.split()[0] for name, finding in looked.found.items() if LATE_BEATS in finding.detail}
        if late_names == {late} - {""}:
            return looked
    pytest.fail(f"late beats in the trials of {late_names}")


def test_what_stops_the_drive_is_proven_with_its_time_at_rest_and_at_1_mm_s() -> None:
    with Stall() as stall:
        looked = looked_in_time(trials=[False, True], relay_opens_s=0.4, enable_opens_s=0.2)
    late_s = 0.1 + 3 * stall.longest_s
    assert all(finding.passed for finding in looked.found.values()), looked.found
    for name, took_s in (("enable", 0.2), ("relay", 0.4), ("watchdog", 0.5)):
        moving = looked.found[f"{name} in motion"]
        assert took_s - 0.01 <= moving.after_s <= took_s + late_s
        assert " mm on" in moving.detail
    assert 0.19 <= looked.found["enable"].after_s <= 0.2 + late_s
    assert 0.39 <= looked.found["relay"].after_s <= 0.4 + late_s
    assert looked.found["watchdog"].after_s == 0
    assert looked.furthest_mm <= 2.0


@pytest.mark.parametrize("homed", [False, thorough(True)])
def test_wires_that_are_not_there_are_found_each_by_itself(homed: bool) -> None:
    unwired = {"enable_not_wired": True, "relay_not_wired": True, "drive_unwatched": True}
    looked = looked_in_time(trials=[False, True], homed=homed, **unwired)
    failed = {name: finding.detail for name, finding in looked.found.items() if not finding.passed}
    assert set(failed) == {"enable", "enable in motion", "relay", "relay in motion", "watchdog in motion"}
    assert "stays on when port1/line0 goes low" in failed["enable in motion"]
    assert "stays on without edges on port1/line4" in failed["relay in motion"]
    assert "went on for" in failed["watchdog in motion"]
    assert looked.furthest_mm <= 2.0


@pytest.mark.parametrize(
    ("trials", "faults", "missing"),
    [
        ([True], {"enable_not_wired": True, "drive_unwatched": True}, {"enable in motion", "watchdog in motion"}),
        thorough([False], {"enable_not_wired": True, "drive_unwatched": True}, {"enable"}),
        thorough([False, True], {"relay_not_wired": True}, {"relay", "relay in motion"}),
    ],
)
def test_a_wire_that_is_there_is_no_proof_of_another(
    trials: list[bool], faults: dict[str, bool], missing: set[str]
) -> None:
    """Where only the relay works, the enable line is not held to work, nor the drive's own timeout."""
    looked = looked_in_time(trials=trials, **faults)
    assert {name for name, finding in looked.found.items() if not finding.passed} == missing


@pytest.mark.parametrize("in_motion", [True, thorough(False)])
@pytest.mark.parametrize("tried", ["enable", "watchdog"])
def test_a_stop_that_late_beats_made_is_no_proof_of_another(
    monkeypatch: pytest.MonkeyPatch, tried: str, in_motion: bool
) -> None:
    """As of a computer that stands still while enable line or silence timeout, which do nothing, are tried."""
    set_enable, withholding, trying = CardLines.set_enable, MonitoredStage.withholding, threading.Event()

    def try_enable(lines: CardLines, on: bool) -> None:
        set_enable(lines, on)
        trying.set() if not on and tried == "enable" else trying.clear()

    def try_silence(stage: MonitoredStage, **kept: bool) -> AbstractContextManager[None]:
        if "polls" in kept and tried == "watchdog":
            trying.set()
        return withholding(stage, **kept)

    def has_heartbeat(_: CardLines) -> bool:
        """Hold up the thread that beats, which asks this before."""
        if trying.is_set() and threading.current_thread() is not threading.main_thread():
            time.sleep(0.6)
        return True

    monkeypatch.setattr(CardLines, "set_enable", try_enable)
    monkeypatch.setattr(MonitoredStage, "withholding", try_silence)
    monkeypatch.setattr(CardLines, "has_heartbeat", property(has_heartbeat))
    faults = {"enable_not_wired": tried == "enable", "drive_unwatched": True}
    looked = looked_in_time(trials=[in_motion], late=tried, **faults)
    found = looked.found[f"{tried} in motion" if in_motion else tried]
    assert not found.passed
    assert LATE_BEATS in found.detail


def test_a_person_may_keep_the_stage_from_moving_and_then_the_timeout_stays_untried() -> None:
    looked = Looked(rig_of(), skip=True, pace=5.0)
    assert looked.asked[-2:] == [STANDSTILL_PROMPT, MOTION_PROMPT]
    assert not any("in motion" in name for name in looked.found)
    assert "shows in motion only" in looked.found["watchdog"].detail
    stops = assessed(rig_of(), **{name: finding.after_s for name, finding in looked.found.items()})
    assert not stops.on_program.proven


def test_a_patient_timeout_is_tried_more_slowly_over_the_same_way() -> None:
    with Stall() as stall:
        looked = Looked(rig_of(silence_s=1.5, enable=""), trials=[True])
    assert looked.found["watchdog in motion"].passed
    assert 1.4 <= looked.found["watchdog in motion"].after_s <= 1.6 + 3 * stall.longest_s
    assert looked.furthest_mm <= 2.0


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ({"e_stop_pressed": True}, "emergency stop is pressed"),
        thorough({"drive_alarm": "overcurrent"}, "see what else stopped it"),
    ],
)
def test_what_else_stops_the_drive_while_nobody_asks_it_is_no_proof_of_its_timeout(
    fault: dict[str, bool | str], said: str
) -> None:
    rig, injector = rig_of(silence_s=2.0, enable=""), FaultInjector()
    backend = DoubleBackend(BackendRequest(rig, FrictionModelSettings(), connect=False), injector)

    def strike() -> None:
        until(lambda: backend.bench.moving)
        time.sleep(0.5)
        injector.inject(**fault)

    striking = threading.Thread(target=strike)
    striking.start()
    try:
        (finding,) = backend.try_stops(in_motion=True)
        assert not finding.passed
        assert said in finding.detail
        assert not backend.bench.moving
    finally:
        striking.join()
        backend.close()
