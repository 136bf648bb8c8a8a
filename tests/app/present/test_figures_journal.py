"""Figures in the form that journals take: a column's width, letters that can be read, vectors or 600 dpi, no title."""

import io
import os
import re
import time
from pathlib import Path

import pytest
from matplotlib.figure import Figure as MatplotlibFigure
from PIL import Image
from pypdf import PdfReader

from dragrig.cli import main
from dragrig.present.document import (
    SINGLE_COLUMN_MM,
    Document,
    Figure,
    FigureForm,
    Section,
    figure_form,
)
from dragrig.present.drawing import MM_PER_INCH, figure_style, new_figure
from dragrig.present.files import save_figure, svg_text, write_picture
from dragrig.sim_backend.effects.base import catalogue
from places import CAMPAIGN, copied_runs
from property_tests import thorough

PT_PER_MM = 72 / MM_PER_INCH
DRAG, RELAXATION = str(CAMPAIGN / "014-drag.h5"), str(CAMPAIGN / "001-relaxation.h5")


def small_figure(*, narrow: bool = True) -> MatplotlibFigure:
    with figure_style():
        figure = new_figure(12.0, 4.0, "A title", "what it says", narrow=narrow)
        figure.add_subplot().plot([0, 1], [0, 1])
        return figure


@pytest.mark.parametrize(
    ("column", "width_mm", "endings"),
    [
        ("single", 85.0, ("png",)),
        thorough("single", 85.0, ("svg", "pdf")),
        thorough("double", 180.0, ("pdf",)),
        ("88", 88.0, ("svg",)),
        thorough("double", 180.0, ("png", "svg")),
        thorough("88", 88.0, ("png", "pdf")),
    ],
)
def test_a_run_fills_the_column(column: str, width_mm: float, endings: tuple[str, ...], tmp_path: Path) -> None:
    for ending in endings:
        made = tmp_path / f"{column}.{ending}"
        assert main(["show", DRAG, "--out", str(made), "--column", column]) == 0
        assert width_of(made) == pytest.approx(width_mm, abs=0.1)


def width_of(made: Path) -> float:
    """Width of a picture [mm], after a look at what journals ask of its format."""
    if made.suffix == ".png":
        with Image.open(made) as picture:
            assert picture.info["dpi"] == pytest.approx((600, 600), abs=0.1)
            return picture.width / 600 * MM_PER_INCH
    if made.suffix == ".pdf":
        assert b"/Type3" not in made.read_bytes()
        return float(PdfReader(made).pages[0].mediabox.width) / PT_PER_MM
    size = re.search(r'width="([\d.]+)pt"', made.read_text("utf-8"))
    assert size is not None
    return float(size[1]) / PT_PER_MM


def test_the_steady_forces_of_a_campaign_fill_a_column_without_title_or_badge(tmp_path: Path) -> None:
    campaign, made = copied_runs(tmp_path / "mine", "010-drag.h5", "018-drag.h5"), tmp_path / "made.pdf"
    assert main(["show", str(campaign), "--out", str(made), "--column", "single"]) == 0
    assert width_of(made) == pytest.approx(85.0, abs=0.1)
    words = PdfReader(made).pages[0].extract_text()
    assert "Speed (mm/s)" in words
    assert not any(word in words for word in ("SIMULATED", "mine", "Relaxation"))


def test_panels_side_by_side_take_two_columns(tmp_path: Path) -> None:
    assert main(["show", RELAXATION, "--out", str(tmp_path / "wide.pdf"), "--column", "single"]) == 0
    page = PdfReader(tmp_path / "wide.pdf").pages[0]
    assert float(page.mediabox.width) == pytest.approx(180 * PT_PER_MM, abs=0.1)


def test_no_picture_is_so_narrow_or_wide_that_no_journal_takes_it(capsys: pytest.CaptureFixture[str]) -> None:
    for column in ("4", "1e3", "nan", "wide"):
        assert main(["show", DRAG, "--column", column]) == 2
        assert f"--column {column}: is single, double, or a width from 60 to 300 mm" in capsys.readouterr().err


def test_letters_are_those_of_print_and_there_is_no_title(tmp_path: Path) -> None:
    with figure_form(FigureForm(SINGLE_COLUMN_MM)):
        save_figure(small_figure(), tmp_path / "print.pdf")
    save_figure(small_figure(), tmp_path / "screen.pdf")
    sizes: list[float] = []

    def collect(text: str, _: object, matrix: list[float], font: object, size: float) -> None:
        if text.strip() and font is not None:
            sizes.append(size * matrix[3])

    printed = PdfReader(tmp_path / "print.pdf").pages[0].extract_text(visitor_text=collect)
    assert "A title" not in printed
    assert "A title" in PdfReader(tmp_path / "screen.pdf").pages[0].extract_text()
    assert sizes
    assert min(sizes) > 0
    with figure_form(FigureForm(SINGLE_COLUMN_MM)):
        labels = [label.get_fontsize() / 2 for label in small_figure().axes[0].get_xticklabels()]
    assert 6.0 <= min(labels) <= max(labels) <= 7.0


def test_a_diagnosis_writes_its_figures_beside_a_page_for_the_screen(tmp_path: Path) -> None:
    campaign = copied_runs(tmp_path / "campaign", "005-blank.h5", "010-drag.h5", "018-drag.h5")
    left_out = [word for effect in catalogue() if effect != "stribeck" for word in ("--without", effect)]
    assert main(["gap", "diagnose", str(campaign), "--figures", str(tmp_path / "made"), "--picture-format", "pdf",
                 "--column", "double", "--report", str(tmp_path / "gap.html"), "-q", *left_out]) == 0  # fmt: skip
    pictures = sorted((tmp_path / "made").iterdir())
    assert {"location", "ranking"} <= {path.stem for path in pictures}
    assert all(path.suffix == ".pdf" for path in pictures)
    assert [width_of(path) for path in pictures] == pytest.approx([180.0] * len(pictures), abs=0.1)
    assert "Gap in" in (page := (tmp_path / "gap.html").read_text("utf-8")) or "No gap" in page


def test_the_document_s_badge_is_in_figures_that_have_none() -> None:
    def letters(*badges: str) -> int:
        figure = Figure("small", "A line from corner to corner.", "", small_figure)
        document = Document("A result", sections=(Section("only", "", (figure,)),), badges=badges)
        with figure_form(document.figure_form):
            return svg_text(figure).count("<use ")

    assert letters("simulated") == letters() + len("SIMULATED")


def test_the_form_ends_with_its_block() -> None:
    with pytest.raises(RuntimeError, match="stop"), figure_form(FigureForm(SINGLE_COLUMN_MM)):
        raise RuntimeError("stop")
    content = io.BytesIO()
    small_figure().savefig(content, format="png")
    with Image.open(content) as picture:
        assert picture.width == 12 * 120


def test_what_a_killed_program_left_of_a_picture_goes_with_the_next_one(tmp_path: Path) -> None:
    for name, age_s in ((".force.png.11.part", 7200), (".force.png.12.part", 0), (".speed.png.13.part", 7200)):
        (tmp_path / name).write_bytes(b"half a picture")
        os.utime(tmp_path / name, (time.time() - age_s,) * 2)
    write_picture(b"a picture", tmp_path / "force.png")
    left = sorted(path.name for path in tmp_path.iterdir())
    assert left == [".force.png.12.part", "force.png"]
