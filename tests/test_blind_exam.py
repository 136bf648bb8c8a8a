"""The driver of an exam: balanced cases, sealed answers, a score."""

import importlib
import json
from collections import Counter
from hashlib import sha256
from pathlib import Path
from types import ModuleType

import pytest

BENCH = Path(__file__).parents[1] / "bench"


@pytest.fixture
def blind(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCH))
    return importlib.import_module("blind")


def test_an_exam_is_made_sealed_and_scored(
    blind: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    blind.make_all(2, 2, tmp_path, fresh=False)
    text = (tmp_path / "answers.json").read_bytes()
    answers = json.loads(text)
    assert sorted(answers) == ["0001", "0002"]
    assert (tmp_path / "answers.sha256").read_text("utf-8").split()[0] == sha256(text).hexdigest()
    for name in answers:
        assert len(list((tmp_path / name).glob("*.h5"))) >= 27
    told = {"verdict": answers["0001"]["verdict"], "effects": answers["0001"]["effects"], "ranking": []}
    (tmp_path / "0001" / "diagnosis.json").write_text(json.dumps(told), "utf-8")
    capsys.readouterr()
    blind.print_score(tmp_path)
    said = capsys.readouterr().out
    assert "1 of 2 campaigns have no diagnosis.json" in said
    assert "not what was sealed" not in said
    (tmp_path / "answers.json").write_text(json.dumps(answers), "utf-8")
    blind.print_score(tmp_path)
    assert "not what was sealed" in capsys.readouterr().out


def test_the_mix_is_balanced(blind: ModuleType) -> None:
    cases = blind.mix(240, 5)
    kinds = Counter(case.kind for case in cases)
    assert [kinds[kind] for kind in ("full", "third", "tenth", "none", "outside")] == [96, 36, 24, 24, 24]
    assert kinds["pair"] + kinds["rough"] + kinds["rough none"] == 36
    singles = Counter(case.effects[0] for case in cases if case.kind in {"full", "third", "tenth", "rough"})
    assert set(singles) == set(blind.CATALOGUE)
    assert max(singles.values()) - min(singles.values()) <= 3
    assert len({case.seed for case in cases}) == len(cases)
    assert blind.mix(240, 5) == cases
    assert blind.mix(240, 6) != cases
