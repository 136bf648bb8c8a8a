"""The drive's dialect: whatever is said comes back, and nothing damaged passes."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

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

STATIONS = st.integers(0, 99)
PLAIN = [Command.STATUS, Command.POSITION, Command.ENABLE, Command.DISABLE, Command.CLEAR_ALARM, Command.STOP]
POSITIONS = st.integers(-(10**10) + 1, 10**10 - 1).map(lambda steps: steps / 10_000)


def values(parameter: Parameter) -> st.SearchStrategy[float]:
    per_unit = round(1 / DIALECT.resolution(parameter))
    return st.integers(-(10**10) + 1, 10**10 - 1).map(lambda steps: steps / per_unit)


PARAMETERS = st.sampled_from(Parameter)
REQUESTS = st.one_of(
    st.sampled_from(PLAIN).map(Request),
    PARAMETERS.map(lambda one: Request(Command.READ, one)),
    PARAMETERS.flatmap(lambda one: values(one).map(lambda value: Request(Command.SET, one, value))),
    POSITIONS.map(lambda value: Request(Command.GO, value=value)),
    st.sampled_from([-1.0, 1.0]).map(lambda towards: Request(Command.HOME, value=towards)),
)
STATUSES = st.builds(Status, st.booleans(), st.booleans(), st.booleans(), st.integers(0, 255), st.sampled_from(Halt))
REPLIES = st.one_of(
    st.sampled_from([*PLAIN[2:], Command.GO, Command.HOME]).map(Reply),
    PARAMETERS.map(lambda one: Reply(Command.SET, one)),
    STATUSES.map(lambda status: Reply(Command.STATUS, status=status)),
    POSITIONS.map(lambda value: Reply(Command.POSITION, value=value)),
    PARAMETERS.flatmap(lambda one: values(one).map(lambda value: Reply(Command.READ, one, value))),
    st.builds(lambda request, refusal: Reply(request.command, request.parameter, refusal=refusal), REQUESTS,
              st.sampled_from(Refusal)),
)  # fmt: skip


@given(REQUESTS, STATIONS)
def test_every_request_comes_back(request: Request, station: int) -> None:
    frame = DIALECT.encode(request, station)
    assert DIALECT.frame_length(frame) == len(frame)
    assert DIALECT.frame_length(frame[:-1]) == 0
    assert DIALECT.decode_request(frame, station) == request


@given(REPLIES, STATIONS)
def test_every_reply_comes_back(reply: Reply, station: int) -> None:
    frame = DIALECT.encode_reply(reply, station)
    assert DIALECT.frame_length(frame + b"\x02rest") == len(frame)
    assert DIALECT.decode(frame, station) == reply


@given(st.one_of(st.binary(max_size=80), st.binary(max_size=20).map(lambda inner: b"\x0201" + inner + b"\x030000")))
def test_any_bytes_are_a_frame_or_one_kind_of_error(noise: bytes) -> None:
    for read in (DIALECT.decode, DIALECT.decode_request):
        try:
            read(noise, 1)
        except FrameError as error:
            assert str(error)  # noqa: PT017  # most bytes are no frame, and a few may be
    assert 0 <= DIALECT.frame_length(noise) <= max(len(noise), 64)


@given(REPLIES, st.data())
def test_no_single_changed_byte_passes(reply: Reply, data: st.DataObject) -> None:
    frame = DIALECT.encode_reply(reply, 1)
    place = data.draw(st.integers(0, len(frame) - 1))
    flip = data.draw(st.integers(1, 255))
    damaged = frame[:place] + bytes([frame[place] ^ flip]) + frame[place + 1 :]
    with pytest.raises(FrameError):
        DIALECT.decode(damaged, 1)


@given(REQUESTS)
def test_program_and_drive_are_not_mistaken_for_each_other(request: Request) -> None:
    with pytest.raises(FrameError):
        DIALECT.decode(DIALECT.encode(request, 1), 1)
    with pytest.raises(FrameError, match="station"):
        DIALECT.decode_request(DIALECT.encode(request, 1), 2)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e9])
def test_a_value_that_no_frame_holds_is_refused(value: float) -> None:
    with pytest.raises(FrameError, match="fit"):
        DIALECT.encode(Request(Command.GO, value=value), 1)


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
    for name, complaint in (("nobody", "not known"), ("../x", "no module"), ("dragrig.rig.trips", "DIALECT")):
        with pytest.raises(SettingsError, match=complaint):
            find_dialect(name)
