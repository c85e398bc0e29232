"""Perturbations of what an episode begins with: where its objects are, and where the robot is."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjhab.config.perturbing import MAX_DRAWS, PERTURBATIONS, Drawn, called
from mjhab.core.errors import fault
from mjhab.core.joints import BASE
from mjhab.core.rotations import pose_inv, pose_mul
from mjhab.episodes.episode import Episode
from mjhab.episodes.generator import MAX_DRIFT, MAX_SPEED
from mjhab.episodes.moved_furniture import (
    MOVES_PER_HOME,
    Things,
    carried,
    is_possible,
    moved_pieces,
    version_name,
)
from mjhab.episodes.starts import Start, StartMaker
from mjhab.episodes.zones import receptacle_below
from mjhab.layout.layout import yaw_quat
from mjhab.layout.receptacles import placed_receptacles
from mjhab.layout.standing import clear_of, standing_on
from mjhab.robots.robot import Robot
from mjhab.scenes.spec import Home
from mjhab.sim.mujoco.settle import settle
from mjhab.tasks.household.registry import chain
from mjhab.tasks.plan import Target
from mjhab.tasks.subtasks.registry import SUBTASKS, spec_of

NEAR_M = 0.25
"""Farther than this [m] from the target, plus both radii, no distractor is put."""
ABOVE_M = 0.35
"""Objects that are farther above or below than this [m] are on another shelf."""
PLACES = 60
"""Places that are tried for a distractor."""


class EpisodePerturber:
    """Perturbs the objects and starts of episodes.

    Args:
        starts: makes the starts; its configuration names the axes.
    """

    def __init__(self, starts: StartMaker) -> None:
        self._starts = starts
        self._robot = starts.layout.robot
        plan = starts.config.perturbations
        self._plan = plan
        # Looked at once: most environments perturb nothing, and must not pay for it in each episode.
        hooks = {hook for axis in plan.axes for hook in axis.hooks}
        self._of_furniture = "furniture" in hooks
        self._of_objects = "objects" in hooks
        self._of_start = "start" in hooks

    def objects(self, episode: Episode) -> Episode:
        """The episode with its home and objects perturbed; the same one if nothing is asked for."""
        # Furniture first, because distractors are put where the objects then stand.
        if self._of_furniture:
            for drawn in self._drawn(episode, "furniture"):
                episode = self._moved(episode, drawn)
        if not self._of_objects:
            return episode
        for drawn in self._drawn(episode, "objects"):
            scene = _Objects(self._starts, episode, drawn)
            pose, told = _first(drawn, "objects", scene, (len(episode.object_pose), 7))
            if pose is not None:
                episode = dataclasses.replace(episode, object_pose=pose)
            told = {**episode.perturbed.get(drawn.axis, {}), **told}
            perturbed = {**episode.perturbed, drawn.axis: told}
            episode = dataclasses.replace(episode, perturbed=perturbed)
        return episode

    def _moved(self, episode: Episode, drawn: Drawn) -> Episode:
        """The episode in a version of its home in which furniture was moved, the first possible one in a drawn order.

        "moved" is recorded, the number of pieces, and "refused", the number of versions that were impossible.
        """
        layout = self._starts.layout
        homes = layout.pack.homes_by_name
        home = homes[episode.home]
        shift = called(drawn.axis, "furniture", drawn)
        names = [
            version_name(home.name, shift, number) for number in range(MOVES_PER_HOME)
        ]
        known = [name for name in names if name in homes]
        # Drawn, else the first version of a home would take most of its episodes.
        order = drawn.stream("furniture").permutation(len(known)).tolist()
        things = self._things(episode, home)
        refused = 0
        found = home
        for k in order:
            version = homes[known[k]]
            if is_possible(layout.pack, home, version, things):
                found = version
                break
            refused += 1
        told = {"moved": len(moved_pieces(home, found)), "refused": refused}
        pose = carried(layout.pack, home, found, episode.object_pose)
        perturbed = {**episode.perturbed, drawn.axis: told}
        return dataclasses.replace(
            episode, home=found.name, object_pose=pose, perturbed=perturbed
        )

    def _things(self, episode: Episode, home: Home) -> Things:
        """What the furniture of an episode's home must leave in place."""
        layout = self._starts.layout
        # In a chain all targets are handled sooner or later.
        targets = _handled(self._starts, episode) or episode.targets
        names = {target.obj for target in targets}
        is_target = np.array([name in names for name in layout.object_names])
        used = layout.used_slots(episode.object_pose)
        places = episode.object_pose[:, :3]
        goals = [target.goal_pos for target in targets]
        handles = [layout.closed_handle(home, name)[:2] for name in layout.link_ids]
        return Things(
            np.concatenate([places[is_target], np.array(goals).reshape(-1, 3)]),
            places[used & ~is_target],
            np.array(handles).reshape(-1, 2),
        )

    def start(self, start: Start, episode: Episode) -> Start:
        """The start with the robot perturbed; the same one if nothing is asked for."""
        if not self._of_start:
            return start
        for drawn in self._drawn(episode, "start"):
            scene = _RobotMoves(self._starts, start, self._robot)
            qpos, told = _first(drawn, "start", scene, start.qpos.shape)
            if qpos is not None:
                start = dataclasses.replace(start, qpos=qpos)
            perturbed = {**start.perturbed, drawn.axis: told}
            start = dataclasses.replace(start, perturbed=perturbed)
        return start

    def _drawn(self, episode: Episode, hook: str) -> list[Drawn]:
        found = self._plan.drawn(episode.seed, episode.index, self._robot)
        return [drawn for drawn in found if hook in PERTURBATIONS[drawn.axis].hooks]


def _first(
    drawn: Drawn, hook: str, scene: object, shape: tuple[int, ...]
) -> tuple[np.ndarray | None, dict[str, Any]]:
    """What the first possible attempt of a hook makes, and what is recorded of it, "redrawn" among it.

    "kept": no attempt was possible, and everything is as it was.

    Raises:
        UsageError: the hook raises, or returns another shape or what is not finite.
    """
    for attempt in range(MAX_DRAWS):
        found = called(drawn.axis, hook, drawn, scene, attempt)
        if found is not None:
            values, told = found
            # A plugin may return anything, which would fail much later in the simulator.
            values = np.asarray(values, np.float64)
            if values.shape != shape or not np.isfinite(values).all():
                raise fault(
                    PERTURBATIONS.described(drawn.axis),
                    f"{hook} must return finite numbers {shape}, got {values.shape}.",
                )
            # Said in the record: many refusals bend the distribution that was asked for.
            return values, {**told, "redrawn": attempt}
    return None, {"redrawn": MAX_DRAWS, "kept": True}


def _handled(starts: StartMaker, episode: Episode) -> tuple[Target, ...]:
    """The target of the subtask that the episode consists of; none for a chain, and for Open and Close."""
    if not starts.config.subtask:
        return ()
    plan = chain(episode.task, episode.targets, episode.home)
    obj = plan.subtasks[starts.position_of(plan, episode)].obj
    # Open and Close are about a link, which no target names as its object.
    return tuple(target for target in episode.targets if target.obj == obj)


class _RobotMoves:
    """A `StartScene`: the robot of a start, and what it holds, moved."""

    def __init__(self, starts: StartMaker, start: Start, robot: Robot) -> None:
        self.robot = robot
        self._starts = starts
        self._start = start

    def moved(self, base: np.ndarray, arm: np.ndarray) -> np.ndarray | None:
        """See `StartScene.moved`: it must not collide, and what is held stays in the hand."""
        a = self._starts.sim.addresses
        start = self._start
        scratch = self._starts.sampler.scratch
        qpos = start.qpos.copy()
        joints = qpos[a.robot_q].copy()
        joints[BASE] += base
        joints[list(self.robot.arm_columns)] += arm
        qpos[a.robot_q] = self._within_limits(joints)
        carried = self._carried()
        if carried >= 0:
            own = slice(int(a.object_q[carried]), int(a.object_q[carried]) + 7)
            hand = scratch.tcp_pose(start.home, start.qpos)
            # From before the move: relative to the hand the object stays where it is.
            in_hand = pose_mul(pose_inv(hand), start.qpos[own])
            qpos[own] = pose_mul(scratch.tcp_pose(start.home, qpos), in_hand)
        free = scratch.collision_free(start.home, qpos, carried)
        return qpos if free else None

    def _within_limits(self, joints: np.ndarray) -> np.ndarray:
        low, high = np.array(self.robot.joint_limits).T
        own = list(self.robot.arm_columns)
        # Only the arm: the base has no limits, and a rest position at a limit would leave it.
        joints[own] = np.clip(joints[own], low[own], high[own])
        return joints

    def _carried(self) -> int:
        """Slot of the object in the hand at the start, -1 for none."""
        first = self._start.plan.subtasks[0]
        alone = self._starts.config.subtask
        if alone and (spec_of(first.kind).starts_holding or first.must_hold):
            return self._starts.layout.object_names.index(first.obj)
        return -1


class _Objects:
    """An `ObjectScene`: distractors put beside the target of an episode, where they come to rest."""

    def __init__(self, starts: StartMaker, episode: Episode, drawn: Drawn) -> None:
        self._starts = starts
        self._episode = episode
        layout = starts.layout
        targets = {target.obj for target in episode.targets}
        names = layout.object_names
        used = layout.used_slots(episode.object_pose)
        self.distractors: Sequence[int] = [
            slot
            for slot in range(len(names))
            if names[slot] not in targets and used[slot]
        ]
        target = self._beside(drawn)
        alone = starts.config.subtask
        at_goal = bool(alone) and SUBTASKS[alone].starts_holding
        self._slot = names.index(target.obj)
        self._point = np.array(target.goal_pos if at_goal else target.start_pos)
        self._radii = [float(np.hypot(*each.half[:2])) for each in layout.objects]

    def _beside(self, drawn: Drawn) -> Target:
        """The target of the subtask that the episode consists of; a drawn one in a chain, and of Open and Close."""
        episode = self._episode
        targets = _handled(self._starts, episode) or episode.targets
        return targets[int(drawn.stream("target").integers(len(targets)))]

    def beside_target(
        self, slots: Sequence[int], gap: float, random: np.random.Generator
    ) -> np.ndarray | None:
        """See `ObjectScene.beside_target`."""
        layout = self._starts.layout
        home = self._starts.home(self._episode.home)
        # Plain numbers compare faster than numpy's, one by one.
        point: tuple[float, float, float] = tuple(self._point.tolist())
        place = receptacle_below(point, placed_receptacles(layout, home))
        if place is None:
            return None
        standing = standing_on(layout, home).get(place.id, ())
        pose = self._episode.object_pose.copy()
        # Distractors that are about to be moved are in nobody's way.
        apart = {*range(len(pose))} - {*slots}
        there = [(pose[k, :3], self._radii[k]) for k in sorted(apart)]
        goals = {target.obj: target.goal_pos for target in self._episode.targets}
        # A goal must stay free, or a Place could not succeed.
        there += [
            (np.array(goal), self._radii[layout.object_names.index(obj)])
            for obj, goal in goals.items()
        ]
        for slot in slots:
            radius = self._radii[slot]
            half_z = layout.objects[slot].half[2]
            reach = NEAR_M + radius + self._radii[self._slot]
            for _ in range(PLACES):
                spot = self._point[:2] + random.uniform(-reach, reach, 2)
                u, v = place.local(spot)
                room = np.array(place.half) - radius - 0.01
                at = np.array([*spot, place.pos[2] + half_z])
                free = (
                    abs(u) <= room[0]
                    and abs(v) <= room[1]
                    and 2.0 * half_z + 0.02 <= place.height
                    and clear_of(standing, at, radius + 0.5 * gap)
                    and all(
                        # Objects on other shelves are near only as seen from above.
                        abs(p[2] - at[2]) > ABOVE_M
                        or np.hypot(*(p[:2] - at[:2])) > r + radius + gap
                        for p, r in there
                    )
                )
                if free:
                    break
            else:
                return None
            there.append((at, radius))
            # A millimetre above: in contact at once, rounding could make it start inside the surface.
            pose[slot, :3] = at + np.array([0.0, 0.0, 0.001])
            pose[slot, 3:] = yaw_quat(float(random.uniform(-np.pi, np.pi)))
        return self._at_rest(pose)

    def _at_rest(self, pose: np.ndarray) -> np.ndarray | None:
        """Poses after all came to rest; None if an object falls or rolls away."""
        sim = self._starts.sim
        a = sim.addresses
        qpos = sim.model(self._episode.home).qpos0.copy()
        columns = a.object_q[:, None] + np.arange(7)
        qpos[columns] = pose
        # Objects may stand in an open drawer.
        qpos[a.link_q] = self._episode.link_q
        settled, speed = settle(sim.model(self._episode.home), a, qpos)
        drift = np.linalg.norm(settled[columns][:, :3] - pose[:, :3], axis=1)
        if speed > MAX_SPEED or drift.max() > MAX_DRIFT:
            return None
        return settled[columns]


def as_perturbed(episode: Episode, start: Start) -> Episode:
    """The episode that tells what came of the perturbations of its start, too; the same one without any."""
    if not start.perturbed:
        return episode
    perturbed = {**episode.perturbed, **start.perturbed}
    return dataclasses.replace(episode, perturbed=perturbed)
