"""The command line itself: start-up, errors as one sentence, exit codes, consoles and pipes."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from unicodedata import normalize

import click
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from dragrig.cli import main
from dragrig.cli.commands import SECTIONS, dragrig_group
from dragrig.cli.console import echo, legible, run_command_line
from dragrig.present.numbers import to_json_value
from property_tests import thorough

ALONE = "Without a plan the rig itself is checked, so"
HEAVY = ("scipy", "h5py", "matplotlib", "pandas", "pydantic", "numpy", "rich", "pyarrow", "nptdms")
COMMANDS = [(name, summary) for section in SECTIONS.values() for name, (_, summary) in section.items()]


def dragrig(*arguments: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-m", "dragrig", *arguments],
        cwd=cwd,
        capture_output=True,
        check=False,
        env={**os.environ, **environment},
    )


def test_help_loads_nothing_heavy() -> None:
    helps = [["--help"], *([*name.split(), "--help"] for name, _ in COMMANDS), ["gap", "effects", "--help"]]
    code = (
        "import json, sys; from dragrig.cli import main; loaded = {}\n"
        f"for words in {helps!r}:\n"
        f"    assert main(words) == 0; loaded[' '.join(words)] = [name for name in {HEAVY!r} if name in sys.modules]\n"
        "print(json.dumps({words: names for words, names in loaded.items() if names}), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stderr) == {}
    assert done.stdout.count("Usage: dragrig") == len(helps)


@pytest.mark.parametrize(("name", "line"), COMMANDS)
def test_the_overview_names_commands_that_exist(name: str, line: str) -> None:
    command = dragrig_group.get_command(click.Context(dragrig_group), name)
    assert command is not None
    assert command.name == name
    assert line.endswith(".")
    assert line in CliRunner().invoke(dragrig_group, ["--help"], terminal_width=200).output


@pytest.mark.parametrize("name", ["run", "check"])
def test_the_help_names_the_plans_that_ship(name: str) -> None:
    from dragrig.config.settings import shipped_files

    answer = " ".join(CliRunner().invoke(dragrig_group, [name, "--help"]).output.split())
    assert f"Shipped plans: {', '.join(shipped_files('plan'))}." in answer


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["inti"], "inti is not a command; did you mean init?"),
        (["check", "drag", "--specimn", "x"], "check: --specimn is not an option; did you mean --specimen?"),
        (["filter"], "filter: Missing argument 'RUN…'; see dragrig filter --help."),
        (["check", "--out", "x"], f"check: {ALONE} leave out --out; see dragrig check --help."),
        (
            ["find", "--until", "0001-01-01"],
            "0001-01-01 is no date; write it as 2026-05-04 or 2026-05-04T09:15.",
        ),
        (["check", "drga"], "drga: there is no such file and no plan of this name; did you mean drag?"),
    ],
)
def test_a_mistyped_line_gets_one_sentence(
    arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err == f"dragrig: {sentence}\n"


def _failing(error: BaseException) -> click.Command:
    @click.command()
    def command() -> None:
        raise error

    return command


def test_a_bug_is_reported_with_the_place_of_its_details(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command_line(_failing(ZeroDivisionError("division by zero")), []) == 1
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert "ZeroDivisionError" in errors
    report = Path(errors.rsplit(" in ", 1)[1].strip().removesuffix("."))
    try:
        assert "Traceback" in report.read_text("utf-8")
    finally:
        report.unlink()


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (KeyboardInterrupt(), 3, "aborted"),
        (PermissionError(13, "Permission denied", "runs/a.h5"), 2, "runs/a.h5: Permission denied"),
    ],
)
def test_expected_errors_have_their_own_exit_codes(
    error: BaseException, code: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command_line(_failing(error), []) == code
    assert words in capsys.readouterr().err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a device that is always full")
def test_a_full_disk_behind_the_output_is_told_in_a_sentence(tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "dragrig", "--help"],
            cwd=tmp_path, stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith("dragrig: standard output takes no more (No space left on device);")
    assert done.stderr.count("\n") == 1


def test_a_closed_pipe_is_no_error(tmp_path: Path) -> None:
    code = (
        "import sys, click; from dragrig.cli.console import legible, echo, run_command_line\n"
        "@click.command()\ndef many():\n    for _ in range(100_000): echo('line')\n"
        "sys.exit(run_command_line(many, []))"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("encoding", "shown"),
    [
        thorough("utf-8", "−1 μm ≥ 2σ × 3 … ε₀ → Σ ² é 漢"),
        ("cp1252", "-1 µm >= 2sigma × 3 … epsilon0 -> Sigma ² é ?"),
        thorough("cp850", "-1 µm >= 2sigma × 3 ... epsilon0 -> Sigma ² é ?"),
        ("cp437", "-1 µm ≥ 2σ x 3 ... ε0 -> Σ ² é ?"),
        thorough("ascii", "-1 um >= 2sigma x 3 ... epsilon0 -> Sigma 2 ? ?"),
    ],
)
def test_what_a_console_lacks_is_said_with_what_it_has(encoding: str, shown: str, tmp_path: Path) -> None:
    prompt = "−1 μm ≥ 2σ × 3 … ε₀ → Σ ² é 漢"
    done = dragrig(
        "check", "drag", "--set", f"prompt={prompt}", cwd=tmp_path, PYTHONIOENCODING=encoding, PYTHONUTF8="0"
    )
    assert done.returncode == 0, done.stderr
    assert shown in done.stdout.decode(encoding)


@pytest.mark.skipif(sys.platform != "win32", reason="only on Windows do console and files have letters of their own")
def test_what_is_redirected_has_the_letters_of_the_console_in_which_powershell_takes_it(tmp_path: Path) -> None:
    code = "import ctypes, sys; from dragrig.cli import main; ctypes.windll.kernel32.SetConsoleOutputCP(850); " + (
        "sys.exit(main(['check', 'drag', '--set', 'prompt=1 µm × 2 ä']))"
    )
    plain = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path, env=plain, stdout=subprocess.PIPE, creationflags=subprocess.CREATE_NEW_CONSOLE, check=True,
    )  # fmt: skip
    assert "1 µm × 2 ä" in done.stdout.decode("cp850")


@given(st.text(), st.sampled_from(["ascii", "cp1252", "cp850", "cp437", "utf-8", "cp932", "latin-1"]))
def test_every_text_has_letters_for_every_console(text: str, encoding: str) -> None:
    shown = legible(text, encoding)
    # Japan's code page has some signs, as ¬, in their wide form alone.
    assert normalize("NFKC", shown.encode(encoding).decode(encoding)) == normalize("NFKC", shown)
    assert legible(shown, encoding) == shown
    if text.isascii():
        assert shown == text


def test_json_has_no_nan() -> None:
    import numpy as np

    plain = to_json_value({"a": float("nan"), "b": np.array([1.0, np.inf]), "c": Path("x"), "d": (np.float64(2), True)})
    assert plain == {"a": None, "b": [1.0, None], "c": "x", "d": [2.0, True]}


@pytest.fixture
def run_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., object]:
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str, code: int = 0) -> object:
        assert main(arguments) == code
        return json.loads(capsys.readouterr().out)

    return run


def test_check_says_what_a_plan_would_do(run_json: Callable[..., dict[str, list[dict[str, object]]]]) -> None:
    answer = run_json("check", "paper", "--json")
    kinds = [run["kind"] for run in answer["runs"] if run["kind"] != "return"]
    assert [kinds.count(kind) for kind in ("relaxation", "blank", "coulomb", "drag")] == [4, 2, 1, 22]
    assert answer["findings"] == []


def test_check_lists_every_reason_against_a_plan(run_json: Callable[..., dict[str, list[str]]], tmp_path: Path) -> None:
    answer = run_json("check", "drag", "--set", "travel_mm=140", "--json", code=2)
    assert len(answer["findings"]) == 2
    assert all("outside the stage's travel of 0 to 150 mm" in text for text in answer["findings"])
    assert list(tmp_path.iterdir()) == []


def test_results_go_to_standard_output_alone(capsys: pytest.CaptureFixture[str]) -> None:
    @click.command()
    def command() -> None:
        echo("42")

    assert run_command_line(command, []) == 0
    assert capsys.readouterr() == ("42\n", "")


@pytest.mark.parametrize(
    "words", [("run",), ("table",), ("watch",), ("recover",), ("run", "--resume"), ("run", "--rig")]
)
def test_a_file_that_exists_is_never_missing(
    tmp_path: Path, words: tuple[str, ...], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.txt").write_text("not ours", "utf-8")
    command, *option = words
    plan = ["drag"] if option == ["--rig"] else []
    assert main([command, *plan, *option, "there.txt"]) == 2
    said = capsys.readouterr().err
    assert "there.txt" in said
    assert "no such" not in said


def test_a_mistake_in_a_file_of_ones_own_names_file_and_line(capsys: pytest.CaptureFixture[str]) -> None:
    def raise_from(folder: str) -> Callable[[], None]:
        scope: dict[str, Callable[[], None]] = {}
        exec(compile("def law():\n    return 1 / 0\n", str(Path("/somewhere", folder, "mine.py")), "exec"), scope)
        return scope["law"]

    for folder in ("sim_backend/effects", "rig/protocols"):
        assert run_command_line(click.Command("c", callback=raise_from(folder)), []) == 1
        assert f"{Path(folder)}{os.sep}mine.py, line 2: ZeroDivisionError: division by zero" in capsys.readouterr().err
