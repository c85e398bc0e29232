"""The answering end: a websocket server for one policy, with a thread per connection."""

from __future__ import annotations

import errno
import hmac
import logging
import socket
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, Protocol

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from mjhab.core.errors import MjhabError, UsageError
from mjhab.core.timing import STEP_SECONDS
from mjhab.serving.dialects.dialect import CONTROL_HZ, RESET_DONE, Dialect, Incoming
from mjhab.serving.packing import ProtocolError, pack, unpack

LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")
MAX_CONNECTIONS = 64
PORTS_TRIED = 50
"""Ports from the wanted one on that are tried before giving up."""
INTERNAL_ERROR = 1011
GOING_AWAY = 1001
"""Close codes of the websocket protocol."""
PONG_TIMEOUT_S = 600.0
"""Longest wait for the pong of a client [s]: planning, or a client that compiles, may hold up both for long."""
CLOSE_TIMEOUT_S = 1.0
"""Longest wait for the farewell of a client."""


class PolicySession(Protocol):
    """A policy as one connection sees it."""

    def reset(self) -> None:
        """An episode begins."""
        ...

    def infer(self, request: Mapping[str, Any], batch: int | None) -> np.ndarray:
        """Actions (B, H, A) for a request about B worlds; ``batch`` is B, None for a single world outside a batch.

        Raises:
            MjhabError: there are none for it; the client is told why.
        """
        ...

    def close(self) -> None:
        """The connection is gone."""
        ...


class Responder(Protocol):
    """What is served."""

    def metadata(self) -> Mapping[str, Any]:
        """What clients of mjhab are told of the policy."""
        ...

    def session(self) -> PolicySession:
        """A new connection is there."""
        ...


@dataclass(frozen=True)
class ServerOptions:
    """host: to listen on. port: to begin with; 0 for any that is free. token: what clients must show, "" for nothing.
    max_message_bytes: larger messages end their connection."""

    host: str = "127.0.0.1"
    port: int = 8000
    token: str = ""
    max_message_bytes: int = 16 << 20


class PolicyServer:
    """Serves a policy until it is shut down. ``port`` is where; ``requests`` and ``refused`` count messages.

    Args:
        responder: the policy.
        dialect: what is spoken.
        options: where, and to whom.

    Raises:
        UsageError: a host beyond this machine without a token, or no free port.
    """

    def __init__(
        self, responder: Responder, dialect: Dialect, options: ServerOptions
    ) -> None:
        if options.host not in LOCAL_HOSTS and not options.token:
            raise UsageError(
                f"a server on {options.host} can be reached by others: it needs a token."
            )
        self._responder = responder
        self._dialect = dialect
        self._options = options
        self._slots = threading.BoundedSemaphore(MAX_CONNECTIONS)
        self._counting = threading.Lock()
        self._connections: set[ServerConnection] = set()
        self.requests = 0
        self.refused = 0
        listening = free_socket(options.host, options.port)
        self.port = int(listening.getsockname()[1])
        self._server: Server = serve(
            self._handle,
            sock=listening,
            compression=None,
            max_size=options.max_message_bytes,
            process_request=self._admit,
            server_header=None,
            close_timeout=CLOSE_TIMEOUT_S,
            ping_timeout=PONG_TIMEOUT_S,
            logger=_quiet_logger(),
        )

    def run(self) -> None:
        """Serve until `shutdown` is called."""
        self._server.serve_forever()

    def shutdown(self) -> None:
        """End `run` and all connections."""
        self._server.shutdown()
        with self._counting:
            connections = list(self._connections)
        for connection in connections:
            connection.close(GOING_AWAY, "the server ends")

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        if request.path == "/healthz":
            return connection.respond(HTTPStatus.OK, "OK\n")
        token = self._options.token
        if token:
            shown = request.headers.get("Authorization", "")
            if not hmac.compare_digest(shown.encode(), f"Api-Key {token}".encode()):
                return connection.respond(
                    HTTPStatus.UNAUTHORIZED, "this server wants its token\n"
                )
        return None

    def _handle(self, connection: ServerConnection) -> None:
        if not self._slots.acquire(blocking=False):
            connection.close(INTERNAL_ERROR, "too many connections")
            return
        session = self._responder.session()
        with self._counting:
            self._connections.add(connection)
        try:
            own = {
                **self._responder.metadata(),
                "dialect": self._dialect.name,
                CONTROL_HZ: round(1.0 / STEP_SECONDS),
            }
            connection.send(pack(self._dialect.greeting(own)))
            for message in connection:
                self._count()
                reply = self._answer(session, message)
                if reply is not None:
                    connection.send(reply)
        except ConnectionClosed:
            pass
        except MjhabError as error:
            self._count(refused=True)
            _farewell(connection, f"{type(error).__name__}: {error}")
        # Whatever a message made of the policy, the server lives on for the others, as servers of openpi do.
        except Exception as error:
            logging.getLogger(__name__).exception("a request failed")
            self._count(refused=True)
            _farewell(connection, f"{type(error).__name__}: {error}")
        finally:
            with self._counting:
                self._connections.discard(connection)
            session.close()
            self._slots.release()

    def _answer(self, session: PolicySession, message: str | bytes) -> str | bytes | None:
        if isinstance(message, str):
            raise ProtocolError(
                f"messages are msgpack in binary frames, not the text {message[:40]!r}"
            )
        incoming: Incoming = self._dialect.read(unpack(message))
        if incoming.reset:
            session.reset()
            return RESET_DONE if self._dialect.begin_answered else None
        started = time.perf_counter()
        chunks = session.infer(incoming.request, incoming.batch)
        infer_ms = 1e3 * (time.perf_counter() - started)
        return pack(self._dialect.answer(chunks, incoming, infer_ms))

    def _count(self, refused: bool = False) -> None:
        with self._counting:
            if refused:
                self.refused += 1
            else:
                self.requests += 1


def free_socket(host: str, port: int) -> socket.socket:
    """A listening socket on a port, or on the next one that is free.

    Raises:
        UsageError: none of `PORTS_TRIED` ports is free, or the host is none of this machine.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    tried = range(port, min(port + PORTS_TRIED, 1 << 16)) if port else range(1)
    for number in tried:
        listening = socket.socket(family, socket.SOCK_STREAM)
        # A server that was just stopped leaves its port waiting for a minute.
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((host, number))
            listening.listen()
        except OSError as error:
            listening.close()
            # Another port would not help against a wrong host.
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise UsageError(f"cannot listen on {host}:{number}: {error}.") from error
        else:
            return listening
    raise UsageError(
        f"no port from {port} to {tried[-1]} is free on {host}; give another --port."
    )


def _farewell(connection: ServerConnection, text: str) -> None:
    """Tell the client what went wrong, and close."""
    try:
        # As text, which clients of all dialects take for an error.
        connection.send(text)
        connection.close(INTERNAL_ERROR, "error, see the frame before")
    except (ConnectionClosed, OSError):
        pass


def _quiet_logger() -> logging.Logger:
    """A logger for handshakes that fail, which strangers cause: they are no news."""
    logger = logging.getLogger("mjhab.serving.websockets")
    logger.setLevel(logging.CRITICAL)
    return logger
