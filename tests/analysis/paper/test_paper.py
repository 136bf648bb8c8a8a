"""The paper's programme, simulated and identified, and what in the paper does not fit together."""

import csv
import io
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from click.testing import CliRunner
from filelock import FileLock
from hypothesis import given
from hypothesis import strategies as st

from diagnoses import BLANK, without_pictures
from dragrig.analysis.estimates import Estimate, Exclusion
from dragrig.analysis.identification.identification import (
    DragResult,
    Identification,
    JointFit,
    ParameterEstimate,
    RunResidual,
)
from dragrig.analysis.identification.speed_dependence import r2_eq15, squared_correlation
from dragrig.analysis.paper.findings import (
    all_findings,
    determination_examples,
    element_rows,
    offset_for_r2,
    stress_by_eq4,
    stress_by_superposition,
)
from dragrig.analysis.paper.published import PAPER_CAPSULE, PAPER_MODEL, R2_ABOVE, R2_BELOW, PaperFinding
from dragrig.analysis.wording import significant_text
from dragrig.api import reports as reproducing
from dragrig.cli import main
from dragrig.cli.commands import dragrig_group
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.config.settings import find_settings
from dragrig.config.specimen import Capsule
from dragrig.present.document import Column, Table
from dragrig.present.files import PAPER_MODEL_FILE, PAPER_REPORT_FILE, PAPER_TABLES
from dragrig.present.html_page import render_page, without_breaks
from dragrig.present.numbers import percent_difference
from dragrig.present.paper import PaperReportData, paper_document, paper_tables
from dragrig.rig import mark_bad
from dragrig.rig.runfile import read_campaign
from dragrig.rig.runfile.model import RunStatus
from finishing import finished_here
from places import CAMPAIGN
from property_tests import thorough

if TYPE_CHECKING:
    from playwright.sync_api import Browser

VOID = {"meta", "img", "br", "hr", "link", "input"}


def finding(key: str) -> PaperFinding:
    return next(all_finding for all_finding in all_findings() if all_finding.key == key)


@pytest.mark.parametrize(
    ("key", "quantity", "value", "tolerance"),
    [
        ("eq14-table1", "Eq. 14, E1: largest miss", 20, 0.5),
        ("eq14-table1", "Eq. 14, E2: largest miss", 27, 0.5),
        ("eq14-table1", "Eq. 14, E3: largest miss", 7, 0.5),
        ("eq14-table1", "Eq. 14, η1: largest miss", -14, 0.5),
        ("eq14-table1", "Eq. 14, η2: largest miss", -11, 0.5),
        ("eq14-table1", "quadratic, E1: largest miss", -0.4, 0.05),
        ("eq14-table1", "quadratic, E2: largest miss", -4, 0.5),
        ("eq14-table1", "quadratic, E3: largest miss", -2.3, 0.05),
        ("eq14-table1", "quadratic, η1: largest miss", 9, 0.5),
        ("eq14-table1", "quadratic, η2: largest miss", 9.4, 0.05),
        ("eta-unit", "shortest η1/E1", 1e3 * 0.053 / 2.926, 1e-9),
        ("stress-falls", "stress at once at 200 %", 2 * (1.726 + 0.484 + 0.541), 1e-9),
        ("strain-range", "largest strain on the contact", 100, 1e-9),
        ("strain-range", "contact angle that would strain to it", np.degrees(np.arccos(1 / 3)), 1e-9),
        ("side-area", "S, the hemisphere's contact", 226.4, 0.05),
        ("constant-thickness", "difference in P(L)", -38, 0.5),
        ("maximum", "nearest maximum, 0.5 … 60 mm/s", 1.3, 0.05),
        ("maximum", "farthest maximum, 0.5 … 60 mm/s", 3.4, 0.05),
        ("viscous-dimension", "f_v read as δ v, 0.5 mm/s", 0.7, 0.05),
        ("viscous-dimension", "f_v read as δ v, 60 mm/s", 9, 0.1),
        ("viscous-dimension", "f_v read as δ (v/d) S, 0.5 mm/s", 5.5, 0.05),
        ("viscous-dimension", "f_v read as δ (v/d) S, 60 mm/s", 68, 0.5),
        ("coefficient", "μ from the whole force", 0.0816, 5e-5),
        ("coefficient", "μ without f_v", 0.0801, 5e-5),
        ("coefficient", "f_v at 0.5 mm/s", 0.73, 5e-3),
        ("not-returned", "the model's force", 0.082 * 50.1 * 9.80665 + 0.7288, 1e-3),
        ("fixture-gap", "gap all round", 50, 1e-9),
        ("accuracy", "accuracy over the Coulomb force", 100 * 5 / 40.07, 1e-9),
    ],
)
def test_the_findings_carry_the_numbers_that_the_model_gives(
    key: str, quantity: str, value: float, tolerance: float
) -> None:
    assert finding(key).value(quantity) == pytest.approx(value, abs=tolerance)


def test_every_finding_says_what_the_numbers_show_and_what_is_done() -> None:
    result = all_findings()
    assert len(result) >= 25
    assert len({entry.key for entry in result}) == len(result)
    for entry in result:
        assert entry.numbers, entry.key
        assert all(np.isfinite(number.value) for number in entry.numbers), entry.key
        assert re.search(r"\d", entry.shown), entry.key
        for sentence in (entry.paper, entry.shown, entry.practice):
            assert sentence.endswith("."), entry.key
            assert not re.search(r"[{}]| {2}|nan|inf\b|\d-\d", sentence), sentence
        assert len({number.quantity for number in entry.numbers}) == len(entry.numbers), entry.key


def test_the_findings_are_about_the_shipped_model() -> None:
    assert find_settings(FrictionModelSettings, "model", "paper") == PAPER_MODEL
    assert find_settings(Capsule, "capsule", "drag") == PAPER_CAPSULE


def test_eq_15_exceeds_one_where_a_correlation_cannot() -> None:
    half, mirrored, shifted, far = determination_examples()
    assert half.eq15 == pytest.approx(4)
    assert mirrored.eq15 == pytest.approx(1)
    assert shifted.eq15 < 1
    assert far.eq15 == pytest.approx(R2_ABOVE)
    assert all(example.correlation == pytest.approx(1) for example in (half, mirrored, shifted, far))


@given(st.floats(0.05, 0.99), st.lists(st.floats(10, 200), min_size=3, max_size=12, unique=True))
def test_the_offset_that_is_named_gives_the_r2_that_is_named(r2: float, forces: list[float]) -> None:
    model = np.array(forces)
    if np.ptp(model) > 1e-3:
        shifted = model + offset_for_r2(r2, model)
        assert r2_eq15(model, shifted) == pytest.approx(r2, rel=1e-6)
        assert squared_correlation(model, shifted) == pytest.approx(1)


def test_a_strains_history_matters_neither_to_relaxed_nor_to_fresh_wall() -> None:
    assert stress_by_superposition(1e-3) == pytest.approx(stress_by_eq4(1e-3), rel=2e-3)
    assert stress_by_superposition(1e6) == pytest.approx(stress_by_eq4(1e6), rel=1e-3)
    assert stress_by_superposition(20.0) > 1.05 * stress_by_eq4(20.0)


@given(st.floats(1e-6, 1e9), st.integers(1, 8), st.sampled_from([1, -1]))
def test_numbers_are_spelled_to_their_digits(size: float, digits: int, sign: int) -> None:
    text = significant_text(sign * size, digits)
    assert "e" not in text
    assert float(text.replace("−", "-")) == pytest.approx(sign * size, rel=0.51 * 10.0 ** (1 - digits))


def test_numbers_keep_their_sign_and_their_unit() -> None:
    assert [significant_text(0.99999, 4), significant_text(0), significant_text(float("nan"))] == ["1.000", "0", "–"]
    assert [percent_difference(0.2), percent_difference(-0.0036)] == ["+20 %", "−0.4 %"]
    assert without_breaks("40 mN at 0.5 mm/s, 1 gut") == "40\u00a0mN at 0.5\u00a0mm/s, 1 gut"
    assert without_breaks("more (p = 0.4), p < 1") == "more (p\u00a0=\u00a00.4), p\u00a0<\u00a01"


@given(st.lists(st.tuples(st.text(), st.one_of(st.none(), st.floats())), max_size=5))
def test_a_table_comes_back_from_its_csv(rows: list[tuple[str, float | None]]) -> None:
    table = Table("any", "Any", (Column("word", "Word"), Column("value_mN", "Value, mN")), tuple(rows))
    header, *back = csv.reader(io.StringIO(table.csv(), newline=""))
    assert header == ["word", "value_mN"]
    assert back == [[word, "" if value is None or not np.isfinite(value) else repr(value)] for word, value in rows]
    assert [row[0].text for row in table.cells] == [word for word, _ in rows]


@dataclass
class Made:
    """What one call of the command left, and what it printed."""

    folder: Path
    printed: dict[str, Any]
    runs: Mapping[str, int]
    """How many of which kind."""

    @property
    def page(self) -> str:
        return (self.folder / PAPER_REPORT_FILE).read_text("utf-8")

    def rows(self, name: str) -> list[dict[str, str]]:
        with (self.folder / f"{name}.csv").open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))


SPEEDS = (1.0, 5.0, 10.0, 20.0, 60.0)
# Its runs before the drags are those of the whole programme.
SHORT_PLAN = f"""
name = "paper"
seed = 2012
[[steps]]
kind = "relaxation"
shear_strain = [0.5, 1.0, 1.5, 2.0]
hold_s = 20.0
[[steps]]
kind = "blank"
speed_mm_s = [5.0, 40.0]
travel_mm = 40.0
wait_s = 5.0
[[steps]]
kind = "coulomb"
speed_mm_s = 1.0
travel_mm = 20.0
tare_s = 1.0
[[steps]]
kind = "drag"
speed_mm_s = {list(SPEEDS)}
travel_mm = 20.0
way_back = "by_hand"
"""
WHOLE_RUNS = {"relaxation": 4, "blank": 2, "coulomb": 1, "drag": 22, "return": 29}


@pytest.fixture(scope="session", params=["short", thorough("whole")])
def made(request: pytest.FixtureRequest, shared_folder: Path) -> Made:
    """Call the command once for all workers; the one that comes first does it.

    With a plan of fewer drags and ways back and blank pictures, a third of the time, or as it is.
    """
    folder = shared_folder / f"paper-{request.param}"
    with_suffix = folder.with_suffix(".json")
    with FileLock(folder.with_suffix(".lock")), pytest.MonkeyPatch.context() as patch:
        if not with_suffix.exists():
            if request.param == "short":
                plan = shared_folder / "paper-short.toml"
                plan.write_text(SHORT_PLAN, "utf-8")
                patch.setattr(reproducing, "PAPER_PLAN", str(plan))
                patch.setattr("dragrig.present.files.svg_text", lambda _: BLANK)
            arguments = ["paper", "--out", str(folder), "--seed", "1", "--json", "--quiet"]
            with finished_here():
                done = CliRunner().invoke(dragrig_group, arguments, standalone_mode=False)
            assert done.exception is None, done.exception
            with_suffix.write_text(done.stdout, "utf-8")
    runs = WHOLE_RUNS if request.param == "whole" else {**WHOLE_RUNS, "drag": len(SPEEDS), "return": 7}
    return Made(folder, json.loads(with_suffix.read_text("utf-8")), runs)


@pytest.fixture
def few(made: Made, tmp_path: Path) -> Made:
    """A copy with two of its runs and all that was written about them."""
    folder = tmp_path / "few"
    folder.mkdir()
    runs = sorted(made.folder.glob("*.h5"))
    others = [path for path in made.folder.iterdir() if path.suffix != ".h5"]
    for path in (*runs[:2], *others):
        shutil.copy(path, folder)
    return Made(folder, made.printed, made.runs)


def test_the_command_says_where_everything_is(made: Made) -> None:
    assert made.printed["report"] == str(made.folder / PAPER_REPORT_FILE)
    assert made.printed["model"] == str(made.folder / PAPER_MODEL_FILE)
    assert made.printed["tables"] == [str(made.folder / f"{name}.csv") for name in PAPER_TABLES]
    assert len(made.printed["findings"]) == len(all_findings())
    identified = made.printed["identification"]
    assert len(identified["relaxation"]["runs"]) == 4
    assert len(identified["drag"]["speeds"]) == min(made.runs["drag"], 11)


def test_the_runs_are_a_campaign_like_any_other(made: Made) -> None:
    campaign = read_campaign(made.folder)
    assert not campaign.unreadable
    assert not campaign.recordings
    kinds = [run.kind for run in campaign.good]
    assert {kind: kinds.count(kind) for kind in kinds} == made.runs
    assert all(run.status is RunStatus.COMPLETE and run.header.backend == "simulated" for run in campaign.good)
    assert all("seed = 1\n" in entry.header.settings_toml for entry in campaign.good)


class Page(HTMLParser):
    """Checks that every tag is closed in its turn, and gathers what a page refers to."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.sources: list[str] = []
        self.links: list[str] = []
        self.ids: list[str] = []
        self.shown: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        result = dict(attrs)
        self.tags.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        self.sources += [value or "" for key, value in attrs if key in {"src", "srcset", "data"}]
        self.links += [value or "" for key, value in attrs if key == "href"]
        self.ids += [value or "" for key, value in attrs if key == "id"]
        assert not any(key.startswith("on") for key in result)
        if result.get("role") == "img":
            self.shown.append(result.get("aria-label") or "")

    def handle_endtag(self, tag: str) -> None:
        assert self.open
        assert self.open.pop() == tag


def test_the_report_needs_nothing_but_itself(made: Made) -> None:
    read = Page()
    read.feed(made.page)
    read.close()
    assert read.open == []
    assert not {"img", "iframe", "object"} & read.tags
    assert read.sources == []
    assert len(read.ids) == len(set(read.ids))
    assert all((link.startswith("#") and link[1:] in read.ids) or link == "data:," for link in read.links)
    assert len(read.shown) == 6
    assert all(len(part) > 30 for part in read.shown)
    style = made.page.split("<style>")[1].split("</style>")[0]
    assert "prefers-color-scheme: dark" in style
    assert "@media print" in style
    assert "url(" not in style
    assert "@import" not in style


def test_the_report_is_presentable_in_a_browser(browser: "Browser", made: Made) -> None:
    from browsing import must_be_presentable, must_sort

    must_be_presentable(browser, made.folder / PAPER_REPORT_FILE)
    must_sort(browser, made.folder / PAPER_REPORT_FILE, "#wall > div:nth-of-type(1) table", 3)


def test_the_report_says_what_was_simulated(made: Made) -> None:
    text = made.page
    for message in (
        "<dd>1</dd>",
        f"{sum(made.runs.values())} runs",
        "at 500 Hz",
        "Eq. 14, as printed",
        "dragrig 0.1.0",
    ):
        assert message in text
    for all_finding in all_findings():
        assert f'<h3 id="{all_finding.key}">' in text


def test_the_papers_r2_are_quoted_and_never_reproduced(made: Made) -> None:
    quote = re.search(r'<p class="quoted">(.*?)</p>', made.page, re.DOTALL)
    assert quote is not None
    text = " ".join(quote.group(1).split())
    assert f"{R2_BELOW}" in text
    assert f"{R2_ABOVE}" in text
    assert "no software can reproduce them" in text
    ours = (made.folder / "determination.csv").read_text("utf-8")
    assert ours.splitlines()[0] == "band,speeds,eq15_ratio,squared_correlation"
    assert "0.8769" not in ours
    assert "0.1666" not in ours
    assert len(made.rows("determination")) >= 3


def test_every_table_parses_and_holds_what_the_model_says(made: Made) -> None:
    for name in PAPER_TABLES:
        rows = made.rows(name)
        assert rows, name
        assert all(None not in row and None not in row.values() for row in rows), name
    forces = {float(row["speed_mm_s"]): float(row["total_mN"]) for row in made.rows("forces")}
    assert forces[0.5] == pytest.approx(82.41, abs=0.01)
    for row in made.rows("skew-maximum"):
        assert 1.3 < float(row["x_of_largest_skew_mm"]) < 3.45
    curve = made.rows("skew-resistance")
    largest = max(float(row["skew_mN_at_60_mm_s"]) for row in curve)
    assert largest == pytest.approx(228.7, rel=2e-3)
    printed, simulated, own, identified = made.rows("coulomb")
    assert float(printed["mu"]) == pytest.approx(0.0816, abs=5e-5)
    assert float(printed["mu_without_viscous"]) == pytest.approx(0.0801, abs=5e-5)
    assert float(simulated["mu_without_viscous"]) == pytest.approx(0.082)
    miss = float(identified["force_mN"]) - float(own["force_mN"])
    assert abs(miss) < 4 * float(identified["force_standard_error_mN"])


def test_the_elements_that_were_put_in_come_back(made: Made) -> None:
    rows = made.rows("elements")
    assert len(rows) == 20
    inside = 0
    for row in rows:
        low, value, high = (float(row[key]) for key in ("identified_low", "identified", "identified_high"))
        assert high - low < (0.2 if row["element"].startswith("η") else 0.1) * value
        assert abs(float(row["identified_relative_difference_from_simulated"])) < 0.05
        inside += low <= float(row["simulated"]) <= high
    assert inside >= 16


def test_the_specimen_that_was_put_in_comes_back(made: Made) -> None:
    rows = made.rows("parameters")
    assert len(rows) == 11
    known = [row for row in rows if row["value"]]
    assert {row["parameter"] for row in rows if not row["value"]} == {"force_gain", "insertion_dwell_scale"}
    assert sum(float(row["low"]) <= float(row["simulated"]) <= float(row["high"]) for row in known) >= 8
    assert all(float(row["prior_low"]) < float(row["low"]) < float(row["high"]) for row in known)
    assert "do not determine" in made.page
    assert "can hardly be separated" in made.page
    elements = [row for row in made.rows("combinations") if row["combination"].startswith(("e", "fast", "slow"))]
    assert len(elements) == 7
    assert all(float(row["half_width"]) < 0.03 for row in elements)
    assert sum(float(row["low"]) <= float(row["simulated"]) <= float(row["high"]) for row in elements) >= 6


def test_each_runs_own_factors_come_back(made: Made) -> None:
    runs = made.rows("joint-runs")
    assert len(runs) == sum(made.runs.values()) - made.runs["return"]
    result = [row for row in runs if row["kind"] == "relaxation"]
    ratio = np.array([float(row["stiffness_factor"]) / float(row["simulated_stiffness_factor"]) for row in result])
    assert np.ptp(ratio) < 0.005
    assert all(row["friction_factor"] == row["simulated_friction_factor"] == "" for row in result)


def test_the_identified_model_is_one_that_the_simulator_loads(made: Made) -> None:
    model = find_settings(FrictionModelSettings, "model", str(made.folder / PAPER_MODEL_FILE))
    (friction,) = (row["value"] for row in made.rows("parameters") if row["parameter"] == "friction_coefficient")
    assert model.friction_coefficient == pytest.approx(float(friction), rel=1e-9)
    assert model.insertion_dwell_scale == 1.0
    assert f"dragrig run drag --model {PAPER_MODEL_FILE}" in made.page


def test_what_is_there_is_not_overwritten(few: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in few.folder.iterdir()}
    assert main(["paper", "--out", str(few.folder)]) == 2
    assert {path.name: path.stat().st_mtime_ns for path in few.folder.iterdir()} == before
    errors = capsys.readouterr().err
    assert "is there already" in errors
    assert "--overwrite" in errors
    assert errors.count("\n") == 1
    for name in ("findings.csv", PAPER_MODEL_FILE):
        mine = tmp_path / "mine" / name
        mine.parent.mkdir(exist_ok=True)
        mine.write_text("mine\n", "utf-8")
        assert main(["paper", "--out", str(mine.parent)]) == 2
        assert name in capsys.readouterr().err
        mine.unlink()


def test_overwriting_takes_away_own_runs_and_nothing_else(few: Made) -> None:
    mark_bad(read_campaign(few.folder).runs[0].path, "tried")
    (few.folder / "notes.txt").write_text("mine\n", "utf-8")
    reproducing.clear_paper_folder(few.folder, overwrite=True)
    left = {"notes.txt", PAPER_REPORT_FILE, PAPER_MODEL_FILE, *(f"{name}.csv" for name in PAPER_TABLES)}
    assert {path.name for path in few.folder.iterdir()} == left


def test_other_peoples_runs_are_never_replaced(few: Made, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copy(CAMPAIGN / "010-drag.h5", few.folder)
    before = {path.name for path in few.folder.iterdir()}
    for choice in ([], ["--overwrite"]):
        assert main(["paper", "--out", str(few.folder), *choice]) == 2
        errors = capsys.readouterr().err
        assert "010-drag.h5: is no run of dragrig paper" in errors
        assert "say --overwrite" not in errors
    assert {path.name for path in few.folder.iterdir()} == before


@pytest.mark.parametrize("seed", ["x", "-1", "1.5", "9" * 30])
def test_a_seed_is_a_whole_number(seed: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["paper", "--out", str(tmp_path / "out"), "--seed", seed]) == 2
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert "seed" in errors
    assert seed in errors
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("place", ["file", "file/inside"])
def test_a_file_is_no_folder(place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("", "utf-8")
    assert main(["paper", "--out", str(tmp_path / place)]) == 2
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert Path(place).name in errors


def test_a_folder_that_is_closed_is_said_in_a_sentence(
    tmp_path: Path, close_folder: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "closed"
    folder.mkdir()
    close_folder(folder)
    assert main(["paper", "--out", str(folder)]) == 2
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert "closed" in errors


def test_the_papers_programme_is_whole() -> None:
    kinds = [run.protocol.kind for run in reproducing.paper_setup(1, "eq14", "published").programme().runs]
    assert {kind: kinds.count(kind) for kind in kinds} == WHOLE_RUNS


def test_choices_reach_the_simulator() -> None:
    setup = reproducing.paper_setup(7, "table1", "newtonian")
    assert (setup.model.wall, setup.model.viscous) == ("table1", "newtonian")
    assert setup.rig.simulated.seed == 7
    assert setup.backend == "simulated"


def nothing_identified() -> Iterator[Identification]:
    bare = Identification("gut", (), (Exclusion("a.h5", "it is <broken>"),), None, None, None, None, ("a & b",))
    yield bare
    yield replace(bare, drag=DragResult((), None, None, (), ("no drag run",)))
    scale = ParameterEstimate("stiffness_scale", "1", 777.7, 1.0, (5.0, 9.0), (0.7, 1.4), 0.0)
    left = RunResidual("a.h5", "drag", "force", 9, 1.0, 1.0, Estimate(0.0, 0.1), {})
    joint = JointFit("capsule", (scale,), (), np.eye(1), (left,), 9, 9, 0.5, False, 99, ("it <ran> away",))
    yield replace(bare, joint=joint)


def test_what_was_not_identified_is_said_to_be_missing() -> None:
    for identification in nothing_identified():
        results = PaperReportData(
            PAPER_MODEL,
            PAPER_CAPSULE,
            2.5,
            RigSettings(),
            0,
            {},
            identification,
            element_rows(None, PAPER_MODEL, {}),
            all_findings(),
            None,
        )
        made = paper_tables(results)
        text = render_page(without_pictures(paper_document(results, made)))
        assert "No element was identified" in text
        assert "it is &lt;broken&gt;" in text
        assert "a &amp; b" in text
        assert ("No drag was identified" in text) == (identification.drag is None)
        assert ("did not converge" in text) == (identification.joint is not None)
        assert ("it &lt;ran&gt; away" in text) == (identification.joint is not None)
        assert "777.7" not in text
        assert made["parameters"].rows == ()
        assert PAPER_MODEL_FILE not in text


def test_the_overview_of_commands_loads_no_report() -> None:
    script = (
        "import sys\nfrom click.testing import CliRunner\nfrom dragrig.cli.commands import dragrig_group\n"
        "assert 'paper' in CliRunner().invoke(dragrig_group, ['--help']).output\n"
        "assert CliRunner().invoke(dragrig_group, ['paper', '--help']).exit_code == 0\n"
        "print([one for one in ('jinja2', 'matplotlib', 'numpy') if one in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
