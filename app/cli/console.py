"""What goes to the terminal: results on standard output, everything else on standard error, errors as one sentence."""

import errno
import json
import os
import sys
import tempfile
import traceback
from collections.abc import Sequence
from pathlib import Path

import click

from dragrig.config.errors import AbortedError, DragrigError
from dragrig.plain import to_plain

QUIET = "dragrig.quiet"
"""Key in a click context's `meta`: whether only results and errors are wanted."""

BUG = 1
BAD_INPUT = 2


def result(text: str) -> None:
    """Print a result on standard output."""
    click.echo(text)


def result_json(value: object) -> None:
    """Print a result as JSON on standard output: dataclasses as objects, NaN and infinities as null."""
    click.echo(json.dumps(to_plain(value), indent=2, allow_nan=False))


def say(text: str) -> None:
    """Tell the person something that is no result, on standard error, unless they asked for quiet."""
    if not is_quiet():
        click.echo(text, err=True)


def is_quiet() -> bool:
    """Whether the running command was asked to print results and errors only."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(QUIET, False))


def exit_code_of(command: click.Command, arguments: Sequence[str] | None) -> int:
    """Run a command and return its exit code; whatever goes wrong is told in one sentence."""
    _never_fail_on_a_character()
    try:
        returned = command.main(args=arguments, prog_name="dragrig", standalone_mode=False)
        sys.stdout.flush()
    except SystemExit:
        return 0  # click's way out when whoever read our standard output has closed it, as `head` does
    except Exception as error:  # noqa: BLE001  # the last place where a person can be told in a sentence
        return _tell(error)
    return returned if isinstance(returned, int) else 0


def _tell(error: Exception) -> int:
    if isinstance(error, OSError) and _reader_is_gone(error):
        return 0
    return complain(*_sentence_and_code(error))


def _sentence_and_code(error: Exception) -> tuple[str, int]:
    code = BAD_INPUT
    match error:
        case DragrigError():
            sentence, code = str(error), error.exit_code
        case click.Abort():
            sentence, code = "aborted", AbortedError.exit_code
        case click.ClickException():
            sentence = _usage_sentence(error)
        case OSError() if error.filename is not None:
            sentence = f"{error.filename}: {error.strerror}; check the path and who may use it"
        case MemoryError():
            sentence = "there is not enough memory for this; take fewer samples, or close other programs"
        case _:
            sentence, code = _bug_sentence(error), BUG
    return sentence, code


def complain(sentence: str, code: int = BAD_INPUT) -> int:
    """Tell what is wrong in one line on standard error; return the exit code."""
    line = " ".join(sentence.splitlines())
    click.echo(f"dragrig: {line}{'' if line.endswith(('.', '?')) else '.'}", err=True)
    return code


def _usage_sentence(error: click.ClickException) -> str:
    if not isinstance(error, click.UsageError) or error.ctx is None:
        return error.format_message()
    path = error.ctx.command_path.removeprefix("dragrig").strip()
    where = f"{path}: " if path else ""
    if isinstance(error, click.NoSuchOption):
        from dragrig.config.loading import nearest

        known = [name for one in error.ctx.command.get_params(error.ctx) for name in one.opts if name.startswith("--")]
        return f"{where}{error.option_name} is not an option; {nearest(error.option_name, known)}"
    message = error.format_message()
    if message.endswith("?") or " known are " in message:
        return where + message
    return f"{where}{message.rstrip('.')}; see {error.ctx.command_path} --help."


def _bug_sentence(error: Exception) -> str:
    text = "".join(traceback.format_exception(error))
    with tempfile.NamedTemporaryFile(
        "w", prefix="dragrig-bug-", suffix=".log", delete=False, encoding="utf-8"
    ) as report:
        report.write(f"{sys.argv}\n{sys.version}\n\n{text}")
    return f"a bug ({type(error).__name__}: {str(error)[:120]}); please report it with the details in {report.name}."


def _never_fail_on_a_character() -> None:
    """Let a console that lacks a character (μ on cp1252) show a stand-in for it."""
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="replace")


def _reader_is_gone(error: OSError) -> bool:
    """Whether the last of our standard output found nobody who reads it."""
    if error.errno not in {errno.EPIPE, errno.EINVAL}:  # Windows says EINVAL
        return False
    try:
        sys.stdout.flush()
    except OSError:
        # What is still buffered would raise again when the interpreter ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


def shown_path(path: Path) -> str:
    """Spell a path for a person: relative where it lies below the working folder."""
    try:
        return str(path.absolute().relative_to(Path.cwd()))
    except ValueError:
        return str(path)
