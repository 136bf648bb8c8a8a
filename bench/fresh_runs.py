"""Picture of the tutorial's fresh runs: `python bench/fresh_runs.py FOLDER`, where the tutorial's commands were run."""

import sys
from pathlib import Path

from dragrig.api import gap_evaluate
from dragrig.present import evaluation_document, figure_form
from dragrig.present.files import save_figure

TARGET = Path(__file__).parents[1] / "docs" / "images" / "fresh-runs.png"


def main(folder: Path) -> None:
    """Draw the fresh runs beside the model without the effect, and beside the amended one."""
    document = evaluation_document(gap_evaluate(folder / "amended.toml", folder / "fresh"))
    with figure_form(document.figure_form):
        for figure in document.figures():
            if not isinstance(figure.drawing, str):
                print(save_figure(figure.drawing(), TARGET, overwrite=True))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
