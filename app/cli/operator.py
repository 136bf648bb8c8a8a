"""The operator at the terminal: answers prompts and sees a session's progress."""

import sys
from collections.abc import Iterable, Sequence
from types import TracebackType
from typing import Self

import click

from dragrig.cli.console import ProgressMeter, is_quiet
from dragrig.present import duration_text
from dragrig.rig import AcquisitionOutcome, Answer, PlannedRun, Programme, Prompt, Reading, RunStatus


class TerminalOperator:
    """Prints a session's prompts, progress and checks on standard error, and reads answers from standard input."""

    def __init__(self, *, yes: bool) -> None:
        self._yes = yes
        self._real_time = False
        # Read here: the session's own thread has no click context.
        self._quiet = is_quiet()
        self._meter = ProgressMeter("", 1.0, quiet=self._quiet)
        self._pending: Sequence[PlannedRun] = ()
        self._seen_s = 0.0
        self._order = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._meter.__exit__(kind, error, trace)

    def ask(self, prompt: Prompt) -> Answer:
        """Print a prompt and read the answer; its first letter is enough, an empty line means done.

        `--yes` answers every prompt that needs no hands at the rig.
        """
        if self._yes and not prompt.hands:
            return Answer.DONE
        self._meter.pause()
        allowed = {Answer.REDO: prompt.can_redo, Answer.SKIP: prompt.can_skip}
        choices = [answer for answer in Answer if allowed.get(answer, True)]
        names = ", ".join(f"[{answer.value[0]}]{answer.value[1:]}" for answer in choices)
        click.echo(f"\n{prompt.text}.", err=True)
        if prompt.run is not None and prompt.run.mounting not in prompt.text:
            click.echo(f"  Next run: {prompt.run.mounting}.", err=True)
        if prompt.hands:
            _discard_typed_input()
        while True:
            click.echo(f"  {names}: ", err=True, nl=False)
            line = sys.stdin.readline() if sys.stdin is not None else ""  # None when it was closed before the start
            if not line:
                why = "this needs hands at the rig" if prompt.hands else "--yes answers every such prompt with done"
                click.echo(f"\nNobody answers on standard input; {why}.", err=True)
                return Answer.ABORT
            typed = line.strip().lower() or Answer.DONE.value
            for answer in choices:
                if answer.value.startswith(typed):
                    return answer

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        """Start the progress bar."""
        self._real_time = real_time
        self._pending = pending
        self._meter = ProgressMeter(programme.plan.name, self._duration_s(pending), quiet=self._quiet)

    def waits(self, duration_s: float, why: str) -> None:
        """Print what is waited for, in real time."""
        if self._real_time:
            self._meter.say(f"  {why}: {duration_text(duration_s)}")

    def run_begins(self, run: PlannedRun, order: int) -> None:
        """Show which run the bar is at."""
        self._seen_s = 0.0
        # Runs before it were made or skipped, and it may be made again.
        before = [earlier for earlier in self._pending if earlier.index < run.index]
        rest_s = run.wait_s if self._real_time else 0.0
        self._order = order
        label = f"{len(before) + 1} of {len(self._pending)}: run {order}, {run.protocol.summary()}"
        self._meter.to(self._duration_s(before) + rest_s, label)

    def reads(self, reading: Reading) -> None:
        """Advance the bar."""
        now = float(reading.time[-1])
        self._meter.advance(now - self._seen_s)
        self._seen_s = now

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        """Print one line: how the run ended, and its checks."""
        checks = outcome.checks.values
        results = []
        if "rest_offset_mN" in checks:
            results.append(f"at rest {checks['rest_offset_mN']:+.1f} mN, noise {checks['rest_noise_mN']:.1f} mN")
        results.append(f"following error {1000 * float(checks['following_error_mm']):.1f} µm")
        line = f"{self._order:3d}  {run.protocol.summary():22} {outcome.status.value:9} {', '.join(results)}"
        reason = [outcome.reason] if outcome.status is not RunStatus.COMPLETE else []
        self._meter.say("; ".join((line, *reason, *(f"NOTE {warning}" for warning in outcome.checks.warnings))))

    def _duration_s(self, runs: Iterable[PlannedRun]) -> float:
        return sum(run.duration_s + (run.wait_s if self._real_time else 0.0) for run in runs)


def _discard_typed_input() -> None:
    """Discard what was typed before the prompt: an Enter too many must not start a motion."""
    if not sys.stdin.isatty():
        return
    if sys.platform == "win32":
        import msvcrt

        while msvcrt.kbhit():
            msvcrt.getwch()
    else:
        import termios

        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)
