"""`--scheduler`: whatever spreads its work goes to the cluster named, and to no process here in its place."""

import shutil
import sys
from pathlib import Path

import pytest

from dragrig.cli import main
from places import CAMPAIGN

ADDRESS = "tcp://127.0.0.1:8786"


@pytest.mark.parametrize(
    "command",
    [
        ("gap", "diagnose", "first"),
        ("gap", "diagnose", "first", "second"),
        ("gap", "diagnose", "first", "second", "--together"),
        ("gap", "blind", "--cases", "2", "--out", "exam"),
        ("identify", "first", "second"),
        ("identify", "first", "second", "--together"),
    ],
    ids=" ".join,
)
def test_the_work_is_the_clusters(
    command: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("first", "second"):
        shutil.copytree(CAMPAIGN, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    # Where Dask is not installed, whoever turns to a cluster says so.
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main([*command, "--quiet", "--scheduler", ADDRESS]) == 2
    assert "dragrig[dask]" in capsys.readouterr().err
