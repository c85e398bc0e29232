"""From simulator arrays to what the task functions and the observations read."""

from __future__ import annotations

import numpy as np

from mjhab.envs.observations import ObsContext
from mjhab.envs.plan_tables import PlanTables
from mjhab.scenes.fetch import FINGER_LINKS, FINGER_OPEN_DIR, TCP_LINK
from mjhab.scenes.layout import Addresses, Layout
from mjhab.sim.protocol import SimState
from mjhab.tasks.measure import Signals, WorldState
from mjhab.tasks.plan import SubtaskKind


class Sensing:
    """Gathers, for every world, the quantities of its active subtask."""

    def __init__(self, layout: Layout, addresses: Addresses, num_worlds: int) -> None:
        self._rows = np.arange(num_worlds)
        self._fingers = [addresses.robot_body[f] for f in FINGER_LINKS]
        self._opening = np.array([FINGER_OPEN_DIR[f] for f in FINGER_LINKS])
        self._tcp = addresses.robot_body[TCP_LINK]
        self._link_body = addresses.link_body
        self._handles = np.array([ref.link.handle.pos for ref in layout.links])
        self._low = np.array([ref.link.range[0] for ref in layout.links])
        self._high = np.array([ref.link.range[1] for ref in layout.links])

    def world_state(
        self, state: SimState, tables: PlanTables, pointer: np.ndarray, joint_start: np.ndarray
    ) -> WorldState:
        """The input of `tasks.measure` for the subtasks at ``pointer`` (W,)."""
        rows = self._rows
        index = np.minimum(pointer, tables.arrays.length - 1)
        target, held, link = tables.target[rows, index], tables.held[rows, index], tables.link[rows, index]
        jointed = (link >= 0)[:, None]
        joint = np.stack([state.link_q[rows, link], self._low[link], self._high[link], joint_start], axis=1) * jointed
        obj_pos = state.object_pose[rows[:, None], tables.obj, :3] * (tables.obj >= 0)[..., None]
        return WorldState(
            base_pose=state.robot_q[:, :3],
            robot_q=state.robot_q,
            robot_qd=state.robot_qd,
            tcp_pos=state.body_pos[:, self._fingers].mean(axis=1),
            finger_force=self._force(state, target),
            finger_dir=np.einsum("wfij,fj->wfi", state.body_mat[:, self._fingers], self._opening),
            robot_force=state.link_force.sum(axis=1),
            target_contact=state.touch[rows, target] & (target >= 0),
            plan_obj_pos=obj_pos,
            joint_q=joint[:, 0],
            joint_min=joint[:, 1],
            joint_max=joint[:, 2],
            joint_start=joint[:, 3],
            held_force=self._force(state, held),
        )

    def _force(self, state: SimState, column: np.ndarray) -> np.ndarray:
        return state.finger_force[self._rows, :, column] * (column >= 0)[:, None, None]

    def joint_now(self, state: SimState, tables: PlanTables, pointer: np.ndarray) -> np.ndarray:
        """(W,) position of the joint of the subtask at ``pointer``, 0 where it has none."""
        index = np.minimum(pointer, tables.arrays.length - 1)
        link = tables.link[self._rows, index]
        return state.link_q[self._rows, link] * (link >= 0)

    def handle_pos(self, state: SimState, world: np.ndarray, link: np.ndarray) -> np.ndarray:
        """World positions (n, 3) of the handles of links (n,) in worlds (n,)."""
        body = self._link_body[link]
        return state.body_pos[world, body] + np.einsum("nij,nj->ni", state.body_mat[world, body], self._handles[link])

    def tcp_pose(self, state: SimState) -> np.ndarray:
        """(W, 7) world pose of gripper_link."""
        return np.concatenate([state.body_pos[:, self._tcp], state.body_quat[:, self._tcp]], axis=1)

    def context(self, state: SimState, tables: PlanTables, pointer: np.ndarray, signals: Signals) -> ObsContext:
        """The input of the observation table, masked by each world's active subtask."""
        rows = self._rows
        index = np.minimum(pointer, tables.arrays.length - 1)
        kind = tables.arrays.kind[rows, index]
        obj, link = tables.obj[rows, index], tables.link[rows, index]
        jointed = (kind == SubtaskKind.OPEN) | (kind == SubtaskKind.CLOSE)
        goal = tables.arrays.goal_pos[rows, index]
        if jointed.any():
            goal = np.where(jointed[:, None], self.handle_pos(state, rows, np.maximum(link, 0)), goal)
        return ObsContext(
            robot_q=state.robot_q,
            robot_qd=state.robot_qd,
            base=state.robot_q[:, :3],
            tcp_pose=self.tcp_pose(state),
            obj_pose=state.object_pose[rows, obj],
            has_obj=(obj >= 0) & (kind != SubtaskKind.CLOSE),
            goal_pos=goal,
            has_goal=kind != SubtaskKind.PICK,
            is_grasped=signals.is_grasped,
        )
