"""What recording costs: processor time at 250 kS/s, throughput beside bare h5py and PyMeasure's CSV, memory.

Run `python bench/recording.py [FOLDER]` with the dependency group `bench`. Force, position and motor force are
recorded, with the time, command and phase that every run file holds. Finishing (the compressed copy) happens in
another process after the run and is printed apart.
"""

import logging
import queue
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from uuid import uuid4

import h5py
import numpy as np
import numpy.typing as npt
import psutil

from dragrig.rig.runfile import Finisher, Recorder, finish, read_info
from dragrig.rig.runfile.model import RecordedChannel, RunEnding, RunHeader, RunStatus

RATE_HZ = 250_000.0
BLOCK = 12_500
BARE_CHUNKS = {"chunks of 4096": 4096, "chunks of 65536": 65_536, "chunks as long as a block": -1, "one piece": 0}
"""How bare h5py may lay out its datasets; ours is compared with the fastest. One piece cannot grow."""
CHANNELS = (RecordedChannel("force", "mN"), RecordedChannel("position", "mm"), RecordedChannel("motor_force", "mN"))
Arrays = dict[str, npt.NDArray[np.generic]]


def header() -> RunHeader:
    """Return the header of a run of kind motion."""
    return RunHeader(
        run_id=str(uuid4()), start_time=datetime.now(UTC), order=0, backend="simulated", kind="motion",
        sample_rate_hz=RATE_HZ, channels=CHANNELS,
        capsule={"diameter_mm": 12.9, "length_mm": 15.2, "mass_g": 50.1, "contact_angle_deg": 60.0},
        specimen={"name": "bench", "wall_thickness_mm": 2.5, "fixture": "none"},
    )  # fmt: skip


def samples(count: int) -> Arrays:
    """Return a block as the engine hands it over: noisy 16 bit force and motor force, a steady motion."""
    draw = np.random.default_rng(1)
    index = np.arange(count)
    return {
        "time": index / RATE_HZ,
        "force": (np.round(draw.normal(200, 3, count) / 0.03) * 0.03).astype(np.float32),
        "position": (np.round(index / RATE_HZ * 1e4) / 1e3).astype(np.float32),
        "motor_force": (np.round(draw.normal(500, 20, count) / 0.3) * 0.3).astype(np.float32),
        "command": (index / RATE_HZ * 10).astype(np.float32),
        "phase": np.full(count, 2, np.uint8),
    }


def record(path: Path, block: Arrays, blocks: int, pace_s: float = 0.0) -> tuple[float, float]:
    """Record a block over and over; return wall and processor seconds from the first sample to the closed file."""
    size = len(block["time"])
    with Recorder(path, header()) as recorder:
        wall, processor = time.perf_counter(), time.process_time()
        for number in range(blocks):
            if pace_s:
                time.sleep(max(0.0, wall + (number + 1) * pace_s - time.perf_counter()))
            recorder.offer(number * size, block)
        recorder.close(RunEnding(RunStatus.COMPLETE, "as planned"))
        return time.perf_counter() - wall, time.process_time() - processor


def write_bare(path: Path, block: Arrays, blocks: int, chunk: int) -> float:
    """Write the same with h5py and nothing else; return wall seconds."""
    size = len(block["time"])
    growing = {"shape": (0,), "maxshape": (None,), "chunks": (size if chunk < 0 else chunk,)}
    layout = growing if chunk else {"shape": (size * blocks,)}
    wall = time.perf_counter()
    with h5py.File(path, "w") as file:
        datasets = {name: file.create_dataset(name, dtype=values.dtype, **layout) for name, values in block.items()}
        for number in range(blocks):
            for name, dataset in datasets.items():
                if chunk:
                    dataset.resize(((number + 1) * size,))
                dataset[number * size : (number + 1) * size] = block[name]
    return time.perf_counter() - wall


def write_pymeasure(path: Path, records: int) -> float:
    """Write three columns the way PyMeasure's worker does, a record at a time; return wall seconds."""
    logging.getLogger("pymeasure").addHandler(logging.NullHandler())
    from pymeasure.experiment import Procedure, Results
    from pymeasure.experiment.listeners import Recorder as CsvRecorder

    class Three(Procedure):  # type: ignore[misc]
        DATA_COLUMNS = ("force", "position", "motor_force")

    block = samples(records)
    rows = [dict(zip(Three.DATA_COLUMNS, row, strict=True))
            for row in zip(*(block[name].tolist() for name in Three.DATA_COLUMNS), strict=True)]  # fmt: skip
    recorder = CsvRecorder(Results(Three(), str(path)), queue.Queue())
    wall = time.perf_counter()
    for row in rows:
        recorder.handle(row)
    for handler in recorder.handlers:
        handler.close()
    return time.perf_counter() - wall


@contextmanager
def emptied(folder: Path) -> Iterator[Path]:
    """Give a folder, and empty it afterwards."""
    yield folder
    for path in folder.iterdir():
        path.unlink()


def in_real_time(folder: Path, seconds: float) -> None:
    """Print what a paced recording costs, and its finishing."""
    with emptied(folder):
        blocks = round(seconds * RATE_HZ / BLOCK)
        _, processor = record(folder / "run.h5", samples(BLOCK), blocks, BLOCK / RATE_HZ)
        wall, repack = time.perf_counter(), time.process_time()
        remaining = read_info(finish(folder / "run.recording.h5")).samples
        wall, repack = time.perf_counter() - wall, time.process_time() - repack
        print(f"real time, 3 channels at {RATE_HZ / 1e3:.0f} kS/s for {seconds:.0f} s in blocks of {BLOCK}:")
        print(
            f"  {100 * processor / seconds:.1f} % of one core, {blocks * BLOCK - remaining} samples lost (bar: 10 %, 0)"
        )
        print(f"  finishing apart: {wall:.2f} s of wall, {repack:.2f} s of processor time for {seconds:.0f} s of run")


def beside_a_repack(folder: Path, seconds: float) -> None:
    """Print how long the acquiring thread waits while the run before is being finished."""
    block, blocks = samples(BLOCK), round(seconds * RATE_HZ / BLOCK)
    waits: list[float] = []
    with emptied(folder), Finisher() as finisher:
        record(folder / "before.h5", block, 10 * blocks)
        begun = time.perf_counter()
        finisher.submit(folder / "before.recording.h5")
        with Recorder(folder / "run.h5", header()) as recorder:
            first = time.perf_counter()
            for number in range(blocks):
                time.sleep(max(0.0, first + (number + 1) * BLOCK / RATE_HZ - time.perf_counter()))
                offered = time.perf_counter()
                recorder.offer(number * BLOCK, block)
                waits.append(time.perf_counter() - offered)
            pending = finisher.pending
            recorder.close(RunEnding(RunStatus.COMPLETE, "as planned"))
        finisher.wait()
    overlap = "all the time" if pending else "for a part"
    print(f"while the run before is being finished ({overlap}):")
    print(f"  begun after {1e3 * (first - begun):.0f} ms, acquiring thread waits {1e3 * max(waits):.1f} ms at most")


def free_running(folder: Path, size: int, blocks: int, rounds: int = 5) -> float:
    """Print throughput beside bare h5py, alternating; return our records per second."""
    block = samples(size)
    total, width = size * blocks, sum(values.itemsize for values in block.values())
    ours: list[float] = []
    bare: dict[str, list[float]] = {name: [] for name in BARE_CHUNKS}
    for _ in range(rounds):
        for name, chunk in BARE_CHUNKS.items():
            with emptied(folder):
                bare[name].append(write_bare(folder / "bare.h5", block, blocks, chunk))
        with emptied(folder):
            ours.append(record(folder / "run.h5", block, blocks)[0])
    rate = total / median(ours)
    print(f"free-running in blocks of {size}, {total * width / 1e6:.0f} MB, median of {rounds}:")
    print(f"  {rate / 1e6:.1f} M records/s ({rate * width / 1e6:.0f} MB/s); of bare h5py's (bar: 80 %) that is")
    for name, times in bare.items():
        print(
            f"  {100 * median(times) / median(ours):.0f} % with {name} ({total / median(times) / 1e6:.1f} M records/s)"
        )
    return rate


def beside_pymeasure(folder: Path, ours: float, records: int = 200_000) -> None:
    """Print records per second beside PyMeasure's CSV."""
    with emptied(folder):
        theirs = records / median(write_pymeasure(folder / f"{number}.csv", records) for number in range(3))
    print(f"PyMeasure's CSV, 3 columns: {theirs / 1e3:.0f} k records/s; ours with 6 datasets is {ours / theirs:.0f} "
          "times that (bar: 20)")  # fmt: skip


def memory(folder: Path, measure: Callable[[], float]) -> None:
    """Print how memory grows with the length of a run."""
    block, grown = samples(BLOCK), []
    for blocks in (200, 200, 800, 3200):
        with emptied(folder):
            record(folder / "run.h5", block, blocks)
            grown.append(f"{blocks * BLOCK / 1e6:.1f} M samples {measure():.0f} MB")
    print(f"memory of this process after runs of {', '.join(grown)}")


def main() -> None:
    """Measure in a folder of the disk asked for, or of the system's temporary one."""
    with tempfile.TemporaryDirectory(dir=sys.argv[1] if len(sys.argv) > 1 else None) as name:
        folder = Path(name)
        in_real_time(folder, 8.0)
        beside_a_repack(folder, 4.0)
        rate = free_running(folder, BLOCK, 800)
        free_running(folder, 500, 4000)
        beside_pymeasure(folder, rate)
        memory(folder, lambda: psutil.Process().memory_info().rss / 1e6)


if __name__ == "__main__":
    main()
