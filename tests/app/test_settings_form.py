"""The rig settings as a form: every mistake beside its field, and a saved file that keeps its comments."""

from datetime import datetime
from pathlib import Path

import pytest

from dragrig.config.errors import SettingsError
from dragrig.config.rig import RigSettings
from dragrig.config.settings import parse_assignment, read_settings_file
from dragrig.settings_form import RigSettingsForm, rig_settings_form, specimen_form
from dragrig.setup import resolve
from dragrig.views import FieldKind
from windows import lab_in


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    return lab_in(tmp_path / "lab") / "rig.toml"


def filled(form: RigSettingsForm, **texts: str) -> list[dict[str, str]]:
    """Return the form's values with some changed, each by table and key with a double underscore between them."""
    values = form.values()
    names = [group.name for group in form.groups]
    for place, text in texts.items():
        *path, key = place.split("__")
        values[names.index(".".join(path) or "rig")][key] = text
    return values


def told(form: RigSettingsForm, **texts: str) -> dict[str, str]:
    """Return what is wrong with changed values, by table and key."""
    problems = form.problems(filled(form, **texts))
    return {f"{form.groups[number].name}.{key}": problem for (number, key), problem in problems.items()}


def test_every_setting_of_the_schema_is_in_the_form(rig: Path) -> None:
    form = rig_settings_form(rig)
    keys = {(*form.path_of(number), field.key) for number, group in enumerate(form.groups) for field in group.fields}

    def leaves(table: dict[str, object], path: tuple[str, ...] = ()) -> set[tuple[str, ...]]:
        found: set[tuple[str, ...]] = set()
        for key, value in table.items():
            found |= leaves(value, (*path, key)) if isinstance(value, dict) else {(*path, key)}
        return found

    assert keys == leaves(RigSettings().model_dump(mode="json"))
    fields = {field.key: field for group in form.groups if group.name == "stage" for field in group.fields}
    speed = fields["max_speed_mm_s"]
    assert (speed.name, speed.unit, speed.limits) == ("max speed", "mm/s", "above 0 to 5000 mm/s")
    assert fields["stop_accel_mm_s2"].help == "Deceleration of a stop."
    assert fields["start_from"].kind is FieldKind.CHOICE
    assert form.problems(form.values()) == form.changes(form.values()) == {}


def test_a_mistake_is_told_of_the_field_that_it_is_in(rig: Path) -> None:
    form = rig_settings_form(rig)
    assert told(form, hardware__drive__baud="quick") == {
        "hardware.drive.baud": "'quick' is not a number; write it as 12.5."
    }
    assert told(form, stage__start_mm="500", hardware__card__force__per_V="0") == {
        "stage.start_mm": "start must lie between lowest and highest",
        "hardware.card.force.per_V": "per volt must not be 0",
    }
    [(place, problem)] = told(form, guard__force_limit_mN="20000").items()
    assert place == "guard.force_limit_mN"
    assert problem.startswith("force limit (Guard) must be below range (Force sensor), or no force")
    assert "ai0 to ai7" in told(form, hardware__card__force__channel="ai99")["hardware.card.force.channel"]
    assert "must not be empty" in told(form, name="")["rig.name"]
    assert list(told(form, hardware__card__inputs='{name = "T", channel = "ai1", unit = "C"}')) == [
        "hardware.card.inputs"
    ]


def test_saving_changes_what_was_edited_and_keeps_the_rest(rig: Path) -> None:
    text = rig.read_text("utf-8").replace("start_mm = 40.0", "start_mm = 40.0  # off the clamp")
    rig.write_text(text.replace("[simulated]", "# Ours.\n[simulated]"), "utf-8")
    before = rig.read_text("utf-8").splitlines()
    form = rig_settings_form(rig)
    settings = form.save(
        filled(
            form,
            stage__start_mm="50",
            sampling__motor_force="no",
            hardware__card__encoder__filter_ns="6425",
            hardware__card__encoder__z="",
            hardware__drive__baud="",
        )
    )
    after = rig.read_text("utf-8").splitlines()
    changed = {new for old, new in zip(before, after, strict=True) if old != new}
    assert changed == {"start_mm = 50.0  # off the clamp", "motor_force = false", "filter_ns = 6425", 'z = ""'}
    assert settings == read_settings_file(RigSettings, rig)
    assert settings.hardware.drive.baud == 38400  # an empty number is the default
    inputs = rig_settings_form(rig)
    inputs.save(filled(inputs, hardware__card__inputs='{name = "temperature", channel = "ai1", unit = "C"}'))
    again = rig_settings_form(rig)
    assert [made.name for made in again.settings.hardware.card.inputs] == ["temperature"]
    assert again.problems(again.values()) == {}


def test_a_short_file_gets_what_is_changed_and_no_more(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text('name = "ours"\n\n[stage]\nstart_mm = 30.0\n', "utf-8")
    form = rig_settings_form(file)
    form.save(filled(form, hardware__drive__velocity__lag_s="0.01"))
    assert file.read_text("utf-8").startswith('name = "ours"\n\n[stage]\nstart_mm = 30.0\n')
    assert rig_settings_form(file).settings.hardware.drive.velocity.lag_s == 0.01


def test_what_is_invalid_is_not_written(rig: Path) -> None:
    form, before = rig_settings_form(rig), rig.read_bytes()
    with pytest.raises(SettingsError, match="Start: start must lie between"):
        form.save(filled(form, stage__start_mm="500"))
    assert rig.read_bytes() == before
    rig.write_text(before.decode().replace("highest_mm = 150.0", "highest_mm = 45.0"), "utf-8")  # by another program
    with pytest.raises(SettingsError, match="start_mm must lie between"):
        form.save(filled(form, stage__start_mm="50"))
    shipped = rig_settings_form(None)
    assert shipped.path is None
    with pytest.raises(SettingsError, match="dragrig init"):
        shipped.save(filled(shipped, name="other"))


def test_what_is_stated_of_a_specimen_are_the_same_assignments_as_on_the_command_line() -> None:
    form = specimen_form()
    (empty,) = form.values()
    assert form.assignments([empty]) == ()
    stated = {
        "id": "7",
        "mounted_at": "2026-05-04T09:40:00+02:00",
        "storage": 'Tyrode, "cold"',
        "temperature_degC": "37",
    }
    assignments = form.assignments([{**empty, **stated}])
    specimen = resolve("drag", assignments=assignments).specimen
    assert (specimen.id, specimen.storage, specimen.temperature_degC) == ("7", 'Tyrode, "cold"', 37.0)
    assert specimen.not_stated == ("excised_at",)
    (dated,) = form.assignments([{**empty, "excised_at": "00:00"}])
    assert (
        datetime.fromisoformat(parse_assignment(dated)[1]).date() == datetime.now().astimezone().date()
    )  # not of a later day


def test_a_mistake_about_a_specimen_is_told_of_its_field() -> None:
    form = specimen_form()
    (empty,) = form.values()

    def told(**texts: str) -> dict[str, str]:
        return {key: problem for (_, key), problem in form.problems([{**empty, **texts}]).items()}

    assert told() == {}
    assert "time of day" in told(excised_at="this morning")["excised_at"]
    assert "not a number" in told(temperature_degC="warm")["temperature_degC"]
    assert "above 60 °C, the most allowed" in told(temperature_degC="310")["temperature_degC"]
    late = {"excised_at": "2026-05-04T09:40", "mounted_at": "2026-05-04T09:15"}
    assert "comes before" in told(**late)["mounted_at"]
    with pytest.raises(SettingsError, match=r"^Specimen, Excised at: .*time of day"):
        form.assignments([{**empty, "excised_at": "this morning"}])
