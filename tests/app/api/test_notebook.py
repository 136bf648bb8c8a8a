"""The example notebook, run in a kernel: a process of its own, which finishes its run files as a user's does."""

from pathlib import Path

import pytest

from places import ROOT


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")  # of the notebook's own machinery
def test_the_example_notebook_runs_in_a_kernel(tmp_path: Path) -> None:
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(ROOT / "docs" / "example.ipynb", as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    NotebookClient(
        notebook, timeout=900, startup_timeout=900, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    assert any("image/png" in output.get("data", {}) for cell in code for output in cell.outputs)
    assert not any(
        output.output_type == "stream" and output.name == "stderr" for cell in code for output in cell.outputs
    )
    assert list(tmp_path.iterdir()) == []
