"""Progress: silent for a second, a bar on a terminal, plain lines elsewhere, nothing when quiet is asked for."""

import io
import sys
import time

import click
import pytest
from click.testing import CliRunner

from dragrig.cli import options
from dragrig.cli.console import ProgressMeter, is_quiet, with_progress
from dragrig.cli.operator import TerminalOperator
from dragrig.rig.operator import Answer, Prompt
from dragrig.setup import resolve
from driving import until


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def steps(clock: Clock, count: int, each_s: float) -> None:
    with ProgressMeter("work", count, quiet=is_quiet(), clock=clock) as meter:
        for number in range(count):
            clock.now += each_s
            meter.advance(1.0, f"item {number}")
        meter.say("remark")


def test_what_is_quick_shows_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    steps(Clock(), 10, 0.05)
    assert capsys.readouterr() == ("", "remark\n")


def test_without_a_terminal_there_is_a_line_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    steps(Clock(), 1000, 0.125)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "item 39: 4 %"  # nobody knows it before a tenth is done
    assert lines[2] == "item 159: 16 %, 1 min 45 s left"
    assert 3 <= len(lines) <= 8


class Tty(io.StringIO):
    def isatty(self) -> bool:
        return True


def show_on_terminal(monkeypatch: pytest.MonkeyPatch) -> Tty:
    made = Tty()
    monkeypatch.setattr(sys, "stderr", made)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    return made


def test_the_time_left_counts_down_within_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    screen, clock = show_on_terminal(monkeypatch), Clock()
    with ProgressMeter("work", 20, quiet=False, clock=clock) as meter:
        clock.now = 10.0
        meter.advance(10.0)
        # The bar is drawn anew by a thread of its own.
        for later_s, said in ((14.0, "6 s left"), (19.5, "less than 5 s left"), (30.0, "takes longer than expected")):
            clock.now = later_s
            deadline = time.monotonic() + 30.0
            while said not in screen.getvalue():
                assert time.monotonic() < deadline, screen.getvalue()
                time.sleep(0.02)


def test_a_terminal_gets_a_bar_with_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    screen, clock = show_on_terminal(monkeypatch), Clock()
    with ProgressMeter("work", 20, quiet=False, clock=clock) as meter:
        for number in range(15):
            clock.now += 0.2
            meter.advance(1.0, f"item {number}")
        # Drawn ten times a second by a thread of its own.
        until(lambda: "item 14" in screen.getvalue())
        meter.say("remark")
    shown = screen.getvalue()
    assert "75%" in shown
    assert "less than 5 s left" in shown
    assert "remark" in shown


def test_time_at_a_prompt_does_not_count(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    with ProgressMeter("work", 100.0, quiet=False, clock=clock) as meter:
        clock.now = 2.0
        meter.advance(20.0)
        meter.pause()
        clock.now = 1000.0
        meter.advance(0.0)
        clock.now = 1008.0
        meter.advance(40.0)
    assert capsys.readouterr().err == "work: 60 %, 8 s left\n"


class Closed(io.StringIO):
    def write(self, text: str) -> int:
        raise BrokenPipeError(32, "Broken pipe")


def test_work_goes_on_when_nobody_looks_any_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Closed())
    with ProgressMeter("work", 1.0, quiet=False) as meter:
        meter.say("first")
        meter.say("second")


def test_quiet_shows_nothing() -> None:
    @click.command()
    @options.quiet
    def command() -> None:
        steps(Clock(), 100, 1.0)
        assert list(with_progress([1, 2], "x")) == [1, 2]

    assert CliRunner().invoke(command, ["--quiet"]).output == ""
    assert "left" in CliRunner().invoke(command, []).output


@pytest.mark.parametrize(
    ("typed", "can_redo", "answer"),
    [
        ("\n", False, Answer.DONE),
        ("d\n", False, Answer.DONE),
        ("SKIP\n", False, Answer.SKIP),
        ("r\nwhat\na\n", False, Answer.ABORT),
        ("r\n", True, Answer.REDO),
        ("", False, Answer.ABORT),
    ],
)
def test_a_prompt_takes_the_first_letter(
    typed: str, can_redo: bool, answer: Answer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(typed))
    run = resolve("drag").programme().runs[0]
    assert TerminalOperator(yes=False).ask(Prompt("Fit a fresh specimen", run, can_redo, can_skip=True)) is answer
    output = capsys.readouterr()
    assert "Fit a fresh specimen." in output.err
    assert ("[r]edo" in output.err) is can_redo
    assert output.out == ""


def test_yes_answers_every_prompt(capsys: pytest.CaptureFixture[str]) -> None:
    run = resolve("drag").programme().runs[0]
    assert TerminalOperator(yes=True).ask(Prompt("Fit a fresh specimen", run, hands=False)) is Answer.DONE
    assert capsys.readouterr().err == ""


def test_the_last_seconds_are_a_bound(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    with ProgressMeter("work", 100.0, quiet=False, clock=clock) as meter:
        clock.now = 6.0
        meter.advance(95.0)
    assert capsys.readouterr().err == "work: 95 %, less than 5 s left\n"


def test_loading_before_the_work_does_not_make_it_look_long(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    with ProgressMeter("work", 10, quiet=False, clock=clock) as meter:
        for moment in (30.0, 40.0, 50.0, 60.0):
            clock.now = moment
            meter.advance(1.0)
    assert capsys.readouterr().err.splitlines()[-1] == "work: 40 %, 1 min 00 s left"
