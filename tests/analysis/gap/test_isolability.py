"""`dragrig gap isolability`: which effects runs tell apart, and how small a one they show."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import dragrig
from diagnoses import BLANK
from dragrig.analysis.gap.isolability import DETECTABLE_D_PRIME, Isolability, order_by_similarity
from dragrig.cli import main
from dragrig.config.plan import Plan
from dragrig.config.settings import to_toml
from dragrig.present.html_page import render_page
from dragrig.present.isolability import isolability_document
from dragrig.sim_backend.effects import catalogue
from places import CAMPAIGN

if TYPE_CHECKING:
    from playwright.sync_api import Browser

SOME = ("stribeck", "folds", "wall_lift_off", "adhesion", "force_drift", "mains_hum")
WITHOUT_OTHERS = tuple(name for name in catalogue() if name not in SOME)
DRAGS = {"kind": "drag", "speed_mm_s": [1.0, 4.0, 30.0], "travel_mm": 12.0}


def plan(*steps: dict[str, object]) -> Plan:
    return Plan.model_validate({"name": "tried", "steps": steps})


@pytest.fixture(scope="module")
def drags() -> Isolability:
    return dragrig.gap_isolability(plan(DRAGS), without=WITHOUT_OTHERS)


def test_runs_show_what_acts_in_them_and_nothing_else(drags: Isolability) -> None:
    blanks = dragrig.gap_isolability(plan({"kind": "blank", "speed_mm_s": [5.0, 40.0], "travel_mm": 20.0}))
    shown = {visibility.effect for visibility in blanks.effects if visibility.smallest is not None}
    assert {"payload_inertia", "arm_compliance", "force_drift", "mains_hum", "servo_lag"} <= shown
    assert {"stribeck", "folds", "extra_relaxation", "wall_lift_off"} <= set(blanks.invisible)
    assert {"stribeck", "folds", "wall_lift_off"} <= {visibility.effect for visibility in drags.visible_in("force")}
    assert blanks.pair("payload_inertia", "stribeck") is None
    assert blanks.pair("payload_inertia", "servo_lag") is None


def test_coulomb_runs_set_friction_apart_from_tack(drags: Isolability) -> None:
    # Tack needs the closed gut; what changes the friction coefficient shows in the open one too.
    both = dragrig.gap_isolability(
        plan(DRAGS, {"kind": "coulomb", "speed_mm_s": [1.0, 4.0, 30.0], "travel_mm": 20.0}), without=WITHOUT_OTHERS
    )
    alone, beside = drags.pair("stribeck", "adhesion"), both.pair("stribeck", "adhesion")
    assert alone is not None
    assert beside is not None
    assert alone.confused
    assert beside.sin2 > 3 * alone.sin2
    assert beside.separation > 2 * alone.separation


def test_more_runs_show_smaller_effects(drags: Isolability) -> None:
    twice = dragrig.gap_isolability(plan({**DRAGS, "repeats": 2}), without=WITHOUT_OTHERS)
    before, after = (
        {visibility.effect: visibility for visibility in isolability.visible_in("force")}
        for isolability in (drags, twice)
    )
    for name in ("stribeck", "wall_lift_off", "adhesion"):
        assert after[name].d_prime > 1.2 * before[name].d_prime
        assert (after[name].smallest or 0) < (before[name].smallest or 0)
    # The smallest size is where d′ comes to what is found nearly always.
    visibility = before["adhesion"]
    assert visibility.smallest is not None
    assert visibility.smallest * visibility.d_prime / visibility.usual == pytest.approx(DETECTABLE_D_PRIME, rel=0.3)


def test_angles_are_shares_and_pairs_come_closest_first(drags: Isolability) -> None:
    assert drags.pairs
    assert all(0 <= pair.sin2 <= min(pair.typical_sin2) + 1e-9 <= 1 + 1e-9 for pair in drags.pairs)
    assert [pair.sin2 for pair in drags.pairs] == sorted(pair.sin2 for pair in drags.pairs)
    d_primes = {visibility.effect: visibility.d_prime for visibility in drags.effects}
    assert all(pair.separation <= min(d_primes[effect] for effect in pair.effects if effect in d_primes) * 1.5
               for pair in drags.pairs if pair.effects == ("stribeck", "adhesion"))  # fmt: skip


def test_near_ones_stand_together() -> None:
    names = ("a", "b", "c", "d")
    near = {frozenset("ac"): 0.1, frozenset("bd"): 0.05}
    sin2 = {frozenset((name, label)): 0.9 for name in names for label in names if name != label} | near
    order = order_by_similarity(names, sin2)
    assert sorted(order) == list(names)
    assert abs(order.index("a") - order.index("c")) == 1
    assert abs(order.index("b") - order.index("d")) == 1


def test_a_campaign_is_told_as_json_and_as_a_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dragrig.present.files.svg_text", lambda _: BLANK)
    report = tmp_path / "apart.html"
    names = [label for name in WITHOUT_OTHERS for label in ("--without", name)]
    assert main(["gap", "isolability", str(CAMPAIGN), "--json", "--quiet", "--report", str(report), *names]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["format"], answer["planned"], answer["duration_s"]) == ("dragrig-isolability", False, None)
    assert sum(answer["runs"].values()) == 8
    assert {"id", "d_prime", "least_seen", "least_seen_mN", "unit"} <= set(answer["effects"][0])
    text = report.read_text("utf-8")
    assert answer["in_words"][0].replace("'", "’")[:40] in text.replace("\u00a0", " ")
    assert 'role="img"' in text
    assert "://" not in text.split("<main>")[0]


def test_a_plan_in_a_file_says_what_it_would_make(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(to_toml(plan(DRAGS)), "utf-8")
    names = [label for name in WITHOUT_OTHERS for label in ("--without", name)]
    assert main(["gap", "isolability", str(file), "--quiet", *names]) == 0
    text = capsys.readouterr().out
    assert "3 drag runs" in text
    assert "adhesion" in text
    assert main(["gap", "isolability", "papr", "--quiet"]) == 2
    assert "paper" in capsys.readouterr().err
    assert main(["gap", "isolability", "paper", "--without", "stribek"]) == 2
    assert "stribeck" in capsys.readouterr().err


def test_the_page_holds_every_effect(drags: Isolability) -> None:
    text = render_page(isolability_document(drags))
    assert "Stribeck friction" in text
    assert "not told apart" in text


def test_the_page_is_presentable(browser: "Browser", drags: Isolability, tmp_path: Path) -> None:
    from browsing import must_be_presentable

    file = tmp_path / "apart.html"
    file.write_text(render_page(isolability_document(drags)), "utf-8")
    must_be_presentable(browser, file)
