"""Teleports on the device: the goal poses of all Navigate subtasks of a plan, computed with the start of its episode.

The cpu backend samples poses during the episode and checks each against the present state of the world. This module
samples the same poses in the same order, but checks them against the expected state: that after success of all earlier
subtasks. Both give the same pose unless objects lie elsewhere than expected; then the robot may touch them. With an
object in hand the arm keeps its pose here, while the cpu backend adds noise to it.
"""

from __future__ import annotations

import numpy as np
import torch

from mjhab.core.joints import BASE, BASE_X, BASE_Y, BASE_YAW
from mjhab.core.rotations import quat_mul
from mjhab.core.seeding import stream
from mjhab.episodes.episode import Episode
from mjhab.episodes.spawns import MAX_TRIES
from mjhab.episodes.starts import Start, StartMaker
from mjhab.layout.addresses import Addresses
from mjhab.sim.protocol import SimState
from mjhab.tasks.subtasks.registry import spec_of


def find_teleport_poses(
    starts: StartMaker, episode: Episode, start: Start, length: int
) -> tuple[np.ndarray, np.ndarray]:
    """Find the pose of the robot after the teleport of every Navigate subtask of a plan.

    Args:
        starts: samples and checks poses.
        episode: the episode.
        start: its start state and plan.
        length: number of subtasks of the result; plans may be shorter.

    Returns:
        Joint positions (length, J), zero for other subtasks; and (length,) bool, True if no sampled pose was valid and
        the nearest one is used.
    """
    joints = np.zeros((length, len(starts.layout.robot.joints)))
    fallback = np.zeros(length, bool)
    for position, subtask in enumerate(start.plan.subtasks):
        if spec_of(subtask.kind).navigates:
            joints[position], fallback[position] = _land(starts, episode, start, position)
    return joints, fallback


def _land(
    starts: StartMaker, episode: Episode, start: Start, position: int
) -> tuple[np.ndarray, bool]:
    # The state that the plan should have led to: the present one is not known when the pool is made.
    qpos = starts.foresee(episode, start.plan, position)
    goal = starts.spawn_goal(start.plan, position, start.boxes)
    key = ("navigate", episode.task, episode.index, position)
    # A stream per try, as on the host, so that both backends sample the same poses.
    rngs = (stream(episode.seed, *key, attempt) for attempt in range(MAX_TRIES))
    found, _ = starts.sampler.search(episode.home, qpos, goal, rngs)
    missed = found is None
    if found is None:
        found = starts.sampler.fallback(episode.home, qpos, goal)
    return found[starts.sim.addresses.robot_q], missed


class Teleporter:
    """Moves robots, and the objects that they hold, to the poses of `find_teleport_poses`.

    Args:
        addresses: addresses of joints and objects in the layout's state.
        device: device of the tensors.
    """

    def __init__(self, addresses: Addresses, device: torch.device) -> None:
        self._robot_q = torch.as_tensor(
            np.asarray(addresses.robot_q, np.int64), device=device
        )
        self._first = int(addresses.object_q[0])
        self._slots = torch.arange(len(addresses.object_q), device=device)

    def moved(
        self,
        qpos: torch.Tensor,
        state: SimState,
        teleport_pose: torch.Tensor,
        carried: torch.Tensor,
    ) -> torch.Tensor:
        """Positions (W, nq) of all worlds after a teleport.

        Args:
            qpos: (W, nq) present positions.
            state: present state.
            teleport_pose: (W, J) joint positions after the teleport; a robot that holds the object to carry moves only
                its base, and the object with it.
            carried: (W,) int64 slot of the object to carry, -1 for none.
        """
        worlds = torch.arange(len(qpos), device=qpos.device)
        # -1 would read the last object.
        some = carried.clamp(min=0)
        pressed = state.finger_force[worlds, :, some].square().sum(-1) > 0
        held = (carried >= 0) & pressed.all(-1)
        base = teleport_pose[:, BASE]
        # With something in the hand the arm stays as it is, or the object would be lost.
        robot = torch.where(held[:, None], state.robot_q, teleport_pose)
        robot = torch.cat([base, robot[:, BASE.stop :]], dim=1)
        along = _turned(state.object_pose, state.robot_q[:, BASE], base)
        mine = held[:, None] & (self._slots == carried[:, None])
        poses = torch.where(mine[..., None], along, state.object_pose)
        out = qpos.clone()
        out[:, self._first : self._first + poses.shape[1] * 7] = poses.flatten(1)
        out[:, self._robot_q] = robot
        return out


def _turned(
    poses: torch.Tensor, before: torch.Tensor, after: torch.Tensor
) -> torch.Tensor:
    """Poses (W, N, 7) moved as a base moves from ``before`` to ``after``, both (W, 3): x, y, yaw."""
    turn = after[:, BASE_YAW] - before[:, BASE_YAW]
    cos = torch.cos(turn)[:, None]
    sin = torch.sin(turn)[:, None]
    zero = torch.zeros_like(poses[..., 0])
    x = poses[..., 0] - before[:, None, BASE_X]
    y = poses[..., 1] - before[:, None, BASE_Y]
    moved = torch.stack(
        [
            after[:, None, BASE_X] + cos * x - sin * y,
            after[:, None, BASE_Y] + sin * x + cos * y,
            poses[..., 2],
        ],
        dim=-1,
    )
    # Adding zeros spreads the turn over the objects.
    half = 0.5 * turn[:, None] + zero
    spin = torch.stack([torch.cos(half), zero, zero, torch.sin(half)], dim=-1)
    return torch.cat([moved, quat_mul(spin, poses[..., 3:])], dim=-1)
