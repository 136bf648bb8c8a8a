"""Frame times of the window's plots: 10 million points on the screen, and 250 kS/s live, on one core.

`python bench/window.py` prints median and worst frame, and what a step of the filter takes; a frame is all that it
takes to bring the plots to the screen's memory, drawn off screen, at the usual size. Frames stay on the last core;
`--busy` keeps all others busy.
"""

import os

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import numpy as np
from PySide6.QtCore import QEvent, QObject
from PySide6.QtWidgets import QAbstractScrollArea

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from dragrig.engine_host.messages import LiveSamples
from dragrig.rig.runfile import finish
from dragrig.views import filtered_anew, shown_trace
from dragrig.window.live_view import LiveView
from dragrig.window.look_page import TraceOverlay
from dragrig.window.main_window import qt_application
from dragrig.window.plots import TimePlot
from dragrig.window.trace_pyramid import TracePyramid
from runfiles import record

FRAMES = 60
WANTED_HZ = 30.0
POINTS = 10_000_000
RATE_HZ = 250_000.0


class Paints(QObject):
    """Counts how often plots are painted."""

    def __init__(self, *plots: TimePlot) -> None:
        super().__init__()
        self.count = 0
        self._views = [cast("QAbstractScrollArea", plot.widget).viewport() for plot in plots]
        for view in self._views:
            view.installEventFilter(self)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Count."""
        self.count += event.type() is QEvent.Type.Paint and watched in self._views
        return False


def frames(draw: Callable[[int], None], *plots: TimePlot) -> np.ndarray:
    """Return times of frames [s]; each is drawn and painted."""
    app = qt_application()
    app.processEvents()
    paints, took = Paints(*plots), []
    for number in range(FRAMES):
        begun = time.perf_counter()
        draw(number)
        app.processEvents()
        took.append(time.perf_counter() - begun)
    assert paints.count >= FRAMES * len(plots), "frames were left out"
    return np.array(took)


def print_frame_times(name: str, took: np.ndarray) -> None:
    """Print what was measured."""
    median, worst = float(np.median(took)), float(took.max())
    passed = "ok" if 1 / median >= WANTED_HZ else "TOO SLOW"
    print(
        f"{name:58} median {1000 * median:6.1f} ms, worst {1000 * worst:6.1f} ms, {1 / median:5.0f} frames/s  {passed}"
    )


def still() -> None:
    """Zoom and pan over 10 million points."""
    qt_application()
    panel = TimePlot("Force", "mN")
    panel.widget.resize(1000, 600)
    panel.widget.show()
    noise = np.random.default_rng(1).normal(100.0, 3.0, POINTS).astype(np.float32)
    pyramid = TracePyramid()
    begun = time.perf_counter()
    pyramid.append(noise)
    print(f"pyramid of {POINTS / 1e6:g} million points: {time.perf_counter() - begun:.2f} s, once")
    panel.line("", "#0072B2", 2.0).trace(pyramid, RATE_HZ)
    length = POINTS / RATE_HZ

    def zoomed(number: int) -> None:
        share = 0.5 ** (number % 20)
        panel.show_times(0.3 * length * (1 - share), 0.3 * length * (1 - share) + share * length)

    def panned(number: int) -> None:
        panel.show_times(-0.01 * number, length - 0.01 * number)

    print_frame_times("10 million points, all of them shown, panned", frames(panned, panel))
    print_frame_times("10 million points, zoomed from all to 40 samples", frames(zoomed, panel))


def filter_steps() -> None:
    """Filter a run of 10 million points in other ways, as when somebody turns the filter's knobs."""
    app = qt_application()
    overlay = TraceOverlay()
    overlay.resize(1000, 700)
    overlay.show()
    with tempfile.TemporaryDirectory() as folder:
        shown = shown_trace(finish(record(Path(folder) / "long.h5", POINTS)), 0.05, 3)
    overlay.show_traces([shown])
    for window_s in (0.04, 0.05, 0.06, 0.08, 0.1, 0.2):
        begun = time.perf_counter()
        overlay.show_traces([filtered_anew(shown, window_s, 3, "force")])
        app.processEvents()
        took_s = time.perf_counter() - begun
        print(f"10 million points at 1 kHz, filtered anew over {1000 * window_s:3.0f} ms: {took_s:.2f} s")


def live() -> None:
    """Draw what comes at 250 kS/s, as fast as it comes: the frame holds what a 30th of a second brings."""
    qt_application()
    view = LiveView()
    view.resize(1000, 700)
    view.show()
    per_frame = round(RATE_HZ / WANTED_HZ)
    rng = np.random.default_rng(2)

    def draw(number: int) -> None:
        first = number * per_frame
        force = rng.normal(100.0, 3.0, per_frame).astype(np.float32)
        position = (np.arange(first, first + per_frame) / RATE_HZ * 20.0).astype(np.float32)
        view.take(LiveSamples(2, RATE_HZ, first, 0, force, position, np.full(per_frame, 2, np.uint8)))

    plots = (view.force, view.position, view.speed)
    first = frames(draw, *plots)
    print_frame_times("250 kS/s live, three plots, filter and speed, first 2 s", first[10:])
    assert view.run is not None
    # A quarter of an hour later: as many points as that, and the next frames.
    fill = rng.normal(100.0, 3.0, 1_000_000).astype(np.float32)
    for pyramid in (view.run.force, view.run.filtered, view.run.position, view.run.speed):
        for _ in range(100):
            pyramid.append(fill)
    print_frame_times(
        "250 kS/s live, 100 million samples later", frames(lambda number: draw(FRAMES + number), *plots)[10:]
    )


@contextmanager
def one_core(*, busy: bool) -> Iterator[None]:
    """Stay on the last core; keep the others busy."""
    if not hasattr(os, "sched_setaffinity"):
        print("this system cannot keep a process on one core: measured on all of them")
        yield
        return
    *others, mine = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {mine})
    forever = "import os, sys\nos.sched_setaffinity(0, {int(sys.argv[1])})\nwhile True: pass"
    spinning = [
        subprocess.Popen([sys.executable, "-c", forever, str(core)], start_new_session=True)
        for core in others if busy
    ]  # fmt: skip
    print(f"on one core of {1 + len(others)}, {'the others busy' if spinning else 'the others as they are'}")
    try:
        yield
    finally:
        for entry in spinning:
            entry.kill()


if __name__ == "__main__":
    filter_steps()
    with one_core(busy="--busy" in sys.argv):
        still()
        live()
