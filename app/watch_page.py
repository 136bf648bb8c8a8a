"""A campaign's state as a small page, served to this machine alone."""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from dragrig.config.errors import OutputError
from dragrig.plain import to_plain
from dragrig.watching import CampaignState

LINGER_S = 3.0
"""How long the last state is still to be had."""
LOCAL = ("127.0.0.1", "localhost")


class StatePage:
    """What the server shows; `show` belongs to one thread, the rest to the server's."""

    def __init__(self) -> None:
        self.port = 0
        self.html = b""
        self.state = b"{}"
        self._over = False
        self._seen = threading.Event()

    def show(self, state: CampaignState) -> None:
        """Have the page show another state."""
        self._over = state.over
        self.state = json.dumps(to_plain(state), allow_nan=False).encode()

    def handed_out(self) -> None:
        """Note that somebody has been given the state."""
        if self._over:
            self._seen.set()

    def linger(self) -> None:
        """Wait until somebody has seen the last state, if anybody looks at all."""
        self._seen.wait(LINGER_S)


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
                self._answer(page.state, "application/json")
                page.handed_out()
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
        server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    except OSError as error:
        raise OutputError(f"--page {port}: cannot be served at ({error.strerror}); name another port, or 0.") from error
    server.daemon_threads = True
    page.port = server.server_address[1]
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    try:
        yield page
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
