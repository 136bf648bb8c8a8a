"""What holds for every effect of the catalogue, whatever it is."""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from dragrig.sim_backend.effects.base import (
    Channel,
    Effect,
    EncoderEffect,
    ForceEffect,
    MotorEffect,
    Role,
    SensorEffect,
    catalogue,
    confusable_effects,
    similar_effects,
)
from dragrig.sim_backend.effects.run_state import RunState
from effect_scenes import KINDS, changed, scene, sized
from places import ROOT

EFFECTS = tuple(catalogue().values())
every = pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
STOPPED_S = 1.3


@cache
def seen(kind: str) -> RunState:
    return scene(kind)


@every
def test_it_says_what_it_is(effect: Effect) -> None:
    roles = [parameter.role for parameter in effect.parameters]
    assert roles.count(Role.SIZE) == 1
    assert roles.count(Role.PHASE) <= 1
    assert isinstance(effect, ForceEffect | SensorEffect | MotorEffect | EncoderEffect)
    assert effect.summary.endswith(".")
    assert effect.source
    for parameter in effect.parameters:
        assert parameter.low <= parameter.default <= parameter.high, parameter.name
        assert all(parameter.low <= value <= parameter.high for value in parameter.grid), parameter.name
        assert parameter.unit == "1" or "_" in parameter.name, parameter.name
    assert effect.size.low <= 0


@every
def test_its_declarations_agree(effect: Effect) -> None:
    known = catalogue()
    assert {*effect.confused_with, *effect.similar_to} <= known.keys() - {effect.id}
    assert (effect.phase is None) == (effect.period is None)
    assert effect.spectral_line <= (effect.period is not None)
    assert effect.moves_stage <= (effect.channel is Channel.POSITION)
    assert (effect.position_form is not None) == (Channel.POSITION in effect.channels)
    for second in effect.similar_to:
        assert effect.id in similar_effects(second)
    for second in effect.confused_with:
        assert effect.id in confusable_effects(second)


@every
@pytest.mark.parametrize("kind", KINDS)
def test_without_size_it_changes_nothing(effect: Effect, kind: str) -> None:
    assert np.abs(changed(effect, seen(kind), sized(effect, 0.0))).max() < 1e-9


@every
def test_it_shows_somewhere_and_grows_with_its_size(effect: Effect) -> None:
    whole, half = (
        sum(float(np.abs(changed(effect, seen(kind), sized(effect, share))).sum()) for kind in KINDS)
        for share in (0.2, 0.1)
    )
    if not effect.nominal:
        assert whole > 0
    assert half == pytest.approx(0.5 * whole, rel=0.15)


@every
def test_what_is_in_the_gut_does_not_show_without_it(effect: Effect) -> None:
    if isinstance(effect, ForceEffect):
        assert not changed(effect, seen("blank"), effect.defaults).any()


@every
@pytest.mark.parametrize("kind", KINDS)
def test_it_is_finite_for_all_that_is_tried(effect: Effect, kind: str) -> None:
    for parameter in effect.parameters:
        for value in (parameter.low, parameter.high, *parameter.grid):
            values = {**effect.defaults, parameter.name: value}
            assert np.isfinite(changed(effect, seen(kind), values)).all(), (parameter.name, value)


@every
@pytest.mark.parametrize("kind", ["drag", "relaxation"])
def test_it_knows_nothing_of_what_is_to_come(effect: Effect, kind: str) -> None:
    until = 1.05 if kind == "relaxation" else STOPPED_S
    full = changed(effect, scene(kind, until_s=until), effect.defaults)
    broken_off = changed(effect, scene(kind, stopped_s=until, until_s=until), effect.defaults)
    assert broken_off == pytest.approx(full, abs=1e-3 * max(1e-3, float(np.abs(full).max())))
    longer = changed(effect, scene(kind, until_s=until + 0.5), effect.defaults)[: full.size]
    assert longer == pytest.approx(full, abs=1e-3 * max(1e-3, float(np.abs(full).max())))


def test_the_page_on_how_to_add_one_shows_what_ships() -> None:
    page = (ROOT / "docs" / "effects.md").read_text("utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert code == (ROOT / "sim_backend" / "effects" / "payload_inertia.py").read_text("utf-8")


def test_one_new_file_is_a_new_effect(tmp_path: Path) -> None:
    import dragrig.sim_backend.effects as package

    source = (Path(package.__file__).parent / "payload_inertia.py").read_text("utf-8")
    (tmp_path / "second_payload.py").write_text(source.replace("payload_inertia", "second_payload"), "utf-8")
    code = (
        f"import dragrig.sim_backend.effects as package; package.__path__.append({str(tmp_path)!r})\n"
        "import sys; from dragrig.cli import main\n"
        "sys.exit(main(['check', 'blank', '--effect', 'second_payload:mass_g=3']) or main(['gap', 'effects']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, encoding="utf-8")
    assert done.returncode == 0, done.stderr
    assert "\nsecond_payload\n" in done.stdout


def test_no_module_but_its_own_knows_an_effect_by_id_by_class_or_by_a_parameters_name() -> None:
    ids = {*catalogue()}
    # Others, such as speed_mm_s and mass_g, are names of settings and columns of runs too.
    names = {parameter.name for effect in EFFECTS for parameter in (effect.period, effect.phase) if parameter}
    classes = {"ForceEffect", "SensorEffect", "MotorEffect", "EncoderEffect"}
    result = []
    for room in ("app", "analysis", "sim_backend", "rig", "config"):
        for path in (ROOT / room).rglob("*.py"):
            inside = path.relative_to(ROOT).as_posix()
            if inside.startswith("sim_backend/blind/") or (path.parent.name == "effects" and path.stem in ids):
                continue
            text = path.read_text("utf-8")
            if not any(word in text for word in classes | {f'"{word}"' for word in ids | names}):
                continue
            for node in ast.walk(ast.parse(text)):
                match node:
                    case ast.Constant(value=str(word)) if word in ids | names:
                        result.append(f"{inside}:{node.lineno} {word}")
                    case ast.Name(id=name) if name in classes and path.parent.name != "effects":
                        result.append(f"{inside}:{node.lineno} {name}")
    assert not result
