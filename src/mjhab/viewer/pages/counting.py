"""A client that counts the messages that the viewer sends to a page, for measurements."""

from __future__ import annotations

import math
import threading
import time

import msgspec
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol


class CountingPage:
    """Connect as viser's page does, and send a camera pose, after which the server counts it as an open page.

    Args:
        port: port of the viewer on this machine.

    Attributes:
        messages, bytes: number and size of the messages received so far.
        complete_at: time (`time.perf_counter`) at which the scene as it was at the connection had been received;
            infinite before.
    """

    def __init__(self, port: int) -> None:
        self.messages = 0
        self.bytes = 0
        self.complete_at = math.inf
        self._socket = connect(
            f"ws://127.0.0.1:{port}/",
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            compression=None,
            max_size=None,
            proxy=None,
        )
        self._socket.send(msgspec.msgpack.encode(_CAMERA))
        self._thread = threading.Thread(target=self._count, name="page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close the page."""
        self._socket.close()
        self._thread.join(timeout=5.0)

    def _count(self) -> None:
        try:
            for message in self._socket:
                assert isinstance(message, bytes)
                self.messages += 1
                self.bytes += len(message)
                if math.isinf(self.complete_at) and _ends_replay(message):
                    self.complete_at = time.perf_counter()
        except ConnectionClosed:
            pass


def _ends_replay(message: bytes) -> bool:
    """Whether a message marks the end of the replayed scene.

    A message has two sizes of 8 bytes, zstandard-compressed msgpack of the second size, then arrays.
    """
    size = int.from_bytes(message[8:16], "little")
    return b"ReplayDoneMessage" in zstandard.decompress(message[16 : 16 + size])


_CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 2.0),
    "fov": 1.0,
    "near": 0.01,
    "far": 100.0,
    "image_height": 720,
    "image_width": 1280,
    "look_at": (1.0, 0.0, 1.0),
    "up_direction": (0.0, 0.0, 1.0),
}
