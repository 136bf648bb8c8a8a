"""`import dragrig`: what people call from scripts and notebooks."""

import doctest
import json
import subprocess
import sys
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

import dragrig
from dragrig.api import evaluate as evaluating
from dragrig.api import measure as measuring
from dragrig.config.errors import AnalysisError, DragrigError, OutputError, PlanError, RunFileError, SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.plan import PlanStep
from dragrig.rig.protocols import protocol_kinds
from dragrig.rig.protocols.kinds import DragProtocol
from dragrig.setup import StepChoices, create_lab
from places import ROOT

pytestmark = pytest.mark.usefixtures("finished_here")
INTERPRETER = sys.executable
DRAG = DragProtocol(speed_mm_s=10, travel_mm=15, hold_s=0.5)


@pytest.fixture(scope="module")
def run() -> dragrig.Run:
    (made,) = dragrig.simulate(DRAG)
    return made


def test_importing_loads_nothing_heavy_and_offers_everything() -> None:
    code = (
        "import sys, dragrig; heavy = [n for n in ('numpy', 'h5py', 'scipy', 'pandas', 'pydantic') if n in sys.modules]"
        "; print(heavy)"
    )
    done = subprocess.run([INTERPRETER, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    assert [name for name in dragrig.__all__ if not hasattr(dragrig, name)] == []
    with pytest.raises(AttributeError, match="attribute flter"):
        getattr(dragrig, "flter")  # noqa: B009  # mypy knows that there is no such name


@pytest.mark.parametrize("module", [measuring, evaluating], ids=lambda module: module.__name__)
def test_the_examples_of_the_docstrings_run(module: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = doctest.testmod(module)
    assert result.attempted > 4
    assert result.failed == 0


def test_memory_and_files_hold_the_same_samples(run: dragrig.Run, tmp_path: Path) -> None:
    (filed,) = dragrig.simulate(DRAG, out=tmp_path / "c")
    for name, values in run.trace.channels.items():
        assert np.array_equal(filed.trace.channels[name], values), name
    assert np.array_equal(filed.trace.time, run.trace.time)
    assert filed.info.path.parent == tmp_path / "c"
    assert dragrig.load(filed.info.path).info.header.run_id == filed.info.header.run_id
    assert [entry.path for entry in dragrig.campaign(tmp_path / "c").good] == [filed.info.path]


def test_a_model_in_memory_is_simulated_as_its_settings_are(run: dragrig.Run) -> None:
    slippery = FrictionModelSettings(friction_coefficient=0.02)
    (arguments,) = dragrig.simulate(DRAG, model=slippery)
    (assigned,) = dragrig.simulate(DRAG, assignments=["model.friction_coefficient=0.02"])
    assert np.array_equal(arguments.trace.force, assigned.trace.force)
    assert not np.array_equal(arguments.trace.force, run.trace.force)


def test_a_filter_leaves_a_run_in_memory_as_it_is_and_stores_in_a_file(run: dragrig.Run, tmp_path: Path) -> None:
    smooth = dragrig.filter(run, window_s=0.1)
    assert run.filtered is None
    assert smooth.filtered is not None
    (filed,) = dragrig.simulate(DRAG, out=tmp_path / "c")
    dragrig.filter(filed.info.path, window_s=0.1)
    stored = dragrig.load(filed.info.path).filtered
    assert stored is not None
    assert np.array_equal(stored.channels["force"], smooth.filtered.channels["force"], equal_nan=True)


def test_a_table_of_runs_is_the_table_of_their_folder(run: dragrig.Run, tmp_path: Path) -> None:
    dragrig.simulate(DRAG, out=tmp_path / "c")
    numbers = ["speed_mm_s", "steady_force_mN", "steady_force_error_mN"]
    assert np.array_equal(dragrig.table([run])[numbers], dragrig.table(tmp_path / "c")[numbers])


def test_a_run_in_memory_can_be_exported_once(run: dragrig.Run, tmp_path: Path) -> None:
    (written,) = dragrig.export(run, tmp_path / "drag.npz", format="npz")
    with np.load(written) as stored:
        force = next(stored[name] for name in stored.files if name.startswith("force"))
    assert np.array_equal(force, run.trace.force)
    with pytest.raises(OutputError, match="exists already"):
        dragrig.export(run, tmp_path / "drag.npz", format="npz")


def test_the_model_is_what_the_simulator_shows(run: dragrig.Run) -> None:
    (row,) = dragrig.model([10.0]).to_dict("records")
    total = row["f_e_mN"] + row["f_v_mN"] + row["f_c_mN"]
    assert row["total_mN"] == pytest.approx(total)
    steady = dragrig.table([run]).loc[0]
    offset_sd, spread = 3.0, 0.05
    assert abs(steady["steady_force_mN"] - total) < 4 * (offset_sd + spread * total)


def test_invalid_arguments_are_errors_with_a_message(run: dragrig.Run, tmp_path: Path) -> None:
    with pytest.raises(PlanError, match="outside the stage's travel"):
        dragrig.simulate(DragProtocol(speed_mm_s=10, travel_mm=500))
    with pytest.raises(AnalysisError, match="odd number"):
        dragrig.filter(run, window_samples=10)
    dragrig.simulate(DRAG, out=tmp_path / "c")
    with pytest.raises(OutputError, match="holds runs already"):
        dragrig.simulate(DRAG, out=tmp_path / "c")


@pytest.mark.parametrize(
    ("call", "nearest"),
    [
        (lambda: dragrig.simulate("drag", speed=10), "speed_mm_s"),
        (lambda: dragrig.check("drag", asignments=["wait_s=1"]), "assignments"),
        (lambda: dragrig.run("drag", modell="paper"), "model"),
        (lambda: dragrig.examine(bakend="simulated"), "backend"),
        (lambda: dragrig.jog(5.0, dobule=True), "double"),
        (lambda: dragrig.gap_next("drag", speed_mm=10), "speed_mm_s"),
        (lambda: dragrig.gap_diagnose_many([], nominl="capsule"), "nominal"),
        (lambda: dragrig.import_run("a.csv", "b.h5", decimals=","), "decimal"),
    ],
)
def test_a_misspelt_keyword_is_a_type_error_that_names_the_right_one(
    call: Callable[[], object], nearest: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(TypeError, match=rf"is not an argument; did you mean {nearest}\?"):
        call()


def test_keys_of_steps_are_keywords_and_assignments_may_be_a_dict(run: dragrig.Run) -> None:
    (by_keyword,) = dragrig.simulate("drag", speed_mm_s=np.float64(10), travel_mm=15, hold_s=0.5, way_back="stay")
    assert by_keyword.info.header.protocol == run.info.header.protocol
    by_dict = {"speed_mm_s": np.array([10.0, 5.0]), "rig.stage.highest_mm": 61}
    checked = dragrig.check("drag", assignments=by_dict, travel_mm=15, repeats=2)
    drags = [preview.run.protocol for preview in checked.previews if isinstance(preview.run.protocol, DragProtocol)]
    assert [(drag.speed_mm_s, drag.travel_mm) for drag in drags] == [(10, 15), (5, 15)] * 2
    assert checked.findings == ()


def test_a_plan_may_be_a_dict_and_its_mistakes_are_told_as_those_of_a_file() -> None:
    steps = [{"kind": "drag", "speed_mm_s": [20.0, 40.0], "travel_mm": 5.0}]
    found = dragrig.check({"name": "two", "steps": steps})
    assert [preview.run.protocol.kind for preview in found.previews].count("drag") == 2
    with pytest.raises(PlanError, match=r"travl_mm is not a key of a drag step; did you mean travel_mm"):
        dragrig.check({"name": "two", "steps": [{"kind": "drag", "speed_mm_s": 20.0, "travl_mm": 5.0}]})


def test_the_typed_keys_of_steps_are_those_of_the_shipped_kinds() -> None:
    keys = set().union(*(kind.model_fields for kind in protocol_kinds().values())) | set(PlanStep.model_fields)
    assert set(StepChoices.__annotations__) == keys - {"kind", "parameters", "capsule", "note"}


@pytest.mark.parametrize("changes", [{"speed_mm_s": "x"}, ["speed_mm_s"], ["rig.stage.x=1"], ["speed_mm=1"]])
def test_messages_of_the_python_api_name_no_option_of_the_command_line(changes: object) -> None:
    with pytest.raises(DragrigError) as caught:
        dragrig.check("drag", assignments=changes)  # type: ignore[arg-type]
    assert "--" not in str(caught.value)
    assert "speed_mm" in str(caught.value) or "rig.stage.x" in str(caught.value)


def test_a_folder_in_the_place_of_a_run_or_of_campaigns_in_that_of_one_is_told(tmp_path: Path) -> None:
    dragrig.simulate(DRAG, out=tmp_path / "runs" / "first")
    with pytest.raises(RunFileError, match=r"is a folder; dragrig\.campaign"):
        dragrig.load(tmp_path / "runs" / "first")
    for read in (dragrig.table, dragrig.campaign):
        with pytest.raises(RunFileError, match=r"did you mean .*first\?"):
            read(tmp_path / "runs")


def test_a_former_name_still_works_and_says_what_it_is_called_now() -> None:
    with pytest.warns(DeprecationWarning, match=r"dragrig\.next_experiment is called dragrig\.gap_next now"):
        former = getattr(dragrig, "next_experiment")  # noqa: B009  # mypy knows that there is no such name
    assert former is dragrig.gap_next


def test_simulated_runs_end_now_and_none_before_its_specimen_was_taken() -> None:
    began = datetime.now().astimezone()
    runs = dragrig.simulate("drag", speed_mm_s=[5, 10], wait_s=3600)
    ends = [run.info.end_time for run in runs]
    assert all(end is not None and end <= datetime.now().astimezone() for end in ends)
    assert runs[0].info.header.start_time < began - timedelta(hours=1)
    excised = began - timedelta(minutes=5)
    (run, *_) = dragrig.simulate("drag", wait_s=3600, assignments={"specimen.excised_at": excised.isoformat()})
    assert run.info.header.start_time > excised


def test_a_run_shows_itself_in_a_line_and_in_a_notebook_with_its_force(run: dragrig.Run, tmp_path: Path) -> None:
    assert repr(run).startswith("<run drag, speed_mm_s=10.0, jejunum, ")
    html = run._repr_html_()
    assert "steady force" in html
    assert html.count("<polyline") == 1
    dragrig.simulate(DRAG, out=tmp_path / "c")
    campaign = dragrig.campaign(tmp_path / "c")
    assert repr(campaign) == f"<campaign {tmp_path / 'c'}: 1 drag; jejunum>"
    assert campaign.runs[0].path.name in campaign._repr_html_()
    compared = dragrig.compare(run, tmp_path / "c")
    assert repr(compared).startswith("<comparison of A and c: ")
    assert all(len(repr(value)) < 400 for value in (run, campaign, compared))


def test_a_run_becomes_a_table_and_a_dataset_with_units_and_phases(run: dragrig.Run) -> None:
    frame = run.to_pandas()
    assert frame.index.name == "time_s"
    assert list(frame.columns) == ["force_mN", "position_mm", "motor_force_mN", "command_mm", "phase"]
    assert frame.loc[frame["phase"] == "steady", "position_mm"].between(0, 15).all()
    dataset = dragrig.filter(run).to_xarray()
    assert dataset["force"].attrs == dataset["force_filtered"].attrs == {"units": "mN"}
    assert dataset["time"].attrs == {"units": "s"}
    steady = dataset["force"].where(dataset["phase"] == "steady", drop=True)
    assert float(steady.mean()) == pytest.approx(float(frame.loc[frame["phase"] == "steady", "force_mN"].mean()), 1e-4)
    assert dataset.attrs["protocol_speed_mm_s"] == 10


def test_without_xarray_one_sentence_says_how_to_get_it(run: dragrig.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ImportError, match="pip install xarray"):
        run.to_xarray()


def test_runs_are_found_marked_and_drawn_as_by_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    create_lab(tmp_path)
    monkeypatch.chdir(tmp_path)
    (made,) = dragrig.simulate(DRAG, out="runs/first")
    (found,) = dragrig.find(specimen="Jejunum", kind="drag", since="2020-01-01")
    assert found.samefile(made.info.path)
    assert dragrig.find(until="2020-01-01") == ()
    assert dragrig.mark(found, bad="capsule turned") == (found,)
    assert dragrig.find(bad=True) == (found,)
    assert isinstance(dragrig.show(found), Figure)
    assert isinstance(dragrig.show("runs/first"), Figure)
    assert isinstance(made.plot(), Figure)
    with pytest.raises(SettingsError, match="say which"):
        dragrig.mark(found)
    with pytest.raises(SettingsError, match="write it as 2026-05-04"):
        dragrig.find(since="4.5.2026")


def notebook_cells() -> list[str]:
    """Return the code of the example notebook, which is kept without results."""
    cells = json.loads((ROOT / "docs" / "example.ipynb").read_text("utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in code)
    return ["".join(cell["source"]) for cell in code]


@pytest.mark.thorough
def test_the_code_of_the_example_notebook_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    names: dict[str, object] = {}
    for cell in notebook_cells():
        exec(cell, names)  # our own page
    figure = names["figure"]
    assert isinstance(figure, Figure)
    figure.canvas.draw()
    plt.close(figure)
    assert capfd.readouterr().err == ""
    assert list(tmp_path.iterdir()) == []
