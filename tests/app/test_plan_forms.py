"""Plans as forms: every key with unit, range and help, and back to the same plan."""

from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

import dragrig
from dragrig.config.errors import DragrigError, SettingsError
from dragrig.config.plan import Plan
from dragrig.config.settings import shipped_files
from dragrig.engine_host.messages import RigSelection
from dragrig.rig.protocols import protocol_kinds
from dragrig.setup import create_lab
from dragrig.views import FieldKind, describe_rig, known_plans, motion_curves, plan_form, preview_session
from places import ROOT


@pytest.mark.parametrize("name", known_plans())
def test_a_form_left_as_it_is_gives_the_same_plan(name: str) -> None:
    form = plan_form(name)
    assert form.filled([step.values for step in form.groups]) == form.plan


def test_a_form_tells_unit_range_and_help_of_every_number() -> None:
    fields = {field.key: field for field in plan_form("drag").groups[0].fields}
    speed = fields["speed_mm_s"]
    assert (speed.name, speed.unit, speed.limits) == ("speed", "mm/s", "from 0.0001 to 5000 mm/s")
    assert "speed of the stroke" in speed.help
    assert speed.sweeps
    assert speed.required
    assert fields["order"].choices == ("listed", "reversed", "random", "random_within_repeat")
    assert fields["prompt_each"].kind is FieldKind.SWITCH
    assert all(field.help for field in fields.values())


def test_several_values_make_one_run_of_each() -> None:
    form = plan_form("drag")
    values = {**form.groups[0].values, "speed_mm_s": "1, 5, 20", "repeats": "2"}
    session = preview_session(form.filled([values]), RigSelection())
    assert (
        len([preview for preview in session.preflight.previews if preview.run.protocol.summary().startswith("drag")])
        == 6
    )


@pytest.mark.parametrize(("key", "text"), [("speed_mm_s", "fast"), ("speed_mm_s", "-3"), ("wait_s", "1, 2")])
def test_what_cannot_be_is_said_in_a_sentence(key: str, text: str) -> None:
    form = plan_form("drag")
    with pytest.raises(DragrigError) as refused:
        preview_session(form.filled([{**form.groups[0].values, key: text}]), RigSelection())
    assert text.split(",", maxsplit=1)[0] in str(refused.value)


def test_strokes_of_a_motion_can_be_edited(tmp_path: Path) -> None:
    file = tmp_path / "to-and-fro.toml"
    file.write_text(
        'name = "to-and-fro"\n[[steps]]\nkind = "motion"\nstrokes = [{travel_mm = 5, speed_mm_s = 2},'
        " {travel_mm = -5, speed_mm_s = 4}]\n",
        "utf-8",
    )
    form = plan_form(str(file))
    plan = form.filled([step.values for step in form.groups])
    assert len(preview_session(plan, RigSelection()).preflight.previews) == 1
    changed = form.filled([{"strokes": "{travel_mm = 3, speed_mm_s = 2}"}])
    assert preview_session(changed, RigSelection()).preflight.previews[0].highest_mm == pytest.approx(43.0)


def test_plans_of_a_lab_are_offered_first(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('name = "mine"\n[[steps]]\nkind = "blank"\nspeed_mm_s = 5\n', "utf-8")
    (tmp_path / "rig.toml").write_text("", "utf-8")
    (tmp_path / "plans").mkdir()
    (tmp_path / "plans" / "drag.toml").write_text('name = "drag"\ndescription = "My own"\n[[steps]]\nkind = "blank"\n')
    found = known_plans(tmp_path)
    assert list(found)[:2] == [str(tmp_path / "mine.toml"), str(tmp_path / "plans" / "drag.toml")]
    assert str(tmp_path / "rig.toml") not in found
    assert "drag" not in found  # there are no two of a name
    assert found[str(tmp_path / "plans" / "drag.toml")] == "My own"
    assert all(known_plans().values())  # what ships says what it is for


def test_a_plan_of_the_lab_is_found_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    create_lab(tmp_path)
    (tmp_path / "plans").mkdir()
    (tmp_path / "plans" / "short.toml").write_text('name = "short"\n[[steps]]\nkind = "blank"\nspeed_mm_s = 5\n')
    monkeypatch.chdir(tmp_path / "runs")
    assert plan_form("short").source == str(tmp_path / "plans" / "short.toml")
    assert len(dragrig.check("short").previews) == 2
    with pytest.raises(SettingsError, match="did you mean short"):
        dragrig.check("shrt")


def test_a_plan_of_the_lab_with_a_mistake_is_not_replaced_by_a_shipped_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    create_lab(tmp_path)
    (tmp_path / "drag.toml").write_text('name = "drag"\n[[steps]\nkind = "drag"\n', "utf-8")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SettingsError, match="line 2"):
        dragrig.check("drag")
    assert "line 2" in known_plans(tmp_path)[str(tmp_path / "drag.toml")]


def test_a_preview_shows_the_way_and_what_forbids_it() -> None:
    session = preview_session(plan_form("drag").plan, RigSelection())
    time, position, speed = motion_curves(session.preflight.previews[0])
    assert position[0] == pytest.approx(session.preflight.previews[0].lowest_mm)
    assert position.max() == pytest.approx(session.preflight.previews[0].highest_mm)
    assert speed.max() == pytest.approx(20.0)
    assert time[-1] == pytest.approx(session.preflight.previews[0].run.duration_s)
    form = plan_form("drag")
    far = preview_session(form.filled([{**form.groups[0].values, "travel_mm": "900"}]), RigSelection())
    assert "change travel_mm or start_mm" in far.preflight.findings[0]


@pytest.mark.parametrize(
    ("rig", "title", "real"),
    [
        (RigSelection(), "SIMULATED", False),
        (RigSelection(backend="hardware"), "HARDWARE", True),
        (RigSelection(backend="hardware", double=True), "DOUBLE", False),
    ],
)
def test_a_rig_is_named_unmistakably(rig: RigSelection, title: str, real: bool) -> None:
    text = describe_rig(rig)
    assert (text.title, text.real) == (title, real)


def test_a_plan_that_is_none_is_refused() -> None:
    with pytest.raises(SettingsError, match="no plan of this name"):
        plan_form("dragg")


def test_the_page_on_plans_has_every_key_and_its_allowed_words() -> None:
    page = (ROOT / "docs" / "writing-a-plan.md").read_text("utf-8")
    kinds = {kind: protocol for kind, protocol in protocol_kinds().items() if kind != "return"}
    tables = [table for model in (Plan, *kinds.values()) for table in schema_tables(model)]
    entries = [(key, entry) for table in tables for key, entry in table.get("properties", {}).items()]
    words = {key for key, _ in entries} | {word for table in tables for word in table.get("enum", ())} | {*kinds}
    words |= {*shipped_files("plan"), *shipped_files("capsule")}
    assert {"sentinel", "drift_percent", "pause_s", "random_within_repeat"} < words
    assert [word for word in sorted(words - {"parameters"}) if f"`{word}`" not in page] == []
    rows = [line.replace(" ", "") for line in page.splitlines()]
    unsaid = [
        f"{key}: {bound}"
        for key, entry in entries
        for bound in bounds_of(entry)
        if not any(f"`{key}`" in row and bound in row for row in rows)
    ]
    assert unsaid == []


def schema_tables(model: type[BaseModel]) -> list[dict[str, Any]]:
    schema = model.model_json_schema()
    return [schema, *schema.get("$defs", {}).values()]


def bounds_of(entry: dict[str, Any]) -> list[str]:
    """Return what a number may not go beyond, as a page writes it."""
    options = [entry, *entry.get("anyOf", ())]
    names = ("minimum", "exclusiveMinimum", "maximum")
    bounds = [option[name] for option in options for name in names if name in option]
    return [format(bound, "g" if abs(bound) < 1e5 else ".0f").replace("-", "−") for bound in bounds]
