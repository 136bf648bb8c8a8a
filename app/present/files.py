"""Results written into files: texts, pages, and figures as PNG, SVG or PDF; a file is written whole or not at all."""

import io
import re
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING

from dragrig.analysis import Progress, no_progress, printable
from dragrig.config import OutputError
from dragrig.parallel import open_executor, parallel_map_with_progress
from dragrig.present import current_figure_form, figure_form
from dragrig.rig import written_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dragrig.present.document import Document, FigureForm
    from dragrig.present.document import Figure as DocumentFigure

FIGURE_FORMATS: Mapping[str, Mapping[str, str | None]] = {
    ".png": {"Software": "dragrig"},
    ".svg": {"Date": None, "Creator": "dragrig"},
    ".pdf": {"CreationDate": None, "Creator": "dragrig"},
}
"""Endings of files that can be written, and what such a file says of itself: never when it was made."""
PRINT_DPI = 600
"""Resolution of pictures for print."""
_MM_PER_POINT = 25.4 / 72
_SVG_WIDTH = re.compile(r'\bwidth="([0-9.]+)pt"')
_SVG_SIZE = re.compile(rb'\b(width|height)="([0-9.]+)pt"')

PAPER_REPORT_FILE = "report.html"
PAPER_MODEL_FILE = "model.toml"
"""The identified friction model, as the simulator loads it."""
PAPER_TABLES = (
    "elements",
    "skew-maximum",
    "skew-resistance",
    "coulomb",
    "forces",
    "parameters",
    "combinations",
    "joint-runs",
    "drag",
    "determination",
    "eq15-examples",
    "findings",
)
"""Stems of the CSV files, in the order of the report."""


def write_texts(folder: Path, texts: Mapping[str, str]) -> tuple[Path, ...]:
    """Write texts under their names, replacing what is there; return the paths.

    Raises `OutputError` when the folder cannot be made or refuses.
    """
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            path = folder / name
            path.write_text(text, "utf-8", newline="")
            paths.append(path)
    except OSError as error:
        where = error.filename or folder
        raise OutputError(f"{where}: cannot be written ({error.strerror}); choose another folder.") from error
    return tuple(paths)


def require_writable(path: Path, *, overwrite: bool) -> None:
    """Ask before the work whether a file can be written; raises `OutputError` where it cannot."""
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; name a file.")
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: is there already; name another file, or say --overwrite.")
    if not path.absolute().parent.is_dir():
        raise OutputError(f"{path}: there is no folder {path.parent}; make it, or name another.")


def write_text(text: str, path: Path, *, overwrite: bool, make_folder: bool = False) -> Path:
    """Write one file and return its path; raises `OutputError` as `require_writable`, and where the folder refuses."""
    try:
        if make_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        require_writable(path, overwrite=overwrite)
        path.write_text(text, "utf-8", newline="\n")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another place.") from error
    return path


def unused_path(path: Path, suffix: str = "") -> Path:
    """Return the path, or one with the first free number before its suffix where it exists."""
    stem = path.name.removesuffix(suffix)
    numbered = (path.with_name(f"{stem}-{number}{suffix}") for number in count(2))
    return next(candidate for candidate in chain([path], numbered) if not candidate.exists())


def save_figure(figure: "Figure", path: Path, overwrite: bool = False) -> Path:
    """Write a picture as PNG, SVG or PDF, by its name's ending, and return the path.

    Raises `OutputError` when the ending is another one, the file exists and may not be replaced, or the folder cannot
    be written to.
    """
    ending = path.suffix.lower()
    if ending not in FIGURE_FORMATS:
        raise OutputError(f"{path}: a picture is written as {', '.join(FIGURE_FORMATS)}; change the name's ending.")
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: is there already; choose another name or say --overwrite.")
    write_picture(_figure_bytes(figure, ending), path)
    return path


def make_folder(folder: Path) -> None:
    """Make a folder where there is none; raises `OutputError` when it cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise OutputError(f"{folder}: is a file; name a folder for the pictures.") from error
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror}); choose another folder.") from error


def save_figure_in(folder: Path, name: str, figure: "Figure", overwrite: bool = False) -> Path:
    """Write a picture under a name that nobody chose: where it is taken, a number is added to it.

    The name is without an ending, which is that of the current `FigureForm`.

    The folder is made if there is none. Raises as `save_figure` does.
    """
    make_folder(folder)
    path = folder / f"{name}{current_figure_form().suffix}"
    return save_figure(figure, path if overwrite else unused_path(path, path.suffix), overwrite)


def save_figures(document: "Document", folder: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Write every figure of a document under its name; yields each path as it is written."""
    with figure_form(document.figure_form):
        for figure in document.figures():
            if not isinstance(figure.drawing, str):
                yield save_figure_in(folder, figure.name, figure.drawing(), overwrite)


def svg_text(figure: "DocumentFigure") -> str:
    """Return a figure of a document as a whole SVG document; the same figure gives the same text."""
    if isinstance(figure.drawing, str):
        return figure.drawing
    return _figure_bytes(figure.drawing(), ".svg").decode("utf-8")


def svg_of_width(svg: str, width_mm: float) -> str:
    """Return a drawn figure as an SVG document that is so wide."""
    size = _SVG_WIDTH.search(svg)
    if size is None:
        raise ValueError("the drawing does not say how wide it is")
    return _scaled_svg(svg.encode(), width_mm / _MM_PER_POINT / float(size[1])).decode()


def write_picture(content: bytes, path: Path) -> None:
    """Write a picture, over one that is there; raises `OutputError` when the folder cannot be written to."""
    try:
        with written_atomically(path, synced=False) as part:
            part.write_bytes(content)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose a folder that can.") from error


def drawn(document: "Document", progress: Progress = no_progress, workers: int | None = 1) -> "Document":
    """Return a document with its figures drawn, so that another process can show it.

    Parameters
    ----------
    workers
        Processes that draw, of figures whose drawing pickles (None: as many as there are cores).
    """
    figures = tuple(document.figures())
    with open_executor(workers, tasks=len(figures) // _FIGURES_PER_WORKER) as executor:
        draw = partial(_svg_text_in, document.figure_form)

        def drawn_so_far(done: int, of: int) -> None:
            progress(done + (_LOADING_FIGURES if done else 0), of + _LOADING_FIGURES)

        texts = parallel_map_with_progress(executor, draw, figures, drawn_so_far)
    return document.with_drawings({figure.name: text for figure, text in zip(figures, texts, strict=True)})


_LOADING_FIGURES = 2
"""Loading matplotlib, with the first figure, takes as long as so many more."""
_FIGURES_PER_WORKER = 6
"""Fewer are drawn in the time that a process takes to start and to load matplotlib."""


def _svg_text_in(form: "FigureForm", figure: "DocumentFigure") -> str:
    with figure_form(form):
        return svg_text(figure)


def _figure_bytes(figure: "Figure", ending: str) -> bytes:
    from matplotlib.text import Text as MatplotlibText

    from dragrig.present.drawing import PRINT_SCALE, figure_style, lay_out, layout_of

    printed = layout_of(figure).form.width_mm is not None
    content = io.BytesIO()
    for text in figure.findobj(MatplotlibText):
        text.set_text(printable(text.get_text()))
    with figure_style():
        lay_out(figure)
        if printed and ending == ".png":
            pixels = {"dpi": (PRINT_DPI, PRINT_DPI)}
            dpi = PRINT_DPI * PRINT_SCALE
            figure.savefig(content, format="png", dpi=dpi, metadata=FIGURE_FORMATS[ending], pil_kwargs=pixels)
        else:
            figure.savefig(content, format=ending[1:], metadata=FIGURE_FORMATS[ending])
    if printed and ending != ".png":
        return (_scaled_svg if ending == ".svg" else _scaled_pdf)(content.getvalue(), PRINT_SCALE)
    return content.getvalue()


def _scaled_svg(content: bytes, scale: float) -> bytes:
    """Return an SVG document that is shown smaller; its own coordinates stay."""

    def smaller(size: re.Match[bytes]) -> bytes:
        return b'%s="%.6gpt"' % (size[1], scale * float(size[2]))

    head, rest = content.split(b"viewBox", 1)[0], content[content.index(b"viewBox") :]
    tail, rest = rest.split(b">", 1)
    return _SVG_SIZE.sub(smaller, head) + _SVG_SIZE.sub(smaller, tail) + b">" + rest


def _scaled_pdf(content: bytes, scale: float) -> bytes:
    """Return a PDF document of one page with page and content scaled."""
    from pypdf import PdfReader, PdfWriter

    writer = PdfWriter(clone_from=PdfReader(io.BytesIO(content)))
    writer.pages[0].scale_by(scale)
    scaled = io.BytesIO()
    writer.write(scaled)
    return scaled.getvalue()
