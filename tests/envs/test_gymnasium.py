"""What other libraries do with our environments: copy and pickle them, step them in other processes, read `info`."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import re
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers import FlattenObservation, NumpyToTorch
from gymnasium.wrappers.vector import DictInfoToList
from gymnasium.wrappers.vector import FlattenObservation as VectorFlattenObservation
from gymnasium.wrappers.vector import NumpyToTorch as VectorNumpyToTorch

import mjhab
from mjhab.config.env import EnvConfig
from mjhab.core.errors import UsageError
from mjhab.core.typed.frozen import FrozenMap
from mjhab.data.record.recorder import Recorder
from mjhab.envs.device.env import DeviceEnv
from mjhab.envs.observations.modes import STATE_KEY
from mjhab.envs.observations.state import BASE_VELOCITY_KEY, state_dim
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.envs.single import OF_WORLDS, SingleEnv
from mjhab.envs.spaces import nested
from mjhab.envs.wrappers import FlattenStatePixels, FrameStack, NormalizeImages
from tests.refusals import refused

ENV_ID = "mjhab/CloseSubtaskTrain-v1"
TARGET = "kitchen_counter/drawer3"
OPTIONS: dict[str, Any] = {"target": TARGET, "home": "builtin_m0_00", "threads": 1}
OBJECTS = ("events", "ended", "instruction", "episode_spec", "reward_mode")


def build(**options: Any) -> SequentialTaskEnv:
    return mjhab.make_train(subtask="close", **OPTIONS | options)


def still(env: gymnasium.vector.VectorEnv) -> np.ndarray:
    return np.zeros(env.action_space.shape or (), np.float32)


def test_an_env_is_copied_and_pickled_before_it_is_used() -> None:
    env = gymnasium.make(ENV_ID, obs_mode="depth", **OPTIONS)
    assert env.spec is not None
    assert pickle.loads(pickle.dumps(env.spec)).kwargs == env.spec.kwargs
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    for each in copies:
        assert each.observation_space == env.observation_space
        assert each.action_space == env.action_space
    first, _ = copies[0].reset(seed=3)
    second, info = copies[1].reset(seed=3)
    np.testing.assert_array_equal(first[STATE_KEY], second[STATE_KEY])
    assert env.observation_space.contains(first)
    assert pickle.loads(pickle.dumps(info))["episode_spec"] == info["episode_spec"]
    with refused(said="before the first reset"):
        pickle.dumps(copies[1])
    env.close()


@pytest.mark.parametrize(
    "name", ["no_such_thing", "num_envs", "single_action_space", "_private"]
)
def test_a_name_that_nobody_has_builds_no_world(name: str) -> None:
    env: Any = gymnasium.make(ENV_ID, **OPTIONS).unwrapped
    with pytest.raises(AttributeError, match=f"no attribute '{name}'"):
        getattr(env, name)
    assert not hasattr(env, name)
    assert env._opened is None and copy.deepcopy(env).config == env.config


def test_a_single_world_has_what_its_vector_environment_has_but_vectors_of_worlds() -> (
    None
):
    env: Any = gymnasium.make(ENV_ID, **OPTIONS).unwrapped
    env.reset(seed=0)
    of_vectors = {
        "num_envs",
        "single_action_space",
        "single_observation_space",
        "autoreset_mode",
    }
    elsewhere = {*dir(VectorEnv), *dir(SingleEnv), *vars(env), *of_vectors, "due"}
    public = {name for name in dir(env.worlds) if not name.startswith("_")}
    assert public - elsewhere == OF_WORLDS
    assert all(hasattr(env, name) for name in OF_WORLDS)
    env.close()


def dtypes(values: Mapping[str, Any]) -> dict[str, Any]:
    """Type of every entry, those of nested entries too: the dtype of tensors and arrays, else the class."""
    return {
        key: dtypes(value)
        if isinstance(value, dict)
        else getattr(value, "dtype", type(value))
        for key, value in values.items()
    }


@pytest.mark.parametrize("vector", [False, True])
def test_gymnasium_gives_our_environments_as_tensors(vector: bool) -> None:
    options = OPTIONS | {
        "obs_mode": "depth",
        "camera_size": 16,
        "horizon": 2,
        "episode_pool": 2,
    }
    env: Any
    if vector:
        env = VectorNumpyToTorch(gymnasium.make_vec(ENV_ID, num_envs=2, **options))
    else:
        env = NumpyToTorch(gymnasium.make(ENV_ID, **options))
    obs, info = env.reset(seed=0)
    for _ in range(2):
        obs, reward, terminated, truncated, info = env.step(
            torch.zeros(env.action_space.shape)
        )
    seen = dtypes(obs)
    assert seen[STATE_KEY] == torch.float32
    assert seen["sensor_data/fetch_head/depth"] == torch.int16
    told = dtypes(info)
    assert told["success"] == torch.bool and told["robot_force"] == torch.float64
    assert set(told["reward_terms"].values()) == {torch.float64}
    spec = info["episode_spec"]
    if vector:
        assert {key for key, kind in told.items() if kind == np.dtype("O")} == {*OBJECTS}
        assert reward.dtype == torch.float64 and truncated.all() and not terminated.any()
        assert dtypes(info["final_info"])["success"] == torch.bool
        assert info["instruction"].tolist() == [each["instructions"][0] for each in spec]
    else:
        assert (type(reward), terminated, truncated) == (float, False, True)
        assert info["instruction"] == spec["instructions"][0]
        assert info["ended"]["kind"] == "close"
    env.close()


def test_a_single_world_in_gymnasiums_own_vector_keeps_its_types() -> None:
    env = gymnasium.make_vec(ENV_ID, num_envs=2, vectorization_mode="sync", **OPTIONS)
    _, info = env.reset(seed=0)
    assert info["success"].dtype == bool and info["robot_force"].dtype == np.float64
    env.close()


def test_the_autoreset_mode_is_an_attribute_as_in_gymnasiums_own_vectors() -> None:
    for mode in AutoresetMode:
        env = build(
            num_envs=1, autoreset=mode.name.lower(), obs_mode="depth", camera_size=16
        )
        assert env.autoreset_mode == FrameStack(env, 2).autoreset_mode == mode
        assert FlattenStatePixels(env).autoreset_mode == mode


def test_a_frameskip_is_refused_as_torchrl_understands_it() -> None:
    with pytest.raises(
        TypeError, match="unexpected keyword argument 'frameskip'"
    ) as refused:
        gymnasium.make(ENV_ID, frameskip=2)
    assert isinstance(refused.value, UsageError)


def test_worlds_run_in_processes_of_their_own() -> None:
    env = gymnasium.make_vec(ENV_ID, num_envs=2, vectorization_mode="async", **OPTIONS)
    try:
        obs, info = env.reset(seed=[5, 6])  # pyright: ignore[reportArgumentType]
        assert env.observation_space.contains(obs)
        assert [spec["seed"] for spec in info["episode_spec"]] == [5, 6]
        _, reward, *_, info = env.step(still(env))
        assert reward.shape == (2,) and info["robot_force"].dtype == np.float64
    finally:
        env.close()
    here = build(num_envs=1, autoreset="disabled")
    same, _ = here.reset(seed=6)
    np.testing.assert_array_equal(obs[STATE_KEY][1], same[STATE_KEY][0])


def test_info_is_arrays_and_its_records_reach_who_looks_at_nothing_else() -> None:
    env = build(num_envs=2, horizon=3)
    wrapped = DictInfoToList(env)
    wrapped.reset(seed=0)
    for _ in range(2):
        *_, infos = wrapped.step(still(env))
    assert infos[1]["ended"] is None and infos[1]["episode_spec"]["index"] > 0
    *_, truncated, info = env.step(still(env))
    assert truncated.all()
    leaves = {k: v for k, v in info.items() if not isinstance(v, Mapping)}
    assert all(isinstance(v, np.ndarray) and len(v) == 2 for v in leaves.values())
    assert {k for k, v in leaves.items() if v.dtype == object} == set(OBJECTS)
    # same_step: the record is of the episode that has just ended, the spec of the one that begins.
    assert [record["kind"] for record in info["ended"]] == ["close", "close"]
    assert info["ended"][0]["label"] == info["final_info"]["ended"][0]["label"]
    assert [spec["index"] & 1 for spec in info["episode_spec"]] == [1, 1]
    *_, info = env.step(still(env))
    assert info["ended"].tolist() == [None, None]


def test_step_before_reset_is_told() -> None:
    env = build(num_envs=2)
    with refused(said="call env.reset"):
        env.step(still(env))


def test_keys_are_flat_or_nested() -> None:
    flat = build(num_envs=2, obs_mode="depth", camera_size=16)
    deep = build(
        num_envs=2, obs_mode="depth", camera_size=16, obs_keys="nested", horizon=1
    )
    have, _ = flat.reset(seed=1)
    got, _ = deep.reset(seed=1)
    assert deep.observation_space.contains(got)
    assert set(got) == {"agent", "extra", "sensor_data", "sensor_param", "state"}
    same = nested(have)
    np.testing.assert_array_equal(got["extra"]["is_grasped"], have["extra/is_grasped"])
    np.testing.assert_array_equal(
        got["sensor_data"]["fetch_head"]["depth"],
        same["sensor_data"]["fetch_head"]["depth"],
    )
    *_, info = deep.step(still(deep))
    assert set(info["final_obs"]) == set(got) and "qpos" in info["final_obs"]["agent"]
    for refuse in (lambda: FrameStack(deep, 2), lambda: Recorder(None, deep, {})):  # type: ignore[arg-type]
        with refused(said="flat"):
            refuse()


@pytest.mark.parametrize("keys", ["flat", "nested"])
@pytest.mark.parametrize("mode", ["state", "proprioception+depth"])
def test_flattened_observations_hold_the_state_once(keys: str, mode: str) -> None:
    options = {**OPTIONS, "obs_keys": keys, "obs_mode": mode, "camera_size": 16}
    env: Any = gymnasium.make(ENV_ID, **options, cameras=("fetch_hand",))
    obs, _ = env.reset(seed=0)
    flat: Any = spaces.flatten(env.observation_space, obs)
    state = obs[STATE_KEY]
    others = 0 if mode == "state" else 16 * 16 + 9 + 16 + 12
    assert flat.shape == (len(state) + others,)
    assert spaces.flatdim(env.observation_space) == len(flat)
    assert spaces.flatten_space(env.observation_space).contains(flat.astype(np.float32))
    np.testing.assert_array_equal(flat[len(flat) - len(state) :], state)
    back: Any = spaces.unflatten(env.observation_space, flat)
    assert list(back) == list(env.observation_space.spaces)
    for key, value in leaves(obs).items():
        np.testing.assert_array_equal(leaves(back)[key], value)
    seen, _ = FlattenObservation(env).reset(seed=0)
    np.testing.assert_array_equal(seen, flat)
    env.close()


def leaves(obs: Mapping[str, Any], before: tuple[str, ...] = ()) -> dict[Any, np.ndarray]:
    """Entries of nested dicts by path."""
    found: dict[Any, np.ndarray] = {}
    for key, value in obs.items():
        path = (*before, key)
        found |= leaves(value, path) if isinstance(value, Mapping) else {path: value}
    return found


def test_stacked_and_normalised_observations_are_flattened_once_too() -> None:
    env = build(num_envs=2, obs_mode="depth", camera_size=16, cameras="fetch_hand")
    width = state_dim(env.layout.robot)
    plain = spaces.flatdim(env.single_observation_space)
    stacked = NormalizeImages(FrameStack(env, 3))
    assert spaces.flatdim(stacked.single_observation_space) == plain + 2 * 16 * 16
    assert (
        spaces.flatdim(FrameStack(env, 2, ["state"]).single_observation_space) > 3 * width
    )
    other = build(
        num_envs=2,
        obs_mode="depth",
        camera_size=16,
        cameras="fetch_hand",
        autoreset="disabled",
    )
    flat, _ = VectorFlattenObservation(other).reset(seed=0)
    assert flat.shape == (2, plain)


def test_the_state_as_a_whole_comes_without_its_parts() -> None:
    env = build(num_envs=2, obs_keys="whole", horizon=1)
    obs, _ = env.reset(seed=0)
    assert set(obs) == {STATE_KEY} == set(env._keys)
    *_, info = env.step(still(env))
    assert set(info["final_obs"]) == {STATE_KEY}
    images = build(num_envs=1, obs_keys="whole", obs_mode="depth", camera_size=16)
    stacked, _ = FrameStack(images, 2).reset(seed=0)
    assert "agent/qpos" not in stacked and STATE_KEY in stacked
    with refused(said="parts of the state"):
        Recorder(None, env, {})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("env_id", "options", "steps"),
    [
        ("mjhab/CloseSubtaskTrain-v1", {}, 200),
        ("mjhab/CloseSubtaskTrain-v1", {"horizon": 7}, 7),
        ("mjhab/CloseSubtaskTrain-v1", {"profile": "ms_hab"}, 100),
        ("mjhab/NavigateSubtaskTrain-v1", {}, 1000),
        # Each of its two objects: 4 times Navigate, Open, Pick, Place, Close.
        ("mjhab/SetTable-v1", {}, 2 * (4 * 500 + 4 * 200)),
    ],
)
def test_the_specification_tells_the_longest_episode(
    env_id: str, options: dict[str, Any], steps: int
) -> None:
    env = gymnasium.make(env_id, **options)
    worlds = gymnasium.make_vec(env_id, **options)
    assert env.spec is not None and worlds.spec is not None
    assert env.spec.max_episode_steps == worlds.spec.max_episode_steps == steps
    # Not by a wrapper, which would end episodes of other horizons.
    assert "TimeLimit" not in repr(env)
    again = gymnasium.make(env.spec)
    assert again.spec is not None and again.spec.max_episode_steps == steps


def test_other_libraries_see_that_gymnasium_made_the_classes() -> None:
    """skrl's wrap_env looks at the direct bases."""
    for kind in (SequentialTaskEnv, DeviceEnv, SingleEnv):
        assert any(base.__module__.startswith("gymnasium.") for base in kind.__bases__)


@pytest.mark.parametrize(
    ("option", "value", "here"),
    [
        ("obs_mode", "segmentation", "'seg'"),
        ("obs_mode", "rgb+segmentation", "'seg'"),
        ("obs_mode", "state_dict", "obs_keys='nested'"),
        ("shader_dir", "default", "shader='raster'"),
        ("sensor_configs", {"width": 64}, "camera_size=128"),
        ("max_episode_steps", 200, "horizon=N"),
        ("task_plans", [], "episodes_file='FILE'"),
        ("spawn_data_fp", "x.pt", "spawns='FILE'"),
        ("robot_uids", "fetch", "robot='fetch'"),
        ("build_config_idxs", [1], "home='...'"),
    ],
)
def test_spellings_of_the_original_get_its_name_here(
    option: str, value: Any, here: str
) -> None:
    for make in (mjhab.make, mjhab.make_train):
        with refused(said=here) as told:
            make(**{option: value})
        assert told.value.expected and "Did you mean" not in str(told.value)


def test_the_options_are_listed_where_they_are_documented() -> None:
    words = set(re.findall(r"\w+", mjhab.make.__doc__ or ""))
    assert not {field.name for field in dataclasses.fields(EnvConfig)} - words


def test_a_restored_state_can_be_observed() -> None:
    env = build(num_envs=2, autoreset="disabled")
    with refused(said="call env.reset"):
        env.observe()
    obs, _ = env.reset(seed=0)
    same = env.observe()
    assert set(same) == set(obs)
    np.testing.assert_array_equal(same[STATE_KEY], obs[STATE_KEY])
    kept = env.get_state(0)
    moved, *_ = env.step(np.full_like(still(env), 0.5))
    assert (moved[STATE_KEY][0] != obs[STATE_KEY][0]).any()
    env.set_state(0, kept)
    back = env.observe()[STATE_KEY]
    # A restored world may differ in the last digits.
    np.testing.assert_allclose(back[0], obs[STATE_KEY][0], atol=1e-6)
    np.testing.assert_array_equal(back[1], moved[STATE_KEY][1])
    one: Any = gymnasium.make(ENV_ID, **OPTIONS)
    first, _ = one.reset(seed=0)
    np.testing.assert_array_equal(one.unwrapped.observe()[STATE_KEY], first[STATE_KEY])


def test_info_tells_which_reward_is_paid() -> None:
    worlds = (
        (mjhab.make(subtask="close", **OPTIONS), "sparse"),
        (build(num_envs=1), "normalized_dense"),
        (mjhab.make(subtask="close", profile="ms_hab", **OPTIONS), "sparse"),
    )
    for env, paid in worlds:
        _, info = env.reset(seed=0)
        assert info["reward_mode"].tolist() == [paid]
        *_, reward, _, _, info = env.step(still(env))
        assert info["reward_mode"].tolist() == [paid]
        assert (float(reward[0]) == 0.0) == (paid == "sparse")


def test_proprioception_holds_what_the_robot_measures() -> None:
    env = build(num_envs=2, obs_mode="proprioception")
    obs, _ = env.reset(seed=0)
    robot = env.layout.robot
    space = env.single_observation_space
    assert isinstance(space, spaces.Dict)
    hidden = {"extra/obj_pose_wrt_base", "extra/goal_pos_wrt_base", "extra/is_grasped"}
    assert not hidden & set(obs) and obs[STATE_KEY].shape == (
        2,
        state_dim(robot, own=True),
    )
    actions = still(env)
    actions[:, 11] = 0.5  # ahead at half of 1 m/s
    for _ in range(6):
        before = env.state.robot_q[:, :3].copy()
        obs, *_ = env.step(actions)
    moved = env.state.robot_q[:, :3] - before
    ahead = np.cos(before[:, 2]) * moved[:, 0] + np.sin(before[:, 2]) * moved[:, 1]
    speed = obs[BASE_VELOCITY_KEY]
    np.testing.assert_allclose(speed[:, 0], ahead / 0.05, atol=0.05)
    assert (np.abs(speed[:, 0]) > 0.2).all() and (np.abs(speed[:, 1]) < 0.05).all()
    assert env.observation_space.contains(obs)


def test_scales_of_another_shape_are_told_theirs() -> None:
    with refused("reward_scales"):
        build(reward_scales={"reach": 10})


def test_a_frozen_map_is_read_only() -> None:
    spec = FrozenMap({"a": 1})
    with pytest.raises(TypeError):
        spec["a"] = 2  # type: ignore[index]
    assert copy.deepcopy(spec) == spec == {"a": 1}
