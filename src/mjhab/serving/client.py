"""The asking end: a connection to a policy server that is opened when needed and opened again when it was lost."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from websockets.exceptions import (
    ConnectionClosed,
    InvalidHandshake,
    InvalidStatus,
    WebSocketException,
)
from websockets.sync.client import ClientConnection, connect

from mjhab.core.errors import MjhabError, UsageError
from mjhab.serving.address import TOKEN_VARIABLE, Address
from mjhab.serving.dialects.dialect import RESET_DONE, Ask
from mjhab.serving.dialects.names import answered_in, dialect_named, greeted_in
from mjhab.serving.packing import ProtocolError, pack, unpack

MAX_ANSWER_BYTES = 64 << 20
GREETING_TIMEOUT_S = 10.0
RETRY_S = 0.2
"""Time between two attempts to connect to a server [s]."""
MAX_ATTEMPTS = 3
"""Number of times that a request is sent before the episode fails, if the connection is lost each time."""
_MOST_SHOWN = 300


class PolicyFault(MjhabError):
    """A served policy gave no answer, or an answer without a valid action. It ends one episode, not the run."""


class Connection:
    """A connection to a policy server.

    ``metadata``: the greeting of the server, empty before the first request. ``latency_ms``: duration of each request.

    Args:
        address: which server, and how it is asked.
    """

    def __init__(self, address: Address) -> None:
        self.address = address
        self.metadata: Mapping[str, Any] = {}
        self.latency_ms: list[float] = []
        self._dialect = dialect_named(address.dialect)
        self._socket: ClientConnection | None = None
        self._asked = False
        self._understood = False
        self._patience = address.reconnect

    def greet(self) -> Mapping[str, Any]:
        """Connect, and return the metadata of the server.

        Raises:
            UsageError: there is no server, it refuses the connection, or it speaks another dialect.
        """
        if self._socket is None:
            self._connect()
        return self.metadata

    def ask(self, asks: Sequence[Ask], begins: bool) -> np.ndarray:
        """Actions (B, H, A) for what is seen in B worlds.

        Args:
            asks: one per world; more than one where the dialect has batches.
            begins: this is the first request of an episode.

        Raises:
            PolicyFault: no answer in time, an error of the server, an answer that is none, or a lost connection that
                cannot be made good.
            UsageError: the first answer is in another dialect.
        """
        for _ in range(MAX_ATTEMPTS):
            fresh = self._socket is None
            if fresh and not begins and self._dialect.remembers and self._asked:
                self._asked = False
                raise PolicyFault(
                    "the connection was lost in the middle of the episode, and with it what the server knew of it"
                )
            self._reach()
            try:
                return self._exchange(asks, begins)
            except (ConnectionClosed, OSError):
                self.close()
        raise PolicyFault(
            f"the server closed the connection {MAX_ATTEMPTS} times when it was asked"
        )

    def close(self) -> None:
        """Close the connection; the next request opens it again."""
        socket = self._socket
        self._socket = None
        if socket is not None:
            # The other end may be gone or stuck: nobody waits for its farewell.
            socket.close_timeout = 0.1
            socket.close()

    def _exchange(self, asks: Sequence[Ask], begins: bool) -> np.ndarray:
        socket = self._socket
        assert socket is not None
        address = self.address
        timeout = (
            address.timeout
            if self._asked
            else max(address.timeout, address.first_timeout)
        )
        beginning = self._dialect.begin(asks[0].session) if begins else None
        if beginning is not None:
            socket.send(pack(beginning))
            if self._dialect.begin_answered:
                self._check_reset(self._receive(timeout))
        started = time.perf_counter()
        socket.send(pack(self._dialect.request(asks, self.metadata, address.batch)))
        message = self._receive(timeout)
        self._asked = True
        self.latency_ms.append(1e3 * (time.perf_counter() - started))
        return self._actions(message, len(asks))

    def _receive(self, timeout: float) -> str | bytes:
        assert self._socket is not None
        try:
            return self._socket.recv(timeout)
        except TimeoutError:
            # A late answer must not be taken for that to the next request.
            self.close()
            raise PolicyFault(f"no answer within {timeout:g} s") from None

    def _check_reset(self, answer: str | bytes) -> None:
        if answer not in (RESET_DONE, RESET_DONE.encode(), pack(RESET_DONE)):
            self.close()
            raise PolicyFault(f"the server did not begin an episode: {_said(answer)}")

    def _actions(self, message: str | bytes, batch: int) -> np.ndarray:
        if isinstance(message, str):
            self.close()
            raise PolicyFault(f"the server reports an error: {_said(message)}")
        answer: Any = None
        try:
            answer = unpack(message)
            actions = self._dialect.actions(answer, batch)
        except ProtocolError as error:
            self.close()
            other = answered_in(answer)
            if other and other != self.address.dialect and not self._understood:
                raise wrong_dialect(self.address, other) from error
            raise PolicyFault(str(error)) from error
        self._understood = True
        return actions

    def _reach(self) -> None:
        """Connect, if need be, for as long as the server may take to come back.

        Raises:
            PolicyFault: it did not come back.
        """
        until = time.monotonic() + self._patience
        while self._socket is None:
            try:
                self._connect()
            except UsageError as error:
                if time.monotonic() > until:
                    # One wait was in vain; the episodes to come are not to wait as long again.
                    self._patience = RETRY_S
                    raise PolicyFault(str(error)) from error
                time.sleep(RETRY_S)
        self._patience = self.address.reconnect

    def _connect(self) -> None:
        token = os.environ.get(TOKEN_VARIABLE)
        headers = {"Authorization": f"Api-Key {token}"} if token else None
        try:
            socket = connect(
                self.address.uri,
                compression=None,
                max_size=MAX_ANSWER_BYTES,
                additional_headers=headers,
                open_timeout=GREETING_TIMEOUT_S,
                proxy=None,
            )
        except InvalidStatus as error:
            raise UsageError(
                _refusal(self.address.told, error.response.status_code)
            ) from error
        except (InvalidHandshake, EOFError) as error:
            raise UsageError(
                f"{self.address.told} is no policy server, it speaks no websocket: {error}."
            ) from error
        except (OSError, TimeoutError, WebSocketException) as error:
            raise UsageError(
                f"no policy server at {self.address.told} ({error}). Start one, as in: mjhab serve expert --port "
                f"{self.address.port}."
            ) from error
        try:
            self.metadata = self._greeting(socket)
        except UsageError:
            socket.close()
            raise
        self._socket = socket
        self._asked = False

    def _greeting(self, socket: ClientConnection) -> Mapping[str, Any]:
        address = self.address
        try:
            message = socket.recv(GREETING_TIMEOUT_S)
        except TimeoutError:
            raise UsageError(
                f"{address.told} sent nothing within {GREETING_TIMEOUT_S:g} s, and servers of openpi, roboarena and "
                "behavior greet first; servers of vla-eval are asked by mjhab.integrations.vla_eval."
            ) from None
        except ConnectionClosed as error:
            raise UsageError(
                f"{address.told} closed the connection at once: {error}."
            ) from error
        if isinstance(message, str):
            raise UsageError(
                f"{address.told} does not speak {address.dialect}: it says {_said(message)}"
            )
        try:
            metadata = unpack(message)
        except ProtocolError as error:
            raise UsageError(
                f"{address.told} does not speak {address.dialect}: {error}."
            ) from error
        if not isinstance(metadata, Mapping):
            raise UsageError(
                f"{address.told} greets with {metadata!r:.80}, not with a map of metadata."
            )
        other = greeted_in(metadata)
        if other and other != address.dialect:
            raise wrong_dialect(address, other)
        return metadata


def wrong_dialect(address: Address, spoken: str) -> UsageError:
    """The error for a server that speaks another dialect."""
    return UsageError(
        f"{address.told} speaks {spoken}, not {address.dialect}; give --dialect {spoken}."
    )


def _refusal(uri: str, status: int) -> str:
    if status in (401, 403):
        return (
            f"the policy server at {uri} wants a token (HTTP {status}); put the one that it printed into the "
            f"environment variable {TOKEN_VARIABLE}."
        )
    return f"{uri} is no policy server: it answers with HTTP status {status}."


def _said(text: str | bytes) -> str:
    """What a server said, short and on one line: the end of it, where a traceback has its message."""
    words = text if isinstance(text, str) else repr(text[:_MOST_SHOWN])
    lines = [line.strip() for line in words.splitlines() if line.strip()]
    last = lines[-1] if lines else "nothing"
    return "".join(c if c.isprintable() else "?" for c in last)[-_MOST_SHOWN:]
