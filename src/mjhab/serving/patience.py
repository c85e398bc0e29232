"""How long a policy server may take: longer before it has answered, and longer the more it is asked at once."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from mjhab.core.progress import say
from mjhab.serving.address import Address

GREETING_TIMEOUT_S = 10.0
"""Wait for a handshake and a greeting after which the user is told of it; the longest wait for a stuck server [s]."""
RETRY_S = 0.2
"""Time between two attempts to connect to a server [s]."""


class Patience:
    """What is known of how busy a server is; shared by all connections of a policy to it.

    A server may answer one request after the other, and read nothing while it does. So silence on one connection means
    nothing while others get answers, and many requests may take many times as long as one.

    Args:
        address: of the server, with the waits that the user asked for.
    """

    def __init__(self, address: Address) -> None:
        self._address = address
        self._lock = threading.Lock()
        self._asked = 0
        self._firsts = 0
        self._in_vain = False
        self._announced = False
        self._last_sign = -float("inf")
        self.answers = 0
        """Number of answers so far."""

    @contextmanager
    def asking(self, worlds: int, first: bool) -> Iterator[None]:
        """While a request about so many worlds is under way.

        ``first``: nothing was answered over its connection yet.
        """
        with self._lock:
            self._asked += worlds
            self._firsts += first
        try:
            yield
        finally:
            with self._lock:
                self._asked -= worlds
                self._firsts -= first

    def answered(self) -> None:
        """Note that the server answered a request."""
        with self._lock:
            self.answers += 1
            self._last_sign = time.monotonic()
            self._in_vain = False

    def greeted(self) -> None:
        """Note that the server greeted: it lives, but may have to compile before its first answer."""
        with self._lock:
            self._in_vain = False

    def was_in_vain(self) -> None:
        """Note that the server was waited for in full. It is not waited for as long again until it gives a sign."""
        with self._lock:
            self._in_vain = True

    def tell_once(self, text: str) -> None:
        """Tell the user that the server lets one wait, unless that was told before."""
        with self._lock:
            if self._announced:
                return
            self._announced = True
        say(text)

    def for_answer(self, first: bool) -> float:
        """Longest wait for an answer [s], counted from the request or from the last answer to another one.

        Args:
            first: nothing was answered over this connection yet.
        """
        address = self._address
        if self._in_vain:
            return address.timeout
        # A server that answers one after the other needs the time of all that were asked.
        waits = [address.timeout * max(1, self._asked)]
        # What a server does for the first answer over one connection may hold up all others.
        if first or self._firsts:
            waits.append(address.first_timeout)
        return max(waits)

    def answer_due(self, sent: float, first: bool) -> float:
        """When (`time.monotonic`) an answer to a request of the time ``sent`` is overdue."""
        return max(sent, self._last_sign) + self.for_answer(first)

    def for_handshake(self) -> float:
        """Longest wait for a handshake, and for the greeting after it [s]."""
        if self._in_vain:
            # It was waited for once; the episodes to come should fail fast.
            return min(GREETING_TIMEOUT_S, self.for_answer(False))
        if not self.answers:
            return self.for_answer(True)
        return max(GREETING_TIMEOUT_S, self.for_answer(False))

    def for_return(self) -> float:
        """How long a server that does not take connections is looked for [s]."""
        address = self._address
        if self._in_vain:
            return RETRY_S
        if not self.answers:
            # It may still be starting.
            return max(address.reconnect, address.first_timeout)
        return address.reconnect

    def longest(self) -> float:
        """The longest of all waits for an answer [s]."""
        address = self._address
        return max(address.first_timeout, address.timeout * max(1, self._asked))
