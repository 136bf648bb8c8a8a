"""What can be tested of Windows here: no POSIX-only modules, spawned processes, its console's encoding."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

POSIX_ONLY = ("termios", "fcntl", "pty", "resource", "tty", "grp", "pwd")
BLOCK = f"import sys\nfor name in {POSIX_ONLY!r}:\n    sys.modules[name] = None\n"
SPAWN = """
import multiprocessing, sys
from dragrig.cli import main

def work(arguments, codes):
    codes.put(main(arguments))

if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    codes = context.Queue()
    process = context.Process(target=work, args=(sys.argv[1:], codes))
    process.start()
    code = codes.get(timeout=50)
    process.join()
    sys.exit(code)
"""


@pytest.fixture
def windows_like(tmp_path: Path) -> dict[str, str]:
    site = tmp_path / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(BLOCK, "utf-8")
    (tmp_path / "spawn.py").write_text(SPAWN, "utf-8")
    return {**os.environ, "PYTHONPATH": str(site), "PYTHONUTF8": "0", "PYTHONIOENCODING": "cp1252"}


def test_posix_only_modules_are_really_out_of_reach(windows_like: dict[str, str], tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", "import termios"], env=windows_like, capture_output=True, check=False)
    assert b"ModuleNotFoundError" in done.stderr


@pytest.mark.parametrize(
    "arguments", [["init", "lab"], ["run", "drag", "--yes", "--pace", "fast", "--set", "travel_mm=10"]], ids=" ".join
)
def test_a_spawned_command_needs_no_posix(windows_like: dict[str, str], tmp_path: Path, arguments: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "spawn.py", *arguments], cwd=tmp_path, env=windows_like, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
