"""Following a running campaign from another process, read-only, and serving its state as a page to this machine."""

import json
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np

from dragrig.config.errors import OutputError, RunFileError
from dragrig.present.json_values import to_json_value
from dragrig.rig.runfile import read_info, read_tail
from dragrig.rig.runfile.model import PHASE_NAMES, Run
from dragrig.rig.runfile.schema import is_recording, run_name
from dragrig.rig.session import read_session_records
from dragrig.session_state import SessionState, is_session_running, read_state

RECENT_TRACE_S = 20.0
FORCE_MEAN_S = 0.1
"""Mean over so long is the force now."""
MAX_TAIL_SAMPLES = 200_000
RECENT_POINTS = 300
"""Of the recent force, about a screen's width."""


@dataclass(frozen=True, slots=True)
class RunInProgress:
    """The run that is being recorded.

    Attributes
    ----------
    time_s, run_s
        How long it records already, and how long altogether; None where nobody says.
    recent_s, recent_mN
        Force of the last seconds, a few hundred points.
    """

    file: str
    kind: str
    order: int
    phase: str
    time_s: float
    run_s: float | None
    samples: int
    force_mN: float | None
    position_mm: float | None
    recent_s: tuple[float, ...] = ()
    recent_mN: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class FinishedRun:
    """A run that is whole."""

    file: str
    kind: str
    order: int
    status: str
    reason: str
    samples: int


@dataclass(frozen=True, slots=True)
class CampaignState:
    """A campaign as it is now.

    Attributes
    ----------
    doing
        `preparing`, `asking`, `waiting`, `recording`, `between`, `ended`; `died` where the process that carried the
        session out is gone without a word.
    said
        The prompt that waits for an answer, what is waited for, or why the session ended.
    run, of
        Which run of this session it is at, and of how many; None where nobody says.
    left_s
        Time left by the plan, people's hands not counted; of recorded time where time is not real.
    status
        How the session ended.
    """

    campaign: str
    folder: Path
    plan: str
    backend: str
    doing: str
    said: str
    since: datetime | None
    run: int | None
    of: int | None
    left_s: float | None
    status: str
    recording: RunInProgress | None
    finished: tuple[FinishedRun, ...] = field(default=())

    @property
    def over(self) -> bool:
        """Whether nothing more will come."""
        return self.doing in {"ended", "died"}


class CampaignWatch:
    """Looks at a campaign again and again; finished runs are read once.

    Parameters
    ----------
    folder
        A campaign's folder, or one that holds campaigns: then the latest is meant.

    Raises
    ------
    RunFileError
        When there is no campaign.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = latest_campaign(folder)
        self._finished: dict[Path, FinishedRun] = {}
        self._state: SessionState | None = None

    def look(self) -> CampaignState:
        """Return what the campaign is doing."""
        before = read_state(self.folder)
        working = is_session_running(self.folder)
        # What changed meanwhile was changed by somebody who lives; Windows refuses to read what is being replaced.
        state = read_state(self.folder) or self._state
        working = working or state != before
        self._state = state
        recording = self._recording(state) if working else None
        finished = self._look_at_finished()
        if state is None:
            return self._without_word(finished, working=working)
        doing, said = state.doing if working or state.doing == "ended" else "died", state.said
        if doing == "ended":
            said = state.reason
        elif doing == "died":
            said = "the program that carried it out is gone; dragrig recover finishes what it left"
        return CampaignState(
            campaign=self.folder.resolve().name,
            folder=self.folder,
            plan=state.plan,
            backend=f"{state.backend}, double" if state.double else state.backend,
            doing=doing,
            said=said,
            since=state.since,
            run=state.made,
            of=state.runs,
            left_s=None if doing in {"ended", "died"} else _time_left_s(state, recording),
            status=state.status,
            recording=recording if doing == "recording" else None,
            finished=finished,
        )

    def follow(self, every_s: float) -> Iterator[CampaignState]:
        """Look until the campaign is over; the last state is the last."""
        while True:
            state = self.look()
            yield state
            if state.over:
                return
            time.sleep(every_s)

    def _without_word(self, finished: tuple[FinishedRun, ...], *, working: bool) -> CampaignState:
        """Say what the files alone say: a session that has only just begun, or one made elsewhere or by an older us."""
        records, _ = read_session_records(self.folder)
        latest = records[-1] if records else None
        left = any(is_recording(path) for path in self.folder.glob("*.h5"))
        said = "a recording is left, which dragrig recover finishes" if left else "no session is at work here"
        return CampaignState(
            campaign=self.folder.resolve().name,
            folder=self.folder,
            plan="" if latest is None else latest.plan.name,
            backend="" if latest is None else latest.backend,
            doing="preparing" if working else "ended",
            said="" if working else said,
            since=None,
            run=None,
            of=None,
            left_s=None,
            status="",
            recording=None,
            finished=finished,
        )

    def _recording(self, state: SessionState | None) -> RunInProgress | None:
        paths = sorted(path for path in self.folder.glob("*.h5") if is_recording(path))
        try:
            return _run_in_progress(read_tail(paths[-1], RECENT_TRACE_S), state) if paths else None
        except RunFileError:
            return None  # finished while it was read; the next look finds it whole

    def _look_at_finished(self) -> tuple[FinishedRun, ...]:
        for path in self.folder.glob("*.h5"):
            if path in self._finished or is_recording(path):
                continue
            try:
                info = read_info(path)
            except RunFileError as error:
                self._finished[path] = FinishedRun(path.name, "", -1, "unreadable", str(error), 0)
                continue
            self._finished[path] = FinishedRun(
                path.name, info.kind, info.header.order, info.status.value, info.reason, info.samples
            )
        return tuple(sorted(self._finished.values(), key=lambda one: (one.order, one.file)))


def latest_campaign(folder: Path) -> Path:
    """Return a campaign's folder: the one named, or the latest in it; raises `RunFileError` where there is none."""
    if not folder.is_dir():
        raise RunFileError(f"{folder}: there is no such folder; name a campaign, or the folder that holds campaigns.")
    if any(folder.glob("session-*")) or any(folder.glob("*.h5")):
        return folder
    below = list(folder.glob("*/session-*.toml"))
    if not below:
        raise RunFileError(f"{folder}: holds no campaign; name the folder that dragrig run writes to.")
    return max(below, key=lambda one: one.stat().st_mtime_ns).parent


def _run_in_progress(run: Run, state: SessionState | None) -> RunInProgress:
    info, trace = run.info, run.trace
    now = trace.time.size - max(1, round(FORCE_MEAN_S * trace.sample_rate_hz))
    some = trace.time.size > 0
    every = max(1, trace.time.size // RECENT_POINTS)
    force = np.asarray(trace.force[::every], dtype=np.float64)
    return RunInProgress(
        file=run_name(info.path),
        kind=info.kind,
        order=info.header.order,
        phase=PHASE_NAMES[trace.phase[-1]] if some else "",
        time_s=float(trace.time[-1]) if some else 0.0,
        run_s=state.run_s if state is not None and state.order == info.header.order else None,
        samples=info.samples,
        force_mN=float(np.nanmean(trace.force[max(0, now) :])) if some else None,
        position_mm=float(trace.position[-1]) if some else None,
        recent_s=tuple(round(float(one), 4) for one in trace.time[::every]),
        recent_mN=tuple(round(float(one), 2) for one in force),
    )


def _time_left_s(state: SessionState, recording: RunInProgress | None) -> float:
    of_run = 0.0
    if recording is not None and recording.run_s is not None and state.doing == "recording":
        of_run = max(0.0, recording.run_s - recording.time_s)
    waited = min(state.wait_s, (datetime.now(UTC) - state.since).total_seconds()) if state.doing == "waiting" else 0.0
    return max(0.0, of_run + state.after_s - waited)


LAST_STATE_S = 3.0
"""How long the last state is still to be had."""
LOCAL_HOSTS = ("127.0.0.1", "localhost")


@dataclass(frozen=True, slots=True)
class _ShownState:
    content: bytes = b"{}"
    last: bool = False


class StatePage:
    """What the server shows; `show` belongs to one thread, the rest to the server's."""

    def __init__(self) -> None:
        self.port = 0
        self.html = b""
        self.shown = _ShownState()
        self._seen = threading.Event()

    def show(self, state: CampaignState) -> None:
        """Have the page show another state."""
        self.shown = _ShownState(json.dumps(to_json_value(state), allow_nan=False).encode(), state.over)

    def handed_out(self, shown: _ShownState) -> None:
        """Note that somebody has been given a state."""
        if shown.last:
            self._seen.set()

    def linger(self) -> None:
        """Wait until somebody has seen the last state, if anybody looks at all."""
        self._seen.wait(LAST_STATE_S)


class _PageServer(ThreadingHTTPServer):
    daemon_threads = True
    # On Windows this would let two programs serve at one port.
    allow_reuse_address = os.name == "posix"

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of a browser that went away before it had its answer."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


@contextmanager
def serve_state_page(port: int) -> Iterator[StatePage]:
    """Serve a page on the loopback address until the block ends.

    Raises
    ------
    OutputError
        When the port cannot be had.
    """
    from dragrig.present.html_page import render_template

    page = StatePage()
    page.html = render_template("watch.html", {"title": "dragrig watch"}).encode()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            # A name of somebody else's that leads here must not read what this machine alone may see.
            if self.headers.get("Host", "").rsplit(":", 1)[0] not in LOCAL_HOSTS:
                self.send_error(403)
                return
            if self.path == "/":
                self._answer(page.html, "text/html; charset=utf-8")
            elif self.path == "/state.json":
                shown = page.shown
                self._answer(shown.content, "application/json")
                page.handed_out(shown)
            else:
                self.send_error(404)

        def _answer(self, content: bytes, kind: str) -> None:
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002  # as the base class has it
            del format, args

    try:
        server = _PageServer(("127.0.0.1", port), Handler)
    except OSError as error:
        raise OutputError(f"--page {port}: cannot be served at ({error.strerror}); name another port, or 0.") from error
    page.port = server.server_address[1]
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    try:
        yield page
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
