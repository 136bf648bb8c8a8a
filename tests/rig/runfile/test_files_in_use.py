"""Files that a person's system refuses: opened by another program for itself, read-only."""

import os
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dragrig.config.errors import OutputError
from dragrig.rig.runfile import finish, read_campaign, replace_text
from dragrig.rig.runfile.filesystem import refusal_remedy
from runfiles import record

EXCLUSIVE = """
import ctypes, sys
handle = ctypes.WinDLL("kernel32").CreateFileW(sys.argv[1], ctypes.c_uint(1 << 31), 0, None, 3, 0, None)
print(handle, flush=True)
sys.stdin.readline()
"""


@contextmanager
def refused(path: Path) -> Iterator[str]:
    """Have the system refuse to read a file; yields how that is said."""
    if os.name == "nt":
        program = [sys.executable, "-c", EXCLUSIVE, str(path)]
        with subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
            assert other.stdout is not None
            assert other.stdout.readline().strip() not in {b"", b"-1"}
            yield "is open in another program that lets nobody else read it: close it there, or ask for permission"
            other.communicate(b"\n")
        return
    path.chmod(0)
    user = os.geteuid()
    os.seteuid(user or 65534)  # root may read anything
    try:
        yield "may not be read; ask for permission"
    finally:
        os.seteuid(user)


def test_a_run_that_may_not_be_read_is_named_and_the_others_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = (finish(record(tmp_path / f"{name}.h5", 200)) for name in ("first", "second"))
    read_campaign(tmp_path)
    tmp_path.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    with refused(second) as how:
        campaign = read_campaign(Path())
    assert [run.path.name for run in campaign.runs] == [first.name]
    ((path, error),) = campaign.unreadable
    assert path.name == second.name
    assert str(error).startswith(f"{second.name}: {how}")


def test_a_read_only_file_is_no_file_that_another_program_has_open(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    assert refusal_remedy(path, "nt") == "close the program that has it open"
    path.write_text("", "utf-8")
    assert refusal_remedy(path, "nt") == "close the program that has it open"
    assert "permission" in refusal_remedy(path, "posix")
    assert refusal_remedy(tmp_path, "nt") == "it is a folder: choose another name"
    path.chmod(stat.S_IREAD)
    assert refusal_remedy(path, "nt") == refusal_remedy(path, "posix") == "it is read-only: make it writable"


@pytest.mark.skipif(os.name != "nt", reason="elsewhere a read-only file is replaced where its folder may be written to")
def test_a_read_only_file_is_named_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "contact.toml"
    path.write_text("", "utf-8")
    path.chmod(stat.S_IREAD)
    monkeypatch.setattr("dragrig.rig.runfile.filesystem.MAX_SHARING_WAIT_S", 600.0)
    with pytest.raises(OutputError, match="it is read-only: make it writable"):
        replace_text(path, "new")
