"""All that an exam says of a diagnosis."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dragrig.gap_scoring.calibration import Calibration, calibration
from dragrig.gap_scoring.confusion import Confusion, confusion
from dragrig.gap_scoring.detection import Detection, detection
from dragrig.gap_scoring.promises import Promises, promises
from dragrig.gap_scoring.rates import Rate, rates
from dragrig.gap_scoring.records import Answer, Case, Diagnosis, Shrink, read
from dragrig.gap_scoring.withheld import withheld_rates

if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True, slots=True)
class Score:
    """How often a diagnosis is right.

    Attributes
    ----------
    rates
        In the order of the table.
    missed
        The cases whose verdict is not right.
    withheld
        Rates of what is said when the true effect is taken out of the catalogue.
    """

    rates: tuple[Rate, ...]
    missed: tuple[Case, ...]
    confusion: Confusion
    detection: tuple[Detection, ...]
    calibration: Calibration
    promises: Promises
    withheld: tuple[Rate, ...]

    def __getitem__(self, name: str) -> Rate:
        """Return the rate of that name."""
        return next(one for one in (*self.rates, *self.withheld) if one.name == name)

    def tables(self) -> tuple["Table", "Table"]:
        """Return the rates, and what was said where it was not right, as tables for a console."""
        from rich.table import Table

        shown = Table("", "held", "share", "95 % interval", title="How often the diagnosis is right")
        for one in self.rates:
            bounds = f"{one.low:.2f} to {one.high:.2f}"
            told = (f"{one.share:.2f}", bounds) if one.count else ("", "")
            shown.add_row(one.name, f"{one.held} of {one.count}", *told)
        missed = Table("case", "truth", "form", "size", "said", "probability", title="Not right")
        for row in map(missed_cells, self.missed):
            missed.add_row(*row)
        return shown, missed


def missed_cells(case: Case) -> tuple[str, ...]:
    """Return a case whose verdict is not right as cells: name, truth, form, size, said, probability."""
    said = "+".join(case.said.effects) or case.said.verdict
    sizes = ", ".join(f"{size:.2g}" for size in case.answer.size)
    truth = case.answer.truth or ", ".join(case.answer.effects)
    return case.name, truth, ", ".join(case.answer.form), sizes, said, f"{case.said.probability:.2f}"


def score(
    pairs: Iterable[tuple[str, Mapping[str, object], Mapping[str, object]]],
    *,
    withheld: Mapping[str, Mapping[str, object]] | None = None,
    achieved: Mapping[str, Mapping[str, object]] | None = None,
    amounts: Mapping[str, float] | None = None,
) -> Score:
    """Score diagnoses against what was hidden.

    Parameters
    ----------
    pairs
        Name of the campaign, its answer, and the diagnosis as `dragrig gap diagnose --json` prints it.
    withheld
        Diagnoses without the true effect, by the campaign's name.
    achieved
        What `dragrig gap evaluate --json` prints of fresh runs, by the campaign's name.
    amounts
        d′ of the hidden effects, by the campaign's name.

    Raises
    ------
    AnalysisError
        When an answer or a diagnosis lacks what is scored.
    """
    others, fresh, sizes = withheld or {}, achieved or {}, amounts or {}
    cases = [
        Case(
            name,
            read(Answer, answer, name),
            read(Diagnosis, said, name),
            read(Diagnosis, others[name], name) if name in others else None,
            read(Shrink, fresh[name].get("shrink"), name) if name in fresh else None,
            sizes.get(name),
        )
        for name, answer, said in pairs
    ]
    return Score(
        rates(cases),
        tuple(one for one in cases if not one.right),
        confusion(cases),
        detection(cases),
        calibration(cases),
        promises(cases),
        withheld_rates(cases),
    )
