"""The demonstration: the first thing that anybody sees."""

from pathlib import Path

import numpy as np
import pytest

from dragrig.api import reports
from dragrig.cli import main
from dragrig.rig.runfile import read_campaign, read_run
from dragrig.setup import resolve
from property_tests import thorough

SHORT_PLAN = """
name = "short"
[[steps]]
kind = "coulomb"
speed_mm_s = 10.0
travel_mm = 10.0
way_back = "stay"
[[steps]]
kind = "drag"
speed_mm_s = 40.0
travel_mm = 20.0
start_mm = 40.0
"""


def test_the_demonstration_makes_twelve_runs_of_every_kind() -> None:
    kinds = [run.protocol.kind for run in resolve(reports.DEMO_PLAN).programme().runs]
    assert len(kinds) == 12
    assert [kind for kind in kinds if kind != "return"] == [*ONE_OF_EACH, "drag", "drag"]


ONE_OF_EACH = ("blank", "relaxation", "coulomb", "drag")


@pytest.mark.parametrize("plan", ["short", thorough("shipped")])
def test_the_demonstration_leaves_runs_filtered_exported_and_drawn(
    plan: str,
    finished_here: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    if plan == "short":
        (tmp_path / "short.toml").write_text(SHORT_PLAN, "utf-8")
        monkeypatch.setattr(reports, "DEMO_PLAN", "short.toml")
    (tmp_path / "rig.toml").write_text(
        "backend = 'hardware'\n[stage]\nhighest_mm = 50\n", "utf-8"
    )  # a lab's own rig is left alone
    assert main(["demo"]) == 0
    (folder,) = (tmp_path / "dragrig-demo").iterdir()
    runs = read_campaign(folder).runs
    own = [run for run in runs if run.kind != "return"]
    assert [run.kind for run in own] == [*(("coulomb", "drag") if plan == "short" else (*ONE_OF_EACH, "drag", "drag"))]
    for run in runs:
        filtered = read_run(run.path).filtered
        assert filtered is not None
        assert np.isfinite(filtered.channels["force"]).all()
    assert {path.stem for path in (folder / "csv").glob("*.csv")} == {run.path.stem for run in runs}
    pictures = [*(folder / "pictures").glob("*.png"), folder / "overview.png"]
    assert {path.stem for path in pictures} == {*(entry.path.stem for entry in own), "overview"}
    assert all(path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 20_000 for path in pictures)
    output = capsys.readouterr()
    assert str(Path("dragrig-demo") / folder.name) in output.out
    assert "Traceback" not in output.err
