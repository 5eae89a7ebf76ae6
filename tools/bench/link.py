"""Scans over a slow link: a bank with a cache beside MDS shards of ``mosaicml-streaming``.

    python tools/bench/link.py [--scans N] [--shard N] [--rates 250 --rates 1000] [--delay MS]
        [--other PYTHON]

A server on this machine answers every request ``--delay`` milliseconds late, and sends all answers
together at the rate of the link, Mbit/s. One process reads every scan once in order, as arrays of
range, reflectance and label, from an empty cache, and once more. PYTHON is the interpreter of an
environment with ``mosaicml-streaming``, which is given the same scans in shards of the same size,
compressed by zstd at level 1, and a downloader for http, which it has not.
"""

import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from multiprocessing import get_context
from multiprocessing.synchronize import Event
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Annotated, Any
from urllib.request import urlopen

import numpy as np
from bank import FIELDS, town_images, write
from timing import machine, seconds
from typer import Option, run

from lidar_synth.bank import Bank
from lidar_synth.bank.cache import ShardCache

BLOCK = 1 << 17
MEGABIT = 1e6 / 8


class Link:
    """What all answers of a server share.

    Args:
        rate: bytes a second.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._free = 0.0
        self._lock = Lock()

    def wait(self, size: int) -> None:
        """Wait until this many bytes have gone through the link."""
        with self._lock:
            self._free = max(self._free, time.monotonic()) + size / self._rate
            until = self._free
        time.sleep(max(0.0, until - time.monotonic()))


def answer(folder: str, rate: float, delay: float, port: Any, ready: Event) -> None:
    """Serves a folder over the link."""
    link = Link(rate)

    class Handler(SimpleHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def __init__(self, *given: Any) -> None:
            super().__init__(*given, directory=folder)

        def do_HEAD(self) -> None:
            self.do_GET()

        def do_GET(self) -> None:
            time.sleep(delay)
            path = Path(self.translate_path(self.path))
            if not path.is_file():
                self.send_error(404)
                return
            size = path.stat().st_size
            first = 0
            last = size - 1
            if asked := self.headers.get("Range"):
                begin, _, end = asked.removeprefix("bytes=").partition("-")
                first = int(begin)
                last = min(int(end or last), last)
            self.send_response(206 if asked else 200)
            self.send_header("Content-Range", f"bytes {first}-{last}/{size}")
            self.send_header("Accept-Ranges", "bytes")
            self.send_header("Content-Length", str(last + 1 - first))
            self.end_headers()
            if self.command == "HEAD":
                return
            with path.open("rb") as file:
                file.seek(first)
                left = last + 1 - first
                while left:
                    block = file.read(min(BLOCK, left))
                    link.wait(len(block))
                    self.wfile.write(block)
                    left -= len(block)

        def log_message(self, *given: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    port.value = server.server_port
    ready.set()
    server.serve_forever()


@contextmanager
def served(folder: Path, rate: float, delay: float) -> Iterator[str]:
    """The URL of a folder behind a link."""
    context = get_context("spawn")
    port = context.Value("i")
    ready = context.Event()
    given = (str(folder), rate * MEGABIT, delay / 1e3, port, ready)
    process = context.Process(target=answer, args=given, daemon=True)
    process.start()
    ready.wait()
    try:
        yield f"http://127.0.0.1:{port.value}"
    finally:
        process.kill()
        process.join()


def download(urls: list[str]) -> None:
    """Fetches files by four connections and forgets them: what the link gives."""

    def drain(url: str) -> None:
        with urlopen(url) as answer:
            while answer.read(BLOCK):
                pass

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(drain, urls))


def read_bank(url: str, cache: Path) -> list[float]:
    """Seconds of a plain download, of fetching all shards without reading them, and of two
    epochs."""
    bank = Bank(url)
    cache.mkdir()
    shards = bank.index.shards
    whole = ShardCache(cache / "whole", None, url, bank.index)
    fetch = seconds(lambda: whole.fetch(range(len(shards))))
    whole.clear()
    bank = Bank(url, cache / "bank")
    bank.expect(range(len(bank)))
    return [
        seconds(lambda: download([f"{url}/{entry.file}" for entry in shards])),
        fetch,
        *(seconds(lambda: [bank.image(n) for n in range(len(bank))]) for _ in range(2)),
    ]


MDS = """
import sys, time, urllib.request, shutil
from pathlib import Path
import numpy as np
from streaming import MDSWriter, StreamingDataset
from streaming.base.storage import download

class HTTPDownloader(download.CloudDownloader):
    @staticmethod
    def _client_identifier():
        return "http"
    def clean_up(self):
        pass
    def _download_file_impl(self, remote, local, timeout):
        with urllib.request.urlopen(remote, timeout=timeout) as answer, open(local, "wb") as out:
            shutil.copyfileobj(answer, out, 1 << 20)

download.DOWNLOADER_MAPPINGS["http"] = HTTPDownloader
what, folder, at, size = sys.argv[1:]
if what == "write":
    arrays = np.load(at)
    columns = {name: "ndarray" for name in arrays.files}
    options = dict(out=folder, columns=columns, compression="zstd:1", size_limit=int(size))
    loaded = {name: arrays[name] for name in arrays.files}
    with MDSWriter(**options) as out:
        for n in range(len(loaded["range"])):
            out.write({name: values[n] for name, values in loaded.items()})
else:
    data = StreamingDataset(
        remote=at, local=folder, shuffle=False, batch_size=1, num_canonical_nodes=1
    )
    for _ in range(2):
        start = time.perf_counter()
        for sample in data:
            pass
        print("SECONDS", time.perf_counter() - start)
"""


def other(python: Path, *words: object) -> list[float]:
    """Runs ``MDS``; the seconds that it prints."""
    done = subprocess.run(
        [python, "-c", MDS, *map(str, words)],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    lines = [line.split() for line in done.stdout.splitlines()]
    return [float(line[1]) for line in lines if line[:1] == ["SECONDS"]]


def main(
    scans: int = 2048,
    shard: int = 512,
    rates: Annotated[list[float] | None, Option()] = None,
    delay: float = 50.0,
    other_python: Annotated[Path | None, Option("--other")] = None,
) -> None:
    """Prints the table."""
    town = town_images(min(scans, 64))
    images = [town[n % len(town)] for n in range(scans)]
    with TemporaryDirectory() as folder:
        root = Path(folder)
        local = write(root / "bank", images, FIELDS[:2], size=shard)
        disk = seconds(lambda: [local.image(n) for n in range(scans)])
        size = local.index.size
        if other_python:
            stored = [local.facts.encoding.encode(image) for image in images]
            arrays = {name: np.stack([s[name] for s in stored]) for name in stored[0]}
            np.savez(root / "arrays.npz", **arrays)  # type: ignore[arg-type]
            limit = shard * sum(values.nbytes for values in stored[0].values())
            other(other_python, "write", root / "mds", root / "arrays.npz", limit)
        print(
            f"\n### {scans} scans in shards of {shard}, {size / 1e6:.0f} MB, {delay:g} ms\n\n"
            f"{machine()}\n"
        )
        print("| Mbit/s | what | scans/s | share of the link |\n|---:|---|---:|---:|")
        print(f"| | bank on a disk | {scans / disk:.0f} | |", flush=True)
        for rate in rates or [250.0, 1000.0]:
            with served(root, rate, delay) as url:
                cache = root / f"cache-{rate:g}"
                names = (
                    "plain download",
                    "shards fetched",
                    "bank, first epoch",
                    "bank, second",
                )
                took = dict(zip(names, read_bank(f"{url}/bank", cache), strict=True))
                kinds = dict.fromkeys(took, size)
                if other_python:
                    found = other(other_python, "read", cache / "mds", f"{url}/mds", 0)
                    held = (root / "mds").glob("*.zstd")
                    bytes_there = sum(path.stat().st_size for path in held)
                    for name, value in zip(
                        ("first epoch", "second"), found, strict=True
                    ):
                        took[f"MDS, {name}"] = value
                        kinds[f"MDS, {name}"] = bytes_there
            for name, value in took.items():
                share = kinds[name] / value / (rate * MEGABIT)
                shown = "" if "second" in name else f"{share:.2f}"
                print(
                    f"| {rate:g} | {name} | {scans / value:.0f} | {shown} |", flush=True
                )


if __name__ == "__main__":
    run(main)
