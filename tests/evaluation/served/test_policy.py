"""Served policies in an environment: what they are sent, what is done with their answers, and what befalls whom."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mjhab.envs as envs
from mjhab.evaluation.parts import close_policy, requests_of
from mjhab.evaluation.resolve import PolicyOptions, inspect_policy, resolve_policy
from mjhab.evaluation.served.action_spaces import space_named
from mjhab.evaluation.served.twin import (
    EpisodeStep,
    ObservationAdapter,
    TwinResponder,
    TwinSession,
)
from mjhab.integrations.lerobot import LeRobotEnv
from mjhab.learning.checkpoint import save_student
from mjhab.learning.configs import InputConfig
from mjhab.learning.observation.spec import observation_spec_of
from mjhab.learning.students.heads import make_student
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import Selective, ZeroPolicy
from mjhab.serving.dialects.names import DIALECTS
from mjhab.serving.dialects.openpi import OpenPi
from mjhab.serving.server import ServerOptions
from tests.learning.small import config
from tests.refusals import refused
from tests.serving.constant import Constant, serving

STEPS = 8


def world(**options: Any) -> Any:
    defaults = {"task": "set_table", "subtask": "close", "num_envs": 2, "threads": 1}
    return envs.make(autoreset="disabled", **{**defaults, **options})


def spec(port: int, options: str = "") -> str:
    return f"ws://127.0.0.1:{port}?timeout=30&first_timeout=60&reconnect=5{options}"


class Whimsical(Constant):
    """Sends to every other session what is no action, after two good chunks."""

    def __init__(self, bad: Any) -> None:
        super().__init__(np.zeros((1, 13)))
        self.bad = bad

    def session(self) -> Any:
        self.sessions += 1
        return _Mood(self, self.sessions % 2 == 0)


class _Mood:
    def __init__(self, policy: Whimsical, spoils: bool) -> None:
        self.policy = policy
        self.spoils = spoils
        self.asked = 0

    def infer(self, request: Mapping[str, Any], batch: int | None) -> np.ndarray:
        self.asked += 1
        good = self.policy.infer(request, batch)
        return (
            np.asarray(self.policy.bad)[None] if self.spoils and self.asked > 2 else good
        )

    def reset(self) -> None:
        pass

    def close(self) -> None:
        pass


@pytest.mark.parametrize(
    ("bad", "error"),
    [
        (np.full((1, 13), np.nan), "has nan for shoulder_pan_joint"),
        (np.zeros((1, 7)), "actions have 7 numbers, not 13"),
    ],
    ids=["nan", "size"],
)
def test_a_wrong_answer_ends_its_episode_alone(bad: np.ndarray, error: str) -> None:
    policy = Whimsical(bad)
    with serving(policy) as server:
        env = world()
        served = resolve_policy(spec(server.port, "&execute=1"), env)
        records = rollout(env, served, [0, 1], seed=0, max_steps=STEPS)
        served.close()  # type: ignore[attr-defined]
    # The first connection is that of world 0.
    assert [record.steps for record in records] == [STEPS, 3]
    assert not records[0].error and error in records[1].error
    assert not records[1].success_once


def test_a_served_policy_of_a_policies_file_fails_alone(tmp_path: Path) -> None:
    path = tmp_path / "policies.json"
    with serving(Whimsical(np.full((1, 13), np.nan))) as server:
        address = spec(server.port, "&execute=1&prompt=task")
        entries = [{"subtask": "close", "target": "", "checkpoint": address}]
        path.write_text(json.dumps({"policies": entries}), encoding="utf-8")
        env = world()
        policy = resolve_policy(str(path), env)
        records = rollout(env, policy, [0, 1], seed=0, max_steps=STEPS)
        assert requests_of(policy)["latency_ms"]["p50"] > 0
        assert requests_of(policy)["out_of_range"] == {}
        close_policy(policy)
    assert [record.steps for record in records] == [STEPS, 3]
    assert not records[0].error and "has nan for" in records[1].error


def test_a_served_policy_is_asked_for_the_worlds_of_its_subtask_alone() -> None:
    policy = Constant(np.full((1, 13), 0.5))
    with serving(policy) as server:
        env = world()
        served = resolve_policy(spec(server.port, "&execute=1&prompt=task"), env)
        assert isinstance(served, Selective)
        obs, info = env.reset(seed=0)
        served.reset(np.ones(2, bool))
        first, _ = info["episode_spec"]
        told = {**info, "episode_spec": [first, None]}
        actions = served.act_in(obs, told, np.array([True, False]))
        close_policy(served)
    assert actions[0].any() and not actions[1].any()


def test_a_policy_sees_images_state_and_the_instruction_and_its_chunks_are_executed() -> (
    None
):
    chunk = np.linspace(-0.3, 0.3, 4 * 9).reshape(4, 9)
    policy = Constant(chunk)
    with serving(policy) as server:
        address = spec(server.port, "&execute=3&actions=ee&prompt=task")
        facts = inspect_policy(address)
        assert facts.env_options["control_mode"] == "pd_ee_delta_pose"
        env = world(num_envs=1, **{**facts.env_options, "camera_size": 16})
        served = resolve_policy(address, env)
        obs, info = env.reset(
            seed=0, options={"episode": [0], "reset_mask": np.ones(1, bool)}
        )
        served.reset(np.ones(1, bool))
        acted = np.stack([served.act(obs, info)[0] for _ in range(6)])
        served.close()  # type: ignore[attr-defined]
        told = resolve_policy(address, env, PolicyOptions(instruction="shut the drawer"))
        told.reset(np.ones(1, bool))
        told.act(obs, info)
        told.close()  # type: ignore[attr-defined]
    assert len(policy.seen) == 3
    names = [entry.name for entry in env.action_table]
    sent = [
        "ee_x",
        "ee_y",
        "ee_z",
        "ee_rx",
        "ee_ry",
        "ee_rz",
        "gripper",
        "base_forward",
        "base_yaw",
    ]
    columns = [names.index(name) for name in sent]
    np.testing.assert_allclose(
        acted[:, columns], np.concatenate([chunk[:3]] * 2), rtol=1e-6
    )
    assert not np.delete(acted, columns, axis=1).any()
    request = policy.seen[0]
    np.testing.assert_array_equal(
        request["observation/image"], obs["sensor_data/fetch_head/rgb"][0]
    )
    np.testing.assert_array_equal(
        request["observation/wrist_image"], obs["sensor_data/fetch_hand/rgb"][0]
    )
    np.testing.assert_array_equal(request["observation/state"], obs["state"][0])
    assert request["prompt"] == info["episode_spec"][0]["instruction"]
    assert policy.seen[-1]["prompt"] == "shut the drawer"


def test_what_roboarena_is_sent_is_what_its_keys_mean() -> None:
    """docs/serving.md, key by key, each by a formula of its own."""
    policy = Constant(np.zeros((1, 13)))
    with serving(policy, "roboarena") as server:
        address = spec(server.port, "&dialect=roboarena&execute=1")
        env = world(num_envs=2, obs_mode="rgb", camera_size=16)
        served = resolve_policy(address, env)
        obs, info = env.reset(seed=0)
        served.reset(np.ones(2, bool))
        served.act(obs, info)
        close_policy(served)
    model = env.layout.robot
    bodies = env.sim.addresses.robot_body
    order = sorted(policy.seen, key=lambda seen: seen["observation/state"].tolist())
    worlds = sorted(range(2), key=lambda w: obs["state"][w].tolist())
    for seen, w in zip(order, worlds, strict=True):
        base, hand = bodies[model.base_link], bodies[model.tcp]
        base_turn, hand_turn = (
            Rotation.from_matrix(env.state.body_mat[w, body]) for body in (base, hand)
        )
        way = env.state.body_pos[w, hand] - env.state.body_pos[w, base]
        place = base_turn.inv().apply(way)
        turn = base_turn.inv() * hand_turn
        sent = seen["observation/cartesian_position"].astype(float)
        np.testing.assert_allclose(sent[:3], place, atol=1e-5)
        apart = Rotation.from_euler("xyz", sent[3:]) * turn.inv()
        assert apart.magnitude() < 1e-4
        q = env.state.robot_q[w]
        arm = [q[model.joints.index(name)] for name in model.group("arm")]
        np.testing.assert_allclose(seen["observation/joint_position"], arm, rtol=1e-6)
        fingers = [q[model.joints.index(name)] for name in model.group("fingers")]
        closed = 1.0 - np.mean(fingers) / 0.05
        np.testing.assert_allclose(
            seen["observation/gripper_position"], [closed], atol=1e-6
        )
        assert isinstance(seen["session_id"], str)
    assert len({seen["session_id"] for seen in policy.seen}) == 2


@pytest.mark.parametrize(
    ("space", "row", "counted", "told"),
    [
        (
            "joint_position",
            [9.0, 0, 0, 0, 0, 0, 0, 255.0],
            {"shoulder_pan_joint": 2, "gripper": 2},
            "255 for gripper, which goes from 0 to 1",
        ),
        (
            "joint",
            [*[0.0] * 11, 1.5, -1.00001],
            {"base_forward": 2},
            "1.5 for base_forward",
        ),
    ],
)
def test_values_out_of_range_are_told_once_and_counted(
    space: str,
    row: list[float],
    counted: dict[str, int],
    told: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with serving(Constant(np.array([row] * 3))) as server:
        address = spec(server.port, f"&execute=1&actions={space}")
        env = world(num_envs=1, control_mode=space_named(space).control_mode)
        served = resolve_policy(address, env)
        (record,) = rollout(env, served, [0], seed=0, max_steps=2)
        assert requests_of(served)["out_of_range"] == counted
        close_policy(served)
    assert not record.error and record.steps == 2
    said = capsys.readouterr().err
    assert said.count("Values out of range are clipped") == 1 and told in said


def test_joints_that_turn_without_end_are_sent_within_a_turn() -> None:
    with serving(Constant()) as server:
        env = world(num_envs=1)
        served: Any = resolve_policy(spec(server.port), env)
        robot = env.layout.robot
        q = np.zeros(len(robot.joints))
        for name in ("wrist_roll_joint", "forearm_roll_joint"):
            q[robot.joints.index(name)] = 0.25 + 4 * np.pi
        q[robot.joints.index("elbow_flex_joint")] = -2.0
        sent = dict(zip(robot.group("arm"), served._arm_positions(q), strict=True))
        close_policy(served)
    assert sent["wrist_roll_joint"] == sent["forearm_roll_joint"] == np.float32(0.25)
    assert sent["elbow_flex_joint"] == np.float32(-2.0)


def test_the_action_space_of_a_server_is_taken_and_a_wrong_control_mode_refused() -> None:
    with serving(Constant()) as server:
        with refused("control mode", expected="pd_ee_delta_pose"):
            resolve_policy(spec(server.port, "&actions=ee"), world(num_envs=1))
        with refused("action space", "jiont"):
            inspect_policy(spec(server.port, "&actions=jiont"))
        with refused("style", ("speed=0.5",), advice="Give it to its server"):
            options = PolicyOptions(style=("speed=0.5",))
            resolve_policy(spec(server.port), world(num_envs=1), options)


@pytest.mark.parametrize("told", [10, "20", True, float("nan")])
def test_a_server_for_another_rate_of_control_is_refused(
    told: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Slow(OpenPi):
        def greeting(self, own: Mapping[str, Any]) -> Any:
            return {**super().greeting(own), "control_hz": told}

    monkeypatch.setitem(DIALECTS, "openpi", Slow())
    with serving(Constant()) as server:
        with refused("control_hz", expected="20", where="ws://"):
            inspect_policy(spec(server.port))
        with refused("control_hz", expected="20", where="ws://"):
            resolve_policy(spec(server.port), world(num_envs=1))


def test_a_server_that_is_killed_and_started_again_loses_no_episode() -> None:
    env = world()
    policy = Constant(np.zeros((1, 13)))
    episodes = [0, 1, 2, 3]
    with serving(policy) as first:
        port = first.port
        served = resolve_policy(spec(port, "&execute=1"), env)
        some = rollout(env, served, episodes[:2], seed=0, max_steps=STEPS)
    with serving(policy, options=ServerOptions(port=port)):
        more = rollout(env, served, episodes[2:], seed=0, max_steps=STEPS)
    served.close()  # type: ignore[attr-defined]
    records = [*some, *more]
    assert [record.index for record in records] == episodes
    assert all(record.steps == STEPS and not record.error for record in records)


@pytest.mark.parametrize("dialect", ["openpi", "roboarena", "behavior", "lerobot"])
def test_the_expert_acts_over_the_line_as_it_does_at_home(dialect: str) -> None:
    episodes = [0, 1]
    env = world()
    at_home = rollout(env, resolve_policy("expert", env), episodes, seed=0, max_steps=25)
    with serving(TwinResponder("expert", PolicyOptions()), dialect) as server:
        options = f"&dialect={dialect}" + (
            "&batch=yes" if dialect in ("behavior", "lerobot") else ""
        )
        served = resolve_policy(spec(server.port, options), env)
        away = rollout(env, served, episodes, seed=0, max_steps=25)
        served.close()  # type: ignore[attr-defined]
    assert [record.error for record in away] == ["", ""]
    assert [r.final_state for r in away] == [r.final_state for r in at_home]


def test_a_policy_of_lerobot_sees_what_its_data_have() -> None:
    """The keys, sizes and values of the environment of LeRobot, whose names are those of exported data."""

    class Trained(Constant):
        def metadata(self) -> Mapping[str, Any]:
            names = ["fetch_head", "fetch_hand", "empty_camera_0"]
            return {"state": "own", "cameras": names, "image_resolution": [32, 32]}

    policy = Trained()
    with serving(policy, "lerobot") as server:
        address = spec(server.port, "&dialect=lerobot&batch=yes")
        env = world(**inspect_policy(address).env_options, num_envs=1)
        served = resolve_policy(address, env)
        rollout(env, served, [3], seed=0, max_steps=1)
        served.close()  # type: ignore[attr-defined]
    other = LeRobotEnv(
        task="set_table", subtask="close", split=env.config.split, camera_size=32
    )
    obs, _ = other.reset(seed=3)
    (seen,) = policy.seen
    assert seen["task"] == [other.task_description]
    for name, image in obs["pixels"].items():
        np.testing.assert_array_equal(seen[f"observation.images.{name}"][0], image)
    assert not seen["observation.images.empty_camera_0"].any()
    np.testing.assert_array_equal(seen["observation.state"][0], obs["agent_pos"])
    np.testing.assert_array_equal(
        seen["observation.environment_state"][0], obs["environment_state"]
    )
    other.close()


def test_a_server_of_mjhab_says_what_it_lacks() -> None:
    with serving(TwinResponder("zero", PolicyOptions())) as server:
        env = world(num_envs=1, spawns="")
        served: Any = resolve_policy(spec(server.port), env)
        served._config = {"env": {"assets": "/some/folder"}}
        (record,) = rollout(env, served, [0], seed=0, max_steps=3)
        assert "assets must be those of this server, 'builtin'" in record.error
        served._config = {"env": {"episodes_file": "/etc/passwd"}}
        (record,) = rollout(env, served, [1], seed=0, max_steps=3)
        assert "episodes_file must be left out by clients" in record.error
        served._needs = set()
        (record,) = rollout(env, served, [2], seed=0, max_steps=3)
        assert "mjhab eval --policy ws://" in record.error
        served.close()


def test_a_student_acts_over_the_line_as_it_does_at_home() -> None:
    spec_at_home = "student:set_table/close/kitchen_counter/drawer3"
    with serving(TwinResponder(spec_at_home, PolicyOptions())) as server:
        facts = inspect_policy(spec(server.port))
        assert (
            facts.name == "served-student" and facts.identity["server"]["policy_sha256"]
        )
        options = {**facts.env_options, "target": "kitchen_counter/drawer3"}
        env = world(**options)
        at_home = rollout(
            env, resolve_policy(spec_at_home, env), [0, 1], seed=0, max_steps=10
        )
        served = resolve_policy(spec(server.port), env)
        away = rollout(env, served, [0, 1], seed=0, max_steps=10)
        served.close()  # type: ignore[attr-defined]
    assert [record.error for record in away] == ["", ""]
    assert [r.final_state for r in away] == [r.final_state for r in at_home]


def test_a_student_is_told_the_sentence_of_the_client(tmp_path: Path) -> None:
    inputs = InputConfig(cameras=(), image_size=0, condition=False, sentence=True)
    env = world(target="kitchen_counter/drawer3")
    path = str(tmp_path / "told.safetensors")
    save_student(
        Path(path),
        make_student(config(inputs=inputs), observation_spec_of(env, inputs, ())),
        {},
    )

    def final_states(policy: str, instruction: str = "") -> list[str]:
        acting: Any = resolve_policy(policy, env, PolicyOptions(instruction=instruction))
        records = rollout(env, acting, [0, 1], seed=0, max_steps=4)
        assert [record.error for record in records] == ["", ""]
        return [record.final_state for record in records]

    with serving(TwinResponder(path, PolicyOptions())) as server:
        away = [
            final_states(spec(server.port)),
            final_states(spec(server.port), "shut it"),
        ]
    at_home = [final_states(path), final_states(path, "shut it")]
    assert away == at_home and at_home[0] != at_home[1]


def test_a_policy_that_reads_no_instruction_says_so() -> None:
    env = world(num_envs=1)
    with serving(TwinResponder("zero", PolicyOptions())) as server:
        with refused(where="policy zero that ws://", said="reads no instruction"):
            resolve_policy(spec(server.port), env, PolicyOptions(instruction="shut it"))
        served: Any = resolve_policy(spec(server.port), env)
        served.close()
    with serving(Constant(np.zeros((1, 13)))) as server:
        other: Any = resolve_policy(
            spec(server.port), env, PolicyOptions(instruction="shut it")
        )
        other.close()


def test_twins_follow_their_episodes_as_worlds_of_a_batch_come_and_go() -> None:
    class Lender:
        def borrow(self, config: Mapping[str, Any]) -> ObservationAdapter:
            return ObservationAdapter(cast(Any, None), ZeroPolicy())

    def part(index: int, step: int) -> dict[str, Any]:
        return {"world": {"episode": {"seed": 0, "index": index}}, "step": step}

    session = TwinSession(cast(Any, Lender()))
    first = [twin for twin, _ in session._assigned([part(0, 0), part(1, 0)])]
    for twin, index in zip(first, (0, 1), strict=True):
        twin.expects = EpisodeStep(0, index, 1)
    # Episode 0 is over; episode 1 comes first now, and a new one beside it.
    (one, two), (other, three) = session._assigned([part(1, 1), part(2, 0)])
    assert one is first[1] and other is first[0]
    assert (two["step"], three["step"]) == (1, 0)
    with refused("seed, index and step", ("x", None, 0), expected="integers"):
        session._assigned([{"world": {"episode": {"seed": "x"}}, "step": 0}])
