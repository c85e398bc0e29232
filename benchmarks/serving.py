"""What a policy behind a websocket costs, and what happens when its server is killed."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.command import run_command
from mjhab.cli.output import Listing, report
from mjhab.evaluation.resolve import resolve_policy
from mjhab.robots.registry import DEFAULT_ROBOT
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import ACTION_SIZE, RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink, StepView
from mjhab.serving import require_serving
from mjhab.serving.address import Address
from mjhab.serving.dialects.dialect import Ask
from mjhab.serving.dialects.names import DIALECTS
from mjhab.tasks.subtasks.registry import limits_of

IMAGE_SIZE_PX = 224
WARM_UP = 10
"""Requests before the clock starts."""
MAX_ADDED_MS = 5.0
"""Most that a request of one world may add to a control step."""


@dataclass(frozen=True)
class ServingSpec:
    """Measure the latency of a served policy, and the effect on episodes when its server is killed.

    Fails if an episode is lost, or if a request with two images takes more than 5 ms on this machine.
    """

    worlds: int = 8
    """Number of worlds that send requests in parallel."""
    requests: int = 200
    """Number of timed requests per dialect."""
    steps: int = 1000
    """Control steps with a server that is killed; episodes are finished."""
    restarts: int = 2
    """Number of times the server is killed and started again."""
    json: bool = False
    """Print one line of JSON instead of tables."""


class Still:
    """A policy that sends zeros at once; see `serving.server.Responder` and `Session`."""

    def metadata(self) -> Mapping[str, Any]:
        """Its name."""
        return {"policy": "still"}

    def session(self) -> Still:
        """Itself: it keeps nothing."""
        return self

    def reset(self) -> None:
        """Nothing to forget."""

    def infer(self, request: Mapping[str, Any], batch: int | None) -> np.ndarray:
        """Zeros (B, 1, A)."""
        return np.zeros((batch or 1, 1, ACTION_SIZE), np.float32)

    def close(self) -> None:
        """Nothing to free."""


def serve_still(dialect: str, port: int) -> None:
    """Serve `Still` on a port for ever; in a process of its own."""
    from mjhab.serving.server import PolicyServer, ServerOptions

    server = PolicyServer(Still(), DIALECTS[dialect], ServerOptions(port=port))
    print(server.port, flush=True)
    server.run()


class StillServer:
    """`Still` in a process of its own, which can be killed and started again on the same port."""

    def __init__(self, dialect: str) -> None:
        self._dialect = dialect
        self._process = self._start(0)
        assert self._process.stdout is not None
        self.port = int(self._process.stdout.readline())

    def restart(self) -> None:
        """Kill the process, and start another one."""
        self.kill()
        self._process = self._start(self.port)

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()
        # Its port is free only when the process is gone.
        self._process.wait()

    def _start(self, port: int) -> subprocess.Popen[str]:
        code = f"from benchmarks.serving import serve_still; serve_still({self._dialect!r}, {port})"
        return subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
        )


class Killer(Sink[RolloutEnv]):
    """Restarts a server at some of the control steps of a rollout."""

    def __init__(self, server: StillServer, steps: list[int]) -> None:
        self._server = server
        self._steps = steps
        self.taken = 0

    def on_step(self, env: RolloutEnv, step: StepView) -> None:
        """Count, and restart when it is time."""
        self.taken += 1
        if self.taken in self._steps:
            self._server.restart()


def measure_serving(spec: ServingSpec) -> dict[str, Any]:
    """What requests cost, and what becomes of episodes whose server is killed.

    Returns:
        "requests": `measure_requests` by dialect and number of worlds; "restarted": `measure_restarts`; "slowest_ms":
        the largest median of one world; "lost": episodes that have no record.
    """
    require_serving()
    requests: dict[str, dict[str, float]] = {}
    slowest = 0.0
    for dialect in DIALECTS:
        for worlds in (1, spec.worlds):
            name = f"{dialect}, {worlds} world{'s' if worlds > 1 else ''}"
            requests[name] = measure_requests(dialect, worlds, spec.requests)
        # The median, as other processes can delay single requests.
        slowest = max(slowest, requests[f"{dialect}, 1 world"]["p50"])
    restarted = measure_restarts(spec)
    lost = restarted["episodes"] - restarted["finished"] - restarted["marked"]
    return {
        "requests": requests,
        "restarted": restarted,
        "slowest_ms": slowest,
        "lost": lost,
    }


def measure_requests(dialect: str, worlds: int, requests: int) -> dict[str, float]:
    """Median and 99th percentile [ms] of how long it takes until all worlds have their actions."""
    from mjhab.serving.client import Connection

    server = StillServer(dialect)
    try:
        address = Address(f"ws://127.0.0.1:{server.port}", dialect)
        connections = [Connection(address) for _ in range(worlds)]
        ask = _ask()
        with ThreadPoolExecutor(worlds) as pool:

            def step() -> None:
                # A list, because map of a pool tells errors only when it is read.
                list(
                    pool.map(lambda connection: connection.ask([ask], False), connections)
                )

            for connection in connections:
                # The first request of an episode is another one, and is not timed.
                connection.ask([ask], True)
            times = _timed(step, requests)
        for connection in connections:
            connection.close()
    finally:
        server.kill()
    p50, p99 = np.percentile(times, [50, 99])
    return {"p50": round(float(p50), 3), "p99": round(float(p99), 3)}


def _timed(step: Callable[[], None], count: int) -> list[float]:
    for _ in range(WARM_UP):
        step()
    times = []
    for _ in range(count):
        begun = time.perf_counter()
        step()
        times.append(1e3 * (time.perf_counter() - begun))
    return times


def _ask() -> Ask:
    random = np.random.default_rng(0)
    shape = (IMAGE_SIZE_PX, IMAGE_SIZE_PX, 3)
    head, hand = (random.integers(0, 256, shape, np.uint8) for _ in range(2))
    return Ask(
        robot=DEFAULT_ROBOT,
        cameras=("external", "wrist"),
        external=head,
        wrist=hand,
        state=np.zeros(42, np.float32),
        arm=np.zeros(7, np.float32),
        gripper=0.0,
        tcp=np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]),
        prompt="pick up the bowl",
        session="bench",
        chunk=1,
    )


def measure_restarts(spec: ServingSpec) -> dict[str, Any]:
    """Roll out in many worlds against one server that is killed now and then; what became of the episodes."""
    from mjhab.envs import make

    env = make(
        task="set_table", subtask="close", num_envs=spec.worlds, autoreset="disabled"
    )
    server = StillServer("openpi")
    every = spec.steps // (spec.restarts + 1)
    killer = Killer(server, [every * (k + 1) for k in range(spec.restarts)])
    try:
        # To reconnect may take longer than a restart, or episodes would be lost for another reason.
        address = f"ws://127.0.0.1:{server.port}?execute=1&timeout=10&reconnect=60"
        policy = resolve_policy(address, env)
        horizon = limits_of(env.task_config, "close").horizon
        count = -(-spec.steps // horizon) * spec.worlds
        records: list[EpisodeRecord] = rollout(env, policy, range(count), 0, [killer])
    finally:
        server.kill()
        env.close()
    marked = sum(bool(record.error) for record in records)
    return {
        "worlds": spec.worlds,
        "steps": killer.taken,
        "restarts": spec.restarts,
        "episodes": count,
        "finished": len(records) - marked,
        "marked": marked,
    }


def bench_serving(spec: ServingSpec) -> int:
    """Print request latencies and results of episodes; returns 1 if an episode was lost or requests are too slow."""
    found = measure_serving(spec)
    rows = [(name, cost["p50"], cost["p99"]) for name, cost in found["requests"].items()]
    title = f"A request with two images of {IMAGE_SIZE_PX} px [ms]"
    killed = list(found["restarted"].items())
    report(
        spec.json,
        found,
        Listing(title, ("dialect", "median", "99 %"), rows),
        Listing("A server that is killed", ("what", "value"), killed),
    )
    return 1 if found["lost"] or found["slowest_ms"] > MAX_ADDED_MS else 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command(
        "serving",
        ServingSpec,
        bench_serving,
        words,
        {"worlds": 1, "steps": 1, "requests": 1},
    )


if __name__ == "__main__":
    sys.exit(main())
