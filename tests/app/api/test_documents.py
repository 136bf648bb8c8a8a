"""`dragrig.bluesky_documents`: runs in the words of bluesky, for Tiled and its kin."""

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from event_model import DocumentNames, schema_validators

import dragrig
from dragrig.config.errors import RunFileError
from dragrig.rig.protocols.kinds import DragProtocol
from dragrig.rig.runfile.model import RunEvent, RunStatus

DRAG = DragProtocol(speed_mm_s=10, travel_mm=15, hold_s=0.5)


@pytest.fixture(scope="module")
def run() -> dragrig.Run:
    (made,) = dragrig.simulate(DRAG)
    events = (RunEvent(0.5, "prompt", "Insert the capsule"), RunEvent(1.25, "tripped", "force above 8000 mN"))
    return replace(dragrig.filter(made), events=events)


def documents_of(run: dragrig.Run | str | Path) -> dict[str, list[Mapping[str, Any]]]:
    found: dict[str, list[Mapping[str, Any]]] = {}
    for name, document in dragrig.bluesky_documents(run):
        schema_validators[DocumentNames[name]].validate(document)
        found.setdefault(name, []).append(document)
    return found


def rows(pages: list[Mapping[str, Any]], descriptor: Mapping[str, Any], column: str) -> list[Any]:
    return [value for page in pages if page["descriptor"] == descriptor["uid"] for value in page["data"][column]]


def test_every_sample_and_every_event_is_there_with_its_unit_and_time(run: dragrig.Run) -> None:
    found = documents_of(run)
    (start,), (primary, events), pages, (stop,) = (
        found[name] for name in ("start", "descriptor", "event_page", "stop")
    )
    frame, begun_s = run.to_pandas(), run.info.header.start_time.timestamp()
    for column, named in (("force", "force_mN"), ("speed_filtered", "speed_filtered_mm_s"), ("phase", "phase")):
        assert rows(pages, primary, column) == frame[named].tolist()
    assert primary["data_keys"]["force"]["units"] == "mN"
    assert primary["data_keys"]["speed_filtered"]["units"] == "mm/s"
    at_s = [moment for page in pages if page["descriptor"] == primary["uid"] for moment in page["time"]]
    assert at_s == pytest.approx(begun_s + run.trace.time, abs=1e-6)
    numbers = [number for page in pages if page["descriptor"] == primary["uid"] for number in page["seq_num"]]
    assert np.all(np.diff(numbers) == 1)
    assert rows(pages, events, "message") == [event.message for event in run.events]
    assert stop["num_events"] == {"primary": run.info.samples, "events": 2}
    assert start["uid"] == run.info.header.run_id
    assert start["protocol"]["speed_mm_s"] == 10
    assert start["sample"]["name"] == "jejunum"


@pytest.mark.parametrize(
    ("status", "exit_status"),
    [(RunStatus.COMPLETE, "success"), (RunStatus.ABORTED, "abort"), (RunStatus.TRIPPED, "fail")],
)
def test_the_stop_document_says_how_the_run_ended(run: dragrig.Run, status: RunStatus, exit_status: str) -> None:
    ended = replace(run, info=replace(run.info, status=status, reason="by a person"), events=())
    (stop,) = documents_of(ended)["stop"]
    assert (stop["exit_status"], stop["reason"]) == (exit_status, "by a person")


def test_a_file_gives_the_documents_of_its_run(tmp_path: Path) -> None:
    (filed,) = dragrig.simulate(DRAG, out=tmp_path / "c")
    (start,) = documents_of(filed.info.path)["start"]
    assert start["uid"] == filed.info.header.run_id
    with pytest.raises(RunFileError):
        next(dragrig.bluesky_documents(tmp_path / "none.h5"))


def test_a_run_without_a_sample_has_its_documents_too(run: dragrig.Run) -> None:
    trace = run.trace
    empty = {name: values[:0] for name, values in trace.channels.items()}
    nothing = replace(trace, time=trace.time[:0], command=trace.command[:0], phase=trace.phase[:0], channels=empty)
    found = documents_of(replace(run, info=replace(run.info, samples=0), trace=nothing, events=(), filtered=None))
    assert [name for name, documents in found.items() for _ in documents] == ["start", "descriptor", "stop"]


def test_without_event_model_a_sentence_says_how_to_get_it(run: dragrig.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "event_model", None)
    with pytest.raises(ImportError, match="pip install event-model"):
        next(dragrig.bluesky_documents(run))


@pytest.mark.thorough
@pytest.mark.filterwarnings("default")
def test_a_tiled_server_serves_the_run(run: dragrig.Run, tmp_path: Path) -> None:
    catalog = pytest.importorskip("tiled.catalog", reason="the server is in a group of its own: uv run --group tiled")
    from bluesky_tiled_plugins import TiledWriter
    from tiled.client import Context, from_context
    from tiled.server.app import build_app

    storage = [str(tmp_path), f"duckdb:///{tmp_path}/tables.duckdb"]
    with Context.from_app(build_app(catalog.in_memory(writable_storage=storage))) as context:
        client = from_context(context)
        writer = TiledWriter(client)
        for name, document in dragrig.bluesky_documents(run):
            writer(name, document)
        served = client[run.info.header.run_id]
        samples = served["primary"].read()
        np.testing.assert_array_equal(samples["force"], run.trace.force)
        assert served.metadata["start"]["protocol"]["speed_mm_s"] == 10
        assert served["events"].read()["message"].values.tolist() == [event.message for event in run.events]
