"""How a gap was settled, laid out for a reader: the verdict, how its probabilities moved, and why each run was made."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

from dragrig.analysis import count_text, join_names
from dragrig.analysis.gap import Diagnosis, Ending, SettleRecord, SettleStep, display_name
from dragrig.present import (
    BLACK,
    CYCLE,
    GREY,
    PALE,
    CurveLabel,
    Document,
    Field,
    Figure,
    FormattedNumber,
    Items,
    Section,
    Table,
    decimals,
    diagnosis_document,
    figure_style,
    label_curves,
    label_times,
    new_figure,
    probability_text,
    tint,
)
from dragrig.present.diagnosis import settled_cell

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure


MIN_DRAWN_PRESENCE = 0.1
"""Effects that were less likely throughout are not drawn."""
VERDICTS = {"no_gap": "no gap", "unknown": "an unexplained gap", "open": "open, from one condition"}


def settlement_document(record: SettleRecord, diagnosis: Diagnosis, *, source: str = "") -> Document:
    """Lay out a settled gap: the last diagnosis, and how it came about.

    Parameters
    ----------
    record
        What was decided after each batch of runs.
    diagnosis
        The last one.
    source
        The campaign.
    """
    document = diagnosis_document(diagnosis, source=source)
    data = document.data if isinstance(document.data, Mapping) else {}
    return replace(
        document,
        title=f"Settled: {diagnosis.specimen}" if record.ending is Ending.SETTLED else f"Gap of {diagnosis.specimen}",
        lead=(ending_sentence(record), *document.lead),
        # The figure that shows the conclusion comes first.
        sections=(*document.sections[:1], _way_section(record), *document.sections[1:]),
        data={**data, "settle": record.model_dump(mode="json")},
    )


def ending_sentence(record: SettleRecord) -> str:
    """Say why no further run was made, and what it took."""
    last = record.steps[-1]
    spent = f"after {count_text(last.runs, 'run')} ({last.spent_min:.1f} of {record.minutes:g} min of rig time)"
    sure = (
        f"Probability of the verdict: {probability_text(last.probability)}; that just these causes act, however "
        f"little: {probability_text(last.surest)}"
    )
    match record.ending:
        case Ending.SETTLED:
            return f"Settled {spent}. {sure}."
        case Ending.NO_RUN:
            return f"Ended {spent}: no further run would change the answer. {sure}."
        case Ending.TIME:
            return f"Time is up {spent}. {sure}; asked for: {record.until:g}."
    return f"Not ended yet, {spent}. {sure}."


def step_sentence(record: SettleRecord) -> str:
    """Say what the latest diagnosis found, and what is made next and why, as it goes."""
    if not record.steps:
        return f"First: {count_text(len(record.batches[0].plan.steps), 'step')}, {record.batches[0].minutes:.1f} min."
    last = record.steps[-1]
    found = f"{count_text(last.runs, 'run')}, {last.spent_min:.1f} min: {verdict_text(last)}"
    if len(record.batches) == len(record.steps):
        return f"{found}. {ending_sentence(record)}"
    return f"{found}. Next, {record.batches[-1].minutes:.1f} min: {record.batches[-1].reason}"


def verdict_text(step: SettleStep) -> str:
    """Return the verdict of a step with its probability."""
    name = display_name("+".join(step.effects)) if step.effects else VERDICTS.get(step.verdict, step.verdict)
    return f"{name} {probability_text(step.probability)}" if step.probability > 0 else name


def _way_section(record: SettleRecord) -> Section:
    rows = list(enumerate(record.steps))

    def expected(row: tuple[int, SettleStep]) -> FormattedNumber | str:
        return settled_cell(record.batches[row[0]].gain_bits, record.steps[row[0] - 1].open_bits) if row[0] else ""

    return Section(
        "way",
        "How it was settled",
        (
            Figure(
                "probabilities",
                "Probabilities against rig time: the verdict, each effect that was ever likely, and all causes.",
                "After each batch of runs, which the stripes show with their rig time: in black the verdict, in colour "
                "each effect. Dashed, that just the likeliest causes act, however little; dotted, what was asked for.",
                lambda: probabilities_figure(record),
            ),
            Table.of(
                "batches",
                "",
                rows,
                Field("batch", "batch", lambda row: row[0] + 1, decimals(0)),
                Field("runs", "runs", lambda row: row[1].runs, decimals(0)),
                Field("cost", "cost, min", lambda row: record.batches[row[0]].minutes, decimals(1)),
                Field("minutes", "min so far", lambda row: row[1].spent_min, decimals(1)),
                Field("verdict", "verdict", lambda row: verdict_text(row[1])),
                Field("causes", "just these causes", lambda row: row[1].surest, decimals(2)),
                Field("expected", "expected to settle", expected),
            ),
            Section("why", "Why these runs", (Items(tuple(_reasons(record))),)),
        ),
    )


def _reasons(record: SettleRecord) -> Iterator[str]:
    for number, batch in enumerate(record.batches, 1):
        if number > 1:
            then = f" Then {join_names(batch.runs[1:])}." if len(batch.runs) > 1 else ""
            yield f"Batch {number}: {batch.reason}{then}"


def probabilities_figure(record: SettleRecord) -> "MatplotlibFigure":
    """Draw probabilities against rig time: of the verdict, of each effect that was ever likely, and of all causes."""
    steps, minutes = record.steps, [step.spent_min for step in record.steps]
    highest: dict[str, float] = {}
    for step in steps:
        for name, value in step.presence.items():
            highest[name] = max(highest.get(name, 0.0), value)
    drawn = sorted((name for name, value in highest.items() if value >= MIN_DRAWN_PRESENCE), key=lambda n: -highest[n])
    with figure_style():
        figure = new_figure(
            9.0, 4.2, "How the probabilities moved", "After each batch of runs: the verdict, effects, and all causes"
        )
        axes = figure.add_subplot(ylim=(-0.03, 1.03), xlim=(0, 1.03 * minutes[-1]))
        stripes = tuple(pairwise((0.0, *minutes)))
        for number, (begin, end) in enumerate(stripes):
            axes.axvspan(begin, end, color=tint(PALE, 0.35 if number % 2 else 0.15), linewidth=0, zorder=0)
        costs = [CurveLabel((begin + end) / 2, f"{end - begin:.1f} min", GREY) for begin, end in stripes]
        label_times(axes, costs, 1.0, 4)
        labels = []
        for name, colour in zip(drawn, CYCLE, strict=False):
            values = [step.presence.get(name, 0.0) for step in steps]
            axes.plot(minutes, values, "o-", color=colour, clip_on=False)
            labels.append(CurveLabel(values[-1], display_name(name), colour))
        certain = [step.probability for step in steps]
        axes.plot(minutes, certain, "D-", color=BLACK, linewidth=4.0, zorder=1.5, clip_on=False)
        labels.append(CurveLabel(certain[-1], f"verdict {probability_text(certain[-1])}", BLACK))
        surest = [step.surest for step in steps]
        axes.plot(minutes, surest, "s--", color=GREY, clip_on=False)
        labels.append(CurveLabel(surest[-1], "just these causes", GREY))
        axes.axhline(record.until, color=GREY, linestyle=":", linewidth=1.2)
        axes.set_xlabel("Rig time, min")
        axes.set_ylabel("Probability")
        label_curves(axes, labels)
        return figure
