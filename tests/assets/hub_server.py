"""A small hub on 127.0.0.1 that can misbehave."""

from __future__ import annotations

import hashlib
import json
import re
import threading
from collections import defaultdict
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

COMMIT = "0123456789abcdef0123456789abcdef01234567"


class FakeHub:
    """Serves one repository at one commit.

    ``faults[path]``: what happens to the next requests of that file, one word each: ``cut`` (half of what was asked
    for, then the connection closes), ``wrong`` (other bytes), ``whole`` (ranges are ignored), ``busy`` (503), ``gone``
    (the connection closes at once). ``asked``: (path, Range header) of every request for a file.
    """

    def __init__(
        self,
        repo: str,
        files: dict[str, bytes],
        lfs: tuple[str, ...] = (),
        page: int = 1000,
    ) -> None:
        self.repo = repo
        self.files = files
        self.lfs = lfs
        self.page = page
        self.faults: defaultdict[str, list[str]] = defaultdict(list)
        self.asked: list[tuple[str, str]] = []
        self.hosts: set[str] = set()
        hub = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
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
        self._server.shutdown()
        self._server.server_close()

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        parts = urlsplit(request.path)  # a proxy is asked for whole addresses
        self.hosts.add(parts.netloc)
        path = unquote(parts.path)
        if path.startswith(f"/api/datasets/{self.repo}/revision/"):
            self._json(request, {"sha": COMMIT})
        elif path == f"/api/datasets/{self.repo}/tree/{COMMIT}":
            self._tree(request, parts.query)
        elif path.startswith(f"/datasets/{self.repo}/resolve/{COMMIT}/"):
            self._file(request, path.split(f"/resolve/{COMMIT}/")[1])
        else:
            request.send_error(404)

    def _tree(self, request: BaseHTTPRequestHandler, query: str) -> None:
        match = re.search(r"cursor=(\d+)", query)
        start = int(match[1]) if match else 0
        rows = [self._row(path) for path in sorted(self.files)][start : start + self.page]
        link = ""
        if start + self.page < len(self.files):
            link = f'<https://elsewhere.example/tree?recursive=true&cursor={start + self.page}>; rel="next"'
        self._json(
            request,
            [{"type": "directory", "path": "d", "oid": "x", "size": 0}, *rows],
            link,
        )

    def _row(self, path: str) -> dict[str, Any]:
        data = self.files[path]
        if path in self.lfs:
            oid = hashlib.sha256(data).hexdigest()
            return {
                "type": "file",
                "path": path,
                "oid": "p",
                "size": 130,
                "lfs": {"oid": oid, "size": len(data)},
            }
        oid = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
        return {"type": "file", "path": path, "oid": oid, "size": len(data)}

    def _file(self, request: BaseHTTPRequestHandler, path: str) -> None:
        wanted = request.headers.get("Range", "")
        self.asked.append((path, wanted))
        fault = self.faults[path].pop(0) if self.faults[path] else ""
        data = self.files.get(path)
        if data is None or fault == "busy":
            request.send_error(404 if data is None else 503)
            return
        if fault == "gone":
            request.close_connection = True
            request.connection.close()
            return
        if fault == "wrong":
            data = bytes(255 - b for b in data)
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
        request.send_header("Content-Length", str(len(body)))
        request.end_headers()
        request.wfile.write(body[: len(body) // 2] if fault == "cut" else body)

    @staticmethod
    def _json(request: BaseHTTPRequestHandler, value: object, link: str = "") -> None:
        body = json.dumps(value).encode()
        request.send_response(200)
        request.send_header("Content-Length", str(len(body)))
        if link:
            request.send_header("Link", link)
        request.end_headers()
        request.wfile.write(body)
