"""What can be tested of Windows here: no POSIX-only modules, spawned processes, its console's encoding."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

POSIX_ONLY = ("termios", "fcntl", "pty", "resource")
BLOCK = f"import sys\nfor name in {POSIX_ONLY!r}:\n    sys.modules[name] = None\n"
SPAWN = """
import multiprocessing, sys

def work(lines, codes):
    from dragrig.cli import main
    codes.put([main(line.split()) for line in lines])

if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    codes = context.Queue()
    process = context.Process(target=work, args=(sys.argv[1:], codes))
    process.start()
    print(codes.get(), file=sys.stderr)
    process.join()
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


def test_spawned_commands_need_no_posix(windows_like: dict[str, str], tmp_path: Path) -> None:
    lines = [
        "init lab",
        "run drag --yes --out c --set travel_mm=10 --set way_back=stay --set hold_s=0.5 --set wait_s=0 "
        "--set rig.sampling.rate_hz=200",
        "filter c",
        "export c",
        "table c",
        "mark c --bad windy",
        "recover c",
    ]
    done = subprocess.run(
        [sys.executable, "spawn.py", *lines], cwd=tmp_path, env=windows_like, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines()[-1] == str([0] * len(lines)).encode(), done.stderr
    assert {path.suffix for path in (tmp_path / "c").iterdir()} >= {".h5", ".toml", ".csv"}
