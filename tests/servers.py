"""A web server for files with support for byte ranges, which records its requests."""

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from urllib.parse import urlsplit


@dataclass
class Served:
    """State and requests of a server.

    Args:
        url: URL of its folder.
        ranges: whether it supports byte ranges.
        requests: (file, size of the response body), in order.
        broken: names of files for which it responds with status 500.
        busy: it responds with status 503 to one of this many requests; 0 = never.
        endless: names of files that have no end.
        silent: names of files for which it never responds.
        moved: {name of a file: URL to which it redirects}.
    """

    url: str = ""
    ranges: bool = True
    requests: list[tuple[str, int]] = field(default_factory=list)
    broken: set[str] = field(default_factory=set)
    busy: int = 0
    endless: set[str] = field(default_factory=set)
    silent: set[str] = field(default_factory=set)
    moved: dict[str, str] = field(default_factory=dict)

    @property
    def bytes(self) -> int:
        return sum(size for _, size in self.requests)


@contextmanager
def serve(root: Path) -> Iterator[Served]:
    """Serve a folder on this machine until the block ends."""
    served = Served()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            # A proxy is asked for a complete URL.
            path = root / urlsplit(self.path).path.lstrip("/")
            name = path.name
            if served.busy and len(served.requests) % served.busy == served.busy - 1:
                self._answer(503, b"", {})
                return
            if name in served.moved:
                self._answer(302, b"", {"Location": served.moved[name]})
                return
            if name in served.silent:
                time.sleep(3)
                return
            if name in served.endless:
                self._stream()
                return
            if name in served.broken or not path.is_file():
                self._answer(500 if name in served.broken else 404, b"", {})
                return
            content = path.read_bytes()
            wanted = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
            if wanted is None or not served.ranges:
                self._answer(200, content, {})
                return
            first = int(wanted[1])
            last = int(wanted[2] or len(content) - 1)
            if first >= len(content):
                self._answer(416, b"", {"Content-Range": f"bytes */{len(content)}"})
                return
            part = content[first : last + 1]
            self._answer(
                206,
                part,
                {
                    "Content-Range": f"bytes {first}-{first + len(part) - 1}/{len(content)}"
                },
            )

        def _stream(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.close_connection = True
            with suppress(OSError):  # the client has had enough
                while True:
                    self.wfile.write(bytes(1 << 20))

        def do_HEAD(self) -> None:
            path = root / self.path.lstrip("/")
            served.requests.append((path.name, 0))
            self.send_response(200 if path.is_file() else 404)
            self.send_header(
                "Content-Length", str(path.stat().st_size if path.is_file() else 0)
            )
            self.send_header("Accept-Ranges", "bytes" if served.ranges else "none")
            self.end_headers()

        def _answer(self, status: int, body: bytes, headers: dict[str, str]) -> None:
            served.requests.append((Path(self.path).name, len(body)))
            self.send_response(status)
            for name, value in {**headers, "Content-Length": str(len(body))}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    served.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield served
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
