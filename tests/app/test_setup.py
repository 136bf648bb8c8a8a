"""What a session runs with: names, files, lab folders and assignments."""

from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dragrig.config.errors import DragrigError, PlanError, SettingsError
from dragrig.config.specimen import SPECIMEN_FACTS
from dragrig.rig.protocols.kinds import DragProtocol
from dragrig.setup import Setup, resolve
from property_tests import examples


@pytest.fixture(autouse=True)
def _away_from_any_lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def speeds(setup: Setup) -> list[object]:
    return [run.protocol.attributes().get("speed_mm_s") for run in setup.programme().runs if run.follows < 0]


def test_shipped_settings_are_what_is_used_by_default() -> None:
    setup = resolve("drag")
    assert (setup.rig.name, setup.specimen.name, setup.model.name) == ("bench", "jejunum", "paper")
    assert setup.data_root == Path("runs")


def test_a_lab_folder_above_gives_the_rig_and_where_data_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rig.toml").write_text("name = 'ours'\n[data]\nroot = 'data'\n", "utf-8")
    below = tmp_path / "a" / "b"
    below.mkdir(parents=True)
    monkeypatch.chdir(below)
    setup = resolve("drag")
    assert setup.rig.name == "ours"
    assert setup.data_root == tmp_path / "data"
    assert resolve("drag", rig="bench").rig.name == "bench"


def test_a_bare_key_changes_every_step_that_has_it() -> None:
    setup = resolve("paper", assignments=["speed_mm_s=5", "hold_s=7.5", "shear_strain=[0.5, 1.0]"])
    made = [run.protocol for run in setup.programme().runs if run.follows < 0]
    assert {run.kind for run in made} == {"relaxation", "blank", "coulomb", "drag"}
    assert all(entry.hold_s == 7.5 for entry in made)
    assert set(speeds(setup)) == {5.0, None}
    assert sum(run.kind == "relaxation" for run in made) == 2


def test_a_step_keeps_its_own_key_where_only_the_others_protocol_has_it() -> None:
    setup = resolve("paper", assignments=["repeats=1", "order=listed", "capsule=smooth", "way_back=stay"])
    assert {run.capsule.name for run in setup.programme().runs} == {"smooth"}
    assert all(run.follows < 0 for run in setup.programme().runs)


def test_a_path_changes_rig_model_specimen_and_plan() -> None:
    setup = resolve(
        "drag",
        assignments=[
            "rig.stage.highest_mm=120",
            "rig.stage.start_mm=50",
            "model.wall=table1",
            "specimen.wall_thickness_mm=3",
            "plan.seed=7",
        ],
    )
    assert (setup.rig.stage.highest_mm, setup.rig.stage.start_mm) == (120.0, 50.0)
    assert setup.rig.stage.max_speed_mm_s == 100.0
    assert (setup.model.wall, setup.specimen.wall_thickness_mm, setup.plan.seed) == ("table1", 3.0, 7)


def test_a_real_specimen_is_stated_or_unknown_and_never_invented() -> None:
    invented = {"pig", "jejunum", "Tyrode solution, oxygenated"}
    unknown = resolve("drag", backend="hardware", double=True).specimen
    assert not invented & set(unknown.model_dump().values())
    assert unknown.not_stated == SPECIMEN_FACTS
    stated = resolve("drag", backend="hardware", assignments=["specimen.id=P7", "specimen.excised_at=09:15"]).specimen
    assert stated.not_stated == ("animal", "segment", "mounted_at", "storage", "temperature_degC")
    assert stated.excised_at is not None
    age = datetime.now(UTC) - stated.excised_at
    assert timedelta(0) <= age <= timedelta(days=1)
    with pytest.raises(SettingsError, match="comes before excised_at"):
        resolve("drag", assignments=["specimen.excised_at=2026-05-04T09:15", "specimen.mounted_at=2026-05-04T09:10"])


def test_a_specimen_of_tomorrow_is_a_slip_of_the_pen() -> None:
    tomorrow = datetime.now().astimezone() + timedelta(days=1)
    for key in ("excised_at", "mounted_at"):
        with pytest.raises(SettingsError, match=rf"specimen\.{key} = {tomorrow:%Y-%m-%d}.* lies in the future"):
            resolve("drag", assignments=[f"specimen.{key}={tomorrow:%Y-%m-%dT%H:%M}"])


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("speed_ms=5", "did you mean speed_mm_s?"),
        ("speed_mm_s", "key=value"),
        ("stage.highest_mm=3", "rig, model, specimen and plan"),
        ("rig.stage.higest_mm=3", "did you mean highest_mm?"),
        ("rig.stage.highest_mm=nan", "finite"),
        ("rig.stage.highest_mm=10", "start_mm must lie between"),
        ("rig.stage.highest_mm='120 mm'", "number"),
        ("speed_mm_s=nan", "finite"),
        ("speed_mm_s=-5", "0.0001"),
        ("speed_mm_s=200", "run-up and run-down"),
        ("speed_mm_s=5 mm/s", "number"),
        ("capsule=ruogh", "did you mean rough?"),
        ("=3", "key=value"),
    ],
)
def test_a_wrong_assignment_is_answered_in_one_sentence(assignment: str, words: str) -> None:
    with pytest.raises(DragrigError) as caught:
        resolve("drag", assignments=[assignment]).programme()
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_protocol_alone_is_a_plan_of_one_run() -> None:
    setup = resolve(DragProtocol(speed_mm_s=3, travel_mm=10))
    assert speeds(setup) == [3.0]
    assert len(setup.programme().runs) == 1


def test_a_plans_capsule_file_is_found_beside_the_plan(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "own.toml").write_text("name='own'\nsurface='smooth'\ndiameter_mm=11\nlength_mm=20\nmass_g=5\n", "utf-8")
    (folder / "plan.toml").write_text("name='p'\n[[steps]]\nkind='drag'\nspeed_mm_s=5\ncapsule='own.toml'\n", "utf-8")
    assert resolve("mine/plan.toml").programme().runs[0].capsule.name == "own"


_KEYS = st.sampled_from(
    ["speed_mm_s", "rig", "rig.stage", "rig.stage.highest_mm", "rig.simulated.noise", "plan.steps", "plan.seed",
     "model.wall", "specimen.name", "order", "parameters", "kind", "prompt", "capsule", "start_mm"]
)  # fmt: skip
_VALUES = st.one_of(
    st.sampled_from(["nan", "-inf", "1e400", "[]", "{}", "[[1]]", "true", "'x'", "2024-01-01", '"', "", "{a={b=1}}"]),
    st.integers().map(str),
    st.floats().map(str),
    st.text(max_size=12),
)


@settings(max_examples=examples(60))
@given(st.lists(st.tuples(_KEYS | st.text(max_size=8), _VALUES), max_size=4))
def test_any_assignment_works_or_is_refused_in_words(assignments: list[tuple[str, str]]) -> None:
    with suppress(SettingsError, PlanError):
        resolve("drag", assignments=[f"{key}={value}" for key, value in assignments]).programme()
