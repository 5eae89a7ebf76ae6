"""A stand-in of the Hugging Face hub on this machine: repositories with commits, the metadata check
of cards, uploads by git LFS, and downloads with byte ranges.

It answers the requests that huggingface_hub makes; the client is the real one.
"""

import base64
import hashlib
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any
from urllib.parse import unquote, urlsplit

import yaml

TOKEN = "hf_of_the_tests"
KNOWN = ("mit", "cc-by-4.0", "cc-by-nc-sa-3.0", "other")
TASKS = ("unconditional-image-generation", "image-to-3d", "other")
CATEGORIES = ("image-segmentation", "object-detection")


@dataclass
class Hub:
    """State and requests of the stand-in.

    Args:
        url: its address.
        commits: {repository, such as "datasets/user/bank": its commits in order, each the hash and
            {file: content}}.
        objects: {sha256: content} of large files.
        requests: (method, path, bytes of the answer), in order.
        private: repositories that only the token may read.
    """

    url: str = ""
    commits: dict[str, list[tuple[str, dict[str, bytes]]]] = field(default_factory=dict)
    objects: dict[str, bytes] = field(default_factory=dict)
    requests: list[tuple[str, str, int]] = field(default_factory=list)
    private: set[str] = field(default_factory=set)

    def find(self, repository: str, revision: str) -> tuple[str, dict[str, bytes]]:
        """A commit; raises ``LookupError``."""
        commits = self.commits[repository]
        if revision == "main":
            return commits[-1] if commits else ("0" * 40, {})
        return next(c for c in commits if c[0] == revision)


def metadata_faults(card: str, kind: str) -> list[str]:
    """What the hub has against the metadata of a card."""
    found = re.match(r"---\n(.*?)\n---\n", card, re.S)
    values = yaml.safe_load(found[1]) if found else {}
    faults = []
    licence = values.get("license", "")
    for name in licence if isinstance(licence, list) else [licence]:
        if name not in KNOWN:
            faults.append(f'"license" must be one of {KNOWN}')
    if kind == "model" and values.get("pipeline_tag") not in TASKS:
        faults.append(f'"pipeline_tag" must be one of {TASKS}')
    if not set(values.get("task_categories", ())) <= set(CATEGORIES):
        faults.append(f'"task_categories" must be of {CATEGORIES}')
    return faults


@contextmanager
def serve_hub() -> Iterator[Hub]:
    """Run the stand-in until the block ends."""
    hub = Hub()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            path = unquote(urlsplit(self.path).path)
            if path == "/api/validate-yaml":
                asked = json.loads(body)
                faults = metadata_faults(asked["content"], asked["repoType"])
                errors = [{"message": fault} for fault in faults]
                self._json(400 if errors else 200, {"errors": errors, "warnings": []})
            elif not self._allowed():
                self._json(401, {"error": "Invalid username or password."})
            elif path == "/api/repos/create":
                self._create(json.loads(body))
            elif path.endswith("/info/lfs/objects/batch"):
                self._batch(json.loads(body))
            else:
                _, _, kind, user, name, action, revision = path.split("/")
                repository = _key(kind, f"{user}/{name}")
                answer = {"preupload": self._preupload, "commit": self._commit}[action]
                answer(repository, revision, body)

        def do_PUT(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            digest = self.path.rpartition("/")[2]
            assert hashlib.sha256(body).hexdigest() == digest
            hub.objects[digest] = body
            self._answer(200, b"")

        def do_GET(self) -> None:
            path = unquote(urlsplit(self.path).path)
            try:
                if path.startswith("/api/"):
                    self._describe(path.split("/")[2:])
                else:
                    self._download(path)
            except LookupError:
                self._missing("RepoNotFound")
            except StopIteration:
                self._missing("RevisionNotFound")

        do_HEAD = do_GET

        def _allowed(self) -> bool:
            return self.headers.get("Authorization") == f"Bearer {TOKEN}"

        def _create(self, asked: dict[str, Any]) -> None:
            name = f"{asked['organization']}/{asked['name']}"
            key = _key(f"{asked.get('type', 'model')}s", name)
            if asked.get("private") or asked.get("visibility") == "private":
                hub.private.add(key)
            status = 409 if key in hub.commits else 200
            hub.commits.setdefault(key, [])
            self._json(status, {"url": f"{hub.url}/{key}", "name": name})

        def _preupload(self, repository: str, revision: str, body: bytes) -> None:
            large = (".safetensors", ".h5")
            files = [
                {
                    "path": f["path"],
                    "uploadMode": "lfs" if f["path"].endswith(large) else "regular",
                    "shouldIgnore": False,
                }
                for f in json.loads(body)["files"]
            ]
            self._json(200, {"files": files})

        def _batch(self, asked: dict[str, Any]) -> None:
            objects = []
            for one in asked["objects"]:
                target = {"href": f"{hub.url}/lfs/{one['oid']}"}
                there = one["oid"] in hub.objects
                objects.append(one | ({} if there else {"actions": {"upload": target}}))
            self._json(200, {"objects": objects, "transfer": "basic"})

        def _commit(self, repository: str, revision: str, body: bytes) -> None:
            _, files = hub.find(repository, revision)
            files = dict(files)
            for line in body.decode().splitlines():
                operation = json.loads(line)
                value = operation["value"]
                if operation["key"] == "file":
                    files[value["path"]] = base64.b64decode(value["content"])
                elif operation["key"] == "lfsFile":
                    files[value["path"]] = hub.objects[value["oid"]]
            number = len(hub.commits[repository])
            digest = hashlib.sha1(f"{repository} {number}".encode()).hexdigest()
            hub.commits[repository].append((digest, files))
            url = f"{hub.url}/{repository}/commit/{digest}"
            self._json(200, {"commitUrl": url, "commitOid": digest})

        def _describe(self, parts: list[str]) -> None:
            kind, user, name, *rest = parts
            repository = _key(kind, f"{user}/{name}")
            revision = rest[1] if rest else "main"
            if repository in hub.private and not self._allowed():
                raise LookupError(repository)
            digest, files = hub.find(repository, revision)
            if rest and rest[0] == "tree":
                tree = [
                    {"type": "file", "path": path, "size": len(content), "oid": path}
                    for path, content in sorted(files.items())
                ]
                self._json(200, tree)
                return
            siblings = [{"rfilename": path} for path in files]
            about = {"id": f"{user}/{name}", "sha": digest, "siblings": siblings}
            self._json(200, about | {"private": False, "tags": [], "downloads": 0})

        def _download(self, path: str) -> None:
            found = re.fullmatch(
                r"/((?:datasets/)?[^/]+/[^/]+)/resolve/([^/]+)/(.+)", path
            )
            assert found is not None, path
            digest, files = hub.find(found[1], found[2])
            if found[3] not in files:
                self._missing("EntryNotFound")
                return
            content = files[found[3]]
            etag = hashlib.sha256(content).hexdigest()
            headers = {"ETag": f'"{etag}"', "X-Repo-Commit": digest}
            wanted = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
            if wanted is None:
                self._answer(200, content, headers)
                return
            first = int(wanted[1])
            part = content[first : int(wanted[2] or len(content)) + 1]
            span = f"bytes {first}-{first + len(part) - 1}/{len(content)}"
            self._answer(206, part, headers | {"Content-Range": span})

        def _missing(self, code: str) -> None:
            self._answer(404, b"{}", {"X-Error-Code": code, "X-Error-Message": code})

        def _json(self, status: int, values: Any) -> None:
            kind = {"Content-Type": "application/json"}
            self._answer(status, json.dumps(values).encode(), kind)

        def _answer(
            self, status: int, body: bytes, headers: dict[str, str] | None = None
        ) -> None:
            hub.requests.append((self.command, self.path, len(body)))
            self.send_response(status)
            for name, value in (headers or {}).items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    hub.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _key(kind: str, name: str) -> str:
    """How a repository's name begins in URLs; models have no kind there."""
    return f"datasets/{name}" if kind == "datasets" else name
