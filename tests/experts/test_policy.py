"""What `ExpertPolicy` keeps: nothing of one episode may show in the next."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import mjhab
from mjhab.envs.parts.world_view import WorldView
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.experts import make_expert, policy
from mjhab.experts.arm import motion
from mjhab.experts.phases import phase
from mjhab.experts.policy import ExpertPolicy
from mjhab.tasks.style import Styles


def closes_once(view: WorldView) -> Iterator[np.ndarray]:
    """A script that closes the hand in episode 0 and has nothing to do in others."""
    if view.token[1] == 0:
        yield motion.action(view, gripper=motion.CLOSED)


@pytest.fixture
def env(monkeypatch: pytest.MonkeyPatch) -> Iterator[SequentialTaskEnv]:
    monkeypatch.setattr(policy, "script_of", lambda subtask: closes_once)
    made = mjhab.make(
        task="set_table",
        subtask="close",
        home="builtin_m0_00",
        num_envs=1,
        autoreset="disabled",
    )
    yield made
    made.close()


def first_action(
    env: SequentialTaskEnv, expert: ExpertPolicy, episode: int
) -> np.ndarray:
    obs, info = env.reset(seed=0, options={"episode": [episode]})
    expert.reset(np.ones(1, bool))
    return expert.act(obs, info)[0]


def test_a_script_that_ends_at_once_acts_as_after_no_other_episode(
    env: SequentialTaskEnv,
) -> None:
    used = make_expert(env)
    assert first_action(env, used, 0)[env.layout.robot.action.gripper] == motion.CLOSED
    after = first_action(env, used, 1)
    np.testing.assert_array_equal(after, first_action(env, make_expert(env), 1))


@phase("stumble")
def stumbles(view: WorldView) -> Iterator[np.ndarray]:
    yield motion.action(view, gripper=motion.CLOSED)
    raise ValueError("no floor")


def test_an_error_of_a_script_names_subtask_and_phase(
    env: SequentialTaskEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy, "script_of", lambda subtask: stumbles)
    expert = make_expert(env)
    first_action(env, expert, 0)
    assert expert.phases(0) == ("stumble",)
    with pytest.raises(ValueError, match="no floor") as caught:
        expert.act({}, {})
    (note,) = caught.value.__notes__
    assert "'close'" in note and "stumble" in note


def test_the_style_is_that_of_an_episode_in_which_the_expert_has_not_acted(
    env: SequentialTaskEnv,
) -> None:
    styles = Styles.parse(["speed=0.5..1.0"])
    expert = make_expert(env, styles)
    first_action(env, expert, 0)
    # In the next one another policy acts, as the student of a take-over does.
    env.reset(seed=0, options={"episode": [1]})
    assert expert.style(0)["speed"] == styles.draw(0, 1).speed
    assert expert.style(0)["speed"] != styles.draw(0, 0).speed


def test_who_takes_over_does_not_stand_still_first(env: SequentialTaskEnv) -> None:
    expert = make_expert(env, Styles.parse(["hold=5"]))
    gripper = env.layout.robot.action.gripper
    # At the start the robot stands still with an open hand, and then the script closes it.
    assert first_action(env, expert, 0)[gripper] == motion.OPEN
    obs, _, _, _, info = env.step(np.zeros((1, env.layout.robot.action.dim), np.float32))
    expert.reset(np.ones(1, bool))
    assert expert.act(obs, info)[0, gripper] == motion.CLOSED
