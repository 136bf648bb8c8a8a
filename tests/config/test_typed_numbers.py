"""Numbers as people type them: what is read is what the text shows, and everything else is refused."""

import math
import re
from collections.abc import Iterator
from decimal import Decimal

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dragrig.config import NumberRange, RigSettings, SettingsError, number_text, read_number, read_numbers
from dragrig.config.settings import mistakes_in
from dragrig.engine_host.messages import RigSelection
from dragrig.rig.protocols import protocol_kinds
from dragrig.settings_form import rig_settings_form, specimen_form
from dragrig.views import FieldKind, FormField, describe_rig, form_fields, parse_field, plan_form, within_rig
from property_tests import examples

DIGITS = st.text("0123456789", min_size=1, max_size=8)
BLANKS = st.text(" \t\u00a0\u2007\u2009\u202f", max_size=2)
MARKS = st.sampled_from(".,")


@st.composite
def spellings(draw: st.DrawFn) -> tuple[str, Decimal]:
    """A number as people write it, and its value."""
    sign, exponent = draw(st.sampled_from(("", "-", "+", "\u2212"))), draw(st.sampled_from(("", "e3", "E-2", "e+05")))
    whole, fraction, mark = draw(DIGITS), draw(st.one_of(st.just(""), DIGITS)), draw(MARKS)
    body = draw(
        st.sampled_from((f"{whole}{mark}{fraction}", f"{mark}{fraction}") if fraction else (whole, whole + mark))
    )
    value = Decimal(f"{sign}{body}{exponent}".replace("\u2212", "-").replace(",", "."))
    unit = draw(st.sampled_from(("", "mm", " mm", "\u00a0mm")))
    return f"{draw(BLANKS)}{sign}{body}{exponent}{unit}{draw(BLANKS)}", value


@settings(max_examples=examples(300), deadline=None)
@given(spellings())
def test_a_number_is_read_with_either_mark(spelt: tuple[str, Decimal]) -> None:
    text, value = spelt
    assert read_number(text, NumberRange("mm")) == float(value)


@settings(max_examples=examples(500), deadline=None)
@given(st.text("0123456789.,'\u2019_ \u00a0\u202f-\u2212+eEm\u0663\uff15;nai", max_size=12))
@example("1.234,5")
@example("1\u202f234")
@example("\u0661\u066b\u0665")
@example("1_5")
def test_any_text_is_read_as_it_stands_or_refused_in_a_sentence(text: str) -> None:
    value, sentence = None, ""
    try:
        value = read_number(text)
    except SettingsError as error:
        sentence = str(error)
    if value is None:
        assert re.fullmatch(r"""['"].*['"] .*\.""", sentence)
        return
    stands = text.strip().replace("\u2212", "-").replace(",", ".")
    assert stands.isascii()
    assert "_" not in stands
    assert value == float(stands)


@settings(max_examples=examples(200), deadline=None)
@given(
    st.integers(1, 999),
    st.lists(st.integers(0, 999), min_size=1, max_size=3),
    st.sampled_from(".,'\u2019_ \u00a0\u202f"),
    st.one_of(st.just(""), DIGITS),
)
def test_a_mark_of_thousands_is_refused_and_the_number_without_it_offered(
    first: int, groups: list[int], mark: str, fraction: str
) -> None:
    decimal = "," if mark == "." else "."
    if not fraction and len(groups) == 1 and mark in ".,":
        return  # 1.234 and 1,234 are decimals
    marked = mark.join((str(first), *(f"{group:03d}" for group in groups))) + (decimal + fraction if fraction else "")
    with pytest.raises(SettingsError, match="mark of thousands") as refused:
        read_number(marked)
    offered = str(refused.value).rsplit("write ", 1)[1].removesuffix(".")
    digits = "".join((str(first), *(f"{group:03d}" for group in groups)))
    assert read_number(offered) == float(f"{digits}.{fraction or 0}")
    with pytest.raises(SettingsError):
        read_numbers(marked)
    with pytest.raises(SettingsError):
        read_numbers(marked, tight=True)


@settings(max_examples=examples(300), deadline=None)
@given(st.one_of(st.floats(allow_nan=False, allow_infinity=False), st.integers(-(2**53), 2**53).map(float)))
@example(5e-324)
@example(1.5e-300)
@example(-0.0)
def test_the_text_of_a_number_gives_that_very_number(value: float) -> None:
    assert read_number(number_text(value)) == value
    assert read_number(number_text(value).replace(".", ",")) == value


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is empty"),
        ("1.5 m", "is not in mm; write the number in mm"),
        ("1.5 MM", "is not in mm"),
        ("nan", "is not a number"),
        ("inf", "is not a number"),
        ("1e400", "is too large"),
        ("1e-400", "is too small"),
        ("1, 2", "is several numbers"),
        ("\u0663", "is not a number"),
        ("x" * 500, "…' is not a number"),
        ("100.0000001", "is above 100 mm, the rig's limit"),
        ("0", "is not above 0 mm"),
    ],
)
def test_the_reason_is_said(text: str, sentence: str) -> None:
    allowed = NumberRange("mm", 0.0, 5000.0, above_lowest=True).within(-math.inf, 100.0, "the rig's limit")
    with pytest.raises(SettingsError) as refused:
        read_number(text, allowed)
    assert sentence in str(refused.value)
    assert len(str(refused.value)) < 150


def test_a_whole_number_has_no_decimals_and_is_exact() -> None:
    counted = NumberRange(whole=True)
    assert read_number("9007199254740993", counted) == 9007199254740993
    assert read_number("3,0", counted) == 3
    with pytest.raises(SettingsError, match="not a whole number; write it as 2"):
        read_number("2,5", counted)
    with pytest.raises(SettingsError, match="too large"):
        read_number("1e30", counted)


def test_a_comma_between_two_digits_is_asked_about() -> None:
    with pytest.raises(SettingsError, match=r"'5,5' is 5\.5 or 5, 5\? Write a point"):
        read_numbers("5,5")
    assert read_numbers("5, 5") == (5.0, 5.0)
    assert read_numbers("5.5") == (5.5,)
    assert read_numbers("5,5; 10") == (5.5, 10.0)
    assert read_numbers("5, ") == (5.0,)


@settings(max_examples=examples(500), deadline=None)
@given(st.text("0159., ;-'\u00a0", max_size=10), st.booleans())
@example("0.5,1,2", True)
@example("0,20,50", True)
@example("5 ,5", False)
@example("5,5", True)
@example("0,-0", True)
def test_several_numbers_are_never_read_from_what_may_be_one(text: str, tight: bool) -> None:
    try:
        read = read_numbers(text, tight=tight)
    except SettingsError:
        return
    plain = " ".join(text.split())
    if ";" in plain:
        parts = [part.strip().replace(",", ".") for part in plain.split(";")]
    else:
        tight_commas = [at for at, letter in enumerate(plain[:-1]) if letter == "," and plain[at + 1] != " "]
        assert tight or not tight_commas
        # A command line: several commas, or a point as well, cannot be of a decimal.
        assert not tight_commas or not re.fullmatch(r"-?\d*,\d*", plain)
        parts = [part.strip() for part in plain.split(",")]
    assert list(read) == [float(part) for part in parts if part]


def number_fields() -> Iterator[FormField]:
    """Every number field of the forms: of plans, of the rig's settings, of a specimen."""
    rig = describe_rig(RigSelection())
    for kind in protocol_kinds().values():
        yield from form_fields(kind, sweeps=True)
    for form in (within_rig(plan_form("drag"), rig), rig_settings_form(None), specimen_form()):
        for group in form.groups:
            yield from group.fields


@settings(max_examples=examples(500), deadline=None)
@given(
    st.sampled_from([field for field in number_fields() if field.kind is FieldKind.NUMBER]),
    st.floats(0, 1),
    st.integers(0, 9),
    MARKS,
)
def test_every_number_that_a_field_of_a_form_allows_is_what_is_typed(
    field: FormField, share: float, digits: int, mark: str
) -> None:
    allowed = field.allowed
    low, high = max(allowed.lowest, -1e6), min(allowed.highest, 1e6)
    typed = f"{low + share * (high - low):.{0 if allowed.whole else digits}f}"
    if allowed.why_not(float(typed)):  # rounded to a limit
        return
    text = typed if field.sweeps else typed.replace(".", mark)
    assert parse_field(field, text, "step") == float(typed)


def test_a_speed_is_refused_at_the_limit_of_the_rig_in_use() -> None:
    for limit in (100.0, 7.5):
        rig = describe_rig(RigSelection(assignments=(f"rig.stage.max_speed_mm_s={limit}",)))
        form = within_rig(plan_form("drag"), rig)
        values = {**form.groups[0].values, "speed_mm_s": number_text(limit), "way_back_speed_mm_s": "1"}
        assert form.misread([values]) == {}
        told = form.misread([{**values, "speed_mm_s": "5, 100.5"}])
        assert told == {(0, "speed_mm_s"): f"'100.5' is above {number_text(limit)} mm/s, the rig's limit."}


def test_a_list_of_tables_with_a_decimal_comma_is_refused_in_words() -> None:
    strokes = next(field for field in form_fields(protocol_kinds()["motion"], sweeps=True) if field.key == "strokes")
    assert parse_field(strokes, "{travel_mm = 1.5, speed_mm_s = 2}", "motion") == [{"travel_mm": 1.5, "speed_mm_s": 2}]
    with pytest.raises(SettingsError, match="decimals with a point"):
        parse_field(strokes, "{travel_mm = 1,5, speed_mm_s = 2}", "motion")


def test_a_decimal_comma_in_a_setting_is_told_with_the_number_to_write() -> None:
    assert mistakes_in(RigSettings, {"stage": {"start_mm": "40,5"}}) == {
        ("stage", "start_mm"): "is no number with a decimal point; write 40.5"
    }
