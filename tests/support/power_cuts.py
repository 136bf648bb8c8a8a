"""Power cuts on an emulated disk: pages reach it in any order, and a sync takes its time.

`Disk` watches a folder in which a run is recorded and finished. It keeps what the pages of every file held when, what
a sync had made durable when, and which names the folder had. `cut` makes of it what a power cut at a moment may leave:
of each page any content since the last sync that had ended, of a file's length and of the folder's names likewise.
"""

import os
import random
import time
from bisect import bisect_right
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Lock, Thread

import numpy as np

from dragrig.rig import RecoveryOutcome, left_recordings, recover
from dragrig.rig.runfile import Recorder, finish, read_run, verify
from dragrig.rig.runfile.model import RunEnding, RunEvent, RunStatus
from runfiles import START, arrays, header

PAGE_BYTES = 4096
LOOK_S = 0.01
RATE_HZ = 5000.0
BLOCK_S = 0.02


@dataclass
class _History:
    """What something held when, and from when on which state was durable."""

    seen_s: list[float] = field(default_factory=list)
    states: list[object] = field(default_factory=list)
    durable_s: list[float] = field(default_factory=list)
    durable: list[int] = field(default_factory=list)

    def look(self, state: object) -> int:
        if not self.states or self.states[-1] != state:
            self.seen_s.append(time.monotonic())
            self.states.append(state)
        return len(self.states) - 1

    def possible(self, moment_s: float) -> range:
        """Return the states that the disk may hold at a moment: the last durable one, and all since."""
        synced = bisect_right(self.durable_s, moment_s)
        first = self.durable[synced - 1] if synced else -1
        return range(first, bisect_right(self.seen_s, moment_s))


class Disk:
    """An emulated disk under a folder: `os.fsync` lags, and everything is remembered."""

    def __init__(self, folder: Path, draw: random.Random, max_lag_s: float) -> None:
        self._folder, self._draw, self._max_lag_s = folder, draw, max_lag_s
        self._files: dict[int, _History] = {}
        self._names = _History()
        self._lock = Lock()
        self._stop = Event()

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Emulate until the end of the context."""
        real_sync = os.fsync
        watcher = Thread(target=self._watch)
        os.fsync = self._lagging(real_sync)
        watcher.start()
        try:
            yield
        finally:
            os.fsync = real_sync
            self._stop.set()
            watcher.join()

    def _watch(self) -> None:
        while not self._stop.wait(LOOK_S):
            self._look()

    def _look(self) -> None:
        with self._lock:
            names: dict[str, int] = {}
            for entry in os.scandir(self._folder):
                try:
                    names[entry.name] = entry.inode()
                    content = Path(entry.path).read_bytes()
                except OSError:
                    names.pop(entry.name, None)
                    continue
                self._files.setdefault(entry.inode(), _History()).look(content)
            self._names.look(names)

    def _lagging(self, real_sync: Callable[[int], None]) -> Callable[[int], None]:
        def sync(descriptor: int) -> None:
            self._look()
            status = os.fstat(descriptor)
            with self._lock:
                history = self._names if status.st_ino == self._folder.stat().st_ino else self._files.get(status.st_ino)
                if history is None:  # a file elsewhere, of a thread that an earlier test left at work
                    real_sync(descriptor)
                    return
                # Windows syncs no folder; NTFS writes the journal of all names with each file.
                synced = [history, self._names] if os.name == "nt" else [history]
                states = [len(entry.states) - 1 for entry in synced]
            time.sleep(self._draw.uniform(0.0, self._max_lag_s))
            with self._lock:
                for entry, state in zip(synced, states, strict=True):
                    entry.durable.append(max(state, *entry.durable, -1))
                    entry.durable_s.append(time.monotonic())

        return sync

    def cut(self, moment_s: float, into: Path, draw: random.Random) -> None:
        """Write what a power cut at a moment may leave into an empty folder."""
        choice = draw.choice(self._names.possible(moment_s) or [-1])
        names = self._names.states[choice] if choice >= 0 else {}
        assert isinstance(names, dict)
        for name, inode in names.items():
            history = self._files[inode]
            versions = [history.states[i] if i >= 0 else b"" for i in history.possible(moment_s)] or [b""]
            contents = [version for version in versions if isinstance(version, bytes)]
            length = len(draw.choice(contents))
            pages = []
            for start in range(0, length, PAGE_BYTES):
                page = draw.choice(contents)[start : start + PAGE_BYTES]
                pages.append(page + bytes(min(PAGE_BYTES, length - start) - len(page[: length - start])))
            (into / name).write_bytes(b"".join(pages)[:length])


@dataclass(frozen=True)
class Recorded:
    """A run that was recorded on an emulated disk, and when which sample was handed over."""

    disk: Disk
    begun_s: float
    ended_s: float
    offers: list[tuple[float, int]]

    def offered(self, moment_s: float) -> int:
        """Return how many samples had been handed over at a moment."""
        return max((samples for at_s, samples in self.offers if at_s <= moment_s), default=0)


def record_on_emulated_disk(folder: Path, seed: int, max_lag_s: float, duration_s: float = 1.2) -> Recorded:
    """Record a run at a real-time pace and finish it, on an emulated disk."""
    disk = Disk(folder, random.Random(seed), max_lag_s)
    offers: list[tuple[float, int]] = []
    per_block = round(RATE_HZ * BLOCK_S)
    with disk.watching():
        begun_s = time.monotonic()
        with Recorder(folder / "run.h5", header(rate_hz=RATE_HZ), reserve_bytes=0) as recorder:
            started_s = time.monotonic()
            for number in range(round(duration_s / BLOCK_S)):
                time.sleep(max(0.0, started_s + (number + 1) * BLOCK_S - time.monotonic()))
                recorder.offer(number * per_block, arrays(number * per_block, per_block, RATE_HZ))
                offers.append((time.monotonic(), (number + 1) * per_block))
                if number % 10 == 0:
                    recorder.event(RunEvent(number * BLOCK_S, "tick", str(number)))
            left = recorder.close(RunEnding(RunStatus.COMPLETE, "as planned", START))
        finish(left)
        time.sleep(5 * LOOK_S)
    return Recorded(disk, begun_s, time.monotonic(), offers)


def lost_s(recorded: Recorded, moment_s: float, folder: Path, draw: random.Random) -> float:
    """Cut the power at a moment, recover in `folder`, check every sample; return the time that is lost [s].

    Raises `AssertionError` where a sample is wrong, or something is left that nobody could recover.
    """
    recorded.disk.cut(moment_s, folder, draw)
    results = recover(folder)
    path = folder / "run.h5"
    samples = 0
    if path.exists():
        run = read_run(path)
        samples = run.info.samples
        trace = {"time": run.trace.time, "command": run.trace.command, "phase": run.trace.phase, **run.trace.channels}
        for name, values in arrays(0, samples, RATE_HZ).items():
            np.testing.assert_array_equal(trace[name], values, err_msg=name)
        assert verify(path).holds
    elif recorded.offered(moment_s):
        assert not any(result.path for result in results)
    assert not [result for result in results if result.outcome is RecoveryOutcome.LEFT]
    assert left_recordings(folder) == ()
    missing = [at_s for at_s, offered in recorded.offers if offered > samples and at_s <= moment_s]
    return moment_s - missing[0] if missing else 0.0
