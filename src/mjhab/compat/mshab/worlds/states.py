"""States of all worlds in ManiSkill's layout, as `export maniskill` writes those of recorded episodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from mjhab.compat.mshab.worlds.observing import as_tensor
from mjhab.core.arrays import as_like
from mjhab.data.export.maniskill_states import actor_state, articulation_state
from mjhab.data.imports.ms_hab_layout import object_id
from mjhab.envs.loop import TaskLoop

_UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def actors(worlds: TaskLoop) -> dict[str, torch.Tensor]:
    """(W, 13) of every object by its name in task plans: pose in the axes of its scan, velocities in the world."""
    state = worlds.state
    layout = worlds.layout
    poses = as_tensor(state.object_pose)
    yaws = as_like(np.array([kind.scan_yaw for kind in layout.objects]), poses)
    rows = actor_state(poses, as_tensor(state.object_vel), yaws).float()
    names = enumerate(layout.object_names)
    return {object_id(name): rows[:, at] for at, name in names}


def articulations(worlds: TaskLoop, homes: Sequence[str]) -> dict[str, torch.Tensor]:
    """(W, 13 + 2 joints) of the robot and of every piece of furniture: root, positions, velocities.

    Args:
        homes: (W,) name of every world's home, in which furniture has its place.
    """
    state = worlds.state
    layout = worlds.layout
    robot = layout.robot
    # The root of the robot stands still: its base is the first three joints.
    root = np.array([0.0, 0.0, robot.base_height, *_UPRIGHT])
    own = (as_tensor(state.robot_q), as_tensor(state.robot_qd))
    found = {robot.name: articulation_state(root, *own).float()}
    for furniture in layout.articulations:
        at = [
            i for i, ref in enumerate(layout.links) if ref.articulation == furniture.name
        ]
        signs = [-1.0 if layout.links[i].link.mirrored else 1.0 for i in at]
        joints = [
            as_tensor(values)[:, at] * as_like(np.array(signs), as_tensor(values))
            for values in (state.link_q, state.link_qd)
        ]
        placed = [
            layout.articulation_placement(layout.pack.homes_by_name[home], furniture.name)
            for home in homes
        ]
        roots = np.array([(*place.pos, *place.rotation) for place in placed])
        found[f"{furniture.name}-0"] = articulation_state(roots, *joints).float()
    return found
