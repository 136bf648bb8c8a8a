"""A diagnosis in a process of its own, for a screen: progress, cancel, and all that is shown as plain values."""

import io
import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import TypeAlias

from dragrig.analysis.gap.planning.writing import plan_of
from dragrig.analysis.gap.results import Diagnosis, Ranked, RunView, Verdict
from dragrig.analysis.gap.sentences import (
    chance_in_words,
    is_verdict,
    meaning_of_probabilities,
    name_of,
    percent,
    sentence,
    shrink_sentences,
    verdict_sentences,
    what_it_is,
    would_have_seen,
)
from dragrig.analysis.gap.where_words import places, where_sentence
from dragrig.config.errors import DragrigError
from dragrig.config.plan import Plan

_MOST_RANKED = 8


@dataclass(frozen=True, slots=True)
class Wanted:
    """What to diagnose; the words of `dragrig gap diagnose`."""

    campaign: str
    nominal: str = "capsule"
    tolerance_mN: float | None = None


@dataclass(frozen=True, slots=True)
class Far:
    """How far it is."""

    done: int
    of: int


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A line of the ranking; `held_out` is empty where it was not tried so."""

    name: str
    probability: float
    chance: str
    held_out: str
    verdict: bool
    confusable: bool


@dataclass(frozen=True, slots=True)
class Place:
    """Where the gap is along one axis, in words."""

    axis: str
    where: str
    p: float


@dataclass(frozen=True, slots=True, eq=False)
class Told:
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
    ranking: tuple[Hypothesis, ...]
    where: str
    places: tuple[Place, ...]
    where_svg: bytes
    shrink: tuple[str, ...]
    cannot_answer: tuple[str, ...]
    views: tuple[RunView, ...]
    named: bool
    floor_mN: float | None
    next_words: str = ""
    next_plan: Plan | None = None


@dataclass(frozen=True, slots=True)
class Failed:
    """Why there is no diagnosis."""

    sentence: str


News: TypeAlias = Far | Told | Failed


class DiagnosisProcess:
    """A diagnosis under way; belongs to one thread, and never makes it wait."""

    def __init__(self, wanted: Wanted) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe(duplex=False)
        self._over = False
        self._process = context.Process(target=_diagnose, args=(theirs, wanted), name="dragrig-diagnosis", daemon=True)
        self._process.start()
        theirs.close()

    @property
    def over(self) -> bool:
        """Whether nothing more will come."""
        return self._over

    def news(self) -> Iterator[News]:
        """Yield what is new."""
        try:
            while not self._over and self._connection.poll(0):
                told: News = self._connection.recv()
                self._over = not isinstance(told, Far)
                yield told
        except (EOFError, OSError):
            self._over = True
            self._process.join(1.0)
            yield Failed(f"the diagnosis ended unexpectedly (exit code {self._process.exitcode}); try again")

    def cancel(self) -> None:
        """End it at once: it only reads."""
        self._over = True
        self._process.terminate()
        self._process.join(5.0)
        self._connection.close()


def told(diagnosis: Diagnosis) -> Told:
    """Return a diagnosis as a screen shows it."""
    seen = () if diagnosis.verdict is Verdict.NO_GAP else (would_have_seen(diagnosis),)
    ranked = sorted(diagnosis.ranking, key=lambda one: -one.probability)[:_MOST_RANKED]
    found = diagnosis.next_experiment
    return Told(
        verdict=(*verdict_sentences(diagnosis), *map(what_it_is, diagnosis.effects)),
        honesty=(meaning_of_probabilities(diagnosis), *seen),
        ranking=tuple(_hypothesis(one, diagnosis) for one in ranked),
        where=where_sentence(diagnosis.where),
        places=tuple(Place(one.axis, one.where, one.p) for one in places(diagnosis.where)),
        where_svg=_where_svg(diagnosis),
        shrink=() if diagnosis.shrink is None else shrink_sentences(diagnosis.shrink, named=bool(diagnosis.effects)),
        cannot_answer=tuple(map(sentence, diagnosis.cannot_answer)),
        views=diagnosis.views,
        named=bool(diagnosis.effects),
        floor_mN=None if diagnosis.shrink is None else diagnosis.shrink.noise_floor_mN,
        next_words="" if found is None else found.why,
        next_plan=None if found is None else plan_of(found),
    )


def _hypothesis(one: Ranked, diagnosis: Diagnosis) -> Hypothesis:
    return Hypothesis(
        name=name_of(one.hypothesis),
        probability=one.probability,
        chance=chance_in_words(one.probability),
        held_out="" if one.held_out_improvement is None else percent(one.held_out_improvement),
        verdict=is_verdict(one, diagnosis),
        confusable=bool(set(one.hypothesis.split("+")) & set(diagnosis.confusable_with)),
    )


def _where_svg(diagnosis: Diagnosis) -> bytes:
    from dragrig.figures.gap_where import where_figure
    from dragrig.figures.style import drawing

    content = io.BytesIO()
    figure = where_figure(diagnosis.where)
    with drawing():
        figure.savefig(content, format="svg")
    return content.getvalue()


def _diagnose(connection: "Connection[News, object]", wanted: Wanted) -> None:
    from dragrig.diagnosing import diagnosed

    def progress(done: int, of: int) -> None:
        connection.send(Far(done, of))

    # Ctrl-C in the terminal is the window's to hear, which then cancels this.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Nobody listens any more once the window is gone.
    with suppress(OSError):
        try:
            found = diagnosed(
                wanted.campaign, nominal=wanted.nominal, tolerance_mN=wanted.tolerance_mN, progress=progress
            )
            connection.send(told(found.result))
        except DragrigError as error:
            connection.send(Failed(str(error)))
