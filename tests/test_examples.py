"""The examples do as their first lines say, also with a folder and a file of the reader's own."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

import dragrig
from places import CAMPAIGN, ROOT

pytestmark = pytest.mark.usefixtures("finished_here")


def printed_by(name: str, *arguments: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the output of an example."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(ROOT / "examples" / f"{name}.py"), run_name="__main__")
    return capsys.readouterr().out


@pytest.mark.thorough
def test_steady_forces_stand_by_speed_with_their_scatter(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = printed_by("steady_forces", tmp_path / "runs", capsys=capsys).splitlines()[-3:]
    assert [float(row.split()[0]) for row in rows] == [2.0, 10.0, 40.0]
    assert sorted(rows, key=lambda row: float(row.split()[1])) == rows  # the model's force grows with speed
    assert (tmp_path / "runs" / "overview.pdf").read_bytes().startswith(b"%PDF")


def test_a_foreign_file_is_imported_filtered_and_exported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    time_s = np.arange(300) * 0.01
    position_mm = np.clip((time_s - 1.0) * 10.0, 0.0, 10.0)
    table = np.column_stack([time_s, 0.03 * (position_mm > 0.0), position_mm])
    np.savetxt(tmp_path / "lab.csv", table, "%.4f", ",", header="t [s],F [N],x [mm]", comments="")
    told = printed_by("foreign_file", tmp_path / "lab.csv", tmp_path / "runs", capsys=capsys)
    assert f"exported to {tmp_path / 'runs' / 'filtered.csv'}" in told
    [path] = (tmp_path / "runs").glob("*.h5")
    run = dragrig.load(path)
    assert run.trace.channels["force"].max() == pytest.approx(30.0)
    assert run.filtered is not None


@pytest.mark.thorough
def test_a_campaign_without_a_gap_says_so_and_which_run_would_tell_more(capsys: pytest.CaptureFixture[str]) -> None:
    verdict, following = printed_by("gap", CAMPAIGN, capsys=capsys).splitlines()
    assert verdict == "no_gap: no effect named"
    assert following.startswith("next: ")
