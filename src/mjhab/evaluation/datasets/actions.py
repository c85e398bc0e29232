"""Recorded actions as those of another control mode, and whether these still do what the recorded ones did."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjhab.core.errors import fault
from mjhab.core.rotations import rotation_vector
from mjhab.data.export.columns import action_columns
from mjhab.data.record.batches import batches
from mjhab.data.record.worlds import RecordedEnv
from mjhab.data.select.describing import teleported_steps
from mjhab.data.select.query import Filter
from mjhab.data.store.episode_data import RunInfo
from mjhab.data.store.reading import RecordedEpisode
from mjhab.evaluation.datasets.specs import ReplaySpec
from mjhab.evaluation.recorded import recorded_env
from mjhab.robots.controllers import DEFAULT_MODE, Controller, make_controller
from mjhab.robots.registry import robot_named

JOINTS = "pd_joint_pos"
EE_DELTA = "pd_ee_delta_pose"


def base_height(run: RunInfo) -> float:
    """Height of the base link of a run's robot above the floor [m]."""
    return robot_named(run.robot).base_height


def converted_columns(run: RunInfo, mode: str) -> list[dict[str, Any]]:
    """Name, unit and frame of the entries of the actions of a run, in a control mode ("": that of the recording)."""
    if not mode:
        return action_columns(run)
    table = [vars(entry) for entry in _controller(run, mode).table]
    return action_columns(
        dataclasses.replace(run, layout={**run.layout, "action_table": table})
    )


def converted(episode: RecordedEpisode, mode: str) -> tuple[np.ndarray, np.ndarray]:
    """Executed and intended actions (N, A) float32 of an episode in a control mode ("": that of the recording).

    The arm's entries command the positions that the recorded ones commanded in the recorded states; all others are as
    they were recorded. Commands beyond the range of an entry are clipped, as the environment does.

    Raises:
        UsageError: neither the recorded mode nor ``mode`` is ``pd_joint_delta_pos``; the two have other servos; or the
            episode was recorded without states.
    """
    run = episode.run
    recorded = run.config.get("env", {}).get("control_mode", DEFAULT_MODE)
    given = (episode.array("actions"), episode.array("actions_intended"))
    if mode in ("", recorded):
        return given
    controller = _controller(run, mode)
    source = _controller(run, recorded)
    if DEFAULT_MODE not in (mode, recorded) or source.drives != controller.drives:
        raise fault(
            f"episode {episode.name} of {episode.shard.path}",
            f"was recorded in the control mode {recorded}; actions of {DEFAULT_MODE} can be converted, and those of "
            f"modes with the same servos to {DEFAULT_MODE}.",
        )
    columns = run.layout["columns"]["robot_q"]
    # The state before each action; the last state has none after it.
    q = episode.array("states/qpos")[:-1][:, columns]
    if recorded == DEFAULT_MODE:
        executed, intended = (_in_mode(controller, each, q) for each in given)
    else:
        executed, intended = _as_deltas(source, given, q, teleported_steps(episode))
    return executed, intended


def _as_deltas(
    source: Controller,
    given: tuple[np.ndarray, np.ndarray],
    q: np.ndarray,
    teleported: np.ndarray,
) -> list[np.ndarray]:
    """Actions (N, A) of another mode, taken at joint positions (N, J), in the default mode.

    Args:
        source: controller of that mode, for one world.
        given: executed and intended actions. What the mode remembers follows from those executed.
        q: joint positions.
        teleported: (N,) bool, steps after which the mode begins anew.
    """
    arm = list(source.robot.arm_columns)
    aims = [np.empty((len(q), len(arm))) for _ in given]
    begins = True
    for t, now in enumerate(q[:, None]):
        if begins:
            source.reset(np.ones(1, bool), _RecordedJoints(now))
        # Both actions start from the controller's same memory; the intended one must not move it.
        state = source.get_state(0)
        # The executed action last: the memory that it leaves is what the next step had.
        for each, aim in zip(reversed(given), reversed(aims), strict=True):
            source.set_state(0, state)
            aim[t] = source.command(each[t][None].astype(float), now)[0, arm]
        # The environment resets the controller after a teleport, whose joints are others than commanded.
        begins = teleported[t]
    return [
        np.clip(
            np.concatenate(
                [
                    (aim - q[:, arm]) / source.limits.joint_delta,
                    each[:, source.gripper :],
                ],
                axis=1,
            ),
            -1.0,
            1.0,
        ).astype(np.float32)
        for each, aim in zip(given, aims, strict=True)
    ]


@dataclass(frozen=True)
class _RecordedJoints:
    """The part of a state that a controller reads: joint positions (1, J)."""

    robot_q: np.ndarray


def _controller(run: RunInfo, mode: str) -> Controller:
    env = run.config.get("env", {})
    robot = robot_named(run.robot)
    return make_controller(mode, robot=robot, base=env.get("base", "forward"))


def _in_mode(controller: Controller, actions: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Actions (N, A) of the default mode, taken at joint positions (N, J), in the mode of a controller."""
    robot = controller.robot
    arm = list(robot.arm_columns)
    count = len(arm)
    now = q[:, arm]
    # Clipped as the controller does, so that the aim is what was commanded.
    aim = now + controller.limits.joint_delta * np.clip(actions[:, :count], -1.0, 1.0)
    moves = _arm_entries(controller, now, aim)
    whole = np.concatenate([moves, actions[:, count:]], axis=1)
    return np.clip(whole, controller.low, controller.high).astype(np.float32)


def _arm_entries(controller: Controller, now: np.ndarray, aim: np.ndarray) -> np.ndarray:
    """Entries of an action that bring the arm from joint positions (N, J) to others."""
    if controller.mode == JOINTS:
        return aim
    chain = controller.robot.arm_chain
    goal, turned = chain.tip_pose(aim)
    if controller.mode != EE_DELTA:
        return np.concatenate([goal, rotation_vector(turned)], axis=1)
    here, rot = chain.tip_pose(now)
    turn = rotation_vector(turned @ rot.swapaxes(1, 2))
    limits = controller.limits
    return np.concatenate([(goal - here) / limits.ee_move, turn / limits.ee_turn], axis=1)


@dataclass(frozen=True)
class ConvertedReplay:
    """How converted actions did. episodes: that were replayed. recorded, replayed: how many of them succeeded then and
    now. both: how many did both times."""

    episodes: int
    recorded: int
    replayed: int
    both: int


def replay_converted(spec: ReplaySpec) -> ConvertedReplay:
    """Simulate the actions of episodes as converted to ``spec.actions``, from their starts, whatever happens.

    Raises:
        UsageError: see `converted`; no episode passes the filter.
    """

    def make_env(run: RunInfo) -> RecordedEnv:
        env = {**run.config.get("env", {}), "control_mode": spec.actions}
        asked = spec.asked
        other = dataclasses.replace(run, config={**run.config, "env": env})
        return recorded_env(
            other, obs_mode="state", num_envs=asked.num_envs, threads=asked.threads
        )

    then: list[bool] = []
    now: list[bool] = []
    where: Filter | None = spec.filter()
    for env, batch in batches(spec.places, make_env, where):
        then += [episode.record.success_once for episode in batch]
        now += _succeed(env, batch, spec.actions)
    both = np.array(then) & np.array(now)
    return ConvertedReplay(
        len(then), int(np.sum(then)), int(np.sum(now)), int(np.sum(both))
    )


def _succeed(env: RecordedEnv, batch: list[RecordedEpisode], mode: str) -> list[bool]:
    """Whether each of at most W episodes reaches its goal with converted actions."""
    count = len(batch)
    mask = np.arange(env.num_envs) < count
    seeds = [episode.record.seed for episode in batch] + [None] * (env.num_envs - count)
    indices = np.array([episode.record.index for episode in batch])
    env.reset(seed=seeds, options={"episode": indices, "reset_mask": mask})
    rows = [converted(episode, mode)[0] for episode in batch]
    longest = max(len(each) for each in rows)
    actions = np.zeros((env.num_envs, rows[0].shape[1]), np.float32)
    succeeded = np.zeros(env.num_envs, bool)
    for t in range(longest):
        for world, each in enumerate(rows):
            # Episodes that are over go on with their last action, which nobody looks at.
            actions[world] = each[min(t, len(each) - 1)]
        *_, info = env.step(actions)
        running = np.array(
            [t < len(each) for each in rows] + [False] * (env.num_envs - count)
        )
        succeeded |= running & np.asarray(info["success"])
    return succeeded[:count].tolist()
