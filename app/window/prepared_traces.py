"""What draws the traces of runs, made at once where it is little, and else beside the GUI thread.

Who holds the GUI thread up keeps key and button of the stop from it, and while the stage moves, the engine stops it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Signal

from dragrig.views import ShownTrace
from dragrig.window.background import FileWorker
from dragrig.window.trace_pyramid import TraceCrossings, TracePath, TracePyramid

MAX_SAMPLES_AT_ONCE = 1_000_000
"""Prepared in some 10 ms."""

Drawing: TypeAlias = TracePyramid | TracePath | TraceCrossings


@dataclass(frozen=True, slots=True)
class DrawingKey:
    """What is drawn of a trace: a channel against an axis; or looked up in it: where the axis comes to a value."""

    index: int
    """Of the trace."""
    name: str
    kind: Literal["raw", "filtered", "crossings"]
    axis: str

    def values(self, trace: ShownTrace) -> npt.NDArray[np.float32] | None:
        """Return the samples; None where the trace has none."""
        along = None if self.axis == "time" else trace.along(self.axis)
        if self.kind == "crossings" or (along is None and self.axis != "time"):
            return along
        return (trace.filtered if self.kind == "filtered" else trace.channels).get(self.name)

    def drawing(self, trace: ShownTrace) -> Drawing | None:
        """Make it, in a time that depends on the number of samples."""
        values, along = self.values(trace), None if self.axis == "time" else trace.along(self.axis)
        if values is None:
            return None
        if self.kind == "crossings":
            return TraceCrossings(values)
        if along is not None:
            return TracePath(along, values)
        pyramid = TracePyramid()
        pyramid.append(values)
        return pyramid


class PreparedTraces(QObject):
    """The drawings of some traces; `ready` says that more of those that were asked for are there."""

    ready = Signal()
    refused = Signal(str)

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._traces: tuple[ShownTrace, ...] = ()
        self._drawings: dict[DrawingKey, Drawing | None] = {}
        self._under_way: set[DrawingKey] = set()
        self._worker = FileWorker(self.refused.emit, self)

    @property
    def busy(self) -> bool:
        """Whether a drawing that was asked for is not there yet."""
        return self._worker.busy

    def show(self, traces: Sequence[ShownTrace]) -> None:
        """Take other traces; of the same runs, filtered anew, what is drawn of the raw samples against time stays."""
        same = [trace.run for trace in traces] == [trace.run for trace in self._traces]
        kept = self._drawings if same else {}
        self._traces, self._under_way = tuple(traces), set()
        self._drawings = {key: drawn for key, drawn in kept.items() if key.kind == "raw" and key.axis == "time"}

    def of(self, keys: Sequence[DrawingKey]) -> Mapping[DrawingKey, Drawing]:
        """Return those of these drawings that there are, and begin with the others."""
        missing = [key for key in keys if key not in self._drawings and key not in self._under_way]
        sizes = (key.values(self._traces[key.index]) for key in missing)
        if sum(0 if values is None else len(values) for values in sizes) <= MAX_SAMPLES_AT_ONCE:
            self._drawings |= _drawings(self._traces, missing)
        else:
            traces, submit = self._traces, self._worker.do_too if self._under_way else self._worker.do
            self._under_way.update(missing)
            submit(lambda: _drawings(traces, missing), lambda made: self._take(traces, made))
        return {key: drawing for key in keys if (drawing := self._drawings.get(key)) is not None}

    def drop(self) -> None:
        """Wait for what is under way, and forget it."""
        self._worker.drop()

    def _take(self, traces: tuple[ShownTrace, ...], made: Mapping[DrawingKey, Drawing | None]) -> None:
        if traces is self._traces:
            self._drawings |= made
            self._under_way.difference_update(made)
            self.ready.emit()


def _drawings(traces: Sequence[ShownTrace], keys: Sequence[DrawingKey]) -> dict[DrawingKey, Drawing | None]:
    return {key: key.drawing(traces[key.index]) for key in keys}
