"""Flood the page of `dragrig watch`: what it costs the computer that records, and whether it still answers.

`python bench/page.py [REQUESTS]`: half-open requests, requests of a byte now and then, endless requests, and tabs with
long names, so many of each (1000), from a process of their own. Printed: the most threads of the server's process, the
memory that it gains, and the slowest answer that somebody else got meanwhile. Exits with 1 where a bound does not hold.
"""

import multiprocessing
import socket
import sys
import threading
import time
from contextlib import ExitStack, suppress
from urllib.request import urlopen

import psutil

from dragrig.watch import MAX_CONNECTIONS, serve_state_page

REQUESTS = 1000
MOST_THREADS = 2 * MAX_CONNECTIONS
MOST_GROWTH_BYTES = 50e6
MOST_ANSWER_S = 5.0
HELD_S = 3.0


def flood(port: int, token: str, count: int) -> None:
    """Send what never ends, and more names than there are tabs."""
    with ExitStack() as stack:
        held = []
        for number in range(count):
            for start in (b"", b"GET / HTTP/1.0\r\nHost: ", b"GET / HTTP/1.0\r\nX: " + b"y" * 10_000):
                with suppress(OSError):
                    held.append(stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10.0)))
                    held[-1].sendall(start)
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=10.0) as tab:
                name = f"{number}{'n' * 12_000}"
                tab.sendall(f"GET /state.json?token={token}&tab={name} HTTP/1.0\r\n\r\n".encode())
                tab.recv(1)
        until_s = time.monotonic() + HELD_S
        while time.monotonic() < until_s:
            for connection in held:
                with suppress(OSError):
                    connection.send(b"z")
            time.sleep(0.2)


def main() -> int:
    """Flood, and look at the server meanwhile."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else REQUESTS
    own = psutil.Process()
    with serve_state_page(0, "0.0.0.0") as page:
        address = f"http://127.0.0.1:{page.port}/state.json?token={page.token}&tab=own"
        urlopen(address).close()
        before_bytes, threads, growth_bytes, slowest_s, refused = own.memory_info().rss, 0, 0, 0.0, 0
        attacker = multiprocessing.get_context("spawn").Process(target=flood, args=(page.port, page.token, count))
        attacker.start()
        while attacker.is_alive():
            asked_s = time.monotonic()
            try:
                urlopen(address, timeout=60.0).close()
            except OSError:
                refused += 1
            slowest_s = max(slowest_s, time.monotonic() - asked_s)
            threads = max(threads, threading.active_count())
            growth_bytes = max(growth_bytes, own.memory_info().rss - before_bytes)
            time.sleep(0.05)
    print(f"{4 * count} requests: at most {threads} threads, {growth_bytes / 1e6:.0f} MB more; another browser's")
    print(f"slowest answer after {slowest_s:.2f} s, {refused} of its requests without one")
    bounded = threads <= MOST_THREADS and growth_bytes <= MOST_GROWTH_BYTES and slowest_s <= MOST_ANSWER_S
    return 0 if bounded else 1


if __name__ == "__main__":
    sys.exit(main())
