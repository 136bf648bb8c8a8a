"""A diagnosis in its own process, so that the window can show its progress and cancel it."""

import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import TypeAlias

from dragrig.analysis.gap.diagnosis import Diagnosis
from dragrig.config.errors import DragrigError
from dragrig.present.document import Document


@dataclass(frozen=True, slots=True)
class DiagnosisTask:
    """A campaign and its nominal model, as of `dragrig gap diagnose`."""

    campaign: str
    nominal: str = "capsule"


@dataclass(frozen=True, slots=True)
class DiagnosisProgress:
    """How much is done, and of how much."""

    done: int
    of: int


@dataclass(frozen=True, slots=True, eq=False)
class CompletedDiagnosis:
    """A diagnosis and its document, whose figures are drawn; runs before and after are left to the window."""

    diagnosis: Diagnosis
    document: Document


@dataclass(frozen=True, slots=True)
class DiagnosisFailed:
    """Why there is no diagnosis."""

    sentence: str


DiagnosisEvent: TypeAlias = DiagnosisProgress | CompletedDiagnosis | DiagnosisFailed


class DiagnosisProcess:
    """A running diagnosis; belongs to one thread, which it never blocks."""

    def __init__(self, task: DiagnosisTask) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, child_end = context.Pipe(duplex=False)
        self._over = False
        arguments = (child_end, task)
        self._process = context.Process(target=_run_diagnosis, args=arguments, name="dragrig-diagnosis", daemon=True)
        self._process.start()
        child_end.close()

    def events(self) -> Iterator[DiagnosisEvent]:
        """Yield new events; the last is a diagnosis or a failure."""
        try:
            while not self._over and self._connection.poll(0):
                event: DiagnosisEvent = self._connection.recv()
                self._over = not isinstance(event, DiagnosisProgress)
                yield event
        except (EOFError, OSError):
            self._over = True
            self._process.join(1.0)
            yield DiagnosisFailed(f"the diagnosis ended unexpectedly (exit code {self._process.exitcode}); try again")

    def cancel(self) -> None:
        """Kill the process, which only reads files."""
        self._over = True
        self._process.terminate()
        self._process.join(5.0)
        self._connection.close()


def completed(diagnosis: Diagnosis, source: str = "") -> CompletedDiagnosis:
    """Draw the figures of a diagnosis, which takes matplotlib, here and not in the window's process."""
    from dragrig.present.diagnosis import diagnosis_document
    from dragrig.present.files import drawn

    document = diagnosis_document(diagnosis, source=source).without("before-after")
    return CompletedDiagnosis(diagnosis, drawn(document))


def _run_diagnosis(connection: "Connection[DiagnosisEvent, object]", task: DiagnosisTask) -> None:
    from dragrig.api.diagnose import diagnose

    def progress(done: int, of: int) -> None:
        connection.send(DiagnosisProgress(done, of))

    # Ctrl-C in the terminal goes to the window too, which then cancels this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The connection is closed once the window is gone.
    with suppress(OSError):
        try:
            diagnosis = diagnose(task.campaign, nominal=task.nominal, progress=progress)
            connection.send(completed(diagnosis, task.campaign))
        except DragrigError as error:
            connection.send(DiagnosisFailed(str(error)))
