"""Following a running campaign from another process, read-only, and serving its state as a page.

A state is no `Document`: it is no result but a stream, updated in place twice a second in terminal and page, and a line
of JSON each time. Page and `--json` read `CampaignState.to_json`.
"""

import json
import os
import secrets
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BufferedReader
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np

from dragrig.config import OutputError, RunFileError
from dragrig.present import to_json_value
from dragrig.rig import PHASE_NAMES, Run, is_recording, read_info, read_session_records, read_tail, run_name
from dragrig.session_state import SessionState, is_session_running, read_state

RECENT_TRACE_S = 20.0
FORCE_MEAN_S = 0.1
"""The current force is the mean over this time."""
RECENT_POINTS = 300
"""Points of the recent force, about a screen's width."""
PACE_KNOWN_FROM = 0.1
"""From this share of a session on, the time left follows the pace so far."""


@dataclass(frozen=True, slots=True)
class RunInProgress:
    """The run that is being recorded."""

    file: str
    kind: str
    order: int
    phase: str
    time_s: float
    run_s: float | None
    """`time_s`, `run_s`: recorded time, and planned time; None where it is not known."""
    samples: int
    force_mN: float | None
    position_mm: float | None
    """Absolute."""
    recent_s: tuple[float, ...] = ()
    recent_mN: tuple[float, ...] = ()
    """`recent_s`, `recent_mN`: force of the last seconds, a few hundred points."""


@dataclass(frozen=True, slots=True)
class FinishedRun:
    """A finished run."""

    file: str
    kind: str
    order: int
    status: str
    reason: str
    samples: int


@dataclass(frozen=True, slots=True)
class CampaignState:
    """The present state of a campaign."""

    campaign: str
    folder: Path
    plan: str
    backend: str
    doing: str
    """`preparing`, `asking`, `waiting`, `recording`, `between`, `ended`; `died` where the process of the session is
    gone without an end.
    """
    message: str
    """The open prompt, the reason of a wait, or why the session ended."""
    since: datetime | None = None
    run: int | None = None
    runs: int | None = None
    """`run`, `runs`: number of the current run of this session, and of how many; None where it is not known."""
    left_s: float | None = None
    """Time left without prompts; None where it is not known yet."""
    status: str = ""
    """How the session ended."""
    recording: RunInProgress | None = None
    finished: tuple[FinishedRun, ...] = ()

    @property
    def over(self) -> bool:
        """Whether the session is over."""
        return self.doing in {"ended", "died"}

    def to_json(self) -> dict[str, object]:
        """Return the state as page and `--json` have it."""
        names = {"message": "said", "runs": "of"}
        return {names.get(entry.name, entry.name): getattr(self, entry.name) for entry in fields(self)}


class CampaignWatch:
    """Reads the state of a campaign repeatedly; finished runs are read once.

    Parameters
    ----------
    folder
        A campaign's folder, or a folder of campaigns, of which the latest is watched.

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
        """Return the present state."""
        before = read_state(self.folder)
        running = is_session_running(self.folder)
        # A state that changed meanwhile has a living writer; on Windows a file being replaced cannot be read.
        state = read_state(self.folder) or self._state
        running = running or state != before
        self._state = state
        finished = self._read_finished()
        if state is None:
            return self._state_from_files(finished, running=running)
        recording = self._read_recording(state) if running else None
        doing, message = state.doing if running or state.doing == "ended" else "died", state.said
        if doing == "ended":
            message = state.reason
        elif doing == "died":
            message = f"its process is gone; {self._what_finishes_it()}"
        return CampaignState(
            campaign=self.folder.resolve().name,
            folder=self.folder,
            plan=state.plan,
            backend=f"{state.backend}, double" if state.double else state.backend,
            doing=doing,
            message=message,
            since=state.since,
            run=state.made,
            runs=state.runs,
            left_s=None if doing in {"ended", "died"} else _time_left_s(state, recording),
            status=state.status,
            recording=recording if doing == "recording" else None,
            finished=finished,
        )

    def follow(self, every_s: float) -> Iterator[CampaignState]:
        """Yield states until the campaign is over."""
        while True:
            state = self.look()
            yield state
            if state.over:
                return
            time.sleep(every_s)

    def _state_from_files(self, finished: tuple[FinishedRun, ...], *, running: bool) -> CampaignState:
        """Return the state without a state file: a session that just started, or one of an older version."""
        records, _ = read_session_records(self.folder)
        latest = records[-1] if records else None
        message = (
            "an unfinished recording is left; dragrig recover finishes it"
            if self._has_recording()
            else "no session is running here"
        )
        return CampaignState(
            campaign=self.folder.resolve().name,
            folder=self.folder,
            plan="" if latest is None else latest.plan.name,
            backend="" if latest is None else latest.backend,
            doing="preparing" if running else "ended",
            message="" if running else message,
            finished=finished,
        )

    def _has_recording(self) -> bool:
        return any(is_recording(path) for path in self.folder.glob("*.h5"))

    def _what_finishes_it(self) -> str:
        """Return the remedy for a session that has died."""
        if self._has_recording():
            return "dragrig recover finishes its recording"
        return "no recording is left unfinished, and dragrig run --resume makes the missing runs"

    def _read_recording(self, state: SessionState) -> RunInProgress | None:
        paths = sorted(path for path in self.folder.glob("*.h5") if is_recording(path))
        try:
            return _run_in_progress(read_tail(paths[-1], RECENT_TRACE_S), state) if paths else None
        except RunFileError:
            return None  # finished meanwhile; the next look reads the finished file

    def _read_finished(self) -> tuple[FinishedRun, ...]:
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
        return tuple(sorted(self._finished.values(), key=lambda run: (run.order, run.file)))


def latest_campaign(folder: Path) -> Path:
    """Return `folder` if it is a campaign, else the latest campaign in it; `RunFileError` if there is none."""
    if not folder.is_dir():
        missing = "is a file" if folder.is_file() else "no such folder"
        raise RunFileError(f"{folder}: {missing}; name a campaign, or the folder that holds campaigns.")
    if any(folder.glob("session-*")) or any(folder.glob("*.h5")):
        return folder
    sessions = list(folder.glob("*/session-*.toml"))
    if not sessions:
        raise RunFileError(f"{folder}: holds no campaign; name the folder dragrig run writes to.")
    return max(sessions, key=lambda path: path.stat().st_mtime_ns).parent


def _run_in_progress(run: Run, state: SessionState) -> RunInProgress:
    info, trace = run.info, run.trace
    has_samples = trace.time.size > 0
    origin_mm = info.header.entry.get("origin_mm")
    start_mm = origin_mm if isinstance(origin_mm, int | float) else 0.0
    mean_from = max(0, trace.time.size - max(1, round(FORCE_MEAN_S * trace.sample_rate_hz)))
    every = max(1, trace.time.size // RECENT_POINTS)
    force = np.asarray(trace.force[::every], dtype=np.float64)
    return RunInProgress(
        file=run_name(info.path),
        kind=info.kind,
        order=info.header.order,
        phase=PHASE_NAMES[trace.phase[-1]] if has_samples else "",
        time_s=float(trace.time[-1]) if has_samples else 0.0,
        run_s=state.run_s if state.order == info.header.order else None,
        samples=info.samples,
        force_mN=float(np.nanmean(trace.force[mean_from:])) if has_samples else None,
        position_mm=start_mm + float(trace.position[-1]) if has_samples else None,
        recent_s=tuple(round(float(time_s), 4) for time_s in trace.time[::every]),
        recent_mN=tuple(round(float(force_mN), 2) for force_mN in force),
    )


def _time_left_s(state: SessionState, recording: RunInProgress | None) -> float | None:
    """Return the planned time that is left, at the pace so far once a tenth is done.

    Before that it is the plan's, where time is real, and else unknown.
    """
    run_s = 0.0
    if recording is not None and recording.run_s is not None and state.doing == "recording":
        run_s = max(0.0, recording.run_s - recording.time_s)
    since_s = (datetime.now(UTC) - state.since).total_seconds()
    waited = min(state.wait_s, since_s) if state.doing == "waiting" else 0.0
    left_s = max(0.0, run_s + state.after_s - waited)
    done_s = state.total_s - left_s
    if done_s < PACE_KNOWN_FROM * state.total_s or done_s <= 0:
        return left_s if state.real_time else None
    busy_s = state.busy_s + (since_s if state.doing not in {"preparing", "asking"} else 0.0)
    return left_s * busy_s / done_s


MAX_CONNECTIONS = 64
"""Open at once; the oldest gives way to a new one, for an answer takes milliseconds."""
CONNECTION_S = 10.0
"""How long a browser may neither ask nor take its answer."""
MAX_REQUEST_BYTES = 1 << 14
MAX_TABS, MAX_TAB_CHARACTERS = 256, 64
LOCAL_HOST = "127.0.0.1"
LOCAL_HOSTS = (LOCAL_HOST, "localhost")
HIDDEN_TAB_S = 70.0
"""A tab that asked within this time is waited for at the end: browsers let hidden tabs ask once a minute."""


class StatePage:
    """The state a page server serves; one thread calls `show`, the server's threads the rest."""

    def __init__(self, host: str = LOCAL_HOST) -> None:
        self.host = host
        self.port = 0
        self.html = b""
        self.token = "" if host in LOCAL_HOSTS else secrets.token_urlsafe(16)
        """What a request from another machine must bring."""
        self._content = b"{}"
        self._over = False
        self._asked_at: dict[str, float] = {}
        self._changed = threading.Condition()

    @property
    def address(self) -> str:
        """Where a browser finds the page."""
        host = _own_address() if self.host == "0.0.0.0" else self.host  # noqa: S104  # compared, not bound
        return f"http://{host}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    def show(self, state: CampaignState) -> None:
        """Serve this state from now on."""
        with self._changed:
            self._content, self._over = json.dumps(to_json_value(state.to_json()), allow_nan=False).encode(), state.over

    def admits(self, host: str, token: str) -> bool:
        """Return whether a request may read: by its token, or on this machine by its host, against DNS rebinding."""
        if self.token:
            return secrets.compare_digest(token.encode(), self.token.encode())
        return host.rsplit(":", 1)[0] in LOCAL_HOSTS

    def content(self, tab: str) -> tuple[bytes, bool]:
        """Return the state for a tab, and whether it is the last one; of too many tabs, the first are forgotten."""
        with self._changed:
            self._asked_at.pop(tab, None)
            self._asked_at[tab] = time.monotonic()
            if len(self._asked_at) > MAX_TABS:
                del self._asked_at[next(iter(self._asked_at))]
            return self._content, self._over

    def forget(self, tab: str) -> None:
        """Wait for this tab no longer: it has received the last state, or was closed."""
        with self._changed:
            self._asked_at.pop(tab, None)
            self._changed.notify_all()

    def wait_for_tabs(self) -> None:
        """Wait until every open tab has received the last state, at most `HIDDEN_TAB_S`."""
        with self._changed:
            while self._asked_at:
                left_s = max(self._asked_at.values()) + HIDDEN_TAB_S - time.monotonic()
                if left_s <= 0:
                    return
                self._changed.wait(left_s)


def _own_address() -> str:
    """Return the address by which others reach this machine; connecting a datagram socket sends nothing."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(("192.0.2.1", 9))
            return str(probe.getsockname()[0])
    except OSError:
        return socket.gethostname()


class _ShortRequest(BufferedReader):
    """A browser's request, up to a bound; more raises `ConnectionError`."""

    _left = MAX_REQUEST_BYTES

    def readline(self, size: int | None = -1) -> bytes:
        """Return the next line."""
        most = self._left + 1
        line = super().readline(most if size is None or size < 0 else min(size, most))
        self._left -= len(line)
        if self._left < 0:
            raise ConnectionError("the request is too long")
        return line


class _PageServer(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = MAX_CONNECTIONS
    # On Windows it would let two programs serve on one port.
    allow_reuse_address = os.name == "posix"

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        self._open: dict[int, socket.socket] = {}
        self._lock = threading.Lock()
        super().__init__(address, handler)

    def process_request(self, request: socket.socket, client_address: object) -> None:  # type: ignore[override]
        """Answer in a thread of its own, and end the oldest connection where there are too many."""
        with self._lock:
            self._open[id(request)] = request
            oldest = self._open.pop(next(iter(self._open))) if len(self._open) > MAX_CONNECTIONS else None
        if oldest is not None:
            with suppress(OSError):  # it has just ended by itself
                oldest.shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def shutdown_request(self, request: socket.socket) -> None:  # type: ignore[override]
        """End a connection."""
        with self._lock:
            self._open.pop(id(request), None)
        super().shutdown_request(request)

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore a browser that disconnected before its answer."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


class _PageHandler(BaseHTTPRequestHandler):
    def setup(self) -> None:
        super().setup()
        self.connection.settimeout(CONNECTION_S)
        self.rfile = _ShortRequest(self.rfile.detach())

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  # as the base class has it
        del format, args


@contextmanager
def serve_state_page(port: int, host: str = LOCAL_HOST) -> Iterator[StatePage]:
    """Serve a page until the block ends: to this machine alone, or at another address to those who have its token.

    Raises `OutputError` when address or port are not available.
    """
    from dragrig.present import render_template

    page = StatePage(host)
    page.html = render_template("watch.html", {"title": "dragrig watch"}).encode()

    class Handler(_PageHandler):
        def do_GET(self) -> None:
            path, _, query = self.path.partition("?")
            asked = dict(parse_qsl(query))
            tab = asked.get("tab", "")[:MAX_TAB_CHARACTERS]
            if not page.admits(self.headers.get("Host", ""), asked.get("token", "")):
                self.send_error(403)
            elif path == "/":
                self._answer(page.html, "text/html; charset=utf-8")
            elif path == "/state.json":
                content, last = page.content(tab)
                self._answer(content, "application/json")
                if last:
                    page.forget(tab)
            elif path == "/closed":
                page.forget(tab)
                self._answer(b"", "text/plain")
            else:
                self.send_error(404)

        def _answer(self, content: bytes, kind: str) -> None:
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            self.wfile.write(content)

    try:
        server = _PageServer((host, port), Handler)
    except OSError as error:
        raise OutputError(
            f"--page {port} at {host}: not available ({error.strerror}); name another port, or 0, and an address of "
            "this machine."
        ) from error
    page.port = server.server_address[1]
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    try:
        yield page
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
