"""A small hub on 127.0.0.1 that can misbehave."""

from __future__ import annotations

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
    """Serves one data set's repository at one commit, as `huggingface_hub` asks for it.

    ``faults[path]``: what happens to the next requests of that file, one word each: ``cut`` (half of what was asked
    for, then the connection closes), ``wrong`` (one bit is turned), ``whole`` (ranges are ignored), ``busy`` (503),
    ``gone`` (the connection closes at once), ``silent`` (nothing comes),
    ``ctrl-c`` (this process is interrupted after a half). ``asked``: (path, Range header) of every GET
    of a file. ``body``: sent in place of the list of files.
    """

    def __init__(
        self, repo: str, files: dict[str, bytes], lfs: tuple[str, ...] = ()
    ) -> None:
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
        if path.startswith(f"/api/datasets/{self.repo}/revision/"):
            rows = [self._sibling(path) for path in sorted(self.files)]
            self._json(request, {"id": self.repo, "sha": COMMIT, "siblings": rows})
        elif path == f"/api/datasets/{self.repo}/tree/{COMMIT}":
            self._json(request, [self._row(path) for path in sorted(self.files)])
        elif path.startswith(f"/datasets/{self.repo}/resolve/{COMMIT}/"):
            self._file(request, path.split(f"/resolve/{COMMIT}/")[1])
        else:
            request.send_response(404)
            request.send_header("X-Error-Code", "RepoNotFound")
            request.end_headers()

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
