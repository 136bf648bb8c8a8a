"""The drive's dialect: whatever is said comes back, and nothing damaged passes."""

import re
import sys
from pathlib import Path

import pytest
from driving import driven, until
from hypothesis import given
from hypothesis import strategies as st
from simulated import stroke

from dragrig.config.errors import SettingsError
from dragrig.rig.hardware.dialects.base import (
    Command,
    Dialect,
    FrameError,
    Halt,
    Parameter,
    Refusal,
    Reply,
    Request,
    Status,
    find_dialect,
)
from dragrig.rig.hardware.dialects.nikki import DIALECT

PAGE = Path(__file__).parents[1] / "docs" / "drive-dialect.md"


def code_on_the_page() -> str:
    code = re.search(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    assert code is not None
    return code[1]


def from_the_page() -> Dialect:
    module: dict[str, object] = {}
    exec(compile(code_on_the_page(), str(PAGE), "exec"), module)
    dialect = module["DIALECT"]
    assert isinstance(dialect, Dialect)
    return dialect


EXAMPLE = from_the_page()
DIALECTS = pytest.mark.parametrize("dialect", [DIALECT, EXAMPLE], ids=["nikki", "the page's"])
STATIONS = st.integers(0, 99)
PLAIN = [Command.STATUS, Command.POSITION, Command.ENABLE, Command.DISABLE, Command.CLEAR_ALARM, Command.STOP]
# Both dialects hold four decimals of these, or more.
NUMBERS = st.integers(-(10**8), 10**8).map(lambda steps: steps / 10_000)
COARSE = {Parameter.THRUST_LIMIT_N, Parameter.SILENCE_S, Parameter.HOMING_SPEED_MM_S, Parameter.ACCELERATION_MM_S2,
          Parameter.STOP_ACCELERATION_MM_S2}  # fmt: skip


def values(parameter: Parameter) -> st.SearchStrategy[float]:
    return NUMBERS.map(lambda value: round(value, 3) if parameter in COARSE else value)


PARAMETERS = st.sampled_from(Parameter)
REQUESTS = st.one_of(
    st.sampled_from(PLAIN).map(Request),
    PARAMETERS.map(lambda first: Request(Command.READ, first)),
    PARAMETERS.flatmap(lambda first: values(first).map(lambda value: Request(Command.SET, first, value))),
    NUMBERS.map(lambda value: Request(Command.GO, value=value)),
    st.sampled_from([-1.0, 1.0]).map(lambda towards: Request(Command.HOME, value=towards)),
)
STATUSES = st.builds(Status, st.booleans(), st.booleans(), st.booleans(), st.integers(0, 255), st.sampled_from(Halt))
REPLIES = st.one_of(
    st.sampled_from([*PLAIN[2:], Command.GO, Command.HOME]).map(Reply),
    PARAMETERS.map(lambda first: Reply(Command.SET, first)),
    STATUSES.map(lambda status: Reply(Command.STATUS, status=status)),
    NUMBERS.map(lambda value: Reply(Command.POSITION, value=value)),
    PARAMETERS.flatmap(lambda first: values(first).map(lambda value: Reply(Command.READ, first, value))),
    st.builds(lambda request, refusal: Reply(request.command, request.parameter, refusal=refusal), REQUESTS,
              st.sampled_from(Refusal)),
)  # fmt: skip


@DIALECTS
@given(REQUESTS, STATIONS)
def test_every_request_comes_back(dialect: Dialect, request: Request, station: int) -> None:
    frame = dialect.encode(request, station)
    assert dialect.frame_length(frame) == len(frame)
    assert dialect.frame_length(frame[:-1]) == 0
    assert dialect.decode_request(frame, station) == request


@DIALECTS
@given(REPLIES, STATIONS)
def test_every_reply_comes_back(dialect: Dialect, reply: Reply, station: int) -> None:
    frame = dialect.encode_reply(reply, station)
    assert dialect.frame_length(frame + b"\x02rest") == len(frame)
    assert dialect.decode(frame, station) == reply


@DIALECTS
@given(st.one_of(st.binary(max_size=80), st.binary(max_size=20).map(lambda inner: b"\x0201" + inner + b"\x030000")))
def test_any_bytes_are_a_frame_or_one_kind_of_error(dialect: Dialect, noise: bytes) -> None:
    for read in (dialect.decode, dialect.decode_request):
        try:
            read(noise, 1)
        except FrameError as error:
            assert str(error)  # noqa: PT017  # most bytes are no frame, and a few may be
    assert 0 <= dialect.frame_length(noise) <= max(len(noise), 64)


@DIALECTS
@given(REPLIES, st.data())
def test_no_single_changed_byte_passes(dialect: Dialect, reply: Reply, data: st.DataObject) -> None:
    frame = dialect.encode_reply(reply, 1)
    place = data.draw(st.integers(0, len(frame) - 1))
    flip = data.draw(st.integers(1, 255))
    damaged = frame[:place] + bytes([frame[place] ^ flip]) + frame[place + 1 :]
    with pytest.raises(FrameError):
        dialect.decode(damaged, 1)


@DIALECTS
@given(REQUESTS)
def test_program_and_drive_are_not_mistaken_for_each_other(dialect: Dialect, request: Request) -> None:
    with pytest.raises(FrameError):
        dialect.decode(dialect.encode(request, 1), 1)
    with pytest.raises(FrameError, match="station"):
        dialect.decode_request(dialect.encode(request, 1), 2)


@DIALECTS
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e9])
def test_a_value_that_no_frame_holds_is_refused(dialect: Dialect, value: float) -> None:
    with pytest.raises(FrameError, match="fit"):
        dialect.encode(Request(Command.GO, value=value), 1)


@pytest.mark.parametrize(
    ("command", "parameter", "value"),
    [(Command.GO, None, None), (Command.STOP, None, 1.0), (Command.READ, None, None),
     (Command.STATUS, Parameter.SPEED_MM_S, None)],
)  # fmt: skip
def test_a_request_says_all_it_has_to_and_no_more(
    command: Command, parameter: Parameter | None, value: float | None
) -> None:
    with pytest.raises(ValueError, match="comes with"):
        Request(command, parameter, value)


def test_a_move_is_never_sent_twice() -> None:
    assert not Request(Command.GO, value=1.0).repeatable
    assert not Request(Command.HOME, value=-1.0).repeatable
    assert Request(Command.STOP).repeatable


def test_a_dialect_is_found_by_name() -> None:
    assert find_dialect("nikki") is DIALECT
    assert find_dialect("dragrig.rig.hardware.dialects.nikki") is DIALECT
    assert isinstance(DIALECT, Dialect)
    assert not DIALECT.verified
    for name, complaint in (("nobody", "not known"), ("../x", "no module"), ("dragrig.rig.devices", "DIALECT")):
        with pytest.raises(SettingsError, match=complaint):
            find_dialect(name)


def test_the_pages_dialect_moves_a_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "line_dialect.py").write_text(code_on_the_page(), "utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    with driven(dialect="line_dialect") as rig:
        assert type(rig.link.dialect).__name__ == "LineDialect"
        rig.ready().stage.move(stroke(travel_mm=2.0))
        until(lambda: not rig.sync.moving)
        assert rig.stage.state().position_mm == pytest.approx(2.0, abs=1e-3)
    del sys.modules["line_dialect"]
