"""A campaign as an archive for electronic laboratory notebooks."""

import hashlib
import json
from pathlib import Path
from types import SimpleNamespace
from zipfile import ZipFile

import pytest

from diagnoses import BLANK
from dragrig.api.eln import write_eln
from dragrig.cli import main
from dragrig.config.errors import OutputError, RunFileError
from dragrig.rig.runfile.campaigns import mark_bad, write_note
from places import copied_runs


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    folder = copied_runs(tmp_path / "pig 7", "005-blank.h5", "008-coulomb.h5", "010-drag.h5")
    mark_bad(folder / "008-coulomb.h5", "the pump had stopped")
    write_note(folder / "010-drag.h5", "new Tyrode")
    return folder


def test_an_archive_holds_a_campaign_with_its_marks_and_says_what_each_file_is(
    campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dragrig.present.files.svg_text", lambda _: BLANK)
    (campaign / "shopping.txt").write_text("Tyrode")
    archive = write_eln(campaign, tmp_path, "CC-BY-4.0")
    assert archive == tmp_path / "pig 7.eln"
    with ZipFile(archive) as opened:
        assert {name.split("/")[0] for name in opened.namelist()} == {"pig 7"}
        graph = json.loads(opened.read("pig 7/ro-crate-metadata.json"))["@graph"]
        said = {entity["@id"]: entity for entity in graph}
        kept = {path.name for path in campaign.iterdir()} - {"shopping.txt"} | {"pig 7.html"}
        files = [entity for entity in graph if entity["@type"] == "File"]
        assert {entity["name"] for entity in files} == kept
        for entity in files:
            content = opened.read(f"pig 7/pig 7/{entity['name']}")
            assert hashlib.sha256(content).hexdigest() == entity["sha256"]
            assert entity["contentSize"] == str(len(content))
    described = {entity["name"]: entity["description"] for entity in files}
    assert described["008-coulomb.h5"].endswith("marked bad: the pump had stopped")
    assert "marked" not in described["010-drag.h5"]
    assert described["008-coulomb.mark.toml"] == "mark of a bad run"
    assert described["010-drag.note.txt"] == "note on a run"
    assert said["./"]["license"] == {"@id": "#licence"}
    assert said["#licence"]["name"] == "CC-BY-4.0"
    monkeypatch.setattr("dragrig.api.eln.report", None)  # nothing is drawn in vain
    with pytest.raises(OutputError, match="is there already"):
        write_eln(campaign, tmp_path)


def test_an_archive_of_no_campaign_is_refused(
    campaign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunFileError, match="no run"):
        write_eln(tmp_path / "empty", tmp_path)
    assert main(["export", str(campaign / "010-drag.h5"), "--format", "eln"]) == 2
    assert "is a file; give the folder" in capsys.readouterr().err
    assert main(["export", str(campaign), "--format", "eln", "--columns", "force"]) == 2
    assert main(["export", str(campaign), "--licence", "CC0-1.0"]) == 2
    told = capsys.readouterr().err
    assert "leave out --columns" in told
    assert "--licence is for --format eln" in told
    assert not campaign.with_suffix(".eln").exists()


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:ConjunctiveGraph:DeprecationWarning")
def test_the_validator_of_ro_crates_finds_nothing_missing(
    campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import rocrate
    from rocrate_validator import models, services
    from rocrate_validator.utils.http import HttpRequester

    assert main(["export", str(campaign), "--format", "eln", "--licence", "https://example.org/terms"]) == 0
    with ZipFile(campaign.with_name("pig 7.eln")) as archive:
        archive.extractall(tmp_path / "unpacked")
    # The validator takes a space in the crate's own address for none.
    crate = (tmp_path / "unpacked" / "pig 7").rename(tmp_path / "crate")
    terms = Path(rocrate.__file__).with_name("data").joinpath("ro-crate.jsonld").read_text("utf-8")
    # The validator would fetch the terms of RO-Crates from their web address.
    answer = SimpleNamespace(
        status_code=200,
        ok=True,
        headers={"Content-Type": "application/ld+json"},
        text=terms,
        content=terms.encode(),
        json=lambda: json.loads(terms),
        raise_for_status=lambda: None,
    )
    monkeypatch.setattr(HttpRequester, "get", lambda *_, **__: answer, raising=False)
    settings = models.ValidationSettings(
        rocrate_uri=str(crate),
        profile_identifier="ro-crate-1.1",
        requirement_severity=models.Severity.RECOMMENDED,
    )
    issues = [str(issue.message) for issue in services.validate(settings).get_issues()]
    unstated = ("publisher", "`author`")
    assert [text for text in issues if not any(name in text for name in unstated)] == []
