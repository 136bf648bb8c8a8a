"""Cost of the streaming filter beside the offline one, of text tables beside pandas, and of an import.

Run as `python bench/filtering.py`.
"""

import tempfile
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path

import numpy as np
import pandas as pd

from dragrig.analysis import ImportSettings, import_file, parse_map
from dragrig.analysis.estimates import no_progress
from dragrig.analysis.export import CsvStyle, ExportColumn, ExportContent, write_csv
from dragrig.analysis.importing.readers import read_foreign
from dragrig.analysis.savgol import SavgolSettings, SavgolStream, smooth
from dragrig.rig.profile import AnyFloatArray


def best(action: Callable[[], object], repeats: int = 3) -> float:
    """Shortest time of a few [s]."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return min(times)


def streaming(rate: float, seconds: float) -> None:
    """Filter one channel in blocks of 50 ms and at once."""
    values = np.random.default_rng(1).normal(size=int(rate * seconds))
    setting = SavgolSettings(window_s=0.05)
    blocks = np.array_split(values, max(1, int(seconds / 0.05)))

    def stream() -> None:
        running = SavgolStream(rate, setting)
        for block in blocks:
            running.push(block)
        running.flush()

    live, whole = best(stream), best(lambda: smooth(values, rate, setting))
    print(
        f"{rate:9.0f} Hz: {1e9 * live / len(values):7.1f} ns per sample streamed, {1e9 * whole / len(values):7.1f} "
        f"at once; {100 * live / seconds:.2f} % of one core while live"
    )


def tables(rows: int = 300_000) -> None:
    """Write and read a text table of four columns with decimal commas, here and by pandas."""
    rng = np.random.default_rng(2)
    names = ("time_s", "force_mN", "position_mm", "command_mm")
    values: list[AnyFloatArray] = [
        np.arange(rows) / 1000,
        *(rng.normal(size=rows).astype(np.float32) for _ in names[1:]),
    ]
    columns = tuple(ExportColumn(name, name, "", value) for name, value in zip(names, values, strict=True))
    frame = pd.DataFrame(dict(zip(names, values, strict=True)))
    with tempfile.TemporaryDirectory() as folder:
        ours, theirs = Path(folder) / "ours.csv", Path(folder) / "theirs.csv"
        wrote = best(lambda: write_csv(ours, ExportContent(columns, {}), CsvStyle(",", ";"), no_progress))
        pandas_wrote = best(lambda: frame.to_csv(theirs, sep=";", decimal=",", index=False))
        read = best(lambda: read_foreign(ours))
        pandas_read = best(lambda: pd.read_csv(ours, sep=";", decimal=","))
    print(
        f"CSV of {rows} rows, decimal commas: written in {wrote:.2f} s, {pandas_wrote / wrote:.1f} times pandas' speed"
    )
    print(f"  read, dialect found out, in {read:.2f} s; pandas, told the dialect, in {pandas_read:.2f} s")


def importing(rows: int = 1_000_000) -> None:
    """Make a run file of a text table of three columns."""
    time_s = np.arange(rows) / 1000
    values = np.c_[time_s, 0.05 + 0.001 * np.random.default_rng(3).random(rows), time_s * 0.01]
    settings = ImportSettings(columns=parse_map(["time=Time", "force=Force", "position=Position"]))
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "table.csv"
        np.savetxt(table, values, "%.5f", ";", header="Time [s];Force [N];Position [mm]", comments="")
        numbers = count()
        took = best(lambda: import_file(table, Path(folder) / f"{next(numbers)}.h5", settings))
    print(f"CSV of {rows} rows imported in {took:.2f} s")


if __name__ == "__main__":
    importing()
    for sample_rate, span in ((500.0, 100.0), (10_000.0, 20.0), (250_000.0, 4.0)):
        streaming(sample_rate, span)
    tables()
