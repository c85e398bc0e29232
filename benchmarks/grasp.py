"""Grasp benchmark: whether objects stay in the gripper of a moving robot, with the physics of the homes.

Each object is gripped at the rest pose from above, held still for half a second, and then shaken: the base drives
back and forth at 1 m/s and turns, the arm and wrist swing at up to 0.6 rad/s. All motion goes through the servos as
the controller ``pd_joint_delta_pos`` uses them: a new target every 0.05 s, at most 0.1 rad from the measured joint.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from benchmarks.command import run_command
from mjhab.cli.output import listing_of, report
from mjhab.core.errors import unknown_name
from mjhab.core.joints import BASE, BASE_YAW
from mjhab.core.names import copy_name
from mjhab.core.seeding import stream
from mjhab.core.timing import STEP_SECONDS, SUBSTEPS
from mjhab.layout.contact_sensors import pair_force
from mjhab.layout.layout import Layout
from mjhab.layout.model_spec import build_spec
from mjhab.robots.registry import DEFAULT_ROBOT, robot_named
from mjhab.robots.robot import Robot
from mjhab.scenes.builtin.objects import builtin_objects, object_meshes
from mjhab.scenes.spec import Home, ObjectType, Pack

GRIP_TARGET = -0.01
"""Finger target [m] of the gripper action -1: below zero, so that the servos squeeze."""
SETTLE_STEPS = 10
DROP_DISTANCE = 0.08
"""An object that moved this far in the gripper's frame [m] is lost."""
RATES_HZ = (0.35, 0.25, 0.4, 0.3, 0.45, 0.5, 0.55)
"""Frequencies of the swinging arm joints; an arm with more joints begins again."""
MIN_FORCE = 0.5
MAX_ANGLE = np.deg2rad(30.0)
"""Grasp test (mani_skill/agents/robots/fetch/fetch.py, called with 30 degrees by mshab)."""


@dataclass(frozen=True)
class Grasp:
    """How an object sits in the hand: its height axis points along -x of the tool centre (up, at the rest pose).

    ``width`` [m] of what is between the fingers; ``depth`` [m]: object centre beyond the tool centre along +x;
    ``side`` [m]: object centre along +y; ``turn`` [rad]: about the height axis.
    """

    width: float
    depth: float
    side: float = 0.0
    turn: float = 0.0


GRASPS: dict[str, Grasp] = {
    "005_tomato_soup_can": Grasp(width=0.0678, depth=0.024),
    "004_sugar_box": Grasp(width=0.0479, depth=0.060),
    "010_potted_meat_can": Grasp(width=0.0573, depth=0.016),
    "013_apple": Grasp(width=0.0754, depth=0.008),
    "024_bowl": Grasp(width=0.0075, depth=0.034, side=-0.0757),
}
"""Objects of the bench. The bowl hangs by its rim."""
BENCH_OBJECTS: tuple[str, ...] = tuple(GRASPS)


@dataclass(frozen=True)
class GraspSpec:
    """Shake objects in the gripper with base and arm motion and measure how far they slip.

    Objects that are too wide for the robot's gripper are left out.
    """

    seconds: float = 10.0
    """Time of motion for each object [s]."""
    robot: str = DEFAULT_ROBOT
    """The robot (see: mjhab robots list)."""
    seed: int = 0
    """Seed of the motion."""
    json: bool = False
    """Print one line of JSON instead of a table."""


def grasp_table(
    seconds: float = 10.0,
    seed: int = 0,
    objects: tuple[str, ...] = BENCH_OBJECTS,
    robot: str = DEFAULT_ROBOT,
) -> list[dict[str, object]]:
    """Move every object in the gripper and measure how far it slips.

    Args:
        seconds: time of motion.
        seed: chooses the phases of the motion.
        objects: names from ``BENCH_OBJECTS``.
        robot: name of the robot.

    Returns:
        One row per object that fits between the fingers: ``object``; ``slip_mm`` and ``rotation_deg``, the largest
        displacement in the gripper's frame of the object's point at the tool centre [mm] and the largest turn [degrees]
        since the motion began; ``grasp_share`` of control steps in which the grasp test held; ``dropped``, whether the
        object moved farther than ``DROP_DISTANCE``; ``force_n``, mean normal force on a finger [N].

    Raises:
        UsageError: an object has no entry in ``GRASPS``, or the robot is unknown.
    """
    body = robot_named(robot)
    for name in objects:
        if name not in GRASPS:
            raise unknown_name("bench object", name, GRASPS)
    widest = body.gripper.opening
    fitting = [name for name in objects if GRASPS[name].width <= widest]
    return [_shake(body, name, seconds, seed) for name in fitting]


def bench_model(name: str, robot: Robot | None = None) -> mujoco.MjModel:
    """A robot (the default one if not given) and one object on an empty floor, with the options of every home."""
    kind: ObjectType = builtin_objects()[name]
    home = Home(
        "grasp_bench", "bench", "train", 0, 0, (), (-5.0, -5.0, 5.0, 5.0), "", (), ()
    )
    pack = Pack("bench", {}, {}, (home,), {name: kind}, dict(object_meshes()))
    return build_spec(Layout(pack, (name,), robot), home).compile()


class GraspBench:
    """One robot with one object in its hand."""

    def __init__(self, name: str, robot: Robot | None = None) -> None:
        self.robot = robot or robot_named()
        self.model = bench_model(name, self.robot)
        self.data = mujoco.MjData(self.model)
        self.qpos = np.array([self.model.joint(n).qposadr[0] for n in self.robot.joints])
        self.object = copy_name(name, 0)
        self.rest = self.robot.rest.copy()
        self._grip(GRASPS[name])

    def _grip(self, grasp: Grasp) -> None:
        """Rest pose, fingers at the object, object between them."""
        self.data.qpos[self.qpos] = self.rest
        # The object lies between two fingers, each of which opens by half.
        self.data.qpos[self.qpos[self.robot.columns.fingers]] = 0.5 * grasp.width
        # Places of bodies are needed before the object can be put into the hand.
        mujoco.mj_kinematics(self.model, self.data)
        c = np.cos(grasp.turn)
        s = np.sin(grasp.turn)
        # Columns: the object's axes in the frame of the tool centre: height along -x, its x across the fingers.
        axes = np.array([[0.0, 0.0, -1.0], [c, -s, 0.0], [-s, -c, 0.0]])
        hand = self.data.body(self.robot.tcp)
        turn = hand.xmat.reshape(3, 3)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, (turn @ axes).ravel())
        start = self.model.joint(self.object).qposadr[0]
        self.data.qpos[start : start + 3] = hand.xpos + turn @ (
            grasp.depth,
            grasp.side,
            0.0,
        )
        self.data.qpos[start + 3 : start + 7] = quat
        mujoco.mj_forward(self.model, self.data)

    def pose_in_hand(self) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) and rotation (3, 3) of the object in the frame of the tool centre."""
        hand = self.data.body(self.robot.tcp)
        thing = self.data.body(self.object)
        turn = hand.xmat.reshape(3, 3)
        return turn.T @ (thing.xpos - hand.xpos), turn.T @ thing.xmat.reshape(3, 3)

    def step(self, goal: np.ndarray, forward: float, yaw_rate: float) -> None:
        """One control step towards joint positions ``goal`` (J,), at most 0.1 per joint, gripper closed."""
        measured = self.data.qpos[self.qpos]
        ctrl = measured + np.clip(goal - measured, -0.1, 0.1)
        yaw = measured[BASE_YAW]
        ctrl[BASE] = forward * np.cos(yaw), forward * np.sin(yaw), yaw_rate
        ctrl[self.robot.columns.fingers] = GRIP_TARGET
        self.data.ctrl[:] = ctrl
        mujoco.mj_step(self.model, self.data, SUBSTEPS)

    def finger_forces(self) -> tuple[np.ndarray, bool]:
        """Norms (2,) of the object's force on the [l, r] finger [N], and the grasp test."""
        norms = np.zeros(2)
        along = np.zeros(2)
        touches = self.data.sensor(f"touch>{self.object}").data
        for i, finger in enumerate(self.robot.fingers):
            # The sensor gives the force of the finger on the object.
            force = -pair_force(self.data.sensor(f"hand/{finger.link}").data, touches)[0]
            opening = self.data.body(finger.link).xmat.reshape(3, 3) @ finger.opens
            norms[i] = np.linalg.norm(force)
            along[i] = force @ opening
        return norms, bool(
            (norms >= MIN_FORCE).all() and (along >= norms * np.cos(MAX_ANGLE)).all()
        )


def shake_motion(
    robot: Robot, time: float, rest: np.ndarray, phase: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """Joint goal (J,), base speed [m/s] and yaw rate [rad/s] at a time."""
    goal = rest.copy()
    arm = list(robot.arm_columns)
    goal[list(robot.torso_columns)] -= 0.1
    goal[arm[-2]] -= 0.4  # off its upper limit
    rate = 2 * np.pi * np.resize(RATES_HZ, len(arm))
    goal[arm] += 0.6 / rate * np.sin(rate * time + phase)
    forward = 1.0 if int(time) % 2 == 0 else -1.0
    return goal, forward, float(np.sin(2 * np.pi * 0.3 * time) * 1.5)


def _shake(robot: Robot, name: str, seconds: float, seed: int) -> dict[str, object]:
    bench = GraspBench(name, robot)
    joints = len(robot.arm_columns)
    phase = stream(seed, "grasp_bench").uniform(0.0, 2 * np.pi, joints)
    for _ in range(SETTLE_STEPS):
        # The grip gives a little at first, which is no slip.
        bench.step(bench.rest, 0.0, 0.0)
    pos0, turn0 = bench.pose_in_hand()
    held_point = turn0.T @ -pos0
    slip = angle = force = 0.0
    held = 0
    dropped = False
    steps = round(seconds / STEP_SECONDS)
    for k in range(steps):
        bench.step(*shake_motion(bench.robot, k * STEP_SECONDS, bench.rest, phase))
        pos, turn = bench.pose_in_hand()
        # At the point that was held: a turn in the fingers alone is no slip.
        slip = max(slip, float(np.linalg.norm(pos + turn @ held_point)))
        cosine = 0.5 * (np.trace(turn0.T @ turn) - 1.0)
        angle = max(angle, float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))))
        norms, grasped = bench.finger_forces()
        held += grasped
        force += float(norms.mean()) / steps
        dropped = dropped or bool(np.linalg.norm(pos - pos0) > DROP_DISTANCE)
    return {
        "object": name,
        "slip_mm": round(1e3 * slip, 2),
        "rotation_deg": round(angle, 2),
        "grasp_share": round(held / steps, 4),
        "dropped": dropped,
        "force_n": round(force, 2),
    }


def bench_grasp(spec: GraspSpec) -> int:
    """Print how far objects slip in the moving gripper; returns 1 if one is dropped."""
    rows = grasp_table(seconds=spec.seconds, seed=spec.seed, robot=spec.robot)
    title = f"{spec.seconds:g} s of base and arm motion"
    report(spec.json, {"grasps": rows}, listing_of(title, rows))
    return 1 if any(row["dropped"] for row in rows) else 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command("grasp", GraspSpec, bench_grasp, words, {"seconds": 0.1})


if __name__ == "__main__":
    sys.exit(main())
