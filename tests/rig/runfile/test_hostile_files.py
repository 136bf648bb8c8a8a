"""A file from somebody else is only data: it reaches no other file, no module, no port, and not all of the memory."""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import h5py
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from scipy.io import savemat

from dragrig.analysis.importing import file_kinds, matlab, readers
from dragrig.cli import main
from dragrig.config.errors import ImportDataError, RunFileError, SettingsError
from dragrig.config.rig import DriveSettings
from dragrig.rig import mark_bad, write_note
from dragrig.rig.runfile import finish, hdf5, read_run
from dragrig.session_state import SessionState
from dragrig.setup import resolve
from dragrig.watch import CampaignWatch, serve_state_page
from property_tests import thorough
from runfiles import record

if TYPE_CHECKING:
    from playwright.sync_api import Browser

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
        matlab.read_mat73(path)


def nest(file: h5py.File) -> None:
    group = file["entry"]
    for _ in range(100):
        group = group.create_group("deeper")


def crowd(file: h5py.File) -> None:
    group = file["entry"].create_group("crowd")
    for number in range(10_001):
        group[str(number)] = file["entry/run"]


@pytest.mark.parametrize(("spoil", "why"), [(nest, "more than 32 deep"), (crowd, "more than 10000 names")])
def test_a_run_file_of_endless_groups_is_refused_before_it_is_gone_through(
    spoil: Callable[[h5py.File], None],
    why: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = finish(record(tmp_path / "run.h5", 1000))
    with h5py.File(path, "r+") as file:
        spoil(file)
    gone_through: list[h5py.File] = []
    monkeypatch.setattr("dragrig.rig.runfile.reader.refuse_foreign_storage", gone_through.append)
    assert main(["info", str(path)]) == 2
    assert why in capsys.readouterr().err
    assert not gone_through
    measured = tmp_path / "measured.mat"
    shutil.copy(path, measured)
    if spoil is nest:
        with pytest.raises(ImportDataError, match=why):
            readers.read_foreign(measured)


def test_a_file_of_endless_text_heaps_is_not_searched_for_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "heaps.h5"
    rest = hdf5.MIN_HEAP_BYTES - hdf5.HEAP_HEADER_BYTES
    heap = hdf5.HEAP_SIGNATURE + hdf5.MIN_HEAP_BYTES.to_bytes(8, "little") + bytes(8) + rest.to_bytes(8, "little")
    path.write_bytes(heap.ljust(hdf5.MIN_HEAP_BYTES, b"\0") * 40)
    assert hdf5.find_damaged_text(path) is None
    monkeypatch.setattr(hdf5, "MAX_SEARCHED_FOR_HEAPS_BYTES", 30 * path.stat().st_size)
    assert hdf5.find_damaged_text(path) == 30 * hdf5.MIN_HEAP_BYTES


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
    monkeypatch.setattr(file_kinds, "MAX_UNPACKED_BYTES", 8 << 20)
    monkeypatch.setattr(file_kinds, "MAX_UNPACKED_TEXT_BYTES", 1 << 20)
    path = tmp_path / f"bomb{ending}"
    bomb(path, 16 << 20)
    assert path.stat().st_size < 1 << 20
    with pytest.raises(ImportDataError, match="GB is the limit"):
        readers.read_foreign(path)


def test_a_mat_file_of_two_compressed_variables_is_measured_whole(tmp_path: Path) -> None:
    path = tmp_path / "two.mat"
    savemat(path, {"first": np.zeros(1000), "second": np.arange(1000.0)}, do_compression=True)
    assert 16_000 <= matlab.unpacked_bytes(path) < 17_000


HOSTILE = (
    "\x1b[35mred\x1b]0;title\x07\x1b]8;;http://x\x1b\\link\x1b]52;c;QUFB\x07\x9b2J\x85\x08\x08\rover\u202eelif\u2066"
    "<b>bold</b><script>alert(1)</script>{{ 1 }} [red]=1+1"
)
"""What drives a terminal, turns letters round, is HTML, a template, rich's own markup, and begins a formula."""
NOT_IN_NAMES = frozenset(map(chr, range(32))) | frozenset('<>:"|?*\\')


def for_a_name(text: str) -> str:
    """What of a text may be in a file's name: Windows takes neither controls nor some signs."""
    return "".join(letter for letter in text if letter != "/" and not (os.name == "nt" and letter in NOT_IN_NAMES))


def make_hostile(file: h5py.File) -> None:
    """Put what drives a terminal into every text of a run file that may be any text."""
    fixed = {"NX_class", "default", "format", "status", "run_id", "start_time", "end_time", "signal", "axes", "fixture",
             "units", "names", "raw_sha256", "role", "surface"}  # fmt: skip

    def spoil(_: str, item: h5py.Group | h5py.Dataset) -> None:
        for name, value in item.attrs.items():
            if isinstance(value, str) and name not in fixed:
                item.attrs[name] = f"{value}{HOSTILE[:40]}" if name in {"kind", "backend"} else HOSTILE

    file.visititems(spoil)
    run, trace = file["entry/run"], file["entry/trace"]
    run.attrs["reason"] = HOSTILE
    for group in ("run", "protocol", "capsule", "specimen", "checks"):
        file["entry"][group].attrs[HOSTILE[:40]] = HOSTILE
    events = np.zeros(2, run["events"].dtype)
    events["message"], events["kind"] = HOSTILE.encode()[:150], HOSTILE[:9].encode()
    del run["events"]
    run["events"] = events
    channel = HOSTILE[:12]
    trace[channel] = np.zeros(trace["time"].shape, "<f4")
    trace[channel].attrs["units"] = HOSTILE


@pytest.fixture(scope="module")
def hostile_campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("root") / "c"
    short = ["--set", "travel_mm=10", "--set", "hold_s=0.5", "--set", "speed_mm_s=[10.0, 20.0]"]
    assert main(["run", "drag", "--yes", "--out", str(folder), "--note", HOSTILE, "--operator", HOSTILE, *short]) == 0
    for number, path in enumerate(sorted(folder.glob("*.h5"))):
        with h5py.File(path, "r+") as file:
            make_hostile(file)
        path.rename(folder / for_a_name(f"={number}\x1b]0;x\x07\u202e.h5"))
    first, second, *_ = sorted(folder.glob("*.h5"))
    mark_bad(first, HOSTILE)
    write_note(second, HOSTILE)
    (folder / f"damaged{for_a_name(HOSTILE)[:60]}.h5").write_bytes(b"no run")
    (folder / for_a_name(f"cut{HOSTILE[:10]}.recording.h5")).write_bytes(b"no recording")
    state = SessionState(plan=HOSTILE, backend=HOSTILE, doing="asking", said=HOSTILE)
    (folder / "session-state.json").write_text(state.model_dump_json(), "utf-8")
    return folder


def hidden_letters(text: str) -> set[str]:
    """The letters of a text that are not to be seen and do something: controls, and what turns the order round."""
    harmless = "\n\t\u00a0\u2009\u202f"
    return {letter for letter in text if not letter.isprintable() and letter not in harmless}


SHOWN = (
    ["info"], ["info", "--json"], ["info", "--verify"], ["table", "."], ["table", ".", "--json"], ["list", ".."],
    ["list", "..", "--json"], ["find", ".."], ["mark", "--bad", HOSTILE], ["mark", "--note", HOSTILE], ["filter"],
    ["filter", "--json"], ["export", "--out", "exported"], ["watch", ".", "--once"], ["watch", ".", "--once", "--json"],
    ["recover", "."], ["run", f"no{HOSTILE[:30]}.toml"], [HOSTILE], ["info", f"no{HOSTILE}.h5"],
    ["check", "drag", "--set", f"{HOSTILE}=1"], ["import", f"no{HOSTILE}.csv"],
)  # fmt: skip
# Others print the same in the same way.
SHOWN_ALIKE = (["info", "--verify"], ["list", "..", "--json"], ["filter", "--json"], ["watch", ".", "--once", "--json"],
               ["mark", "--note", HOSTILE])  # fmt: skip


@pytest.mark.parametrize(
    "command",
    [thorough(words) if words in SHOWN_ALIKE else words for words in SHOWN],
    ids=[ascii(" ".join(words)[:24]) for words in SHOWN],
)
def test_what_a_file_says_is_shown_and_drives_no_terminal(
    command: list[str],
    hostile_campaign: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "root" / "c"
    shutil.copytree(hostile_campaign, folder)
    monkeypatch.chdir(folder)
    takes_files = command[0] in {"info", "mark", "filter", "export"} and not command[-1].startswith("no")
    files = [str(path) for path in sorted(folder.glob("*.h5"))] if takes_files else []
    code = main([*command, *files])
    output = capsys.readouterr()
    assert code in {0, 2}, output.err
    assert hidden_letters(output.out) | hidden_letters(output.err) == set()
    assert r"\u001b" in output.out + output.err
    if "--json" in command:
        json.loads(output.out)


def test_a_page_and_its_figures_show_what_a_file_says(
    hostile_campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = max(hostile_campaign.glob("=*.h5"))
    assert main(["report", str(run), "--out", "run.html", "--quiet"]) == 0
    page = Path("run.html").read_text("utf-8")
    assert hidden_letters(page) == set()
    assert "<script>alert" not in page
    assert "<img" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;{{ 1 }} [red]=1+1" in page
    assert r"\u001b]0;title\u0007" in page
    assert main(["show", str(run), "--out", "run.svg", "--quiet"]) == 0
    ET.parse("run.svg")


def test_a_pdf_shows_what_a_file_says(hostile_campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pypdf import PdfReader

    monkeypatch.chdir(tmp_path)
    run = max(hostile_campaign.glob("=*.h5"))
    assert main(["show", str(run), "--out", "run.pdf", "--quiet"]) == 0
    reader = PdfReader("run.pdf")
    (page,) = reader.pages
    text = page.extract_text()
    assert hidden_letters(text) == set()
    assert r"\u001b" in text
    assert not page.annotations
    assert not {"/OpenAction", "/AA", "/Names"} & set(reader.root_object)
    assert hidden_letters("".join(map(str, (reader.metadata or {}).values()))) == set()


def test_the_watch_page_shows_what_a_file_says(hostile_campaign: Path, browser: "Browser") -> None:
    from playwright.sync_api import expect

    from browsing import PHONE_PX, opened

    with serve_state_page(0) as server:
        server.show(CampaignWatch(hostile_campaign).look())
        with opened(browser, f"http://127.0.0.1:{server.port}/", PHONE_PX) as (page, heard):
            expect(page.locator("#state")).to_contain_text("Died", timeout=600_000)
            seen = page.locator("body").inner_text()
            assert hidden_letters(seen) == set()
            assert "<script>alert(1)</script>" in seen
            assert r"\u001b[35mred" in seen
            assert page.locator("script").count() == 1
            assert hidden_letters(page.title()) == set()
            assert page.evaluate("document.documentElement.scrollWidth") <= PHONE_PX
            assert heard.messages == []


def test_a_spreadsheet_computes_nothing_that_a_file_says(
    hostile_campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    runs = sorted(hostile_campaign.glob("=*.h5"))[1::2]
    copy = shutil.copytree(hostile_campaign, tmp_path / "copy") / runs[0].name
    assert main(["compare", str(runs[0]), str(copy), "--out", "compared", "--quiet"]) == 0
    with Path("compared/comparison.csv").open(encoding="utf-8", newline="") as file:
        cells = [cell for row in csv.reader(file) for cell in row]
    assert any(cell.startswith("'=") for cell in cells)
    assert not any(cell.startswith(("=", "@")) for cell in cells)


@pytest.mark.skipif(os.name == "nt", reason="no pty on Windows")
def test_a_terminal_is_driven_by_the_program_alone(hostile_campaign: Path) -> None:
    keyboard, screen = os.openpty()
    command = [sys.executable, "-m", "dragrig", "watch", str(hostile_campaign), "--once"]
    subprocess.run(command, stdout=screen, stderr=screen, env=os.environ | {"TERM": "xterm-256color"}, check=True)
    os.close(screen)
    shown = os.read(keyboard, 1 << 16).decode()
    os.close(keyboard)
    own_styles = re.compile(r"\x1b\[(0|1|2|1;3[123])m")
    assert own_styles.search(shown)
    assert r"\u001b[35mred" in shown
    assert hidden_letters(own_styles.sub("", shown).replace("\r\n", "\n")) == set()
