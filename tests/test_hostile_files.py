"""A file from somebody else is only data: it reaches no other file, no module, no port, and not all of the memory."""

import sys
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from runfiles import record
from scipy.io import savemat

from dragrig.analysis.importing import readers
from dragrig.cli import main
from dragrig.config.errors import ImportDataError, RunFileError, SettingsError
from dragrig.config.rig import DriveSettings
from dragrig.rig.runfile import finish, read_run
from dragrig.setup import resolve

SECRET = b"0123456789abcdef" * 512


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "secret"
    path.write_bytes(SECRET)
    return path


@pytest.mark.parametrize("way", ["external storage", "external link", "virtual dataset"])
def test_a_run_file_hands_over_no_other_file(
    way: str, secret: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = finish(record(tmp_path / "run.h5", 1000))
    with h5py.File(path, "r+") as file:
        del file["/entry/trace/force"]
        if way == "external storage":
            file["/entry/trace"].create_dataset("force", (1000,), "<f4", external=[(str(secret), 0, 4000)])
        elif way == "external link":
            with h5py.File(tmp_path / "other.h5", "w") as other:
                other["force"] = np.zeros(1000, "<f4")
            file["/entry/trace/force"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "force")
        else:
            layout = h5py.VirtualLayout((1000,), "<f4")
            layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "force", (1000,))
            file["/entry/trace"].create_virtual_dataset("force", layout)
    # HDF5 keeps the sources of a virtual dataset in a text heap, which does not look like that of a run file.
    why = "text is damaged" if way == "virtual dataset" else "another file"
    with pytest.raises(RunFileError, match=why):
        read_run(path)
    assert main(["export", str(path), "--out", str(tmp_path / "exported")]) == 2
    assert why in capsys.readouterr().err
    assert list((tmp_path / "exported").iterdir()) == []


def test_a_mat_file_hands_over_no_other_file(secret: Path, tmp_path: Path) -> None:
    path = tmp_path / "measured.mat"
    with h5py.File(path, "w") as file:
        file.create_dataset("force", (1000,), "<f8", external=[(str(secret), 0, 8000)])
    with pytest.raises(ImportDataError, match="another file"):
        readers.read_mat(path)


@pytest.mark.parametrize(
    "port", ["spy:///dev/ttyUSB0?file=notes.txt", "alt:///dev/ttyUSB0?class=x.y", "loop://", "/etc/passwd", "/dev/../x"]
)
def test_a_port_is_the_name_of_a_port(port: str) -> None:
    with pytest.raises(ValueError, match="a serial port, as COM3"):
        DriveSettings(port=port)


@pytest.mark.parametrize(
    "port", ["COM12", r"\\.\COM12", "/dev/ttyUSB0", "/dev/serial/by-id/usb-FTDI_A-if00:1", "socket://10.0.0.2:4001"]
)
def test_ports_of_every_system_are_known(port: str) -> None:
    assert DriveSettings(port=port).port == port


def test_a_run_file_loads_no_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "planted.py").write_text("raise SystemExit('loaded')", "utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    command = ["run", "drag", "--yes", "--out", "c", "--set", "rig.hardware.drive.dialect=planted"]
    assert main([*command, "--set", "travel_mm=10", "--set", "hold_s=0.5"]) == 0
    with pytest.raises(SettingsError, match="'planted', a module of somebody's own"):
        resolve(next((tmp_path / "c").glob("*drag*.h5")))
    assert "planted" not in sys.modules


def zipped_zeros(path: Path, name: str, size: int) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open(name, "w") as file:
        for _ in range(size >> 20):
            file.write(bytes(1 << 20))


def bomb(path: Path, size: int) -> None:
    values = size // 8
    match path.suffix:
        case ".npz":
            zipped_zeros(path, "force.npy", size)
        case ".xlsx":
            zipped_zeros(path, "xl/worksheets/sheet1.xml", size)
        case ".parquet":
            parquet.write_table(pa.table({"force": pa.array(np.zeros(values, np.float32))}), path, compression="zstd")
        case ".mat":
            savemat(path, {"run": {"force": np.zeros(values)}}, do_compression=True)


@pytest.mark.parametrize("ending", [".npz", ".xlsx", ".parquet", ".mat"])
def test_an_import_is_bounded_in_what_it_unpacks_to(
    ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(readers, "MAX_UNPACKED_BYTES", 8 << 20)
    monkeypatch.setattr(readers, "MAX_UNPACKED_TEXT_BYTES", 1 << 20)
    path = tmp_path / f"bomb{ending}"
    bomb(path, 16 << 20)
    assert path.stat().st_size < 1 << 20
    with pytest.raises(ImportDataError, match="GB is the limit"):
        readers.read_foreign(path)


def test_a_mat_file_of_two_compressed_variables_is_measured_whole(tmp_path: Path) -> None:
    path = tmp_path / "two.mat"
    savemat(path, {"first": np.zeros(1000), "second": np.arange(1000.0)}, do_compression=True)
    assert 16_000 <= readers._mat5_bytes(path) < 17_000
