"""The operator at the terminal: answers prompts and sees a session's progress."""

import sys
from collections.abc import Iterable, Sequence
from types import TracebackType
from typing import Self

import click

from dragrig.cli.console import ProgressMeter, is_quiet
from dragrig.present.numbers import duration_text
from dragrig.rig.engine import AcquisitionOutcome
from dragrig.rig.operator import Answer, Prompt
from dragrig.rig.programme import PlannedRun, Programme
from dragrig.rig.reading import Reading
from dragrig.rig.runfile.model import RunStatus


class TerminalOperator:
    """Puts a session's prompts, progress and checks on standard error, and reads answers from standard input."""

    def __init__(self, *, yes: bool) -> None:
        self._yes = yes
        self._real_time = False
        # Asked here: on the session's own thread there is no command line.
        self._quiet = is_quiet()
        self._meter = ProgressMeter("", 1.0, quiet=self._quiet)
        self._pending: Sequence[PlannedRun] = ()
        self._seen_s = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._meter.__exit__(kind, error, trace)

    def ask(self, prompt: Prompt) -> Answer:
        """Put a prompt and read the answer; the first letter is enough, an empty line means done.

        `--yes` answers whatever asks for nobody's hands.
        """
        if self._yes and not prompt.hands:
            return Answer.DONE
        self._meter.pause()
        left_out = {Answer.REDO: not prompt.can_redo, Answer.SKIP: not prompt.can_skip}
        choices = [one for one in Answer if not left_out.get(one, False)]
        words = ", ".join(f"[{one.value[0]}]{one.value[1:]}" for one in choices)
        click.echo(f"\n{prompt.text}.", err=True)
        if prompt.hands:
            discard_typed_input()
        while True:
            click.echo(f"  {words}: ", err=True, nl=False)
            line = sys.stdin.readline() if sys.stdin is not None else ""  # None when it was closed before we began
            if not line:
                why = "this asks for hands at the rig" if prompt.hands else "--yes answers every such prompt with done"
                click.echo(f"\nNobody answers on standard input; {why}.", err=True)
                return Answer.ABORT
            said = line.strip().lower() or Answer.DONE.value
            for choice in choices:
                if choice.value.startswith(said):
                    return choice

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        """Start the bar."""
        self._real_time = real_time
        self._pending = pending
        self._meter = ProgressMeter(programme.plan.name, self._takes(pending), quiet=self._quiet)

    def waits(self, duration_s: float, why: str) -> None:
        """Say what is waited for, where time is real."""
        if self._real_time:
            self._meter.say(f"  {why}: {duration_text(duration_s)}")

    def run_begins(self, run: PlannedRun, order: int) -> None:
        """Name the run that the bar is at."""
        del order
        self._seen_s = 0.0
        # Runs before it were made or skipped, and it may be made again.
        before = [one for one in self._pending if one.index < run.index]
        rest_s = run.wait_s if self._real_time else 0.0
        label = f"run {len(before) + 1} of {len(self._pending)}, {run.protocol.summary()}"
        self._meter.to(self._takes(before) + rest_s, label)

    def reads(self, reading: Reading) -> None:
        """Move the bar."""
        now = float(reading.time[-1])
        self._meter.advance(now - self._seen_s)
        self._seen_s = now

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        """Say how the run ended and what its checks saw."""
        self._meter.say(run_result_line(run, outcome))

    def _takes(self, runs: Iterable[PlannedRun]) -> float:
        return sum(run.duration_s + (run.wait_s if self._real_time else 0.0) for run in runs)


def discard_typed_input() -> None:
    """Drop what was typed before it was asked for: an Enter too many must not set a stage in motion."""
    if not sys.stdin.isatty():
        return
    if sys.platform == "win32":
        import msvcrt

        while msvcrt.kbhit():
            msvcrt.getwch()
    else:
        import termios

        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)


def run_result_line(run: PlannedRun, outcome: AcquisitionOutcome) -> str:
    """One line about a run that was made: how it ended, and what the checks right after it saw."""
    checks = outcome.checks.values
    seen = []
    if "rest_offset_mN" in checks:
        seen.append(f"at rest {checks['rest_offset_mN']:+.1f} mN, noise {checks['rest_noise_mN']:.1f} mN")
    seen.append(f"off the command by {1000 * float(checks['following_error_mm']):.1f} µm")
    line = f"{run.index:3d}  {run.protocol.summary():22} {outcome.status.value:9} {', '.join(seen)}"
    told = [outcome.reason] if outcome.status is not RunStatus.COMPLETE else []
    return "; ".join((line, *told, *(f"NOTE {warning}" for warning in outcome.checks.warnings)))
