"""A policy that always sends the same actions, and servers of it for tests."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from mjhab.serving.dialects.dialect import Ask
from mjhab.serving.dialects.names import dialect_named
from mjhab.serving.server import PolicyServer, ServerOptions


class Constant:
    """Sends ``chunk`` (H, A) for every world; as responder and as session. ``seen`` are the requests.

    delay_s: waits so long before it answers. error: is raised instead.
    """

    def __init__(
        self, chunk: Any = None, delay_s: float = 0.0, error: Exception | None = None
    ) -> None:
        self.chunk = np.zeros((4, 13), np.float32) if chunk is None else np.asarray(chunk)
        self.delay_s = delay_s
        self.error = error
        self.seen: list[Mapping[str, Any]] = []
        self.resets = 0
        self.sessions = 0

    def metadata(self) -> Mapping[str, Any]:
        return {"policy": "constant"}

    def session(self) -> Constant:
        self.sessions += 1
        return self

    def reset(self) -> None:
        self.resets += 1

    def infer(self, request: Mapping[str, Any], batch: int | None) -> np.ndarray:
        self.seen.append(request)
        if self.error is not None:
            raise self.error
        time.sleep(self.delay_s)
        return np.stack([self.chunk] * (batch or 1))

    def close(self) -> None:
        pass


@contextmanager
def serving(
    policy: Any, dialect: str = "openpi", options: ServerOptions | None = None
) -> Iterator[PolicyServer]:
    """A server in a thread of its own."""
    server = PolicyServer(
        policy, dialect_named(dialect), options or ServerOptions(port=0)
    )
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join(5.0)


def an_ask(image: bool = True) -> Ask:
    """What a world could show."""
    picture = np.full((32, 32, 3), 7, np.uint8) if image else None
    return Ask(
        robot="boxy",
        cameras=("boxy_head", "boxy_hand"),
        external=picture,
        wrist=picture,
        state=np.arange(42, dtype=np.float32),
        arm=np.zeros(7, np.float32),
        gripper=0.25,
        tcp=np.array([0.5, 0.1, 0.8, 1.0, 0.0, 0.0, 0.0]),
        prompt="pick up the bowl",
        session="s1",
        chunk=4,
    )
