"""`dragrig filter`."""

from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.batch import Batch
from dragrig.cli.console import result, result_json

if TYPE_CHECKING:
    from dragrig.analysis.filtering import Filtered


@click.command("filter")
@options.inputs
@click.option("--window-s", type=float, metavar="S", help="Length of the window in seconds; 0.05 unless given.")
@click.option("--window-samples", type=int, metavar="N", help="The same in samples, an odd number.")
@click.option("--order", type=int, metavar="N", help="Order of the polynomial; 3 unless given.")
@click.option(
    "--derivative", type=int, metavar="N", default=0, show_default=True, help="Derivative of the forces by time."
)
@options.as_json
@options.quiet
def command(
    inputs: tuple[str, ...],
    window_s: float | None,
    window_samples: int | None,
    order: int | None,
    derivative: int,
    as_json: bool,
) -> None:
    """Smooth every force of run files, and measure the speed from the position.

    RUN is a run file, a pattern or a campaign's folder. The result is stored in the file beside the raw trace,
    with its parameters, in place of an earlier one; the raw trace stays as it is. Runs marked bad are left out
    unless they are named themselves.
    """
    from dragrig.analysis.filtering import filter_file
    from dragrig.evaluating import filter_settings
    from dragrig.rig.runfile import read_info

    batch = Batch.of_good_runs(inputs, "filtering")
    done = []
    for path, filtered in batch.each(
        lambda path, _within: filter_file(
            path,
            filter_settings(read_info(path).header.sample_rate_hz, window_s, window_samples, order, derivative),
        )
    ):
        done.append({"file": path, "parameters": filtered.trace.parameters, "events": filtered.events})
        if not as_json:
            result(f"{path}  {_words(filtered)}")
    if as_json:
        result_json(done)
    batch.close()


def _words(filtered: "Filtered") -> str:
    how = filtered.trace.parameters
    words = f"window {how['window_s']:.4g} s ({how['window_samples']} samples), order {how['order']}"
    if how["derivative"]:
        words += f", derivative {how['derivative']}"
    return "; ".join((words, *(event.message for event in filtered.events)))
