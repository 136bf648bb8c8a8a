"""One program per rig, held by the operating system: real processes, one of them killed."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from dragrig.config.errors import DeviceError
from dragrig.config.rig import CardSettings, DriveSettings, HardwareSettings
from dragrig.rig.hardware.backend import HeldError, RigLock, hold_file, lock_name, port_name
from ending import kill
from property_tests import thorough

FILE_HOLDER = """
import pathlib, sys
from dragrig.rig.hardware.backend import hold_file
held = hold_file(sys.argv[1], pathlib.Path("."))
print("held", flush=True)
sys.stdin.readline()
"""
HOLDER = """
import sys
from dragrig.config.rig import HardwareSettings
from dragrig.rig.hardware.backend import RigLock
for _ in range(2):
    with RigLock(HardwareSettings(), sys.argv[1]):
        print("held", flush=True)
        sys.stdin.readline()
    print("let go", flush=True)
    sys.stdin.readline()
"""


def rig(device: str = "Dev1", port: str = "COM1") -> HardwareSettings:
    return HardwareSettings(card=CardSettings(device=device), drive=DriveSettings(port=port))


@pytest.fixture
def holder(tmp_path: Path) -> Iterator["subprocess.Popen[str]"]:
    """Another program that is at the rig, lets it go at a line on its standard input, and comes back at the next."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "held\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def told(holder: "subprocess.Popen[str]") -> str:
    """Give the other program a line, and return its answer."""
    assert holder.stdin is not None
    assert holder.stdout is not None
    holder.stdin.write("\n")
    holder.stdin.flush()
    return holder.stdout.readline()


def test_a_second_program_is_refused_and_told_who_holds_the_rig_until_it_is_let_go_or_its_holder_killed(
    holder: "subprocess.Popen[str]", tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(DeviceError, match=rf"Dev1 and COM1: process {holder.pid} uses this rig") as refused:
        RigLock(rig(), str(tmp_path))
    assert str(refused.value).count(".") == 1
    RigLock(rig(port="COM2"), str(tmp_path)).close()
    RigLock(rig(device="Dev2"), str(tmp_path)).close()
    assert told(holder) == "let go\n"
    RigLock(rig(), str(tmp_path)).close()
    assert holder.poll() is None
    assert told(holder) == "held\n"
    # It is no file that somebody could plant or remove.
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    if sys.platform == "linux":  # a file elsewhere
        assert not list(tmp_path.iterdir())
        held = Path(f"/proc/{holder.pid}/fd")
        assert not any("lock" in str(descriptor.readlink()) for descriptor in held.iterdir())
    for _ in range(300):  # who asks in vain leaves no trace that would end the telling or the lock
        with pytest.raises(DeviceError, match="uses this rig"):
            RigLock(rig(), str(tmp_path))
    kill(holder.pid)
    holder.wait()
    with RigLock(rig(), str(tmp_path)), pytest.raises(DeviceError, match=str(os.getpid())):
        RigLock(rig(), str(tmp_path))


def test_letting_go_twice_frees_nobody_elses_rig(tmp_path: Path) -> None:
    first = RigLock(rig(), str(tmp_path))
    first.close()
    with RigLock(rig(), str(tmp_path)):
        first.close()
        with pytest.raises(DeviceError, match=f"process {os.getpid()}"):
            RigLock(rig(), str(tmp_path))


@pytest.mark.skipif(sys.platform == "win32", reason="ports of Windows are no files")
def test_one_rig_has_one_name_whichever_link_leads_to_its_port(tmp_path: Path) -> None:
    port = tmp_path / "ttyS0"
    port.write_text("", "utf-8")
    link = tmp_path / "by-id"
    link.symlink_to(port)
    # Outside of /dev, no path is taken for a port.
    drives = [DriveSettings().model_copy(update={"port": str(path)}) for path in (port, link)]
    assert len({lock_name(rig().model_copy(update={"drive": drive})) for drive in drives}) == 1


def test_one_rig_has_one_name_however_its_port_is_spelled() -> None:
    assert lock_name(rig("dev1", "com1")) == lock_name(rig("Dev1", "COM1"))
    assert lock_name(rig(port=r"\\.\COM3")) == lock_name(rig(port="com3"))
    names = {lock_name(rig(port=entry)) for entry in ("COM1", "socket://localhost:4001", "socket://localhost:4002")}
    assert len(names) == 3


def test_a_long_name_has_a_lock_too(tmp_path: Path) -> None:
    long = rig(port=f"socket://{'h' * 200}:4001")
    with RigLock(long, str(tmp_path)), pytest.raises(DeviceError, match="uses this rig"):
        RigLock(long, str(tmp_path))


@pytest.mark.parametrize("port", ["COM3", "com3", r"\\.\COM3"])
def test_the_name_of_a_windows_port_is_text_and_asks_no_file_beside_the_program(
    port: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = {port_name(port)}
    if sys.platform != "win32":
        (tmp_path / "elsewhere").write_text("", "utf-8")
        (tmp_path / port).symlink_to("elsewhere")  # which Windows' own ports are to whoever asks
        names.add(port_name(port))
    assert names == {"COM3"}


@pytest.mark.parametrize("name", [thorough("Dev1-com3"), f"socket_{'h' * 80}_4001"])
def test_a_lock_of_a_file_says_which_process_holds_it_and_is_free_once_that_is_killed(
    name: str, tmp_path: Path
) -> None:
    program = [sys.executable, "-c", FILE_HOLDER, name]
    with subprocess.Popen(program, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline().strip() == b"held"
        for _ in range(2):  # who asks in vain takes the name of nobody
            with pytest.raises(HeldError, match=f"process {holder.pid}$"):
                hold_file(name, tmp_path)
        holder.kill()
    release = hold_file(name, tmp_path)
    with pytest.raises(HeldError, match=f"process {os.getpid()}$"):
        hold_file(name, tmp_path)
    release()
    release_again = hold_file(name, tmp_path)
    release()
    with pytest.raises(HeldError, match=f"process {os.getpid()}$"):
        hold_file(name, tmp_path)
    release_again()
    assert not list(tmp_path.glob("*.holder"))
