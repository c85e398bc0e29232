"""A policy server in 30 lines, without mjhab: `pip install websockets msgpack numpy`, see docs/serving.md.

Run `python policy_server.py 8000`, and `mjhab eval --policy ws://localhost:8000 --subtask pick --episodes 2`.
"""

import argparse

import msgpack
import numpy as np
from websockets.sync.server import serve

LENGTH = 8


def packed(value):
    return {
        b"__ndarray__": True,
        b"data": value.tobytes(),
        b"dtype": value.dtype.str,
        b"shape": value.shape,
    }


def restored(entry):
    if b"__ndarray__" not in entry:
        return entry
    return np.frombuffer(entry[b"data"], entry[b"dtype"]).reshape(entry[b"shape"])


def actions(request):
    """LENGTH actions of 13 numbers in [-1, 1] at 20 Hz: here the base drives on, the faster the brighter it is."""
    chunk = np.zeros((LENGTH, 13), np.float32)
    chunk[:, 11] = np.mean(request["observation/image"]) / 255.0
    return chunk


def answer(connection):
    greeting = {"policy": "bright", "action_space": "joint", "control_hz": 20}
    connection.send(msgpack.packb(greeting))
    for message in connection:
        request = msgpack.unpackb(message, object_hook=restored)
        reply = {"actions": actions(request)}
        if "real_time" in request:
            reply["step"] = request["real_time"]["step"]
        connection.send(msgpack.packb(reply, default=packed))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("port", type=int, help="0 for any free port, which is printed")
    port = parser.parse_args().port
    with serve(answer, "localhost", port, compression=None) as server:
        print(server.socket.getsockname()[1], flush=True)
        server.serve_forever()
