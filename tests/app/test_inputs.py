"""What names on a command line stand for."""

from pathlib import Path

import pytest

from dragrig.config.errors import RunFileError
from dragrig.run_inputs import run_files


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "c1"
    folder.mkdir()
    for name in ("b-drag.h5", "a-blank.h5", "c-drag.recording.h5", "notes.txt", "d[1].h5"):
        (folder / name).touch()
    return folder


def names(*inputs: str | Path) -> list[str]:
    return [path.name for path in run_files(inputs)]


def test_a_folder_stands_for_its_finished_runs(runs: Path) -> None:
    assert names("c1") == ["a-blank.h5", "b-drag.h5", "d[1].h5"]


def test_patterns_are_expanded_here(runs: Path) -> None:
    assert names("c1/*-drag*.h5") == ["b-drag.h5"]
    assert names(str(runs / "*-blank.h5")) == ["a-blank.h5"]
    assert names("**/a-*.h5") == ["a-blank.h5"]


def test_a_name_with_brackets_is_a_file_first(runs: Path) -> None:
    assert names("c1/d[1].h5") == ["d[1].h5"]


def test_each_file_counts_once(runs: Path) -> None:
    assert names("c1/b-drag.h5", "c1", "c1/b-drag.h5") == ["b-drag.h5", "a-blank.h5", "d[1].h5"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nowhere.h5", "there is no such file or folder"),
        ("c1/*-coulomb-*.h5", "no file matches"),
        (".", "did you mean c1?"),
    ],
)
def test_an_input_that_names_nothing_is_reported(runs: Path, name: str, words: str) -> None:
    with pytest.raises(RunFileError) as caught:
        run_files([name])
    assert words in str(caught.value)


def test_a_folder_with_only_a_recording_points_to_its_recovery(tmp_path: Path) -> None:
    (tmp_path / "20260301-090000-drag-000.recording.h5").touch()
    with pytest.raises(RunFileError, match=r"dragrig recover"):
        run_files([tmp_path])
