"""Policies that think while the world goes on: when their actions are executed, and what acts meanwhile."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from mjhab.evaluation.parts import close_policy, requests_of
from mjhab.evaluation.resolve import PolicyOptions, inspect_policy, resolve_policy
from mjhab.evaluation.served.real_time import Pace
from mjhab.evaluation.served.twin import TwinResponder
from mjhab.rollout.loop import rollout
from mjhab.serving.address import Address
from mjhab.serving.dialects.dialect import Incoming
from mjhab.serving.dialects.names import DIALECTS
from mjhab.serving.dialects.openpi import OpenPi
from tests.evaluation.served.test_policy import spec, world
from tests.refusals import refused
from tests.serving.constant import Constant, serving

UNIT = 0.001
"""Number of a control step in an action."""
TORSO = 10
"""Column of the actions that tells the control step."""
LENGTH = 8
LATER = 3
"""Control steps from an observation to the first action of a server that plans for later."""


class Counting(Constant):
    """Sends chunks whose actions tell the control step that they are for."""

    def infer(self, request: Mapping[str, Any], batch: int | None) -> np.ndarray:
        super().infer(request, batch)
        chunk = np.zeros((1, LENGTH, 13), np.float32)
        chunk[0, :, TORSO] = UNIT * (request["real_time"]["step"] + np.arange(LENGTH) + 1)
        return chunk


class Executed:
    """Keeps the actions of world 0."""

    def __init__(self, policy: Any) -> None:
        self.policy = policy
        self.name = policy.name
        self.actions: list[np.ndarray] = []
        self.late = 0

    def reset(self, mask: np.ndarray) -> None:
        self.policy.reset(mask)

    def fault(self, world: int) -> str:
        return self.policy.fault(world)

    def act(self, obs: Any, info: Any) -> np.ndarray:
        actions = self.policy.act(obs, info)
        self.actions.append(actions[0].copy())
        return actions

    @property
    def told(self) -> list[int]:
        return [round(float(action[TORSO]) / UNIT) for action in self.actions]


@pytest.fixture(scope="module")
def env() -> Any:
    made = world(num_envs=1, obs_mode="state")
    yield made
    made.close()


def played(env: Any, options: str, steps: int = 14, policy: Any = None) -> Executed:
    """What is executed of a server whose actions tell their control steps."""
    with serving(policy or Counting()) as server:
        served = Executed(
            resolve_policy(spec(server.port, f"&real_time=yes{options}"), env)
        )
        (record,) = rollout(env, served, [0], seed=0, max_steps=steps)
        served.late = requests_of(served.policy)["late_steps"]
        close_policy(served.policy)
    assert not record.error
    return served


@pytest.mark.parametrize(
    ("options", "told"),
    [
        # Two steps of 50 ms: every action is executed in its control step; asked again after three of them.
        ("&latency_ms=100&execute=3", [0, 0, *range(3, 15)]),
        ("&latency_ms=0&execute=3", [*range(1, 15)]),
        # The answer is there when the robot has executed what it had: then it stands still.
        ("&latency_ms=100&execute=8", [0, 0, 3, 4, 5, 6, 7, 8, 0, 0, 11, 12, 13, 14]),
        # 10 steps per second: 100 ms are one step.
        (
            "&latency_ms=100&execute=8&hz=10",
            [0, 2, 3, 4, 5, 6, 7, 8, 0, 10, 11, 12, 13, 14],
        ),
        (
            "&latency_ms=100&execute=4&meanwhile=still",
            [0, 0, 1, 2, 3, 4, 0, 0, 7, 8, 9, 10, 0, 0],
        ),
        (
            "&latency_ms=100&execute=4&meanwhile=last",
            [0, 0, 1, 2, 3, 4, 4, 4, 7, 8, 9, 10, 10, 10],
        ),
    ],
)
def test_what_is_executed_while_the_policy_thinks(
    env: Any, options: str, told: list[int]
) -> None:
    served = played(env, options)
    assert served.told == told
    waits = "last" in options
    late = [
        step
        for step, now in enumerate(told)
        if not now or (waits and now == told[step - 1])
    ]
    assert served.late == len(late)


def test_the_hand_holds_on_while_the_robot_stands_still(env: Any) -> None:
    policy = Constant(np.full((2, 13), 0.5))
    served = played(env, "&latency_ms=50&execute=2&meanwhile=still", 5, policy)
    gripper = [entry.name for entry in env.action_table].index("gripper")
    actions = np.stack(served.actions)
    still = [0, 3]
    assert not np.delete(actions[still], gripper, axis=1).any()
    opened = float(np.mean(env.state.robot_q[0, env.layout.robot.columns.fingers]))
    assert -1.0 <= actions[0, gripper] <= 1.0 and opened >= 0.0
    assert actions[3, gripper] == 0.5


def test_a_server_may_say_which_step_its_first_action_is_for(
    env: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Ahead(Counting):
        def infer(self, request: Mapping[str, Any], batch: int | None) -> np.ndarray:
            timing = request["real_time"]
            assert timing["hz"] == 20.0 and timing["delay"] == 2
            return super().infer(request, batch)[:, LATER:]

    steps: list[int] = []

    class Saying(OpenPi):
        def answer(self, chunks: np.ndarray, incoming: Incoming, infer_ms: float) -> Any:
            said = steps[0] if steps else incoming.request["real_time"]["step"] + LATER
            return {**super().answer(chunks, incoming, infer_ms), "step": said}

    monkeypatch.setitem(DIALECTS, "openpi", Saying())
    with serving(Ahead()) as server:
        address = spec(server.port, "&real_time=yes&latency_ms=100&execute=3")
        served = Executed(resolve_policy(address, env))
        rollout(env, served, [0], seed=0, max_steps=12)
        steps.append(-1)
        (record,) = rollout(env, served.policy, [0], seed=0, max_steps=3)
        close_policy(served.policy)
    # Answers of five actions wait for their step; until then the chunk before goes on, as far as it reaches.
    assert served.told == [0, 0, 0, 4, 5, 6, 7, 8, 0, 10, 11, 12]
    assert "'step' is the number of a control step, not -1" in record.error


def test_answers_without_an_action_left_are_told(
    env: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    served = played(env, f"&latency_ms={50 * LENGTH}", 2 * LENGTH)
    assert served.late == 2 * LENGTH
    assert capsys.readouterr().err.count("none is left to execute") == 1


def test_a_measured_answer_is_late_by_what_it_took(env: Any) -> None:
    served = played(env, "&execute=8", 10, Counting(delay_s=0.12))
    # 120 ms and a little: three control steps, or more on a busy machine.
    late = served.told.index(next(told for told in served.told if told))
    assert late >= 3 and served.told[late] == late + 1
    assert requests_of(served.policy)["latency_ms"]["p50"] >= 120


def test_a_student_that_answers_at_once_acts_as_at_home() -> None:
    at_home = "student:set_table/close/kitchen_counter/drawer3"
    with serving(TwinResponder(at_home, PolicyOptions())) as server:
        address = spec(server.port, "&real_time=yes&latency_ms=0&execute=2")
        facts = inspect_policy(address)
        assert facts.identity["real_time"] == {
            "meanwhile": "chunk",
            "hz": 20.0,
            "latency_ms": 0.0,
        }
        env = world(**{**facts.env_options, "target": "kitchen_counter/drawer3"})
        policies = [resolve_policy(name, env) for name in (at_home, address)]
        there, away = (
            rollout(env, policy, [0, 1], seed=0, max_steps=9) for policy in policies
        )
        assert requests_of(policies[1])["late_steps"] == 0
        close_policy(policies[1])
    assert [record.error for record in away] == ["", ""]
    assert [r.final_state for r in away] == [r.final_state for r in there]


@pytest.mark.parametrize(
    ("options", "option"),
    [
        ("latency_ms=80", "latency_ms"),
        ("meanwhile=still", "meanwhile"),
        ("real_time=yes&meanwhile=stil", "meanwhile"),
        ("real_time=yes&latency_ms=-1", "latency_ms"),
        ("real_time=yes&latency_ms=nan", "latency_ms"),
        ("real_time=yes&hz=1e9", "hz"),
        ("real_time=yes&hz=0", "hz"),
        ("real_time=yes&hz=-20", "hz"),
    ],
)
def test_wrong_options_of_time_are_refused(options: str, option: str) -> None:
    with refused(option):
        Address.parse(f"ws://host:1?{options}")


def test_latencies_are_whole_control_steps_rounded_up() -> None:
    steps = {0: 0, 1: 1, 50: 1, 50.1: 2, 400: 8}
    for latency, delay in steps.items():
        assert Pace("chunk", 20.0, latency).delay(1e6) == delay
        assert Pace("chunk", 20.0).delay(latency) == delay
