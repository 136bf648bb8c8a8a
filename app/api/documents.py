"""A run as documents of bluesky's event model, for Tiled and everything else that listens to a run engine."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from dragrig.rig import Run, RunStatus, read_run

if TYPE_CHECKING:
    from event_model import ComposeDescriptor, DataKey

_ROWS = 1000
"""Samples in a page: some hundred kilobytes as JSON, which a message broker takes."""
_EXIT_STATUS: Mapping[RunStatus, Literal["success", "abort"]] = {
    RunStatus.COMPLETE: "success",
    RunStatus.ABORTED: "abort",
}

Documents: TypeAlias = Iterator[tuple[str, Mapping[str, object]]]


def bluesky_documents(run: Run | str | Path) -> Documents:
    """Yield the documents of a run with their names: start, descriptors, event pages, stop.

    The stream `primary` holds every recorded quantity, the filtered force and the phase, with units; the stream
    `events` the messages of the run. The start document holds all known facts; its uid is the run's own, so that
    a catalogue takes no run for two. See the event model, https://blueskyproject.io/event-model.

    Parameters
    ----------
    run
        A run, or a run file.

    Raises
    ------
    RunFileError
        When the file cannot be read.
    ImportError
        Where event-model is not installed.
    """
    try:
        from event_model import compose_run
    except ImportError as error:
        raise ImportError("event-model is not installed here: pip install event-model.") from error

    run = run if isinstance(run, Run) else read_run(Path(run))
    info, header, trace = run.info, run.info.header, run.trace
    begun_s = header.start_time.timestamp()
    groups = {"sample": header.specimen, "protocol": header.protocol, "capsule": header.capsule, "checks": info.checks}
    facts = {
        **header.entry,
        **{name: dict(values) for name, values in groups.items()},
        "plan_name": info.kind,
        "scan_id": header.order,
        "backend": header.backend,
        "sample_rate_hz": header.sample_rate_hz,
        "settings_toml": header.settings_toml,
    }
    composed = compose_run(uid=header.run_id, time=begun_s, metadata=facts)
    yield "start", composed.start_doc
    samples = {**run.columns(), "phase": (trace.phase_names, "")}
    yield from _stream(composed.compose_descriptor, "primary", begun_s, trace.time, samples, trace.signal)
    if run.events:
        times = np.array([event.time_s for event in run.events])
        messages = {
            name: (np.array([getattr(event, name) for event in run.events]), "") for name in ("kind", "message")
        }
        yield from _stream(composed.compose_descriptor, "events", begun_s, times, messages, "message")
    ended = info.end_time.timestamp() if info.end_time is not None else begun_s + info.samples / header.sample_rate_hz
    yield "stop", composed.compose_stop(_EXIT_STATUS.get(info.status, "fail"), info.reason, time=ended)


def _stream(
    compose: "ComposeDescriptor",
    name: str,
    begun_s: float,
    times_s: npt.NDArray[np.float64],
    columns: Mapping[str, tuple[npt.NDArray[np.generic], str]],
    shown: str,
) -> Documents:
    """Yield the descriptor of a stream and its event pages, none without rows; a plot begins with `shown`."""
    keys: dict[str, DataKey] = {}
    for column, (values, units) in columns.items():
        dtype: Literal["string", "number"] = "string" if values.dtype.kind == "U" else "number"
        keys[column] = {"source": f"dragrig:{column}", "dtype": dtype, "dtype_numpy": values.dtype.str, "shape": []}
        if units:
            keys[column]["units"] = units
    stream = compose(name, keys, {"rig": {"fields": [shown]}}, object_keys={"rig": [*keys]}, time=begun_s)
    yield "descriptor", stream.descriptor_doc
    for begin in range(0, len(times_s), _ROWS):
        rows = slice(begin, begin + _ROWS)
        data = {column: values[rows].tolist() for column, (values, _) in columns.items()}
        at_s = (begun_s + times_s[rows]).tolist()
        yield "event_page", stream.compose_event_page(data, dict.fromkeys(data, at_s), time=at_s)
