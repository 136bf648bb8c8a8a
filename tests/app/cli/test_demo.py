"""The demonstration: the first thing that anybody sees."""

from pathlib import Path

import numpy as np
import pytest

from dragrig.cli import main
from dragrig.rig.runfile import read_campaign, read_run


def test_the_demonstration_leaves_runs_filtered_exported_and_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text(
        "backend = 'hardware'\n[stage]\nhighest_mm = 50\n", "utf-8"
    )  # a lab's own rig is left alone
    assert main(["demo"]) == 0
    (folder,) = (tmp_path / "dragrig-demo").iterdir()
    runs = read_campaign(folder).runs
    own = [run for run in runs if run.kind != "return"]
    assert [run.kind for run in own] == ["blank", "relaxation", "coulomb", "drag", "drag", "drag"]
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
