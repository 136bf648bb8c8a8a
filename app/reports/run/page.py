"""The page of one run."""

from dragrig.analysis.measures import measure
from dragrig.figures.header import title_of, trouble_of
from dragrig.figures.run import run_figure
from dragrig.reports.embedding import Picture, embedded
from dragrig.reports.rendering import render
from dragrig.reports.run.tables import events_table, measures_table
from dragrig.reports.run.values import checks_in_words, further_in_words, recorded_in_words, values_in_words
from dragrig.rig.runfile.model import Run


def page(run: Run, bad_reason: str | None = None) -> str:
    """Return the report on a run as one HTML page.

    Parameters
    ----------
    bad_reason
        Why somebody marked the run bad; None when nobody did.
    """
    info = run.info
    tables = {one.name: one for one in (measures_table(measure(run)), events_table(run.events))}
    return render(
        "run.html",
        {
            "title": title_of(info),
            "info": info,
            "trouble": trouble_of(info, bad_reason),
            "recorded": recorded_in_words(info),
            "checks": checks_in_words(info.checks),
            "protocol": values_in_words(info.header.protocol),
            "capsule": values_in_words(info.header.capsule),
            "specimen": values_in_words(info.header.specimen),
            "further": further_in_words(info),
            "tables": tables,
            "pictures": {"run": run_picture(run, bad_reason)},
        },
    )


def run_picture(run: Run, bad_reason: str | None = None) -> Picture:
    """Draw a run, force over position and speed."""
    return embedded(
        run_figure(run, bad_reason=bad_reason),
        f"{title_of(run.info)}: force, position and speed against time, with the phases of the motion.",
        "Force as recorded (light) and filtered, position beside its command, and speed; shaded, the motion's phases.",
    )
