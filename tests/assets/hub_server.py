"""A small hub on 127.0.0.1 that can misbehave."""

from __future__ import annotations

import base64
import hashlib
import json
import signal
import threading
from collections import defaultdict
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

COMMIT = "0123456789abcdef0123456789abcdef01234567"


class FakeHub:
    """Serves one repository at one commit, as `huggingface_hub` asks for it, and takes commits to it.

    ``faults[path]``: what happens to the next requests of that file, one word each: ``cut`` (half of what was asked
    for, then the connection closes), ``wrong`` (one bit is turned), ``whole`` (ranges are ignored), ``busy`` (503),
    ``gone`` (the connection closes at once), ``silent`` (nothing comes),
    ``ctrl-c`` (this process is interrupted after a half). ``asked``: (path, Range header) of every GET
    of a file. ``body``: sent in place of the list of files. ``kind``: "dataset" or "model". ``token``: that commits
    need. ``commits``: messages of those that were made. ``refuses``: HTTP states of the next commits, in order.
    """

    def __init__(
        self,
        repo: str,
        files: dict[str, bytes],
        lfs: tuple[str, ...] = (),
        kind: str = "dataset",
    ) -> None:
        self.kind = kind
        self.token = "secret"
        self.commits: list[str] = []
        self.refuses: list[int] = []
        self.repo = repo
        self.files = files
        self.lfs = lfs
        self.body: bytes | None = None
        self.faults: defaultdict[str, list[str]] = defaultdict(list)
        self.asked: list[tuple[str, str]] = []
        self.hosts: set[str] = set()
        self._closed = threading.Event()
        hub = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                hub.answer(self)

            def do_POST(self) -> None:
                hub.take(self)

            def do_HEAD(self) -> None:
                hub.answer(self)

            def log_message(self, format: str, *args: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.endpoint = f"http://127.0.0.1:{self._server.server_address[1]}"
        threading.Thread(
            target=self._server.serve_forever, args=(0.02,), daemon=True
        ).start()

    def close(self) -> None:
        self._closed.set()
        self._server.shutdown()
        self._server.server_close()

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        parts = urlsplit(request.path)  # a proxy is asked for whole addresses
        self.hosts.add(parts.netloc)
        path = unquote(parts.path)
        if path.startswith(f"/api/{self.kind}s/{self.repo}/revision/"):
            rows = [self._sibling(path) for path in sorted(self.files)]
            self._json(request, {"id": self.repo, "sha": COMMIT, "siblings": rows})
        elif path == f"/api/{self.kind}s/{self.repo}/tree/{COMMIT}":
            self._json(request, [self._row(path) for path in sorted(self.files)])
        elif path.startswith(f"{self._place}/resolve/{COMMIT}/"):
            self._file(request, path.split(f"/resolve/{COMMIT}/")[1])
        else:
            request.send_response(404)
            request.send_header("X-Error-Code", "RepoNotFound")
            request.end_headers()

    @property
    def _place(self) -> str:
        return f"{'/datasets' if self.kind == 'dataset' else ''}/{self.repo}"

    def take(self, request: BaseHTTPRequestHandler) -> None:
        """Answer the requests of a commit; its files are there when the last one is answered, or none is."""
        body = request.rfile.read(int(request.headers.get("Content-Length", 0)))
        path = unquote(urlsplit(request.path).path)
        if request.headers.get("Authorization") != f"Bearer {self.token}":
            request.send_error(401)
        elif path == "/api/repos/create":
            self._json(request, {"url": f"{self.endpoint}{self._place}"})
        elif path == "/api/validate-yaml":
            self._json(request, {"errors": [], "warnings": []})
        elif path == f"/api/{self.kind}s/{self.repo}/preupload/main":
            rows = [
                {"path": each["path"], "uploadMode": "regular", "shouldIgnore": False}
                for each in json.loads(body)["files"]
            ]
            self._json(request, {"files": rows})
        elif path == f"/api/{self.kind}s/{self.repo}/commit/main" and self.refuses:
            request.send_error(self.refuses.pop(0))
        elif path == f"/api/{self.kind}s/{self.repo}/commit/main":
            lines = [json.loads(line) for line in body.splitlines() if line.strip()]
            for line in lines:
                if line["key"] == "file":
                    content = base64.b64decode(line["value"]["content"])
                    self.files[line["value"]["path"]] = content
            self.commits.append(lines[0]["value"]["summary"])
            url = f"{self.endpoint}{self._place}/commit/{COMMIT}"
            self._json(request, {"commitUrl": url, "commitOid": COMMIT})
        else:
            request.send_error(404)

    def _hash(self, path: str) -> str:
        data = self.files[path]
        if path in self.lfs:
            return hashlib.sha256(data).hexdigest()
        return hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()

    def _sibling(self, path: str) -> dict[str, Any]:
        size = len(self.files[path])
        row: dict[str, Any] = {"rfilename": path, "size": size, "blobId": "pointer"}
        if path not in self.lfs:
            return row | {"blobId": self._hash(path)}
        return row | {
            "lfs": {"sha256": self._hash(path), "size": size, "pointerSize": 130}
        }

    def _row(self, path: str) -> dict[str, Any]:
        return {"type": "file", "path": path, "oid": "x", "size": len(self.files[path])}

    def _file(self, request: BaseHTTPRequestHandler, path: str) -> None:
        is_head = request.command == "HEAD"
        data = self.files.get(path)
        fault = ""
        wanted = request.headers.get("Range", "")
        if not is_head:
            self.asked.append((path, wanted))
            fault = self.faults[path].pop(0) if self.faults[path] else ""
        if data is None or fault == "busy":
            request.send_error(404 if data is None else 503)
            return
        if fault == "silent":
            self._closed.wait()
        if fault in ("gone", "silent"):
            request.close_connection = True
            request.connection.close()
            return
        etag = self._hash(path)
        if fault == "wrong":
            data = bytes([data[0] ^ 1]) + data[1:]
        start = (
            int(wanted.removeprefix("bytes=").rstrip("-"))
            if wanted and fault != "whole"
            else 0
        )
        request.send_response(206 if start else 200)
        if start:
            request.send_header(
                "Content-Range", f"bytes {start}-{len(data) - 1}/{len(data)}"
            )
        body = data[start:]
        request.send_header("ETag", f'"{etag}"')
        request.send_header("X-Repo-Commit", COMMIT)
        request.send_header("Content-Length", str(len(body)))
        request.end_headers()
        if is_head:
            return
        half = len(body) // 2
        request.wfile.write(body[:half])
        if fault == "ctrl-c":
            main = threading.main_thread().ident
            assert main is not None
            signal.pthread_kill(main, signal.SIGINT)
            self._closed.wait(3)
        if fault != "cut":
            request.wfile.write(body[half:])

    def _json(self, request: BaseHTTPRequestHandler, value: object) -> None:
        body = json.dumps(value).encode() if self.body is None else self.body
        request.send_response(200)
        request.send_header("Content-Length", str(len(body)))
        request.end_headers()
        request.wfile.write(body)
