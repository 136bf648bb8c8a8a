"""Reports on runs and campaigns: what they say, where they go, and how they look in a browser."""

import json
import re
import shutil
import sys
from html import unescape
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

import dragrig
from diagnoses import ALL, page_file
from dragrig.analysis.measures import measure
from dragrig.cli import main
from dragrig.config.errors import OutputError, RunFileError
from dragrig.present.campaign import campaign_document, examine_campaign
from dragrig.present.document import Column, Table
from dragrig.present.exam import exam_document
from dragrig.present.html_page import inline_svg, render_page
from dragrig.present.run import attribute_texts, check_texts
from dragrig.rig import mark_bad
from dragrig.rig.runfile import read_run
from exams import large_exam
from places import CAMPAIGN
from property_tests import thorough

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.usefixtures("finished_here")


SOME = tuple(CAMPAIGN / f"{name}.h5" for name in ("005-blank", "010-drag", "014-drag"))


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign with a bad run, a damaged file, one that is still recorded, and a session."""
    folder = tmp_path_factory.mktemp("campaign") / "first piece"
    folder.mkdir()
    for path in SOME:
        shutil.copy(path, folder)
    made = folder.with_name("made")
    dragrig.simulate("blank", out=made, assignments=["rig.sampling.rate_hz=200", "speed_mm_s=[20.0]"])
    for entry in (*made.glob("*.h5"), *made.glob("*.toml")):
        shutil.copy(entry, folder)
    mark_bad(folder / "014-drag.h5", "the gut <slid> off")
    (folder / "015-broken.h5").write_bytes(b"no run file")
    shutil.copy(CAMPAIGN / "005-blank.h5", folder / "016-drag.recording.h5")
    (folder / "session-20200101-000000Z.toml").write_text("plan = 1\n", "utf-8")
    return folder


@pytest.fixture(scope="module")
def campaign_page(campaign: Path) -> Path:
    return dragrig.report(campaign, campaign.with_name("campaign.html"))


@pytest.fixture(scope="module")
def run_page(campaign: Path) -> Path:
    return dragrig.report(campaign / "014-drag.h5", campaign.with_name("run.html"))


@pytest.mark.thorough
def test_a_page_drawn_by_several_processes_is_the_same_page(tmp_path: Path) -> None:
    folder = tmp_path / "twice"
    folder.mkdir()
    for number, source in enumerate([*CAMPAIGN.glob("*.h5")] * 2):
        shutil.copy(source, folder / f"{number:03}-{source.name[4:]}")
    pages = [dragrig.report(folder, tmp_path / f"{workers}.html", workers=workers) for workers in (1, 2)]
    alone, together = (page.read_text("utf-8") for page in pages)
    assert alone.count("<svg") >= 17
    assert together == alone


def words(page: Path) -> str:
    html = re.sub(r"<(style|script|svg).*?</\1>", " ", page.read_text("utf-8"), flags=re.DOTALL)
    return " ".join(unescape(re.sub(r"<[^>]+>", " ", html)).replace("\u00a0", " ").split())


def test_a_runs_page_says_what_was_measured_and_that_it_is_bad(run_page: Path, campaign: Path) -> None:
    answer = words(run_page)
    steady = measure(read_run(campaign / "014-drag.h5")).steady_force
    assert steady.value is not None
    assert steady.interval is not None
    assert f"{steady.value:.1f}" in answer
    assert f"{steady.interval[0]:.1f}" in answer
    assert "Not a good run: marked bad: the gut <slid> off" in answer
    assert "<slid>" not in run_page.read_text("utf-8")
    assert "speed 60 mm/s" in answer
    assert "travel 40 mm" in answer


def test_a_campaigns_page_says_what_was_left_out_and_why(campaign_page: Path) -> None:
    answer = words(campaign_page)
    assert "Campaign first piece" in answer
    assert "4 left out" in answer
    left_out = answer.split("Left out", 1)[1].split("Sessions", 1)[0]
    assert "014-drag.h5 drag marked bad: the gut <slid> off" in left_out
    assert "015-broken.h5" in left_out
    assert "016-drag.recording.h5" in left_out
    assert "dragrig recover finishes it" in left_out
    assert "session record" in left_out
    assert "session-20200101-000000Z.toml" in left_out


def test_a_campaigns_page_has_each_run_and_each_session_with_its_runs(campaign_page: Path) -> None:
    html = campaign_page.read_text("utf-8")
    ids = re.findall(r'<details id="([^"]+)">', html)
    assert {f"run-{path.stem}" for path in SOME} <= set(ids)
    assert not any("return" in entry for entry in ids)
    assert set(re.findall(r'<a href="#(run-[^"]+)">', html)) == set(ids)
    sessions = html.split('id="sessions"', 1)[1].split("</section>", 1)[0]
    cells = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in sessions.split("<tr>")]
    assert ["blank", "simulated", "", "2"] in [row[1:5] for row in cells]
    assert "Not drawn: 1 return stroke;" in words(campaign_page)


def test_a_campaign_without_sessions_is_reported(tmp_path: Path) -> None:
    shutil.copy(CAMPAIGN / "010-drag.h5", tmp_path)
    document = campaign_document(examine_campaign(tmp_path))
    assert "sessions" not in [section.name for section in document.content]
    assert [section.name for section in document.content][:2] == ["overview", "means"]


def test_the_same_run_gives_the_same_page(run_page: Path, campaign: Path, tmp_path: Path) -> None:
    again = dragrig.report(campaign / "014-drag.h5", tmp_path / "again.html")
    assert again.read_bytes() == run_page.read_bytes()


def test_a_page_stands_beside_its_run_and_is_not_replaced_unasked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Path(shutil.copy(CAMPAIGN / "005-blank.h5", tmp_path))
    assert main(["report", str(run), "--json"]) == 0
    page = tmp_path / "005-blank.html"
    assert json.loads(capsys.readouterr().out) == {"source": str(run), "report": str(page)}
    page.write_text("mine", "utf-8")
    assert main(["report", str(run)]) == 2
    assert "005-blank.html: is there already; name another file, or say --overwrite" in capsys.readouterr().err
    assert page.read_text("utf-8") == "mine"
    assert main(["report", str(run), "--overwrite"]) == 0
    assert main(["report", str(run), "--report", str(tmp_path / "named.html")]) == 0
    assert "Blank run" in page.read_text("utf-8")


def test_a_page_says_how_and_of_which_samples_it_was_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/usr/bin/dragrig", "report", "my runs"])
    blank, drag = dragrig.run("drag", out=tmp_path).files
    told = [dragrig.report(path).read_text("utf-8").split("<footer>")[1] for path in (blank, drag, tmp_path)]
    assert all("dragrig report &#39;my runs&#39;</span>" in footer for footer in told)
    assert all(re.search(r"written \d{4}-\d\d-\d\d", footer) for footer in told)
    sums = [re.findall(r"checksums of (\d) run files?: ([0-9a-f]{16})", footer) for footer in told]
    assert [count for [(count, _)] in sums] == ["1", "1", "2"]
    assert len({checksum for [(_, checksum)] in sums}) == 3


def test_what_cannot_be_reported_on_is_said(tmp_path: Path) -> None:
    with pytest.raises(RunFileError, match="holds no run files"):
        dragrig.report(tmp_path)
    with pytest.raises(RunFileError, match="there is no such file"):
        dragrig.report(tmp_path / "gone.h5")
    with pytest.raises(OutputError, match="there is no folder"):
        dragrig.report(CAMPAIGN, tmp_path / "gone" / "page.html")


@pytest.mark.parametrize(
    ("name", "value", "wanted"),
    [
        ("speed_mm_s", 5.0, {"speed": "5 mm/s"}),
        ("accel_mm_s2", 400.0, {"acceleration": "400 mm/s²"}),
        ("shear_strain", 1.5, {"shear strain": "150 %"}),
        ("contact_angle_deg", 60.0, {"contact angle": "60°"}),
        ("specimen_drawn", False, {"specimen drawn": "no"}),
        ("s", "plain", {"s": "plain"}),
        ("storage", "Tyrode", {"storage": "Tyrode"}),
        ("empty", "", {}),
    ],
)
def test_settings_are_spelled_with_their_units(name: str, value: float | str, wanted: dict[str, str]) -> None:
    assert attribute_texts({name: value}) == wanted


def test_checks_say_whether_the_capsule_slipped() -> None:
    assert check_texts({"slip_time_s": -1.0}) == {"slip during the hold": "none seen"}
    assert check_texts({"slip_time_s": 3.21}) == {"slip during the hold": "at 3.2 s"}
    assert check_texts({"following_error_mm": 0.0014}) == {"largest following error": "1.4 µm"}


@given(st.lists(st.tuples(st.floats(-999, 999), st.floats(-999, 999)), min_size=1, max_size=40))
def test_a_line_is_where_it_was_to_a_twentieth(points: list[tuple[float, float]]) -> None:
    data = " ".join(f"{'L' if place else 'M'} {x:.6f} {y:.6f}" for place, (x, y) in enumerate(points))
    drawn = inline_svg(f'<svg viewBox="0 0 9 9" xmlns="http://www.w3.org/2000/svg"><path d="{data}"/></svg>', "a line")
    written = re.search(r' d="M([^"]*)"', drawn.element)
    assert written is not None
    numbers = [float(number) for number in re.findall(r"-?(?:\d+\.?\d*|\.\d+)", written[1])]
    x = y = 0.0
    passed = []
    for step_x, step_y in zip(numbers[::2], numbers[1::2], strict=True):
        x, y = x + step_x, y + step_y
        passed.append((x, y))
    for wanted_x, wanted_y in points:
        assert any(abs(wanted_x - x) < 0.051 and abs(wanted_y - y) < 0.051 for x, y in passed)
    assert abs(passed[-1][0] - points[-1][0]) < 0.051


def test_missing_numbers_have_no_number_to_sort_by() -> None:
    table = Table(
        "t", "c", (Column("a", "a"), Column("b", "b")), (("x", 1.5), ("y", None), ("z", float("nan"))), ("here", "", "")
    )
    assert [row[1].number for row in table.cells] == ["1.5", "", ""]
    assert [row[1].text for row in table.cells] == ["1.500", "–", "–"]
    assert [row[0].link for row in table.cells] == ["here", "", ""]
    assert not any(row[1].link for row in table.cells)


def test_a_campaigns_page_is_presentable(browser: "Browser", campaign_page: Path) -> None:
    from browsing import must_be_presentable, must_save_its_figure, must_sort

    must_be_presentable(browser, campaign_page)
    must_sort(browser, campaign_page, "#runs table", 5)
    must_save_its_figure(browser, campaign_page)


def test_a_link_to_a_run_opens_it_and_all_open_at_once(browser: "Browser", campaign_page: Path) -> None:
    from browsing import opened

    with opened(browser, campaign_page.as_uri()) as (page, heard):
        page.locator("#runs tbody a").first.click()
        page.wait_for_selector("details[open]")
        assert page.locator("details[open]").count() == 1
        page.get_by_role("button", name="Open all").click()
        assert page.locator("details:not([open])").count() == 0
        page.get_by_role("button", name="Close all").click()
        assert page.locator("details[open]").count() == 0
        assert heard.messages == []


@pytest.mark.thorough
def test_a_runs_page_is_presentable(browser: "Browser", run_page: Path) -> None:
    from browsing import must_be_presentable

    must_be_presentable(browser, run_page)


@pytest.mark.parametrize("verdict", [name if name == "several" else thorough(name) for name in ALL])
def test_a_diagnosis_page_is_presentable(browser: "Browser", verdict: str, shared_folder: Path) -> None:
    from browsing import must_be_presentable

    must_be_presentable(browser, page_file(verdict, shared_folder))


@pytest.mark.thorough
def test_an_exams_page_is_presentable(browser: "Browser", tmp_path: Path) -> None:
    from browsing import must_be_presentable

    file = tmp_path / "exam.html"
    file.write_text(render_page(exam_document(large_exam(8), 8, 4, "ab" * 32)), "utf-8")
    must_be_presentable(browser, file)
