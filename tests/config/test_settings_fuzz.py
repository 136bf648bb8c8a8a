"""Whatever a settings file holds, it is either used or refused in one sentence."""

from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from dragrig.cli import main
from dragrig.config import settings as library
from dragrig.config.errors import PlanError, SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.config.rig import RigSettings
from dragrig.config.settings import parse, read_settings_file
from dragrig.config.specimen import Capsule, Specimen
from dragrig.rig.programme import build_programme
from property_tests import examples

MODELS = {"rig": RigSettings, "capsule": Capsule, "specimen": Specimen, "model": FrictionModelSettings, "plan": Plan}
SHIPPED = [(kind, name) for kind in MODELS for name in library.shipped_files(kind)]


def use(kind: str, path: Path) -> None:
    settings = read_settings_file(MODELS[kind], path)
    if isinstance(settings, Plan):
        build_programme(settings, Specimen(name="s"), 40.0, str(path))


@pytest.mark.parametrize(("kind", "name"), SHIPPED)
def test_what_ships_is_valid(kind: str, name: str) -> None:
    settings = library.find_settings(MODELS[kind], kind, name)
    if isinstance(settings, Plan):
        assert settings.name == name
        assert build_programme(settings, Specimen(name="s"), 40.0, name).runs


STEP = "name = 'p'\n[[steps]]\nkind = 'drag'\n"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is empty; it needs name and steps."),
        ("# to do\n\n", "is empty; it needs name and steps."),
        ("kind = drag  # the first\n", 'line 1, kind = drag: text has quotes; write kind = "drag".'),
        (f"{STEP}speed_mm_s = 5,5\n", "line 4, speed_mm_s = 5,5: decimals have a point; write speed_mm_s = 5.5."),
        (f"{STEP}speed_mm_s = 1, 5\n", "line 4, speed_mm_s = 1, 5: a list has brackets; write speed_mm_s = [1, 5]."),
        (f"{STEP}speed_mm_s = 20 mm/s\n", "a number has no unit; write speed_mm_s = 20."),
        ("name = 'p'\n[[steps]\nkind = 'drag'\n", "line 2, [[steps]: the brackets do not match; write [[steps]]."),
        ("name = 'p'\n[steps]\nkind = 'drag'\n", "steps must be a list: begin each entry with [[steps]]."),
        (
            f"{STEP}speed_mm_s = [1,\n5\nwait_s = 3\n",
            "line 6, wait_s = 3: what was opened above is not closed; end it with ].",
        ),
        (
            f"{STEP}speed_mm_s = [1, 5\nwait_s = 3\n",
            "line 4, speed_mm_s = [1, 5: the list is not closed; end it with ].",
        ),
        (f"{STEP}note = 'a\nwait_s = 3\n", "line 4, note = 'a: the quotes are not closed; end the text with '."),
        (f"{STEP}kind = 'blank'\n", "line 4, kind = 'blank': is there already; leave one of the two out."),
        (f"{STEP}wait_s: 3\n", "line 4, wait_s: 3: a key and its value have = between them; write wait_s = 3."),
        (f"{STEP}wait_s =\n", "wait_s has no value; give it one, or leave the line out."),
        (f'{STEP}capsule = "C:\\x.toml"\n', "a text with \\ has single quotes; write capsule = 'C:\\x.toml'."),
        (f"{STEP}speed_mm_s = '20 mm/s'\n", "speed_mm_s = '20 mm/s': is not a number; write 20 alone."),
        (f"{STEP}speed_mm_s = '5,5'\n", "is no number with a decimal point; write 5.5."),
        (f"{STEP}speed_mm_s = 0\n", "speed_mm_s = 0: must be at least 0.0001."),
        (f"{STEP}speed_mm_s = 5\nrepeats = 2.5\n", "steps[0].repeats = 2.5: must be a whole number."),
        (f"{STEP}speed_mm_s = 5\nway_back = 'drive'\n", "is not one of driven, by_hand, stay; did you mean driven?"),
        (f"{STEP}speed_mm_s = 5\nprompt_each = 'often'\n", "steps[0].prompt_each = 'often': must be true or false."),
        (
            STEP.replace("'p'", "'my plan'"),
            "name = 'my plan': a name has letters, digits, . _ and - alone; write my-plan.",
        ),
        ("name = 'p'\nsteps = []\n", "steps = []: must have 1 or more entries, and has 0."),
    ],
)
def test_a_mistake_in_a_file_is_told_with_its_line_and_how_it_is_written(
    tmp_path: Path, text: str, sentence: str
) -> None:
    (tmp_path / "own.toml").write_text(text, "utf-8")
    with pytest.raises((SettingsError, PlanError)) as caught:
        use("plan", tmp_path / "own.toml")
    assert str(caught.value).startswith(str(tmp_path / "own.toml"))
    assert sentence in str(caught.value)


_PIECES = st.sampled_from(
    ["nan", "-inf", "1e999", "''", '"', "[", "]", "{", "}", "=", ".", "\n", "# ", "[[steps]]", "true", "-1", "0", "mm",
     "speed_mm_s", "kind", "99999999999999999999999", "2024-01-01", "\x00", "\ufeff", "µ", "[1,[2]]", "{a=1}"]
)  # fmt: skip


@st.composite
def mutated(draw: st.DrawFn) -> tuple[str, bytes]:
    kind, name = draw(st.sampled_from(SHIPPED))
    data = library.shipped_files(kind)[name].read_bytes()
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        length = draw(st.integers(0, 12))
        piece = draw(_PIECES.map(str.encode) | st.binary(max_size=3))
        data = data[:start] + piece + data[start + length :]
    return kind, data


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=examples(150))
@given(mutated())
@example(("plan", b"name = 'p'\n[[steps]]\nkind = 'drag'\nspeed_mm_s = [[1]]\n"))
@example(("plan", b"name = 'p'\n[[steps]]\nkind = 'drag'\nspeed_mm_s = []\n"))
@example(("plan", b"name = 'p'\n[[steps]]\nkind = 'drag'\nspeed_mm_s = 1979-05-27\n"))
@example(("rig", b"a = " + b"[" * 5000))
@example(("rig", b"a = " + b"[" * 500 + b"]" * 500))
@example(("plan", b"seed = " + b"9" * 5000))
@example(("plan", b"seed = 0x" + b"f" * 5000))
@example(("plan", b"\xff\xfe"))
def test_any_change_to_a_shipped_file_is_used_or_refused(tmp_path: Path, change: tuple[str, bytes]) -> None:
    kind, data = change
    path = tmp_path / "any.toml"
    path.write_bytes(data)
    with suppress(SettingsError, PlanError):
        use(kind, path)


_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=examples(150))
@given(st.sampled_from(sorted(MODELS)), st.data())
def test_any_values_are_used_or_refused(kind: str, data: st.DataObject) -> None:
    known = st.sampled_from(sorted(MODELS[kind].model_fields)) | st.text(max_size=6)
    table = data.draw(st.dictionaries(known, _VALUES, max_size=5))
    if kind == "plan" and data.draw(st.booleans()):
        keys = st.sampled_from(["kind", "speed_mm_s", "shear_strain", "strokes", "capsule", "repeats", "start_mm"])
        steps = st.lists(st.dictionaries(keys, _VALUES | st.sampled_from(["drag", "motion"]), max_size=4), max_size=2)
        table = {"name": "p", "steps": data.draw(steps)}
    with suppress(SettingsError, PlanError):
        parsed = parse(MODELS[kind], table, "any")
        if isinstance(parsed, Plan):
            build_programme(parsed, Specimen(name="s"), 40.0, "any")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name = 'p'\n[[steps]\n", ["own.toml", "not valid TOML", "line 2"]),
        ("name = 'p'\n[[steps]]\nkind='drag'\nspeed_m_s=0.02\n", ["steps[0]", "speed_m_s", "did you mean speed_mm_s?"]),
        ("name = 'p'\n[[steps]]\nkind='drag'\nspeed_mm_s='20 mm/s'\n", ["speed_mm_s = '20 mm/s'", "number"]),
        ("name = 'p'\n[[steps]]\nkind='drag'\nspeed_mm_s=nan\n", ["speed_mm_s", "nan", "finite"]),
        ("name = 'p'\n[[steps]]\nkind='drug'\nspeed_mm_s=2\n", ["kind = 'drug'", "did you mean drag?"]),
        ("name = 'p'\n[[steps]]\nkind='drag'\nspeed_mm_s=60\ntravel_mm=5\n", ["travel_mm = 5", "run-up and run-down"]),
        ("name = 'p'\n[[steps]]\nkind='drag'\nspeed_mm_s=20\ntravel_mm=400\n", ["from 40 to 440 mm", "0 to 150 mm"]),
        ("name = 'p'\n[[steps]]\nkind='drag'\nspeed_mm_s=20\naccel_mm_s2=5000\n", ["5000 mm/s²", "3000 mm/s²"]),
        ("name = 'p'\n[[steps]]\nkind='drag'\nspeed_mm_s=5\ncapsule='own2.toml'\n", ["steps[0].capsule", "own2.toml"]),
        ("name = 'p'\n[[stpes]]\nkind='drag'\n", ["stpes", "did you mean steps?"]),
        ("name = 'p'\n", ["steps is missing"]),
        ("\u0000", ["own.toml", "not valid TOML"]),
        ("name = 'p'\n[[steps]]\nkind='drag'\nspeed_mm_s=1e-300\n", ["speed_mm_s = 1e-300", "0.0001"]),
        (f"name = 'p'\nseed = {'9' * 5000}\n", ["own.toml", "a number that is too long"]),
        (f"name = 'p'\nseed = 0x{'f' * 5000}\n", ["own.toml", "a whole number of more than 64 bits"]),
        (f"name = 'p'\nseed = {'[' * 100}{']' * 100}\n", ["own.toml", "nested too deeply"]),
    ],
)
def test_an_invalid_plan_is_reported_in_one_sentence(
    text: str, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.toml").write_text(text, "utf-8")
    assert main(["check", "own.toml", "--json"]) == 2
    errors = capsys.readouterr().err
    assert all(word in errors for word in ["own.toml", *words]), errors
    assert "Traceback" not in errors
    assert errors.splitlines()[0].startswith("dragrig: ")
    assert [path.name for path in tmp_path.iterdir()] == ["own.toml"]
