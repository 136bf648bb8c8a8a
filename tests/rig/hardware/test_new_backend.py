"""A backend is one file: the one on the docs page is installed with its entry point and runs a plan."""

import io
import json
import re
import sys
from pathlib import Path

import h5py
import pytest

from dragrig.cli import main
from places import ROOT

PAGE = ROOT / "docs" / "new-backend.md"


@pytest.fixture
def backend(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Install the page's backend as `clamped`."""
    code = re.search(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    assert code is not None
    site = tmp_path / "site"
    (site / "clamped-1.dist-info").mkdir(parents=True)
    (site / "clamped-1.dist-info" / "METADATA").write_text("Name: clamped\nVersion: 1\n", "utf-8")
    entry = "[dragrig.backends]\nclamped = clamped_rig:open_backend\n"
    (site / "clamped-1.dist-info" / "entry_points.txt").write_text(entry, "utf-8")
    (site / "clamped_rig.py").write_text(code[1], "utf-8")
    monkeypatch.syspath_prepend(site)
    monkeypatch.delitem(sys.modules, "clamped_rig", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    return "clamped"


def test_a_plan_runs_on_the_backend_of_the_docs_page(backend: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "drag", "--set", "travel_mm=10", "--out", "c", "--yes", "--json", "--backend", backend]
    assert main(words) == 0, capsys.readouterr().err
    assert {run["status"] for run in json.loads(capsys.readouterr().out)["runs"]} == {"complete"}
    files = list(Path("c").rglob("*.h5"))
    assert files
    for file in files:
        with h5py.File(file) as run_file:
            assert run_file["entry/run"].attrs["backend"] == "clamp rig"
            assert run_file["entry/run"].attrs["clamp"] == "pneumatic"


def test_the_backend_of_the_docs_page_is_checked_with_its_clamp(
    backend: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", "--backend", backend]) == 0
    assert "clamp" in capsys.readouterr().out
