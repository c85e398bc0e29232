"""Both ends of the line: they understand each other in every dialect, and neither falls with the other."""

from __future__ import annotations

import dataclasses
import threading
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.sync.server import ServerConnection, serve

from mjhab.core.errors import UsageError
from mjhab.serving.address import TOKEN_VARIABLE, Address
from mjhab.serving.client import Connection, PolicyFault
from mjhab.serving.dialects.names import DIALECTS
from mjhab.serving.packing import pack, unpack
from mjhab.serving.server import PolicyServer, ServerOptions, free_socket
from tests.refusals import refused
from tests.serving.constant import Constant, an_ask, serving

QUICK = {"timeout": 0.3, "first_timeout": 0.3, "reconnect": 0.3}


def address(port: int, dialect: str = "openpi", **options: object) -> Address:
    return Address(f"ws://127.0.0.1:{port}", dialect, **{**QUICK, **options})  # type: ignore[arg-type]


@contextmanager
def scripted(handler: Callable[[ServerConnection], None]) -> Iterator[int]:
    """A server that does what ``handler`` does; gives its port."""
    listening = free_socket("127.0.0.1", 0)
    server = serve(handler, sock=listening, compression=None)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield int(listening.getsockname()[1])
    finally:
        server.shutdown()
        thread.join(5.0)


@pytest.mark.parametrize("dialect", sorted(DIALECTS))
def test_an_answer_is_what_was_sent(dialect: str) -> None:
    chunk = np.random.default_rng(0).normal(size=(4, 13)).astype(np.float32)
    policy = Constant(chunk)
    with serving(policy, dialect) as server:
        connection = Connection(address(server.port, dialect))
        told = {"policy": "constant", "dialect": dialect, "control_hz": 20}
        assert connection.greet()["mjhab"] == told
        for begins in (True, False):
            (got,) = connection.ask([an_ask()], begins)
            np.testing.assert_array_equal(got, chunk)
        connection.close()
    assert len(connection.latency_ms) == len(policy.seen) == 2
    assert policy.resets == (1 if DIALECTS[dialect].remembers else 0)
    sentence = "task" if dialect == "lerobot" else "prompt"
    assert policy.seen[0][sentence] == "pick up the bowl"
    images = [
        v for v in policy.seen[0].values() if isinstance(v, np.ndarray) and v.ndim == 3
    ]
    assert len(images) >= 2 and all((image == 7).all() for image in images)


def test_a_batch_holds_all_worlds() -> None:
    policy = Constant(np.ones((4, 13)))
    with serving(policy, "behavior") as server:
        connection = Connection(address(server.port, "behavior", batch=True))
        got = connection.ask([an_ask(), an_ask(), an_ask()], True)
        assert got.shape == (3, 4, 13)
        # One world is left: what it is sent has the shape of a batch still.
        assert connection.ask([an_ask()], False).shape == (1, 4, 13)
        connection.close()
    for seen, worlds in zip(policy.seen, (3, 1), strict=True):
        assert seen["robot_boxy::boxy_head::rgb"].shape == (worlds, 32, 32, 3)
        assert seen["robot_boxy::proprio"].shape == (worlds, 42)
        assert seen["prompt"] == ["pick up the bowl"] * worlds


@pytest.mark.parametrize("spoken", sorted(DIALECTS))
def test_another_dialect_is_named(spoken: str) -> None:
    asked = "behavior" if spoken == "openpi" else "openpi"
    told = refused(said=f"speaks {spoken}, not {asked}")
    with serving(Constant(), spoken) as server, told:
        Connection(address(server.port, asked)).greet()


@pytest.mark.parametrize(
    ("answer", "spoken"),
    [
        (np.zeros((1, 13), np.float32), "roboarena"),
        ({"action": np.zeros(13, np.float32)}, "behavior"),
    ],
)
def test_a_dialect_is_known_by_its_answers(answer: object, spoken: str) -> None:
    def handle(connection: ServerConnection) -> None:
        connection.send(pack({}))
        connection.recv()
        connection.send(pack(answer))

    with (
        scripted(handle) as port,
        refused(said=f"speaks {spoken}, not openpi"),
    ):
        Connection(address(port)).ask([an_ask()], True)


def test_no_server_and_no_policy_server_are_told() -> None:
    with free_socket("127.0.0.1", 0) as listening:
        port = listening.getsockname()[1]
    with refused(said="no policy server at"):
        Connection(address(port)).greet()
    with refused(said=f"no policy server at ws://127.0.0.1:{port}/path ") as told:
        Connection(Address(f"ws://me:secret@127.0.0.1:{port}/path")).greet()
    assert "secret" not in str(told.value) and f"--port {port}." in str(told.value)
    for greeting, message in (
        ("hello, I speak JSON", "it says hello"),
        (b"\xc1\xc1", "no msgpack message"),
    ):

        def greet(connection: ServerConnection, greeting: str | bytes = greeting) -> None:
            connection.send(greeting)

        with scripted(greet) as port, refused(where="ws://", said=message):
            Connection(address(port)).greet()


def test_late_answers_errors_and_odd_answers_are_faults() -> None:
    with serving(Constant(delay_s=1.0)) as server:
        connection = Connection(address(server.port))
        with pytest.raises(PolicyFault, match=r"no answer within 0\.3 s"):
            connection.ask([an_ask()], True)
    with serving(Constant(error=RuntimeError("out of memory"))) as server:
        connection = Connection(address(server.port))
        with pytest.raises(
            PolicyFault, match="reports an error: RuntimeError: out of memory"
        ):
            connection.ask([an_ask()], True)
    for answer in (
        b"\xc1",
        pack([1]),
        pack({"actions": "left"}),
        pack({"actions": np.zeros(0)}),
    ):

        def handle(connection: ServerConnection, answer: bytes = answer) -> None:
            connection.send(pack({}))
            connection.recv()
            connection.send(answer)

        with scripted(handle) as port, pytest.raises(PolicyFault):
            Connection(address(port)).ask([an_ask()], True)


def test_an_answer_that_comes_twice_is_not_taken_for_the_next() -> None:
    requests = iter(range(10))

    def handle(connection: ServerConnection) -> None:
        connection.send(pack({}))
        for _ in connection:
            number = next(requests)
            answer = pack({"actions": np.full((1, 13), number, np.float32)})
            for _ in range(2 if number == 1 else 1):
                connection.send(answer)

    with scripted(handle) as port:
        connection = Connection(address(port))
        assert [connection.ask([an_ask()], False).max() for _ in range(2)] == [0, 1]
        assert connection._socket is not None
        # What was sent before the pong has come.
        assert connection._socket.ping().wait(5.0)
        with pytest.raises(PolicyFault, match="no request asked for, such as an answer"):
            connection.ask([an_ask()], False)
        assert connection.ask([an_ask()], False).max() == 2
        connection.close()


def test_a_late_answer_is_not_taken_for_the_next() -> None:
    asked = threading.Event()
    requests = iter(range(10))

    def handle(connection: ServerConnection) -> None:
        connection.send(pack({}))
        with suppress(ConnectionClosed):
            for _ in connection:
                number = next(requests)
                if number == 0:
                    asked.wait(5.0)
                connection.send(pack({"actions": np.full((1, 13), number, np.float32)}))

    with scripted(handle) as port:
        connection = Connection(address(port))
        with pytest.raises(PolicyFault, match="no answer within"):
            connection.ask([an_ask()], False)
        asked.set()
        assert connection.ask([an_ask()], False).max() == 1
        connection.close()


@pytest.mark.parametrize("step", [4, 5])
def test_an_answer_for_an_earlier_step_is_to_another_request(step: int) -> None:
    def handle(connection: ServerConnection) -> None:
        connection.send(pack({}))
        connection.recv()
        connection.send(pack({"actions": np.zeros((1, 13), np.float32), "step": step}))

    timing = {"step": 5, "hz": 20.0, "delay": 1}
    ask = dataclasses.replace(an_ask(), timing=timing)
    with scripted(handle) as port:
        connection = Connection(address(port))
        if step == 5:
            connection.ask([ask], False)
            assert connection.first_step == step
        else:
            with pytest.raises(PolicyFault, match=r"for control step 4, before .* 5"):
                connection.ask([ask], False)
        connection.close()


@pytest.mark.parametrize("dialect", sorted(DIALECTS))
def test_a_server_that_comes_back_is_found_again(dialect: str) -> None:
    with serving(Constant(), dialect) as server:
        connection = Connection(address(server.port, dialect, reconnect=1.0))
        connection.ask([an_ask()], True)
        port = server.port
    policy = Constant(np.ones((4, 13)))
    with serving(policy, dialect, ServerOptions(port=port)):
        if DIALECTS[dialect].remembers:
            # What the server knew of the running episode is gone.
            with pytest.raises(PolicyFault, match="lost in the middle of the episode"):
                connection.ask([an_ask()], False)
            assert connection.ask([an_ask()], True).all()
        else:
            assert connection.ask([an_ask()], False).all()
        connection.close()
    with pytest.raises(PolicyFault, match="no policy server"):
        connection.ask([an_ask()], True)


def test_only_the_token_opens_a_server(monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(Constant(), options=ServerOptions(port=0, token="secret")) as server:
        with refused(said=TOKEN_VARIABLE):
            Connection(address(server.port)).greet()
        monkeypatch.setenv(TOKEN_VARIABLE, "wrong")
        with refused(said="wants a token"):
            Connection(address(server.port)).greet()
        monkeypatch.setenv(TOKEN_VARIABLE, "secret")
        connection = Connection(address(server.port))
        assert connection.ask([an_ask()], True).shape == (1, 4, 13)
        connection.close()
        with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/healthz") as answer:
            assert answer.read() == b"OK\n"
    with refused(said="needs a token"):
        PolicyServer(Constant(), DIALECTS["openpi"], ServerOptions("0.0.0.0", 0))


def test_a_port_in_use_gives_way_to_the_next() -> None:
    with serving(Constant()) as first:
        taken = ServerOptions(port=first.port)
        with serving(Constant(), options=taken) as second:
            assert second.port > first.port


def malformed(random: np.random.Generator) -> bytes | str:
    """A message that is broken in one of many ways."""
    good = bytearray(
        pack({"observation/state": np.zeros(42, np.float32), "endpoint": "infer"})
    )
    choice = int(random.integers(6))
    if choice == 0:
        return random.bytes(int(random.integers(0, 300)))
    if choice == 1:
        return bytes(good[: int(random.integers(len(good)))])
    if choice == 2:
        for place in random.integers(len(good), size=5).tolist():
            good[place] = int(random.integers(256))
        return bytes(good)
    if choice == 3:
        return "a text " * int(random.integers(1, 20))
    if choice == 4:
        values = [7, [1, 2], "infer", None, {"endpoint": 3}, {"reset": 1}, {b"x": {}}]
        return pack(values[int(random.integers(len(values)))])
    return b"\x81" * int(random.integers(1, 3000))


@pytest.mark.parametrize("dialect", sorted(DIALECTS))
def test_no_malformed_message_stops_the_server(dialect: str) -> None:
    random = np.random.default_rng(1)
    with serving(
        Constant(), dialect, ServerOptions(port=0, max_message_bytes=1 << 16)
    ) as server:
        uri = f"ws://127.0.0.1:{server.port}"
        for _ in range(200):
            with connect(
                uri, compression=None, proxy=None, close_timeout=0.1
            ) as stranger:
                stranger.recv(5.0)
                with suppress(TimeoutError, ConnectionClosed):
                    stranger.send(malformed(random))
                    stranger.recv(0.02)
        with connect(uri, compression=None, proxy=None) as stranger:
            stranger.recv(5.0)
            stranger.send(b"\0" * (1 << 17))
            with pytest.raises(ConnectionClosed):
                stranger.recv(5.0)
        connection = Connection(
            address(server.port, dialect, timeout=5.0, first_timeout=5.0)
        )
        assert connection.ask([an_ask(image=False)], True).shape == (1, 4, 13)
        connection.close()


@pytest.mark.parametrize("dialect", sorted(DIALECTS))
def test_no_malformed_answer_stops_the_client(dialect: str) -> None:
    random = np.random.default_rng(2)

    def handle(connection: ServerConnection) -> None:
        connection.send(pack(DIALECTS[dialect].greeting({"dialect": dialect})))
        for message in connection:
            asked = unpack(message) if isinstance(message, bytes) else {}
            if dialect in ("behavior", "lerobot") and "reset" in asked:
                continue
            connection.send(malformed(random))

    outcomes = []
    with scripted(handle) as port:
        connection = Connection(address(port, dialect))
        for _ in range(200):
            try:
                connection.ask([an_ask(image=False)], True)
                outcomes.append("answer")
            except (PolicyFault, UsageError) as error:
                outcomes.append(type(error).__name__)
        connection.close()
    assert len(outcomes) == 200 and outcomes.count("PolicyFault") > 150
