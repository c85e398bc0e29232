"""Profiles: what they set, what they leave free, what contradicts them, and where their name is recorded."""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium
import numpy as np
import pytest

import mjhab
import mjhab.envs as envs
from mjhab.config.env import EnvConfig, TrainConfig
from mjhab.config.profiles import MJHAB, MS_HAB, PROFILES
from mjhab.config.thresholds import task_config
from mjhab.data.record.provenance import describe_run
from mjhab.envs.wrappers import FrameStack
from mjhab.evaluation.recorded import recorded_env
from mjhab.experts import make_expert
from mjhab.learning.observation.spec import profile_of
from mjhab.robots.fetch.robot import ROBOT
from mjhab.tasks.subtasks.registry import force_limits, limits_of, number_of
from mjhab.tasks.subtasks.registry import horizons as horizons_of
from tests.refusals import refused

PICK: dict[str, Any] = {"task": "tidy_house", "subtask": "pick"}
PUBLISHED = {
    "stillness": "published",
    "spawn_rule": "published",
    "stationary": ("head",),
    "force_limits": True,
    "reward_formula": "published",
    "reward_normaliser": "published",
    "cameras": ("fetch_head", "fetch_hand"),
    "frame_stack": 3,
    "handle_points": "published",
    "object_axes": "scan",
    "joint_angles": "unwrapped",
    "joint_dynamics": "published",
}
USUAL = {
    "stillness": "absolute",
    "spawn_rule": "front_box",
    "stationary": (),
    "force_limits": True,
    "reward_formula": "bounded",
    "reward_normaliser": "attainable",
    "cameras": ("fetch_head", "fetch_hand"),
    "frame_stack": 1,
    "handle_points": "ours",
    "object_axes": "object",
    "joint_angles": "wrapped",
    "joint_dynamics": "ours",
    "horizon": 0,
}


def values(config: EnvConfig, names: dict[str, Any]) -> dict[str, Any]:
    return {name: getattr(config, name) for name in names}


def test_profiles_set_their_values_at_once() -> None:
    for build in (EnvConfig, TrainConfig):
        assert values(build(**PICK), USUAL) == USUAL and build(**PICK).profile == "mjhab"
        assert values(build(profile="ms_hab", **PICK), PUBLISHED) == PUBLISHED
    assert list(PROFILES) == ["mjhab", "ms_hab"] and not MJHAB.binding and MS_HAB.binding


@pytest.mark.parametrize(
    ("build", "subtask", "horizons"),
    [
        (EnvConfig, "pick", (200, 200, 200, 200, 200)),
        (EnvConfig, "", (200, 200, 500, 200, 200)),
        (EnvConfig, "navigate", (200, 200, 500, 200, 200)),
        (TrainConfig, "pick", (100, 100, 100, 100, 100)),
        (TrainConfig, "navigate", (200, 200, 1000, 200, 200)),
    ],
)
def test_horizons_are_those_of_training_and_of_evaluation(
    build: Any, subtask: str, horizons: tuple[int, ...]
) -> None:
    limits = task_config(
        build(profile="ms_hab", task="set_table", subtask=subtask), ROBOT
    )
    judged = number_of(subtask) if subtask else slice(None)
    assert np.all(np.array(horizons_of(limits))[judged] == np.array(horizons)[judged])
    assert (
        force_limits(limits)[:5] == (5000.0, 7500.0, np.inf, 10000.0, 10000.0)
        and limits.stillness == "published"
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("stillness", "absolute"),
        ("spawn_rule", "front_box"),
        ("stationary", ()),
        ("force_limits", False),
        ("reward_formula", "bounded"),
        ("reward_normaliser", "attainable"),
        ("cameras", ("fetch_hand", "fetch_head")),
        ("object_axes", "object"),
        ("joint_angles", "wrapped"),
        ("joint_dynamics", "ours"),
        ("overrides", {"pick.force_limit": 1400}),
    ],
)
def test_an_option_that_contradicts_the_profile_is_refused_with_both_names(
    name: str, value: Any
) -> None:
    wanted: dict[str, Any] = {name: value}
    given, contradicted = (
        next(iter(value.items())) if isinstance(value, dict) else (name, value)
    )
    for build in (EnvConfig, TrainConfig):
        with refused(given, contradicted, where="ms_hab"):
            build(profile="ms_hab", **PICK, **wanted)
        build(**PICK, **wanted)


@pytest.mark.parametrize(
    "free",
    [
        {"frame_stack": 1},
        {"frame_stack": 2},
        {"horizon": 200},
        {"overrides": {"pick.horizon": 300}},
    ],
)
def test_settings_of_the_original_itself_are_not_refused(free: dict[str, Any]) -> None:
    """Its behaviour cloning sees one frame, its diffusion policy two; its evaluation lasts 200 control steps."""
    for build in (EnvConfig, TrainConfig):
        config = build(profile="ms_hab", **PICK, **free)
        assert config.profile == profile_of(vars(config)) == "ms_hab"
        told = config.of_profile()
        for name, value in free.items():
            assert getattr(config, name) == value
            assert told.get(name, value) == value


def test_what_agrees_or_is_not_fixed_may_be_given() -> None:
    free: dict[str, Any] = {
        "control_mode": "pd_joint_pos",
        "camera_size": 64,
        "overrides": {"goal_type": "cylinder"},
    }
    # Recorded runs tell lists where there were tuples.
    cameras: Any = ["fetch_head", "fetch_hand"]
    config = EnvConfig(
        profile="ms_hab",
        **PICK,
        **free,
        stillness="published",
        horizon=200,
        cameras=cameras,
    )
    assert config.camera_size == 64
    again = dataclasses.replace(config, num_envs=5)
    assert values(again, PUBLISHED) | {"cameras": tuple(again.cameras)} == PUBLISHED


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"profile": "mshab"}, "profile"),
        ({"stillness": "absolut"}, "stillness"),
        ({"spawn_rule": "frontbox"}, "spawn rule"),
        ({"reward_formula": "unbounded"}, "reward formula"),
        ({"joint_dynamics": "0.01"}, "joint dynamics"),
        ({"reward_normaliser": "28"}, "reward normaliser"),
        ({"starts": "published"}, "starts"),
        ({"frame_stack": 0}, "frame_stack"),
        ({"overrides": {"stillness": "published"}}, "overrides"),
    ],
)
def test_unknown_values_list_the_valid_ones(options: dict[str, Any], words: str) -> None:
    with refused(words):
        task_config(EnvConfig(**options), ROBOT)


def test_environments_take_profiles_in_every_way_they_are_made() -> None:
    made = mjhab.make(**PICK, profile="ms_hab", num_envs=2, threads=1)
    trained = mjhab.make_train(**PICK, profile="ms_hab", num_envs=2, threads=1)
    named: Any = gymnasium.make_vec(
        "mjhab/PickSubtaskTrain-v1", num_envs=2, profile="ms_hab", threads=1
    )
    single: Any = gymnasium.make("mjhab/PickSubtaskTrain-v1", profile="ms_hab", threads=1)
    for env, horizon in (
        (made, 200),
        (trained, 100),
        (named.unwrapped, 100),
        (single.unwrapped, 100),
    ):
        assert (
            env.config.profile == "ms_hab"
            and limits_of(env.task_config, "pick").horizon == horizon
        )
        assert env.task_config.stillness == "published"
    for env in (made, trained, named, single):
        env.close()


def test_a_head_that_is_stationary_stays_and_the_expert_does_without_it() -> None:
    env = envs.make_train(
        **PICK, profile="ms_hab", num_envs=1, threads=1, autoreset="disabled"
    )
    env.reset(seed=0)
    before = env.state.robot_q[0, [4, 6]].copy()
    for _ in range(5):
        env.step(np.ones((1, 13), np.float32))
    np.testing.assert_allclose(env.state.robot_q[0, [4, 6]], before, atol=5e-3)
    assert make_expert(env) is not None
    still = envs.make_train(**PICK, stationary=("torso",), num_envs=1, threads=1)
    with refused(said="nothing stationary but the head"):
        make_expert(still)


def test_the_published_reward_reaches_the_environment() -> None:
    usual, published = (
        envs.make_train(
            task="set_table",
            subtask="close",
            num_envs=1,
            threads=1,
            profile=name,
            autoreset="disabled",
        )
        for name in ("mjhab", "ms_hab")
    )
    for env, whole in ((usual, 36.0), (published, 37.0)):
        env.reset(seed=1)
        _, reward, _, _, info = env.step(np.zeros((1, 13), np.float32))
        assert reward[0] == pytest.approx(
            sum(float(term[0]) for term in info["reward_terms"].values()) / whole
        )


def test_frames_are_those_of_the_profile() -> None:
    options = {**PICK, "num_envs": 1, "threads": 1, "obs_mode": "depth", "camera_size": 8}
    env = envs.make_train(**options, profile="ms_hab")
    assert FrameStack(env).num_stack == FrameStack(env, 3).num_stack == 3
    with refused(where="FrameStack", said="frame_stack=2"):
        FrameStack(env, 2)
    free = envs.make_train(**options)
    assert FrameStack(free, 2).num_stack == 2 and FrameStack(free).num_stack == 1


def test_runs_tell_the_profile_and_the_values_in_force() -> None:
    env = envs.make(**PICK, profile="ms_hab", num_envs=1, threads=1)
    run = describe_run(env, {"name": "zero"})
    assert run.config["env"]["profile"] == "ms_hab"
    told = {**run.config["env"], **run.options}
    assert {
        name: tuple(v) if isinstance(v := told[name], list) else v for name in PUBLISHED
    } == PUBLISHED
    # An episode that was recorded before there was a choice of joints had ours, whatever its profile.
    before = {k: v for k, v in run.config["env"].items() if k != "joint_dynamics"}
    older = dataclasses.replace(run, config={**run.config, "env": before})
    for recorded, dynamics in ((run, "published"), (older, "ours")):
        again = recorded_env(recorded, num_envs=1, threads=1)
        assert again.config.joint_dynamics == again.layout.joint_dynamics == dynamics
        again.close()
    # Nor was there a choice of what fingers do in a teleport.
    assert run.config["env"].pop("teleport_fingers") == "still"
    again = recorded_env(run, num_envs=1, threads=1)
    assert again.config.teleport_fingers == "commanded"
    again.close()
    # What is only seen or said of an episode is not part of what happened in it.
    assert not {"frame_stack", "cameras", "reward_formula"} & set(run.config["env"])
