"""A diagnosis in its own process for the window: progress, cancel, and the result as plain values."""

import io
import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import TypeAlias

from dragrig.analysis.gap.candidate_runs import plan_of_next_runs
from dragrig.analysis.gap.diagnosis import Diagnosis, RankedHypothesis, RunTraces, Verdict
from dragrig.analysis.gap.diagnosis_text import (
    as_sentence,
    axis_texts,
    calibration_sentence,
    detection_limit_sentence,
    display_name,
    domain_sentence,
    effect_description,
    is_stated_verdict,
    percent_text,
    probability_text,
    shrink_sentences,
    verdict_sentences,
)
from dragrig.config.errors import DragrigError
from dragrig.config.plan import Plan

_MAX_RANKED = 8


@dataclass(frozen=True, slots=True)
class DiagnosisTask:
    """What to diagnose; the words of `dragrig gap diagnose`."""

    campaign: str
    nominal: str = "capsule"
    tolerance_mN: float | None = None


@dataclass(frozen=True, slots=True)
class DiagnosisProgress:
    """How far it is."""

    done: int
    of: int


@dataclass(frozen=True, slots=True)
class HypothesisRow:
    """A line of the ranking; `held_out` is empty where it was not tried so."""

    name: str
    probability: float
    chance: str
    held_out: str
    verdict: bool
    confusable: bool


@dataclass(frozen=True, slots=True)
class WhereRow:
    """Where the gap is along one axis, in words."""

    axis: str
    where: str
    p: float


@dataclass(frozen=True, slots=True, eq=False)
class DiagnosisView:
    """A diagnosis as a screen shows it.

    Attributes
    ----------
    verdict
        Sentences, the answer first.
    where_svg
        The map of where the gap is.
    views
        Runs before and after.
    floor_mN
        Noise and scatter of repeats; none where nothing was left out to judge by.
    next_words, next_plan
        The experiment to make next; empty and none where none is recommended.
    """

    verdict: tuple[str, ...]
    honesty: tuple[str, ...]
    ranking: tuple[HypothesisRow, ...]
    where: str
    places: tuple[WhereRow, ...]
    where_svg: bytes
    shrink: tuple[str, ...]
    cannot_answer: tuple[str, ...]
    views: tuple[RunTraces, ...]
    named: bool
    floor_mN: float | None
    next_words: str = ""
    next_plan: Plan | None = None


@dataclass(frozen=True, slots=True)
class DiagnosisFailed:
    """Why there is no diagnosis."""

    sentence: str


DiagnosisEvent: TypeAlias = DiagnosisProgress | DiagnosisView | DiagnosisFailed


class DiagnosisProcess:
    """A diagnosis under way; belongs to one thread, and never makes it wait."""

    def __init__(self, wanted: DiagnosisTask) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe(duplex=False)
        self._over = False
        self._process = context.Process(
            target=_run_diagnosis, args=(theirs, wanted), name="dragrig-diagnosis", daemon=True
        )
        self._process.start()
        theirs.close()

    @property
    def over(self) -> bool:
        """Whether nothing more will come."""
        return self._over

    def news(self) -> Iterator[DiagnosisEvent]:
        """Yield what is new."""
        try:
            while not self._over and self._connection.poll(0):
                told: DiagnosisEvent = self._connection.recv()
                self._over = not isinstance(told, DiagnosisProgress)
                yield told
        except (EOFError, OSError):
            self._over = True
            self._process.join(1.0)
            yield DiagnosisFailed(f"the diagnosis ended unexpectedly (exit code {self._process.exitcode}); try again")

    def cancel(self) -> None:
        """End it at once: it only reads."""
        self._over = True
        self._process.terminate()
        self._process.join(5.0)
        self._connection.close()


def diagnosis_view(diagnosis: Diagnosis) -> DiagnosisView:
    """Return a diagnosis as a screen shows it."""
    seen = () if diagnosis.verdict is Verdict.NO_GAP else (detection_limit_sentence(diagnosis),)
    ranked = sorted(diagnosis.ranking, key=lambda one: -one.probability)[:_MAX_RANKED]
    found = diagnosis.next_experiment
    return DiagnosisView(
        verdict=(*verdict_sentences(diagnosis), *map(effect_description, diagnosis.effects)),
        honesty=(calibration_sentence(diagnosis), *seen),
        ranking=tuple(_hypothesis_row(one, diagnosis) for one in ranked),
        where=domain_sentence(diagnosis.where),
        places=tuple(WhereRow(one.axis, one.where, one.p) for one in axis_texts(diagnosis.where)),
        where_svg=_where_svg(diagnosis),
        shrink=() if diagnosis.shrink is None else shrink_sentences(diagnosis.shrink, named=bool(diagnosis.effects)),
        cannot_answer=tuple(map(as_sentence, diagnosis.limitations)),
        views=diagnosis.traces,
        named=bool(diagnosis.effects),
        floor_mN=None if diagnosis.shrink is None else diagnosis.shrink.noise_floor_mN,
        next_words="" if found is None else found.reason,
        next_plan=None if found is None else plan_of_next_runs(found),
    )


def _hypothesis_row(one: RankedHypothesis, diagnosis: Diagnosis) -> HypothesisRow:
    return HypothesisRow(
        name=display_name(one.hypothesis),
        probability=one.probability,
        chance=probability_text(one.probability),
        held_out="" if one.held_out_improvement is None else percent_text(one.held_out_improvement),
        verdict=is_stated_verdict(one, diagnosis),
        confusable=bool(set(one.hypothesis.split("+")) & set(diagnosis.confusable_with)),
    )


def _where_svg(diagnosis: Diagnosis) -> bytes:
    from dragrig.present.diagnosis_figures import location_figure
    from dragrig.present.drawing import figure_style

    content = io.BytesIO()
    figure = location_figure(diagnosis.where)
    with figure_style():
        figure.savefig(content, format="svg")
    return content.getvalue()


def _run_diagnosis(connection: "Connection[DiagnosisEvent, object]", task: DiagnosisTask) -> None:
    from dragrig.api.diagnose import diagnose

    def progress(done: int, of: int) -> None:
        connection.send(DiagnosisProgress(done, of))

    # Ctrl-C in the terminal goes to the window too, which then cancels this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The connection is closed once the window is gone.
    with suppress(OSError):
        try:
            diagnosis = diagnose(task.campaign, nominal=task.nominal, tolerance_mN=task.tolerance_mN, progress=progress)
            connection.send(diagnosis_view(diagnosis))
        except DragrigError as error:
            connection.send(DiagnosisFailed(str(error)))
