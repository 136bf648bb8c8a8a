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
    own = [one for one in runs if one.kind != "return"]
    assert [one.kind for one in own] == ["blank", "relaxation", "coulomb", "drag", "drag", "drag"]
    for one in runs:
        filtered = read_run(one.path).filtered
        assert filtered is not None
        assert np.isfinite(filtered.channels["force"]).all()
    assert {path.stem for path in (folder / "csv").glob("*.csv")} == {one.path.stem for one in runs}
    pictures = [*(folder / "pictures").glob("*.png"), folder / "overview.png"]
    assert {path.stem for path in pictures} == {*(one.path.stem for one in own), "overview"}
    assert all(path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 20_000 for path in pictures)
    told = capsys.readouterr()
    assert str(Path("dragrig-demo") / folder.name) in told.out
    assert "Traceback" not in told.err
