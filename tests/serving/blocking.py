"""A policy server whose inference blocks its event loop, as many public ones do."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from websockets.asyncio.server import serve
from websockets.exceptions import ConnectionClosed

from mjhab.serving.dialects.dialect import RESET_DONE
from mjhab.serving.dialects.names import DIALECTS
from mjhab.serving.packing import pack, unpack
from mjhab.serving.server import free_socket

CHUNK = np.zeros((4, 13), np.float32)


@dataclass
class Blocking:
    """first_s, each_s: what the first answer of the process takes, and each later one [s]. sent: the requests."""

    dialect: str = "openpi"
    first_s: float = 0.0
    each_s: float = 0.0
    port: int = 0
    sent: list[Any] = field(default_factory=list)

    async def handle(self, socket: Any) -> None:
        spoken = DIALECTS[self.dialect]
        greeting = spoken.greeting({})
        del greeting["mjhab"]
        try:
            await socket.send(pack(greeting))
            async for message in socket:
                incoming = spoken.read(unpack(message))
                if incoming.reset:
                    if spoken.begin_answered:
                        await socket.send(RESET_DONE)
                    continue
                time.sleep(self.each_s if self.sent else self.first_s)
                self.sent.append(incoming.request)
                chunks = np.stack([CHUNK] * (incoming.batch or 1))
                await socket.send(pack(spoken.answer(chunks, incoming, 0.0)))
        except ConnectionClosed:
            pass


@contextmanager
def blocking(server: Blocking) -> Iterator[Blocking]:
    """Run a server in a thread of its own; its ``port`` is known then."""
    listening = free_socket("127.0.0.1", 0)
    server.port = int(listening.getsockname()[1])
    loop = asyncio.new_event_loop()
    ended = asyncio.Event()

    async def run() -> None:
        async with serve(server.handle, sock=listening, compression=None, max_size=None):
            await ended.wait()

    thread = threading.Thread(target=lambda: loop.run_until_complete(run()), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        loop.call_soon_threadsafe(ended.set)
        thread.join(10.0)
        loop.close()
