"""Servers that take long: none of their answers is lost, none is taken for absent. Seconds stand for minutes."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection

import mjhab.serving.client as client
import mjhab.serving.patience as patience
from mjhab.serving.address import Address
from mjhab.serving.client import Connection, PolicyFault
from mjhab.serving.dialects.dialect import RESET_DONE
from mjhab.serving.dialects.names import DIALECTS
from mjhab.serving.packing import pack, unpack
from mjhab.serving.patience import Patience
from mjhab.serving.server import ServerOptions, free_socket
from tests.refusals import refused
from tests.serving.blocking import Blocking, blocking
from tests.serving.constant import Constant, an_ask, serving
from tests.serving.test_ends import scripted

WAITS = {"timeout": 0.6, "first_timeout": 15.0, "reconnect": 0.3}


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Waits that nobody chose are as short as those of the addresses here."""
    monkeypatch.setattr(client, "LOOK_S", 0.1)
    for module in (client, patience):
        monkeypatch.setattr(module, "GREETING_TIMEOUT_S", 0.2)


def address(port: int, dialect: str = "openpi", **options: Any) -> Address:
    return Address(f"ws://127.0.0.1:{port}", dialect, **{**WAITS, **options})


def answers(server: Blocking, worlds: int, rounds: int, **options: Any) -> list[str]:
    """What befalls worlds that ask a server at the same time, ``rounds`` times each: "" where all is answered."""
    at = address(server.port, server.dialect, **options)
    shared = Patience(at)
    connections = [Connection(at, shared) for _ in range(1 if at.batch else worlds)]
    faults = [""] * len(connections)
    asks = [an_ask(image=False)] * (worlds if at.batch else 1)

    def ask(k: int) -> None:
        try:
            for step in range(rounds):
                assert connections[k].ask(asks, step == 0).shape == (len(asks), 4, 13)
        except PolicyFault as error:
            faults[k] = str(error)

    connections[0].greet()
    with ThreadPoolExecutor(len(connections)) as pool:
        list(pool.map(ask, range(len(connections))))
    for connection in connections:
        connection.close()
    return faults


@pytest.mark.parametrize("dialect", sorted(DIALECTS))
def test_a_long_first_answer_loses_nothing(dialect: str) -> None:
    with blocking(Blocking(dialect, first_s=2.0)) as server:
        assert answers(server, worlds=4, rounds=2) == [""] * 4


@pytest.mark.parametrize("dialect", sorted(DIALECTS))
def test_many_worlds_may_take_as_many_times_as_long(dialect: str) -> None:
    with blocking(Blocking(dialect, first_s=0.1, each_s=0.15)) as server:
        assert answers(server, worlds=6, rounds=2) == [""] * 6


def test_a_batch_may_take_as_many_times_as_long_as_it_has_worlds() -> None:
    with blocking(Blocking("behavior", first_s=2.0, each_s=1.2)) as server:
        assert answers(server, worlds=8, rounds=2, batch=True) == [""]


@pytest.mark.parametrize("dialect", sorted(DIALECTS))
def test_a_server_that_missed_our_pongs_goes_on_with_the_episode(dialect: str) -> None:
    """Servers of asyncio close the connection when they come to look after a long inference: the process lives."""
    spoken = DIALECTS[dialect]
    resets = []

    def handle(connection: ServerConnection) -> None:
        greeting = spoken.greeting({})
        del greeting["mjhab"]
        connection.send(pack(greeting))
        for message in connection:
            assert isinstance(message, bytes)
            incoming = spoken.read(unpack(message))
            if incoming.reset:
                resets.append(incoming)
                if spoken.begin_answered:
                    connection.send(RESET_DONE)
                continue
            connection.send(pack(spoken.answer(np.zeros((1, 4, 13)), incoming, 0.0)))
            connection.close(1011, "keepalive ping timeout")

    with scripted(handle) as port:
        connection = Connection(address(port, dialect))
        for step in range(4):
            connection.ask([an_ask(image=False)], step == 0)
        connection.close()
    assert len(resets) == (1 if spoken.remembers else 0)


class _Planning(Constant):
    """Each answer but the first takes long; pings are answered."""

    def infer(self, request: Mapping[str, Any], batch: int | None) -> np.ndarray:
        self.delay_s = 2.0 if self.seen else 0.0
        return super().infer(request, batch)


@pytest.mark.parametrize("dialect", sorted(DIALECTS))
def test_long_planning_of_a_server_of_mjhab_is_waited_for(dialect: str) -> None:
    with serving(_Planning(), dialect) as server:
        connection = Connection(address(server.port, dialect))
        for step in range(2):
            assert connection.ask([an_ask(image=False)], step == 0).any() is not None
        connection.close()


def test_a_stuck_server_ends_the_wait() -> None:
    def handle(connection: ServerConnection) -> None:
        connection.send(pack({}))
        with suppress(ConnectionClosed):
            connection.recv()
            connection.send(pack({"actions": np.zeros((1, 13))}))
            time.sleep(3.0)

    with scripted(handle) as port:
        connection = Connection(address(port))
        connection.ask([an_ask(image=False)], True)
        begun = time.monotonic()
        with pytest.raises(PolicyFault, match=r"no answer within 0\.6 s"):
            connection.ask([an_ask(image=False)], False)
        assert time.monotonic() - begun < 3.0


def test_a_busy_server_is_not_no_server(capsys: pytest.CaptureFixture[str]) -> None:
    with free_socket("127.0.0.1", 0) as listening:
        port = listening.getsockname()[1]
        with refused(said="says nothing for 0.7 s") as told:
            Connection(address(port, first_timeout=0.7)).greet()
        assert "no policy server at" not in str(told.value)
        assert "--first-timeout" in str(told.value)
        assert "has not greeted" in capsys.readouterr().err


def test_a_server_that_begins_later_is_waited_for_before_its_first_answer() -> None:
    with serving(Constant()) as server:
        port = server.port
        connection = Connection(address(port))
        connection.greet()
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(connection.ask, [an_ask(image=False)], True)
        # Longer than --reconnect.
        time.sleep(1.0)
        with serving(Constant(), options=ServerOptions(port=port)):
            assert asked.result(10.0).shape == (1, 4, 13)
            connection.close()


def test_a_message_that_is_never_read_ends_the_wait() -> None:
    let_go = threading.Event()

    def silent() -> None:
        with free_socket("127.0.0.1", 0) as listening:
            ports.append(listening.getsockname()[1])
            known.set()
            line, _ = listening.accept()
            asked = line.recv(1 << 16).decode()
            key = next(r for r in asked.splitlines() if r.startswith("Sec-WebSocket-Key"))
            from websockets.utils import accept_key

            reply = accept_key(key.partition(": ")[2])
            line.sendall(
                b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                + f"Sec-WebSocket-Accept: {reply}\r\n\r\n".encode()
            )
            greeting = pack({})
            line.sendall(bytes([0x82, len(greeting)]) + greeting)
            listening.close()
            let_go.wait(20.0)
            line.close()

    ports: list[int] = []
    known = threading.Event()
    thread = threading.Thread(target=silent, daemon=True)
    thread.start()
    known.wait(5.0)
    at = address(ports[0], "behavior", first_timeout=0.6, batch=True)
    connection = Connection(at)
    connection.greet()
    large = an_ask(image=False)
    object.__setattr__(large, "external", np.zeros((4000, 4000, 3), np.uint8))
    with pytest.raises(PolicyFault):
        connection.ask([large], True)
    let_go.set()
    thread.join(5.0)
