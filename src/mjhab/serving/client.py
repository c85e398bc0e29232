"""The asking end: a connection to a policy server that is opened when needed and opened again when it was lost."""

from __future__ import annotations

import os
import socket as sockets
import struct
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from websockets.exceptions import (
    ConnectionClosed,
    InvalidHandshake,
    InvalidStatus,
    WebSocketException,
)
from websockets.sync.client import ClientConnection, connect

from mjhab.core.errors import MjhabError, UsageError, fault
from mjhab.serving.address import TOKEN_VARIABLE, Address
from mjhab.serving.dialects.dialect import OWN, RESET_DONE, STEP, Ask
from mjhab.serving.dialects.names import answered_in, dialect_named, greeted_in
from mjhab.serving.packing import ProtocolError, pack, unpack
from mjhab.serving.patience import GREETING_TIMEOUT_S, RETRY_S, Patience

# Far above a chunk of actions, and far below what would fill the memory.
MAX_ANSWER_BYTES = 64 << 20
TCP_TIMEOUT_S = 10.0
"""Longest wait for a TCP connection [s]: the system of a busy server takes it, that of no server refuses it."""
LOOK_S = 1.0
"""Time between two looks at how a server does while an answer is waited for [s]."""
MAX_ATTEMPTS = 3
"""Number of times that a request is sent before the episode fails, if the connection is lost each time and the server
answers nothing else meanwhile."""
_MOST_SHOWN = 300


class PolicyFault(MjhabError):
    """A served policy gave no answer, or an answer without a valid action. It ends one episode, not the run."""


class _NotNow(UsageError):
    """There is no connection to the server, but there may be one later."""


class Connection:
    """A connection to a policy server.

    ``metadata``: the greeting of the server, empty before the first request. ``latency_ms``: duration of each request.
    ``first_step``: what the last answer says of the control step that its first action is for; None for nothing.

    Args:
        address: which server, and how it is asked.
        patience: what is known of the server, shared by all connections to it; None for the only one.
    """

    def __init__(self, address: Address, patience: Patience | None = None) -> None:
        self.address = address
        self.metadata: Mapping[str, Any] = {}
        self.latency_ms: list[float] = []
        self.first_step: int | None = None
        self._dialect = dialect_named(address.dialect)
        self._socket: ClientConnection | None = None
        # The next episode begins with nothing to remember.
        self._asked = False
        self._understood = False
        self._patience = patience or Patience(address)

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
        # Counted over all connections: one that compiles may hold up the others.
        with self._patience.asking(len(asks), first=not self._asked):
            return self._ask(asks, begins)

    def _ask(self, asks: Sequence[Ask], begins: bool) -> np.ndarray:
        attempts = 0
        while attempts < MAX_ATTEMPTS:
            fresh = self._socket is None
            if fresh and not begins and self._dialect.remembers and self._asked:
                self._asked = False
                raise PolicyFault(
                    "the connection was lost in the middle of the episode, and with it what the server knew of it"
                )
            self._reach()
            answers = self._patience.answers
            try:
                return self._exchange(asks, begins)
            except ConnectionClosed as error:
                self.close()
                if _was_too_busy(error) and OWN not in self.metadata:
                    # The process lives, and what it knows of the episode is not bound to the connection.
                    self._asked = False
            except OSError:
                self.close()
            # A server that answers other requests meanwhile is busy, not broken.
            attempts = attempts + 1 if answers == self._patience.answers else 0
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
        self._refuse_unasked(socket)
        beginning = self._dialect.begin(asks[0].session) if begins else None
        if beginning is not None:
            socket.send(pack(beginning))
            # Its answer must be read, or it would be taken for that to the request.
            if self._dialect.begin_answered:
                self._check_reset(self._receive())
        # The packing of images counts, too: it is part of what the world waits for.
        started = time.perf_counter()
        request = self._dialect.request(asks, self.metadata, self.address.batch)
        socket.send(pack(request))
        message = self._receive()
        self._asked = True
        self._patience.answered()
        self.latency_ms.append(1e3 * (time.perf_counter() - started))
        return self._actions(message, asks)

    def _refuse_unasked(self, socket: ClientConnection) -> None:
        """Refuse a message that came before the request: taken for its answer, actions would be those of another time.

        Raises:
            PolicyFault: there was one.
        """
        with suppress(TimeoutError):
            message = socket.recv(0)
            self.close()
            said = f": {_said(message)}" if isinstance(message, str) else ""
            raise PolicyFault(
                f"the server sent what no request asked for, such as an answer twice{said}"
            )

    def _receive(self) -> str | bytes:
        """The next message, waited for as long as the server may be at work.

        Raises:
            PolicyFault: none came.
        """
        socket = self._socket
        assert socket is not None
        sent = time.monotonic()
        alive = sent
        look = min(LOOK_S, 0.5 * self.address.timeout)
        pong: threading.Event | None = None
        while True:
            first = not self._asked
            due = self._patience.answer_due(sent, first)
            if OWN in self.metadata and time.monotonic() - sent >= look:
                # Servers of mjhab answer pings while their policy plans; those of others may hang and answer them.
                if pong is None or pong.is_set():
                    alive = time.monotonic()
                    pong = socket.ping()
                longest = sent + self._patience.longest()
                due = max(due, min(alive + self.address.timeout, longest))
            left = due - time.monotonic()
            if left <= 0.0:
                break
            # Looks in between tell whether a server of mjhab is still alive.
            with suppress(TimeoutError):
                return socket.recv(min(left, look))
        # A late answer must not be taken for that to the next request.
        self.close()
        self._patience.was_in_vain()
        waited = round(time.monotonic() - sent, 1)
        raise PolicyFault(f"no answer within {waited:g} s")

    def _check_reset(self, answer: str | bytes) -> None:
        if answer not in (RESET_DONE, RESET_DONE.encode(), pack(RESET_DONE)):
            # What it will send next cannot be known.
            self.close()
            raise PolicyFault(f"the server did not begin an episode: {_said(answer)}")

    def _actions(self, message: str | bytes, asks: Sequence[Ask]) -> np.ndarray:
        if isinstance(message, str):
            self.close()
            raise PolicyFault(f"the server reports an error: {_said(message)}")
        answer: Any = None
        try:
            answer = unpack(message)
            actions = self._dialect.actions(answer, len(asks))
            self.first_step = _first_step(answer, asks)
        except ProtocolError as error:
            self.close()
            other = answered_in(answer)
            # Once an answer was understood, a strange one is a fault of the policy and not of the dialect.
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
        until = time.monotonic() + self._patience.for_return()
        while self._socket is None:
            try:
                self._connect()
            except _NotNow as error:
                if time.monotonic() > until:
                    # One wait was in vain; the episodes to come are not to wait as long again.
                    self._patience.was_in_vain()
                    raise PolicyFault(str(error)) from error
                time.sleep(RETRY_S)
            except UsageError as error:
                raise PolicyFault(str(error)) from error

    def _connect(self) -> None:
        wait = self._patience.for_handshake()
        with self._told_when_slow(wait):
            socket = self._shaken_hands(wait)
            try:
                self.metadata = self._greeting(socket, wait)
            except UsageError:
                # A server of another kind would keep the connection open.
                socket.close()
                raise
        self._patience.greeted()
        self._socket = socket
        self._asked = False

    def _shaken_hands(self, wait: float) -> ClientConnection:
        """A websocket to the server.

        Raises:
            UsageError: there is no server, or it is none of websockets.
        """
        server = self.address.shown
        token = os.environ.get(TOKEN_VARIABLE)
        headers = {"Authorization": f"Api-Key {token}"} if token else None
        line = self._tcp_connection()
        try:
            return connect(
                self.address.uri,
                sock=line,
                # Images hardly shrink, and compressing them takes longer than a local network.
                compression=None,
                max_size=MAX_ANSWER_BYTES,
                additional_headers=headers,
                open_timeout=wait,
                # Pings keep the line open. Whether the server is stuck, the wait for its answer decides: one that
                # computes in its event loop answers no pings.
                ping_timeout=None,
                # A proxy for the web would be asked for a server in the same room.
                proxy=None,
            )
        except InvalidStatus as error:
            status = error.response.status_code
            # 5xx passes, as while a server starts behind a proxy; others stay.
            kind = _NotNow if status >= 500 else UsageError
            raise kind(_refusal(server, status)) from error
        except TimeoutError as error:
            raise _NotNow(
                f"{server} takes connections and says nothing for {wait:g} s: the server is busy or stuck, or it is "
                "none of policies. --first-timeout is how long it is waited for."
            ) from error
        except (InvalidHandshake, EOFError) as error:
            raise _NotNow(
                f"{server} is no policy server, it speaks no websocket: {error}."
            ) from error
        except (OSError, WebSocketException) as error:
            raise _NotNow(_absence(self.address, error)) from error

    def _tcp_connection(self) -> sockets.socket:
        parts = urlsplit(self.address.uri)
        port = parts.port or (443 if parts.scheme == "wss" else 80)
        try:
            line = sockets.create_connection((parts.hostname or "", port), TCP_TIMEOUT_S)
        except TimeoutError as error:
            raise _NotNow(
                f"{self.address.shown} does not answer on the network within {TCP_TIMEOUT_S:g} s; is the host right, "
                "and may it be reached from here?"
            ) from error
        except OSError as error:
            raise _NotNow(_absence(self.address, error)) from error
        # The timeout was for the connection alone; websockets sets its own.
        line.settimeout(None)
        _limit_sending(line, self._patience.longest())
        return line

    @contextmanager
    def _told_when_slow(self, wait: float) -> Iterator[None]:
        """Tell the user what is waited for if it takes long."""
        address = self.address
        note = threading.Timer(
            GREETING_TIMEOUT_S,
            self._patience.tell_once,
            [
                f"mjhab: {address.shown} takes connections but has not greeted for {GREETING_TIMEOUT_S:g} s; it is "
                f"waited for up to {wait:g} s, since it may be busy. Servers of vla-eval never greet: they are asked "
                "by mjhab.integrations.vla_eval."
            ],
        )
        # A timer must not keep the process alive.
        note.daemon = True
        note.start()
        try:
            yield
        finally:
            note.cancel()

    def _greeting(self, socket: ClientConnection, wait: float) -> Mapping[str, Any]:
        address = self.address
        try:
            message = socket.recv(wait)
        except TimeoutError:
            raise _NotNow(
                f"{address.shown} sent nothing within {wait:g} s, and servers of openpi, roboarena and "
                "behavior greet first; servers of vla-eval are asked by mjhab.integrations.vla_eval."
            ) from None
        except ConnectionClosed as error:
            raise _NotNow(
                f"{address.shown} closed the connection at once: {error}."
            ) from error
        if isinstance(message, str):
            raise fault(
                address.shown,
                f"does not speak {address.dialect}: it says {_said(message)}",
            )
        try:
            metadata = unpack(message)
        except ProtocolError as error:
            raise fault(
                address.shown, f"does not speak {address.dialect}: {error}."
            ) from error
        if not isinstance(metadata, Mapping):
            raise fault(
                address.shown,
                f"greets with {metadata!r:.80}, not with a map of metadata.",
            )
        other = greeted_in(metadata)
        if other and other != address.dialect:
            raise wrong_dialect(address, other)
        return metadata


def _first_step(answer: Any, asks: Sequence[Ask]) -> int | None:
    """The control step that the first action of an answer is for, if it says so.

    Raises:
        ProtocolError: it is no number of a step, or one before the observation: the answer is to another request.
    """
    step = answer.get(STEP) if isinstance(answer, Mapping) else None
    if step is None:
        return None
    if isinstance(step, bool) or not isinstance(step, int | np.integer) or step < 0:
        raise ProtocolError(f"{STEP!r} is the number of a control step, not {step!r:.80}")
    asked = min((ask.timing[STEP] for ask in asks if ask.timing), default=0)
    if step < asked:
        raise ProtocolError(
            f"the answer is for control step {step}, before that of the observation, {asked}: it is to another request"
        )
    return int(step)


def wrong_dialect(address: Address, spoken: str) -> UsageError:
    """The error for a server that speaks another dialect."""
    return UsageError(
        f"{address.shown} speaks {spoken}, not {address.dialect}; give --dialect {spoken}."
    )


def _was_too_busy(error: ConnectionClosed) -> bool:
    """Whether the server closed the connection since its own event loop stood still for too long to see our pongs."""
    return error.rcvd is not None and "ping timeout" in error.rcvd.reason


def _absence(address: Address, error: Exception) -> str:
    return (
        f"no policy server at {address.shown} ({error}). Start one, as in: mjhab serve expert --port "
        f"{address.port}."
    )


def _limit_sending(line: sockets.socket, seconds: float) -> None:
    """Let a message that the server does not read for so long end the connection, where the system can do that.

    A timeout of the socket itself would end the thread that listens, too.
    """
    if hasattr(sockets, "SO_SNDTIMEO") and os.name == "posix":
        whole = int(seconds)
        limit = struct.pack("@ll", whole, int(1e6 * (seconds - whole)))
        line.setsockopt(sockets.SOL_SOCKET, sockets.SO_SNDTIMEO, limit)


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
    # Text of a server may hold sequences that steer a terminal.
    return "".join(c if c.isprintable() else "?" for c in last)[-_MOST_SHOWN:]
