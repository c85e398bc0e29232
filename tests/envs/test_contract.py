"""The Gymnasium contract: ids, autoreset step by step, seeds, single environments, states, faults."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import mjhab.envs as envs
from mjhab.config.env import AUTORESET_MODES, EnvConfig
from mjhab.config.thresholds import task_config
from mjhab.envs.catalog import env_ids
from mjhab.envs.parts.reporting import active_instruction
from mjhab.envs.sequential import INDEX_STRIDE, SequentialTaskEnv
from mjhab.envs.wrappers import FlattenStatePixels, FrameStack
from mjhab.episodes.spawn_factory import make_set
from mjhab.episodes.spawn_sets import SpawnRecipe
from mjhab.robots.registry import robot_named
from mjhab.sim.protocol import TAINTS
from mjhab.tasks.label_state import WATCHED
from mjhab.tasks.subtasks.registry import force_limits, limits_of
from tests.refusals import refused

NAN_BIT = 1 << TAINTS.index("nan")


def build(**options) -> SequentialTaskEnv:
    defaults = {
        "task": "set_table",
        "subtask": "pick",
        "num_envs": 3,
        "autoreset": "disabled",
        "threads": 1,
    }
    return envs.make_train(**defaults | options)


def actions(env: SequentialTaskEnv, seed: int) -> np.ndarray:
    return (
        np.random.default_rng(seed)
        .uniform(-1, 1, env.action_space.shape)
        .astype(np.float32)
    )


def physics(env: SequentialTaskEnv, world: int) -> list[bytes]:
    return [row.tobytes() for row in env.sim.get_world(world).values()]


@pytest.mark.parametrize("env_id", ["mjhab/SetTable-v1", "mjhab/PickSubtaskTrain-v1"])
def test_check_env_passes_for_a_task_and_for_a_subtask(env_id: str):
    with warnings.catch_warnings():
        # The checker warns that state observations are unbounded; joint speeds and positions are.
        warnings.filterwarnings("ignore", message=".*Box observation space.*")
        env = gymnasium.make(env_id, disable_env_checker=True, threads=1)
        check_env(env.unwrapped)
        env.close()


@pytest.mark.parametrize("env_id", sorted(env_ids()))
def test_make_vec_by_id_runs_and_stays_in_its_spaces(env_id: str):
    env = gymnasium.make_vec(env_id, num_envs=2, threads=1)
    assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    obs, _ = env.reset(seed=1)
    assert env.observation_space.contains(obs)
    worlds = env.unwrapped
    assert isinstance(worlds, SequentialTaskEnv)
    for _ in range(3):
        obs, reward, terminated, truncated, info = worlds.step(env.action_space.sample())
    assert env.observation_space.contains(obs)
    assert reward.shape == (2,) and reward.dtype == np.float64 and np.all(reward <= 1)
    assert not terminated.any() and not truncated.any()
    if "SubtaskTrain" in env_id:
        most = worlds.rewarder.dense.tables[int(info["kind"][0])].attainable
        terms = sum(info["reward_terms"].values())
        np.testing.assert_allclose(terms / most, reward, atol=1e-9)


def test_ids_are_known_after_import_mjhab_alone():
    code = (
        "import mjhab, gymnasium, sys; assert 'mjhab/PickSubtaskTrain-v1' in gymnasium.registry;"
        "assert not {'mujoco', 'torch', 'numba', 'warp'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_info_tells_the_instruction_of_the_active_subtask():
    env = envs.make(task="set_table", num_envs=2, autoreset="disabled", threads=1)
    assert isinstance(env, SequentialTaskEnv)
    _, info = env.reset(seed=0)
    spec = info["episode_spec"][1]
    assert len(spec["instructions"]) == len(spec["plan"])
    assert info["instruction"][1] == spec["instructions"][info["pointer"][1]]
    assert spec["instruction"] not in spec["instructions"]
    env.follow(dataclasses.replace(env.progress, pointer=np.array([3, 7])))
    info = env.step(actions(env, 0))[4]
    assert info["instruction"][0] == info["episode_spec"][0]["instructions"][3]
    assert info["instruction"][1] == spec["instructions"][7]
    assert active_instruction(spec, 16) == spec["instructions"][-1]
    _, alone = build(num_envs=1).reset(seed=0)
    assert alone["instruction"][0] == alone["episode_spec"][0]["instruction"]


def test_same_step_autoreset_step_by_step():
    env = build(autoreset="same_step", num_envs=2)
    first, _ = env.reset(seed=0)
    env.progress.steps_left[0] = 2
    obs, _, terminated, truncated, info = env.step(actions(env, 0))
    assert not (terminated | truncated).any() and "final_obs" not in info
    obs, _, terminated, truncated, info = env.step(actions(env, 1))
    np.testing.assert_array_equal(truncated, [True, False])
    assert not terminated.any()
    np.testing.assert_array_equal(info["_final_obs"], [True, False])
    assert info["final_info"]["ended"][0]["kind"] == info["ended"][0]["kind"] == "pick"
    assert (
        info["episode_spec"][0]["index"] == 1
        and info["final_info"]["episode_spec"][0]["index"] == 0
    )
    assert env.progress.episode_step.tolist() == [0, 2]
    assert not np.array_equal(obs["state"][0], info["final_obs"]["state"][0])
    np.testing.assert_array_equal(obs["state"][1], info["final_obs"]["state"][1])
    # What begins is what a reset by name would begin.
    named, _ = build(num_envs=2).reset(seed=0, options={"episode": [1, INDEX_STRIDE]})
    np.testing.assert_array_equal(obs["state"][0], named["state"][0])
    np.testing.assert_array_equal(first["state"][1], named["state"][1])


def test_next_step_autoreset_step_by_step():
    env = build(autoreset="next_step", num_envs=2)
    env.reset(seed=0)
    env.progress.steps_left[0] = 1
    obs, _, terminated, truncated, info = env.step(actions(env, 0))
    np.testing.assert_array_equal(truncated | terminated, [True, False])
    assert "final_obs" not in info and info["ended"][0]["kind"] == "pick"
    obs, reward, terminated, truncated, info = env.step(actions(env, 1))
    # The reset step: the action is ignored, nothing is earned, the first observation of the next episode comes back.
    assert reward[0] == 0.0 and reward[1] != 0.0 and not (terminated | truncated).any()
    assert info["episode_spec"][0][
        "index"
    ] == 1 and env.progress.episode_step.tolist() == [0, 2]
    named, _ = build(num_envs=2).reset(seed=0, options={"episode": [1, INDEX_STRIDE]})
    np.testing.assert_array_equal(obs["state"][0], named["state"][0])
    obs, *_ = env.step(actions(env, 2))
    assert env.progress.episode_step.tolist() == [1, 3]
    assert not np.array_equal(obs["state"][0], named["state"][0])


def test_disabled_autoreset_leaves_a_finished_world_finished():
    env = build(num_envs=2)
    env.reset(seed=0)
    env.progress.steps_left[0] = 1
    _, _, terminated, truncated, _ = env.step(actions(env, 0))
    assert truncated[0]
    _, _, terminated, truncated, info = env.step(actions(env, 1))
    assert not terminated[0] and not truncated[0] and env.progress.done[0]
    assert info["ended"][0] is None and info["episode_spec"][0]["index"] == 0


def test_termination_is_failure_or_success_and_truncation_is_time():
    env = build(continuous=False, overrides={"pick.force_limit": 0.0}, num_envs=1)
    env.reset(seed=0)
    push = np.zeros((1, 13), np.float32)
    push[:, 11] = 1.0
    for _ in range(120):
        _, _, terminated, truncated, info = env.step(push)
        if terminated[0] or truncated[0]:
            break
    assert (
        terminated[0]
        and not truncated[0]
        and info["fail"][0]
        and info["cumulative_force"][0] > 0
    )


@pytest.mark.parametrize("mode", AUTORESET_MODES)
def test_partial_reset_leaves_other_worlds_bytes(mode: str):
    env = build(autoreset=mode, control_mode="pd_joint_target_delta_pos")
    env.reset(seed=3)
    for step in range(6):
        obs, *_ = env.step(actions(env, step))
    before = [env.get_state(w) for w in (0, 2)]
    again, _ = env.reset(options={"reset_mask": np.array([False, True, False])})
    for state, world in zip(before, (0, 2), strict=True):
        assert flat(env.get_state(world)) == flat(state)
    for key in obs:
        np.testing.assert_array_equal(obs[key][[0, 2]], again[key][[0, 2]])
    assert env.progress.episode_step.tolist() == [6, 0, 6]


def flat(value) -> list:
    """A nested state as a list of comparable parts, arrays as bytes."""
    if isinstance(value, dict):
        return [(key, flat(value[key])) for key in sorted(value)]
    return [value.tobytes()] if isinstance(value, np.ndarray) else [value]


def test_episode_of_a_world_depends_on_its_seed_its_number_and_its_count_only():
    env = build(num_envs=3)
    a, _ = env.reset(seed=[5, 6, 7])
    b, _ = build(num_envs=2).reset(seed=[5, 6])
    np.testing.assert_array_equal(a["state"][:2], b["state"])
    mask = np.array([False, True, False])
    env.reset(options={"reset_mask": mask})
    c, info = env.reset(options={"reset_mask": mask})
    assert info["episode_spec"][1]["index"] == INDEX_STRIDE + 2
    d, _ = build(num_envs=2).reset(seed=6, options={"episode": [0, INDEX_STRIDE + 2]})
    np.testing.assert_array_equal(c["state"][1], d["state"][1])


@pytest.mark.parametrize(
    ("seed", "options", "option"),
    [
        (2**63, None, "seed"),
        (-1, None, "seed"),
        (1.5, None, "seed"),
        ("12", None, "seed"),
        ([1, 2.5], None, "seed"),
        ([1, 2, 3], None, "seed"),
        (None, [1], "options"),
        (None, {"reset_mask": [1, 0]}, "reset_mask"),
        (7, {"episode": 3}, "options['episode']"),
        (7, {"episode": [0.7, 1.2]}, "options['episode']"),
        (7, {"episode": ["a", "b"]}, "options['episode']"),
        (7, {"episode": [0, 2**64]}, "options['episode']"),
        (7, {"episode": [-1, 0]}, "options['episode']"),
    ],
)
def test_a_refused_reset_changes_nothing(seed: Any, options: Any, option: str):
    env = build(num_envs=2)
    env.reset(seed=4)
    with refused(option):
        env.reset(seed=seed, options=options)
    _, info = env.reset()
    told = [(spec["seed"], spec["index"]) for spec in info["episode_spec"]]
    assert told == [(4, 1), (4, INDEX_STRIDE + 1)]


def test_seeds_and_episodes_are_whole_numbers_of_any_type():
    env = build(num_envs=2)
    numbers = (range(2), (0, 1), np.array([0, 1], np.uint8), [np.int64(0), 1])
    for given in numbers:
        _, info = env.reset(seed=given, options={"episode": given})
        told = [(spec["seed"], spec["index"]) for spec in info["episode_spec"]]
        assert told == [(0, 0), (1, 1)]


def test_the_first_reset_begins_an_episode():
    env = build(num_envs=2)
    with refused(said="the first reset must begin an episode"):
        env.reset(options={"reset_mask": np.zeros(2, bool)})
    _, info = env.reset(options={"reset_mask": np.array([True, False])})
    assert [spec is None for spec in info["episode_spec"]] == [False, True]


def test_state_round_trip_in_another_environment():
    env = build()
    other = build()
    env.reset(seed=1)
    other.reset(seed=2)
    for step in range(5):
        env.step(actions(env, step))
    state = env.get_state(1)
    untouched = [physics(other, w) for w in (0, 1)]
    other.set_state(2, state)
    assert flat(other.get_state(2)) == flat(state)
    assert [physics(other, w) for w in (0, 1)] == untouched
    # Two worlds restored from one state go on alike, bit by bit, physics and rewards.
    env.set_state(1, state)
    for step in range(5):
        act = actions(env, 10 + step)
        act[2] = act[1]
        _, r1, _, _, i1 = env.step(act)
        _, r2, _, _, i2 = other.step(act)
        assert r1[1] == r2[2] and i1["cumulative_force"][1] == i2["cumulative_force"][2]
    assert physics(env, 1) == physics(other, 2)
    assert flat(env.get_state(1)["tracker"]) == flat(other.get_state(2)["tracker"])


def test_a_state_after_the_end_of_an_episode_waits_for_its_reset():
    env = build(autoreset="next_step", num_envs=2)
    env.reset(seed=0)
    env.progress.steps_left[0] = 1
    _, _, _, truncated, _ = env.step(actions(env, 0))
    assert truncated.tolist() == [True, False]
    ended = env.get_state(0)
    first, *_ = env.step(actions(env, 1))
    env.set_state(0, ended)
    again, reward, _, _, info = env.step(actions(env, 2))
    assert info["episode_spec"][0]["index"] == 1 and reward[0] == 0.0
    np.testing.assert_array_equal(again["state"][0], first["state"][0])


PER_STEP = (
    "._worlds",
    "sensing._rows",
    ".rewarder._worlds",
    ".controller._arm.target",
    ".nav._fields",
    ".nan_resets",
)
"""Arrays (W, ...) that hold no state of a world: numbers of worlds, what every step computes anew before it is read,
fields with room beyond ``nav._shape``, and counters of the environment."""


def arrays_of_worlds(thing: object, worlds: int, name: str = "") -> dict[str, np.ndarray]:
    """The numeric (W, ...) arrays that an object of mjhab and its parts hold, by their path."""
    if isinstance(thing, np.ndarray):
        row_per_world = thing.ndim > 0 and len(thing) == worlds and thing.dtype != object
        return {name: thing} if row_per_world and not name.endswith(PER_STEP) else {}
    if not type(thing).__module__.startswith("mjhab.") or not hasattr(thing, "__dict__"):
        return {}
    found: dict[str, np.ndarray] = {}
    for key, value in vars(thing).items():
        if key not in ("sim", "source", "starts", "_sim", "_starts"):
            found |= arrays_of_worlds(value, worlds, f"{name}.{key}")
    return found


def test_no_part_of_a_state_is_forgotten():
    """Every part with a state is in snapshots, and a restored world keeps nothing of the episode before."""
    worlds = 5
    env, other = (
        build(num_envs=worlds, subtask="navigate", reward_mode="normalized_dense")
        for _ in range(2)
    )
    for each, seed in ((env, 1), (other, 2)):
        each.reset(seed=seed)
        for step in range(3):
            each.step(actions(each, 10 * seed + step))
    # Without perturbations nothing of them is in a snapshot.
    stateful = [
        part
        for part in vars(env).values()
        if hasattr(part, "get_state") and part is not env.perturber
    ]
    assert stateful
    assert {id(part) for part in stateful} <= {
        id(part) for part in env.restorable_parts().values()
    }
    other.set_state(4, env.get_state(1))
    want = arrays_of_worlds(env, worlds)
    got = arrays_of_worlds(other, worlds)
    assert {
        ".grip",
        ".progress.pointer",
        ".teleports.pending",
        ".nav._origin",
    } <= want.keys()
    different = [key for key in want if not np.array_equal(want[key][1], got[key][4])]
    assert not different
    place = np.tile(env.sim.qpos[1, :2], (worlds, 1))
    assert env.nav.at(place)[1] == other.nav.at(place)[4] > 0.0


def test_a_state_of_a_version_without_ee_contact_and_finger_forces_is_taken():
    env = build(num_envs=1)
    env.reset(seed=0)
    state = env.get_state(0)
    lacking = WATCHED.index("ee_contact")
    old = {
        **state,
        "signals": {k: v for k, v in state["signals"].items() if k != "ee_contact"},
    }
    labels = {**state["tracker"]["labels"]}
    labels |= {name: np.delete(labels[name], lacking) for name in ("now", "seen")}
    old["tracker"] = {**state["tracker"], "labels": labels}
    progress = state["progress"]
    old["progress"] = {k: progress[k] for k in progress if k != "peak_finger_force"}
    env.set_state(0, old)
    # Nothing touches anything at the start.
    assert flat(env.get_state(0)) == flat(state)


def test_state_before_reset_and_of_another_layout_are_refused():
    env = build(num_envs=1)
    with refused(said="call reset first"):
        env.get_state(0)
    env.reset(seed=0)
    state = env.get_state(0)
    state["sim"]["qpos"] = state["sim"]["qpos"][:-7]
    with refused("qpos of the state"):
        env.set_state(0, state)


@pytest.mark.parametrize("mode", AUTORESET_MODES)
def test_a_nan_world_resets_itself_and_the_others_do_not_notice(mode: str):
    env = build(autoreset=mode)
    calm = build(autoreset=mode)
    env.reset(seed=4)
    calm.reset(seed=4)
    env.step(actions(env, 0))
    calm.step(actions(calm, 0))
    env.sim.batch.qvel[1, 3] = np.nan
    obs, reward, terminated, truncated, info = env.step(actions(env, 1))
    calm.step(actions(calm, 1))
    final = info["final_info"] if mode == "same_step" else info
    assert truncated.tolist() == [False, True, False] and not terminated.any()
    assert final["taint"][1] & NAN_BIT and not final["taint"][[0, 2]].any()
    assert final["nan_resets"].tolist() == [0, 1, 0]
    assert final["ended"][1] is not None and not final["ended"][1]["success_at_end"]
    assert all(np.isfinite(obs[key]).all() for key in obs) and np.isfinite(reward).all()
    for step in range(2, 6):
        obs, *_ = env.step(actions(env, step))
        calm.step(actions(calm, step))
    assert [physics(env, w) for w in (0, 2)] == [physics(calm, w) for w in (0, 2)]
    assert np.isfinite(obs["state"]).all()
    if mode != "disabled":
        episode = env.episodes_now[1]
        assert episode is not None and episode.index == INDEX_STRIDE + 1
        assert not env.sim.taint()[1] & NAN_BIT


def test_an_env_whose_state_was_made_infinite_from_outside_goes_on():
    env = build(num_envs=2, autoreset="same_step")
    env.reset(seed=0)
    env.sim.qpos[0, :] = np.inf
    obs, _, _, truncated, info = env.step(actions(env, 0))
    assert (
        truncated[0]
        and info["final_info"]["taint"][0] & NAN_BIT
        and np.isfinite(obs["state"]).all()
    )
    assert np.isfinite(info["final_obs"]["state"]).all()


BAD_ACTIONS = [
    (np.zeros((3, 12), np.float32), {"given": (3, 12), "expected": "(3, 13)"}),
    (np.array([["a"] * 13] * 3), {"expected": "numbers"}),
    (np.full((3, 13), np.nan), {"expected": "finite", "advice": "world 0"}),
]


@pytest.mark.parametrize(("bad", "told"), BAD_ACTIONS)
def test_bad_actions_say_what_is_wrong(bad: np.ndarray, told: dict[str, Any]):
    env = build()
    env.reset(seed=0)
    with refused("actions", **told):
        env.step(bad)


def test_a_nan_action_names_world_and_dimension():
    env = build()
    env.reset(seed=0)
    act = actions(env, 0)
    act[2, 11] = np.inf
    with refused("actions", expected="finite", advice="base_forward"):
        env.step(act)


BAD_OPTIONS = [
    ({"control_mode": "pd_joint_delta_pose"}, "control mode", "pd_joint_delta_pos"),
    ({"obs_mode": "rgdb"}, "observation mode", "rgb"),
    ({"cameras": ("fetch_heat",)}, "camera", "fetch_head"),
    ({"overrides": {"goal_tool": 0.1}}, "task-config override", "goal_tol"),
    ({"overrides": {"pick.horizont": 3}}, "task-config override", "pick.horizon"),
    ({"overrides": {"goal_tol": "wide"}}, "override goal_tol", "like 0.15"),
    ({"overrides": {"ee_rest_pos": "abc"}}, "override ee_rest_pos", "1.25)"),
    ({"overrides": {"ee_rest_pos": [0.5]}}, "override ee_rest_pos", "1.25)"),
    ({"reward_mode": "sparce"}, "reward mode", "sparse"),
    ({"reward_scales": {"pick": {"reech": 1.0}}}, "reward term of pick", "reach"),
    ({"stationary": ("legs",)}, "stationary part", "base"),
    ({"camera_size": 4}, "camera size", "8"),
    ({"autoreset": "sometimes"}, "autoreset mode", "same_step"),
]


@pytest.mark.parametrize(("options", "option", "valid"), BAD_OPTIONS)
def test_bad_options_name_what_is_valid(options: dict, option: str, valid: str):
    with refused(option, expected=valid):
        build(**options)


def test_worlds_that_do_not_fit_are_refused():
    with refused(said="At most"):
        build(num_envs=10**7)


def test_overrides_that_were_recorded_as_json_are_taken():
    """Data sets and runs keep their configuration as JSON, in which a tuple is a list."""
    given = {"ee_rest_pos": (0.5, 0.0, 1.2), "goal_tol": 0.2}
    recorded = json.loads(json.dumps(given))
    first, again = (
        task_config(EnvConfig(overrides=overrides), robot_named())
        for overrides in (given, recorded)
    )
    assert again == first and again.ee_rest_pos == (0.5, 0.0, 1.2)


def test_options_of_training_take_effect():
    env = build(
        overrides={"goal_tol": 0.2, "place.horizon": 50},
        subtask="place",
        force_limits=False,
        num_envs=1,
    )
    assert (
        env.task_config.goal_tol == 0.2
        and limits_of(env.task_config, "place").horizon == 50
    )
    assert np.isinf(force_limits(env.task_config)).all()
    _, info = env.reset(seed=0)
    assert info["steps_left"][0] == 50
    env = build(horizon=7, num_envs=1)
    env.reset(seed=0)
    ends = [env.step(actions(env, i))[3][0] for i in range(7)]
    assert ends == [False] * 6 + [True]


@pytest.mark.parametrize("make", [envs.make, envs.make_train])
def test_a_pool_of_one_episode_is_the_same_arrangement_everywhere(make: Any):
    env = make(subtask="pick", num_envs=3, episode_pool=1, threads=1)
    env.reset(seed=5)
    first, *others = env.episodes_now
    for other in others:
        np.testing.assert_array_equal(other.object_pose, first.object_pose)
    assert len({env.state_digest(world) for world in range(3)}) == 3, "other spawns"


def test_zone_goals_reach_over_the_whole_receptacle():
    env = build(
        subtask="place", task="tidy_house", overrides={"goal_type": "zone"}, num_envs=1
    )
    env.reset(seed=0)
    rect = env.tables.plans[0].subtasks[0].goal_rect
    goal = env.tables.plans[0].subtasks[0].goal_pos
    low = np.min(rect, axis=0)
    high = np.max(rect, axis=0)
    assert (
        (low <= goal[:2]).all()
        and (goal[:2] <= np.array(high)).all()
        and np.prod(high - low) > 0.05
    )


def test_open_training_finds_one_drawer_in_ten_ajar_and_evaluation_none():
    env = build(subtask="open", target="kitchen_counter/drawer3", num_envs=1)
    link = env.layout.link_ids.index("kitchen_counter/drawer3")
    ajar = 0
    for k in range(40):
        env.reset(seed=0, options={"episode": [k]})
        q = env.state.link_q[0, link]
        assert q < 0.01 or q == pytest.approx(
            0.2 * 0.9 * env.layout.links[link].link.range[1], abs=1e-3
        )
        ajar += q > 0.01
    assert 1 <= ajar <= 12
    judged = envs.make(
        subtask="open", target="kitchen_counter/drawer3", num_envs=1, threads=1
    )
    judged.reset(seed=0)
    assert judged.state.link_q[0, link] < 0.01


def test_render_mode_gives_pictures_of_every_world():
    env = build(num_envs=1, render_mode="rgb_array")
    env.reset(seed=0)
    pictures = env.render()
    assert pictures is not None and len(pictures) == 1
    picture = pictures[0]
    assert picture.dtype == np.uint8 and picture.ndim == 3 and picture.std() > 10


def test_pictures_of_a_new_episode_stand_beside_those_that_go_on():
    env = build(autoreset="same_step", obs_mode="rgbd", camera_size=24, num_envs=2)
    stacked = FlattenStatePixels(FrameStack(env, 3))
    stacked.reset(seed=0)
    env.progress.steps_left[0] = 1
    obs, _, _, truncated, info = stacked.step(actions(env, 0))
    assert truncated[0]
    whole = env._observe()
    for camera in ("fetch_head", "fetch_hand"):
        depth = obs["pixels"][f"{camera}_depth"]
        assert depth.shape == (2, 3, 1, 24, 24)
        now = np.moveaxis(whole[f"sensor_data/{camera}/depth"], -1, 1)
        np.testing.assert_array_equal(depth[:, -1], now)
        np.testing.assert_array_equal(depth[0, 0], now[0])
        old = info["final_obs"]["pixels"][f"{camera}_depth"]
        assert not np.array_equal(old[0, -1], now[0]) and not np.array_equal(
            depth[1, 0], depth[1, -1]
        )


def test_statistics_of_gymnasium_wrap_around_ours():
    env = RecordEpisodeStatistics(build(autoreset="same_step", num_envs=2, horizon=3))
    env.reset(seed=0)
    total = np.zeros(2)
    for step in range(3):
        _, reward, _, truncated, info = env.step(actions(env.unwrapped, step))  # type: ignore[arg-type]
        total += reward
    assert np.all(truncated)
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-6)
    assert info["episode"]["l"].tolist() == [3, 3]


def test_a_spawn_set_gives_the_starts_it_was_made_with(tmp_path: Path):
    recipe = SpawnRecipe("set_table", "place", "", "train", seed=3, count=3)
    made = make_set(recipe, tmp_path / "place.npz", 1, lambda done, fallbacks: None)
    online = build(subtask="place", episode_pool=0, num_envs=3)
    used = build(subtask="place", spawns=str(made.path), num_envs=3)
    names = {"episode": [0, 1, 2]}
    a, _ = online.reset(seed=3, options=names)
    b, info = used.reset(seed=3, options=names)
    np.testing.assert_array_equal(a["state"], b["state"])
    assert [spec["index"] for spec in info["episode_spec"]] == [0, 1, 2]
    used.reset(seed=4)
    homes = {episode.home for episode in used.episodes_now if episode is not None}
    assert homes <= {str(name) for name in made.columns["home"]}
    with refused(where="place.npz", said="place"):
        build(subtask="pick", spawns=str(made.path))
