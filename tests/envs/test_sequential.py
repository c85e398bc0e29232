"""SequentialTask: contract, isolation of worlds, determinism, teleport, starts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import mjhab.envs as envs
from mjhab.envs.observations.state import state_dim, state_table
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.episodes.generator import EpisodeMaker
from mjhab.experts import make_expert
from mjhab.robots.controllers import make_controller
from mjhab.robots.fetch.robot import ROBOT
from mjhab.scenes.pack_source import PACK_SOURCES, PackSource
from mjhab.scenes.packs import open_pack
from mjhab.scenes.spec import Roles
from mjhab.tasks.plan import SubtaskKind
from tests.refusals import refused


def build(**options) -> SequentialTaskEnv:
    return envs.make(
        **{"task": "set_table", "num_envs": 2, "autoreset": "disabled", "threads": 1}
        | options
    )


def still(env: SequentialTaskEnv) -> np.ndarray:
    actions = np.zeros((env.num_envs, ROBOT.action.dim), np.float32)
    actions[:, 7] = 1.0
    return actions


def random_actions(env: SequentialTaskEnv, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-1, 1, (env.num_envs, ROBOT.action.dim)).astype(np.float32)


def test_spaces_and_state_layout():
    env = build(num_envs=3)
    obs, info = env.reset(seed=1)
    assert state_dim(ROBOT) == 42
    assert obs["state"].shape == (3, 42) and obs["state"].dtype == np.float32
    assert env.observation_space.contains(obs)
    np.testing.assert_array_equal(
        obs["state"], np.concatenate([obs[e.key] for e in state_table(ROBOT)], axis=1)
    )
    assert [e.name for e in make_controller().table][7] == "gripper" and len(
        make_controller().table
    ) == ROBOT.action.dim
    assert (info["kind"] == SubtaskKind.NAVIGATE).all()


def test_observation_is_masked_by_subtask():
    env = build(subtask="close", target="fridge/top_door", num_envs=1)
    obs, _ = env.reset(seed=0)
    assert not obs["extra/obj_pose_wrt_base"].any()
    assert obs["extra/goal_pos_wrt_base"].any()
    env = build(subtask="pick", target="013_apple", num_envs=1)
    obs, _ = env.reset(seed=0)
    assert obs["extra/obj_pose_wrt_base"].any()
    assert not obs["extra/goal_pos_wrt_base"].any()


def test_teleport_brings_every_world_near_and_facing_without_contact():
    env = build(task="tidy_house", num_envs=6)
    env.reset(seed=3)
    reached = np.zeros(6, bool)
    ended = []
    for _ in range(60):
        obs, _, _, _, info = env.step(still(env))
        arrived = (info["kind"] == SubtaskKind.PICK) & ~reached
        ended += [record for record in info["ended"] if record is not None]
        for w in np.flatnonzero(arrived):
            pose = obs["extra/obj_pose_wrt_base"][w]
            assert np.hypot(pose[0], pose[1]) <= 2.0 + 1e-3
            # Yaw noise is clipped at 0.5 rad about the direction to the object.
            assert abs(np.arctan2(pose[1], pose[0])) <= 0.5 + 1e-3
            assert info["robot_force"][w] == 0.0
        reached |= arrived
        if reached.all():
            break
    assert reached.all()
    assert not info["spawn_fallback"].any()
    # What the environment does itself is marked in the records: it says nothing about a policy.
    told = {record["kind"]: record["teleported"] for record in ended}
    assert told["navigate"] is True and not any(
        told[kind] for kind in {*told} - {"navigate"}
    )


def fingers_after_teleport(**options: str) -> tuple[np.ndarray, np.ndarray]:
    """Positions [m] and speeds [m/s] (W, 2) of the fingers as Open begins, the first subtask after a teleport."""
    env = build(task="set_table", num_envs=2, **options)
    env.reset(seed=0)
    while (env.progress.pointer == 0).any():
        env.step(still(env))
    columns = env.layout.robot.columns.fingers
    return env.state.robot_q[:, columns], env.state.robot_qd[:, columns]


def test_fingers_of_an_empty_hand_rest_when_a_teleport_ends():
    position, speed = fingers_after_teleport()
    np.testing.assert_allclose(position, 0.015, atol=1e-6)
    assert np.abs(speed).max() < 1e-6
    # What was recorded before there was a choice follows the last command, that of an open hand at the start.
    position, speed = fingers_after_teleport(teleport_fingers="commanded")
    assert position.min() > 0.025 and speed.min() > 0.2
    with refused("fingers in teleports", "loose", expected="still"):
        build(task="set_table", teleport_fingers="loose")


def test_what_is_carried_is_held_on_to_in_a_teleport():
    env = build(task="tidy_house", num_envs=1)
    obs, info = env.reset(seed=0)
    policy = make_expert(env)
    policy.reset(np.ones(1, bool))
    while env.focus.kind[0] != SubtaskKind.PLACE:
        obs, _, _, _, info = env.step(policy.act(obs, info))
    # The command of a closed hand; that of the present opening would let go.
    assert env.grip[0] == -1.0 and info["is_grasped"][0]


def test_worlds_can_be_in_different_subtasks():
    env = build(task="tidy_house", num_envs=4)
    env.reset(seed=0)
    for _ in range(4):
        env.step(still(env))
    env.reset(options={"reset_mask": np.array([True, False, False, False])})
    kinds = env.focus.kind
    assert kinds[0] == SubtaskKind.NAVIGATE and (kinds[1:] == SubtaskKind.PICK).any()


def snapshot(env: SequentialTaskEnv, world: int) -> list[bytes]:
    batch = env.sim.batch
    rows = [
        batch.qpos,
        batch.qvel,
        batch.ctrl,
        batch.qacc_warmstart,
        batch.sensordata,
        batch.xpos,
    ]
    rows += [
        getattr(env.progress, f)
        for f in ("pointer", "steps_left", "cumulative_force", "peak_force")
    ]
    rows += [
        env.state.robot_q,
        env.state.object_pose,
        env.tracker._start_step,
        env.joint_start,
    ]
    notes: Any = env.tracker._notes
    labels = notes._labels
    rows += [getattr(labels, name) for name in labels.__dataclass_fields__]
    return [np.ascontiguousarray(r[world]).tobytes() for r in rows if r is not None]


def test_partial_reset_leaves_other_worlds_bit_identical():
    env = build(num_envs=3)
    obs, _ = env.reset(seed=5)
    rng = np.random.default_rng(0)
    for _ in range(12):
        obs, *_ = env.step(random_actions(env, rng))
    before = [snapshot(env, w) for w in (0, 2)]
    after_obs, _ = env.reset(options={"reset_mask": np.array([False, True, False])})
    assert [snapshot(env, w) for w in (0, 2)] == before
    for key in obs:
        np.testing.assert_array_equal(obs[key][[0, 2]], after_obs[key][[0, 2]])
    assert env.progress.episode_step[1] == 0 and env.progress.episode_step[0] == 12


def run(num_envs: int, threads: int, episodes: list[int], steps: int) -> dict[int, bytes]:
    """States of episodes under actions that depend on (episode, step) only."""
    env = build(num_envs=num_envs, threads=threads)
    out = {}
    for first in range(0, len(episodes), num_envs):
        group = episodes[first : first + num_envs]
        mask = np.arange(num_envs) < len(group)
        env.reset(seed=7, options={"reset_mask": mask, "episode": group})
        for step in range(steps):
            actions = np.zeros((num_envs, ROBOT.action.dim), np.float32)
            for w, episode in enumerate(group):
                actions[w] = np.random.default_rng((episode, step)).uniform(
                    -1, 1, ROBOT.action.dim
                )
            env.step(actions)
        for w, episode in enumerate(group):
            out[episode] = (
                env.sim.batch.qpos[w].tobytes() + env.sim.batch.qvel[w].tobytes()
            )
    return out


def test_states_do_not_depend_on_number_of_worlds_or_threads():
    episodes = [0, 1, 2, 3]
    reference = run(1, 1, episodes, 25)
    assert run(2, 2, episodes, 25) == reference
    assert run(4, 1, episodes, 25) == reference
    assert len(set(reference.values())) == len(episodes)


def test_episodes_that_are_made_in_threads_are_the_same(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(
        EpisodeMaker, "episode", lambda self, seed, index: self.make(seed, index)[0]
    )
    pair = [
        build(num_envs=3, threads=threads, home="builtin_m1_00") for threads in (1, 3)
    ]
    for env in pair:
        env.reset(seed=3)
    np.testing.assert_array_equal(pair[0].sim.qpos, pair[1].sim.qpos)
    assert len(np.unique(pair[0].sim.qpos, axis=0)) == 3


@pytest.mark.parametrize("mode", ["same_step", "disabled"])
def test_autoreset_modes(mode: str):
    env = build(subtask="pick", num_envs=2, autoreset=mode)
    env.reset(seed=0)
    env.progress.steps_left[0] = 2
    done_at = None
    for step in range(4):
        if mode == "disabled" and done_at is not None:
            break
        _, _, terminated, truncated, info = env.step(still(env))
        if (terminated | truncated)[0] and done_at is None:
            done_at = step
            if mode == "same_step":
                assert info["_final_obs"][0] and not info["_final_obs"][1]
                assert info["final_info"]["ended"][0]["kind"] == "pick"
                assert env.progress.episode_step[0] == 0
            else:
                assert env.progress.episode_step[0] == 2
    assert done_at == 1
    if mode == "disabled":
        assert env.progress.done[0]


@pytest.mark.parametrize("target", ["024_bowl", "013_apple"])
def test_place_starts_hold_the_object_by_contact(target: str):
    env = build(subtask="place", target=target)
    env.reset(seed=0)
    actions = np.zeros((2, ROBOT.action.dim), np.float32)
    actions[:, 7] = -1.0
    for _ in range(20):
        *_, info = env.step(actions)
    assert info["is_grasped"].all()
    assert not info["taint"].any()


def test_close_starts_open_with_the_object_out_of_the_way():
    env = build(subtask="close", target="kitchen_counter/drawer3")
    env.reset(seed=0)
    view = env.view(0)
    assert view.link_q("kitchen_counter/drawer3") >= 0.44
    *_, info = env.step(still(env))
    assert not info["closed"].any()


def test_horizon_ends_a_single_subtask_and_reports_it():
    env = build(subtask="open", num_envs=1)
    env.reset(seed=0)
    env.progress.steps_left[:] = 3
    for _ in range(3):
        _, _, terminated, truncated, info = env.step(still(env))
    record = info["ended"][0]
    assert truncated[0] and not terminated[0]
    assert (
        record["label"] == "cant_reach_articulation_failure"
        and not record["success_once"]
    )
    assert record["end_step"] - record["start_step"] == 3


def test_nan_taints_only_its_world():
    env = build()
    env.reset(seed=0)
    env.sim.batch.qvel[1, env.sim.addresses.object_v[0]] = np.nan
    *_, info = env.step(still(env))
    names = [n for bit, n in enumerate(env.taint_names) if info["taint"][1] >> bit & 1]
    assert "nan" in names
    assert info["taint"][0] == 0


def test_cameras_are_not_black():
    env = build(num_envs=1, obs_mode="rgbd+seg", camera_size=64)
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    depth = obs["sensor_data/fetch_head/depth"]
    assert (
        depth.shape == (1, 64, 64, 1)
        and depth.dtype == np.int16
        and (depth > 0).mean() > 0.5
    )
    assert obs["sensor_data/fetch_hand/rgb"].std() > 10
    assert len(np.unique(obs["sensor_data/fetch_head/seg"])) > 3


def test_fixed_home_and_splits():
    env = build(home="builtin_m1_00", num_envs=2)
    _, info = env.reset(seed=0)
    assert {e["home"] for e in info["episode_spec"]} == {"builtin_m1_00"}
    val = build(split="val", num_envs=2)
    _, info = val.reset(seed=0)
    assert all(e["home"].startswith("builtin_m3") for e in info["episode_spec"])


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"task": "set_tabel"}, dict(option="task", given="set_tabel")),
        ({"subtask": "pik"}, dict(option="subtask", given="pik")),
        ({"task": "tidy_house", "subtask": "open"}, dict(option="subtask", given="open")),
        ({"num_envs": 0}, dict(option="num_envs", given=0)),
        (
            {"home": "builtin_m0_99"},
            dict(option="home", given="builtin_m0_99", said="builtin_m0_0"),
        ),
        (
            {"subtask": "pick", "target": "024_bow"},
            dict(option="target", given="024_bow"),
        ),
        ({"target": "024_bowl"}, dict(option="target", given="024_bowl")),
        ({"split": "training"}, dict(option="split", given="training")),
        ({"assets": "bultin"}, dict(said="builtin")),
        ({"wrlds": 3}, dict(option="environment option", given="wrlds")),
        ({"obs_mode": "deth"}, dict(option="observation mode", given="deth")),
    ],
)
def test_bad_options_name_what_is_valid(options: dict, told: dict[str, Any]):
    with refused(**told):
        build(**options)


@pytest.fixture
def plain_pack() -> Iterator[str]:
    """Name of a pack without furniture that opens: TidyHouse needs none."""
    pack = open_pack("builtin")
    opening = tuple(f"{name}/" for name in pack.articulations)
    places = {
        role: tuple(place for place in listed if not place.startswith(opening))
        for role, listed in pack.roles.places.items()
    }
    homes = tuple(
        replace(home, articulations=(), open_limits=()) for home in pack.homes[:2]
    )
    plain = replace(
        pack,
        name="plain",
        articulations={},
        homes=homes,
        roles=Roles({role: listed for role, listed in places.items() if listed}),
    )
    PACK_SOURCES.add("plain", PackSource("plain", lambda request: plain))
    yield "plain"
    PACK_SOURCES.remove("plain")


@pytest.mark.parametrize("subtask", ["", "pick", "place", "navigate"])
def test_a_pack_without_furniture_that_opens_is_enough(plain_pack: str, subtask: str):
    env = build(
        task="tidy_house", subtask=subtask, assets=plain_pack, reward_mode="dense"
    )
    env.reset(seed=0)
    obs, reward, *_ = env.step(still(env))
    assert env.observation_space.contains(obs) and np.isfinite(reward).all()
    assert not env.link_state().any()


def test_bad_actions_and_reset_options():
    env = build()
    env.reset(seed=0)
    with refused("actions"):
        env.step(np.zeros((2, 12)))
    with refused("actions", expected="finite"):
        env.step(np.full((2, 13), np.nan))
    with refused("reset option", "mask", expected="reset_mask"):
        env.reset(options={"mask": 1})
    with refused("options['episode']", [1]):
        env.reset(options={"episode": [1]})


def test_an_unknown_id_names_the_nearest():
    with refused("environment id", "mjhab/SetTabel-v1", expected="mjhab/SetTable-v1"):
        envs.make_by_id("mjhab/SetTabel-v1")
