"""Inputs of the task functions and of the observations, computed from simulator arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.core.arrays import Array, as_like, cast, count, may_hold, namespace, zeros
from mjhab.core.conventions.changes import to_scan_axes, within_half_a_turn
from mjhab.core.conventions.names import SCAN_AXES, WRAPPED, Conventions
from mjhab.core.joints import BASE, BASE_YAW
from mjhab.envs.observations.entry import ObsContext
from mjhab.envs.observations.state import pose_in_base
from mjhab.envs.parts.plan_tables import Focus, Tables
from mjhab.layout.addresses import Addresses
from mjhab.layout.layout import Layout
from mjhab.scenes.spec import OWN_POINTS
from mjhab.sim.protocol import SimState
from mjhab.tasks.signals import Signals, WorldState

NEARLY_CLOSED = 0.02
"""Resolution of the opening in `Sensing.link_state`, as a fraction of the range."""
_OWN = Conventions()


@dataclass(frozen=True, eq=False)
class Felt:
    """What the hands of W worlds feel, world frame.

    Attributes:
        force: (W, 2, 2, 3) force [N] of the target, and of the carried object, on the [l, r] finger; 0 without one.
        target_contact: (W,) bool, some robot link touches the target.
        ee_contact: (W,) bool, a finger or the hand touches it.
        tcp_pos: (W, 3) middle of the two fingers [m].
        finger_dir: (W, 2, 3) unit directions in which the fingers open.
    """

    force: Array
    target_contact: Array
    ee_contact: Array
    tcp_pos: Array
    finger_dir: Array


class Sensing:
    """Gathers, for every world, the quantities of its active subtask.

    Args:
        layout: layout of the simulator.
        addresses: addresses of the layout in the simulator's arrays.
        num_worlds: W.
        like: an array of the simulator's library, device and dtype; numpy float64 if not given.
        handle_points: definition of the handle points in observations and rewards, one of HANDLE_POINTS.
        conventions: of observations.
    """

    def __init__(
        self,
        layout: Layout,
        addresses: Addresses,
        num_worlds: int,
        like: Array | None = None,
        handle_points: str = OWN_POINTS,
        conventions: Conventions = _OWN,
    ) -> None:
        like = np.zeros(0) if like is None else like
        whole = namespace(like).int64
        robot = layout.robot
        self._rows = count(num_worlds, like)
        self._left, self._right = (addresses.robot_body[f] for f in robot.finger_links)
        self._fingers = as_like([self._left, self._right], like, whole)
        self._opening = as_like([finger.opens for finger in robot.fingers], like)
        self._tcp = addresses.robot_body[robot.tcp]
        self._base_height = robot.base_height
        self._has_links = bool(layout.links)
        self._link_body = as_like(addresses.link_body, like, whole)
        self._handles = as_like(
            [ref.link.handle.point(handle_points) for ref in layout.links], like
        )
        self._conventions = conventions
        self._endless = robot.endless
        yaws = [kind.scan_yaw for kind in layout.objects]
        self._has_scans = any(yaws)
        self._scan_yaw = as_like(yaws or [0.0], like, namespace(like).float64)
        # The last row is for "no link", index -1.
        self._range = as_like(
            [*(ref.link.range for ref in layout.links), (0.0, 0.0)], like
        )

    def world_state(
        self, state: SimState, tables: Tables, focus: Focus, joint_start: Array
    ) -> WorldState:
        """Gather the input of `tasks.measure` for the active subtasks.

        Args:
            state: state of the simulator.
            tables: plans of the worlds.
            focus: the active subtasks.
            joint_start: (W,) joint position of the active link when its subtask began [m or rad].
        """
        joint_min, joint_max = self.joint_range(focus)
        felt = self.felt(state, focus)
        return WorldState(
            base_pose=state.robot_q[:, BASE],
            robot_q=state.robot_q,
            robot_qd=state.robot_qd,
            tcp_pos=felt.tcp_pos,
            finger_force=felt.force[:, 0],
            finger_dir=felt.finger_dir,
            robot_force=state.link_force.sum(axis=1),
            fingers_force=state.finger_net.sum(axis=1),
            target_contact=felt.target_contact,
            ee_contact=felt.ee_contact,
            plan_obj_pos=self.plan_obj_pos(state, tables, focus),
            joint_q=self.joint_now(state, focus),
            joint_min=joint_min,
            joint_max=joint_max,
            joint_start=joint_start,
            held_force=felt.force[:, 1],
        )

    def felt(self, state: SimState, focus: Focus) -> Felt:
        """What the hand feels of the target and of the object that a Navigate carries, and where it is."""
        rows = self._rows
        column = focus.columns
        has = focus.has_columns
        # Column -1 reads the last target, which the mask takes away.
        force = state.finger_force[rows[:, None], :, column] * has[..., None, None]
        return Felt(
            force,
            state.touch[rows, column[:, 0]] & has[:, 0],
            state.ee_contact[rows, column[:, 0]] & has[:, 0],
            # As ManiSkill's tcp_pose: the mean of the fingers, which is the tcp link while they are symmetric.
            (state.body_pos[:, self._left] + state.body_pos[:, self._right]) / 2,
            namespace(force).einsum(
                "wfij,fj->wfi", state.body_mat[:, self._fingers], self._opening
            ),
        )

    def plan_obj_pos(self, state: SimState, tables: Tables, focus: Focus) -> Array:
        """(W, S, 3) position of the object of every subtask of the plans in the world [m], zeros if it has none."""
        return state.object_pose[self._rows[:, None], tables.obj, :3] * focus.has_obj

    def joint_range(self, focus: Focus) -> tuple[Array, Array]:
        """(W,) lowest and highest joint position of the active subtask's link [m or rad], 0 without one."""
        found = self._range[focus.link]
        return found[:, 0], found[:, 1]

    def joint_now(self, state: SimState, focus: Focus) -> Array:
        """(W,) joint position of the active subtask's link [m or rad], 0 without one."""
        # An empty table has no last row to read.
        if not self._has_links:
            return zeros((len(self._rows),), state.robot_q)
        return state.link_q[self._rows, focus.link] * focus.has_link

    def link_state(self, state: SimState, focus: Focus) -> Array:
        """(W, 5) float32 state of the active subtask's link, zeros without one.

        The columns are the opening as a share of its range, the joint speed [rad/s or m/s], cosine and sine of the
        heading of its frame's x axis in the frame of the base, and exp(-opening / NEARLY_CLOSED). The last one resolves
        small openings: a network cannot distinguish 1 % (closed) from 3 % by a normalised opening.
        """
        xp = namespace(state.robot_q)
        if not self._has_links:
            return xp.astype(zeros((len(self._rows), 5), state.robot_q), xp.float32)
        link = xp.where(focus.has_link, focus.link, 0)
        low, high = self._range[link].T
        opening = (state.link_q[self._rows, link] - low) / (high - low)
        axis = state.body_mat[self._rows, self._link_body[link], :, 0]
        # By cosine and sine below, so that no jump at half a turn is seen.
        heading = xp.atan2(axis[:, 1], axis[:, 0]) - state.robot_q[:, BASE_YAW]
        speed = state.link_qd[self._rows, link]
        near = xp.exp(-opening / NEARLY_CLOSED)
        columns = xp.stack(
            [opening, speed, xp.cos(heading), xp.sin(heading), near], axis=1
        )
        return xp.astype(xp.where(focus.has_link[:, None], columns, 0.0), xp.float32)

    def handle_pos(self, state: SimState, world: Array, link: Array) -> Array:
        """World positions (n, 3) of the handle points of links (n,) in worlds (n,)."""
        body = self._link_body[link]
        rot = state.body_mat[world, body]
        return state.body_pos[world, body] + namespace(rot).einsum(
            "nij,nj->ni", rot, self._handles[link]
        )

    def tcp_pose(self, state: SimState) -> Array:
        """(W, 7) pose of the tcp in the world, xyz [m] + wxyz."""
        pos = state.body_pos[:, self._tcp]
        return namespace(pos).concat([pos, state.body_quat[:, self._tcp]], axis=1)

    def context(
        self,
        state: SimState,
        focus: Focus,
        signals: Signals,
        conventions: Conventions | None = None,
    ) -> ObsContext:
        """Gather the input of the observation table; entries that an active subtask does not use are zero.

        ``conventions``: others than those of the constructor.
        """
        conventions = conventions or self._conventions
        rows = self._rows
        goal = focus.active.goal_pos
        jointed = focus.jointed
        if self._has_links and may_hold(jointed):
            where = namespace(jointed).where
            handle = self.handle_pos(state, rows, where(focus.has_link, focus.link, 0))
            # The handle moves with its link, while the plan has where it was at the start.
            goal = where(jointed[:, None], handle, goal)
        # One array for all three, turned into the base's frame in one call.
        poses = zeros((3, len(rows), 7), state.body_pos)
        poses[0, :, :3] = state.body_pos[:, self._tcp]
        poses[0, :, 3:] = state.body_quat[:, self._tcp]
        poses[1] = state.object_pose[rows, focus.obj]
        poses[2, :, :3] = goal
        local = self.shown_in_base(state.robot_q[:, BASE], poses, focus.shown)
        grasped = signals.is_grasped & (focus.active.kind >= 0)
        robot_q = state.robot_q
        if conventions.joint_angles == WRAPPED:
            robot_q = within_half_a_turn(robot_q, self._endless)
        obj = local[1]
        if conventions.object_axes == SCAN_AXES and self._has_scans:
            # In float32, as it is observed: data and policies that convert it get the same bits.
            seen = cast(obj, namespace(obj).float32)
            obj = cast(to_scan_axes(seen, self._scan_yaw[focus.obj]), obj.dtype)
        return ObsContext(
            robot_q, state.robot_qd, local[0], obj, local[2, :, :3], grasped
        )

    def shown_in_base(self, base: Array, poses: Array, shown: Array) -> Array:
        """World poses (N, W, 7) in the frames of the bases (W, 3) that ``shown`` (N, W, 1) bool names, else zeros."""
        return pose_in_base(base, self._base_height, poses) * shown
