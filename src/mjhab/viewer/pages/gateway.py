"""Web server of the viewer: a proxy of viser's page and messages that also receives the input of teleoperation.

viser listens on its own port on this machine. The gateway forwards its traffic, and adds a script to its page that
sends the state of keys and gamepad (`hand.js`), so that users need one port only.
"""

from __future__ import annotations

import asyncio
import http
import importlib.resources
import logging
import threading
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from mjhab.core.errors import UsageError

HAND_PATH = "/mjhab/hand"
PORTS_TO_TRY = 20
MAX_HAND_MESSAGE_BYTES = 4096
MAX_MESSAGE_BYTES = 1 << 26
START_SECONDS = 10.0
_QUIET = logging.getLogger("mjhab.viewer.pages.gateway")
_QUIET.setLevel(logging.CRITICAL)
"""Logger that is silenced: browsers open connections without using them, and each would be logged with a traceback."""


class Gateway:
    """Listen in a thread from construction until `close`.

    Args:
        inner: port of the viser server on this machine.
        host: address to listen on; "localhost" admits this machine only.
        port: the first port to try; if it is in use, the next free one is taken. 0 lets the system choose.
        on_hand: called with every message (text) of `hand.js`, on the thread of the gateway.
        on_hand_gone: called on the same thread when the last page is closed.

    Attributes:
        port: the port that is listened on.

    Raises:
        UsageError: none of `PORTS_TO_TRY` ports is free, or the host is no address of this machine.
    """

    def __init__(
        self,
        inner: int,
        host: str,
        port: int,
        on_hand: Callable[[str], object],
        on_hand_gone: Callable[[], object] = bool,
    ) -> None:
        self.port = port
        self._inner = inner
        self._host = host
        self._on_hand = on_hand
        self._on_hand_gone = on_hand_gone
        self._hands: set[ServerConnection] = set()
        self._hand_state = "{}"
        self._problem: Exception | None = None
        self._ready = threading.Event()
        self._loop = asyncio.new_event_loop()
        self._end = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="gateway", daemon=True)
        self._thread.start()
        # So that the port is known, and an error raised, when this returns.
        self._ready.wait(START_SECONDS)
        if self._problem is not None:
            raise self._problem

    def tell(self, message: str) -> None:
        """Send a message to `hand.js` of every page, and of pages that are opened later."""
        # Kept for pages that are opened later.
        self._hand_state = message
        self._loop.call_soon_threadsafe(self._tell)

    def close(self) -> None:
        """Stop listening."""
        # The loop may have ended by itself.
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(timeout=2.0)

    def _tell(self) -> None:
        for hand in self._hands:
            self._loop.create_task(_send(hand, self._hand_state))

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        except Exception as error:
            self._problem = error
        finally:
            self._ready.set()

    async def _serve(self) -> None:
        wanted = self.port
        tried = range(wanted, min(wanted + PORTS_TO_TRY, 1 << 16)) if wanted else [0]
        for port in tried:
            try:
                server = await serve(
                    self._accept,
                    self._host,
                    port,
                    process_request=self._answer,
                    select_subprotocol=_first_subprotocol,
                    compression=None,
                    max_size=MAX_MESSAGE_BYTES,
                    logger=_QUIET,
                )
            except (OSError, UnicodeError) as error:
                # Names of hosts that cannot be one end in a UnicodeError.
                problem = error
                continue
            self.port = next(iter(server.sockets)).getsockname()[1]
            self._ready.set()
            async with server:
                await self._end.wait()
            return
        raise UsageError(
            f"cannot listen on {self._host}, ports {wanted} to {tried[-1]}: {problem}. Give another --port or --host."
        )

    async def _answer(
        self, connection: ServerConnection, request: Request
    ) -> Response | None:
        """Answer an HTTP request with viser's answer, `hand.js` added to HTML; None continues a WebSocket handshake."""
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return (
                None
                if _from_our_page(request)
                else connection.respond(403, "another origin\n")
            )
        path = request.path
        # In a thread: a blocking call would hold up all pages.
        status, kind, body = await asyncio.to_thread(self._read, path)
        if kind.startswith("text/html"):
            body = with_script(body)
        headers = Headers({"Content-Type": kind, "Content-Length": str(len(body))})
        return Response(status, http.HTTPStatus(status).phrase, headers, body)

    def _read(self, path: str) -> tuple[int, str, bytes]:
        try:
            with urllib.request.urlopen(
                f"http://127.0.0.1:{self._inner}{path}"
            ) as answer:
                return answer.status, answer.headers["Content-Type"], answer.read()
        except urllib.error.HTTPError as error:
            return error.code, "text/plain", error.read()

    async def _accept(self, connection: ServerConnection) -> None:
        assert connection.request is not None
        path = connection.request.path
        if path.partition("?")[0] == HAND_PATH:
            await self._listen_to_hand(connection)
        else:
            await self._pass_on(connection, path)

    async def _listen_to_hand(self, connection: ServerConnection) -> None:
        self._hands.add(connection)
        try:
            await connection.send(self._hand_state)
            async for message in connection:
                if isinstance(message, str) and len(message) <= MAX_HAND_MESSAGE_BYTES:
                    self._on_hand(message)
        except ConnectionClosed:
            pass
        finally:
            self._hands.discard(connection)
            # Another page may still be open.
            if not self._hands:
                self._on_hand_gone()

    async def _pass_on(self, outside: ServerConnection, path: str) -> None:
        protocols = [outside.subprotocol] if outside.subprotocol else None
        url = f"ws://127.0.0.1:{self._inner}{path}"
        async with connect(
            url, subprotocols=protocols, compression=None, max_size=MAX_MESSAGE_BYTES
        ) as inside:
            pumps = [
                asyncio.create_task(_pump(outside, inside)),
                asyncio.create_task(_pump(inside, outside)),
            ]
            _, open_pumps = await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
            # One end is gone: what the other sends has nobody to go to.
            for pump in open_pumps:
                pump.cancel()
            await asyncio.gather(*pumps, return_exceptions=True)


async def _pump(source: Any, target: Any) -> None:
    with suppress(ConnectionClosed):
        async for message in source:
            await target.send(message)


async def _send(connection: ServerConnection, message: str) -> None:
    with suppress(ConnectionClosed):
        await connection.send(message)


def _from_our_page(request: Request) -> bool:
    """Whether a WebSocket request has our origin (or none); pages of other sites must not control the robot."""
    origin = request.headers.get("Origin")
    return origin is None or urllib.parse.urlsplit(origin).netloc == request.headers.get(
        "Host"
    )


def _first_subprotocol(
    connection: ServerConnection, offered: Sequence[Subprotocol]
) -> Subprotocol | None:
    return offered[0] if offered else None


def with_script(page: bytes) -> bytes:
    """Append the script `hand.js` to an HTML page of viser."""
    code = (
        importlib.resources.files("mjhab.viewer.pages").joinpath("hand.js").read_bytes()
    )
    return page + b"\n<script>" + code + b"</script>\n"
