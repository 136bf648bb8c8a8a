"""A campaign's state as a small page, served to this machine alone."""

import json
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from dragrig.config.errors import OutputError
from dragrig.plain import to_plain
from dragrig.watching import CampaignState

LINGER_S = 3.0
"""How long the last state is still to be had."""
LOCAL = ("127.0.0.1", "localhost")


@dataclass(frozen=True, slots=True)
class _Shown:
    content: bytes = b"{}"
    last: bool = False


class StatePage:
    """What the server shows; `show` belongs to one thread, the rest to the server's."""

    def __init__(self) -> None:
        self.port = 0
        self.html = b""
        self.shown = _Shown()
        self._seen = threading.Event()

    def show(self, state: CampaignState) -> None:
        """Have the page show another state."""
        self.shown = _Shown(json.dumps(to_plain(state), allow_nan=False).encode(), state.over)

    def handed_out(self, shown: _Shown) -> None:
        """Note that somebody has been given a state."""
        if shown.last:
            self._seen.set()

    def linger(self) -> None:
        """Wait until somebody has seen the last state, if anybody looks at all."""
        self._seen.wait(LINGER_S)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    # On Windows this would let two programs serve at one port.
    allow_reuse_address = os.name == "posix"

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of a browser that went away before it had its answer."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


@contextmanager
def served(port: int) -> Iterator[StatePage]:
    """Serve a page on the loopback address until the block ends.

    Raises
    ------
    OutputError
        When the port cannot be had.
    """
    from dragrig.reports.rendering import render

    page = StatePage()
    page.html = render("watch.html", {"title": "dragrig watch"}).encode()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            # A name of somebody else's that leads here must not read what this machine alone may see.
            if self.headers.get("Host", "").rsplit(":", 1)[0] not in LOCAL:
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
        server = _Server(("127.0.0.1", port), Handler)
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
