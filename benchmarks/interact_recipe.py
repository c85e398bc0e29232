"""How the actions of ``mjhab bench interact`` were made: ``python -m benchmarks.interact_recipe FILE.csv``.

The hand goes along way-points at fixed heights above the surface, on arcs about the shoulder: it turns to the right
above the objects, sinks beside them, sweeps to the left through all five, back through what is left at a longer
reach, and rises. Inverse kinematics gives the joints there, straight lines in joint space the motion between.
In each control step the action is the one that reaches for the joints ``AHEAD`` steps on, from where the simulated
arm is; what is recorded is then replayed without looking.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjhab.bench.interact.scene import (
    SHOULDER_X,
    START_QPOS,
    STEPS,
    STIFF_BODY_MODE,
    SURFACE_HEIGHT,
    InteractScene,
    interact_scene,
    with_body,
)
from mjhab.core.files.cache import write_atomic
from mjhab.core.joints import BASE
from mjhab.experts.arm.ik import TipGoals, columns, random_seeds, solve
from mjhab.robots.controllers import make_controller
from mjhab.robots.registry import robot_named
from mjhab.sim.mujoco.cpu import CpuSimulator

WAY = (
    # steps, angle about the shoulder [rad], reach from it [m], height of the tool centre above the surface [m]
    (30, -0.75, 0.66, 0.30),
    (20, -0.75, 0.70, 0.06),
    (60, 0.75, 0.72, 0.06),
    (15, 0.75, 0.80, 0.06),
    (55, -0.75, 0.80, 0.06),
    (20, -0.60, 0.66, 0.30),
)
PITCH = 0.9
"""The hand points away from the shoulder and this far down [rad]: near the start, and wrist and forearm stay high."""
AHEAD = 2.0
"""Control steps [50 ms] that the servo lags behind."""
DIGITS = 3


def way_points(start: np.ndarray) -> np.ndarray:
    """(len(WAY), J) configurations of the robot from ``start`` (J,), hand pitched by PITCH.

    Reach and height are solved straight ahead; turning there is the business of the shoulder's first joint alone, so
    the hand stays at its height during a sweep.
    """
    robot = robot_named()
    chain = robot.chain
    dofs = columns(chain, torso=False)
    pan = robot.arm_columns[0]
    torso = robot.torso_columns[0]
    now = start.copy()
    now[BASE] = 0.0
    now[pan] = 0.0
    surface = SURFACE_HEIGHT + start[torso] - START_QPOS[torso]
    c = np.cos(PITCH)
    s = np.sin(PITCH)
    down = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    out = []
    for _, angle, reach, above in WAY:
        goal = np.array([[SHOULDER_X + reach, 0.0, surface + above]])
        # A fixed seed: the same recipe gives the same file.
        seeds = random_seeds(chain, now, dofs, 64, np.random.default_rng(0), spread=0.3)
        found = solve(chain, TipGoals(goal, down[None], dofs, now), seeds)
        best, price = found.best(np.abs(found.q - now).max(axis=-1))
        if not np.isfinite(price[0]):
            raise ValueError(f"the arm does not reach {goal[0]}")
        now = best[0]
        turned = now.copy()
        turned[pan] += angle
        out.append(turned)
    return np.array(out)


def record(scene: InteractScene) -> np.ndarray:
    """(200, 7) arm actions, rounded, as a closed loop on the CPU simulator finds them."""
    controller = make_controller(STIFF_BODY_MODE, 1)
    sim = CpuSimulator(scene.layout, 1, 1, controller.drives)
    sim.reset([0], [scene.home], scene.qpos[None])
    arm = list(scene.layout.robot.arm_columns)
    knots = np.concatenate([scene.robot[None], way_points(scene.robot)])[:, arm]
    times = np.concatenate([[0.0], np.cumsum([row[0] for row in WAY])])
    done = np.zeros((STEPS, len(arm)), np.float32)
    for step in range(STEPS):
        state = sim.state()
        at = min(step + 1 + AHEAD, STEPS)
        goal = np.array([np.interp(at, times, knots[:, j]) for j in range(len(arm))])
        # From where the arm is and not where it was sent, so that errors do not add up.
        wanted = (goal - state.robot_q[0, arm]) / controller.limits.joint_delta
        # Rounded before it acts, because the file has no more digits.
        done[step] = np.round(np.clip(wanted, -1.0, 1.0), DIGITS)
        sim.step(controller.ctrl(with_body(scene, done[step : step + 1]), state))
    return done


def main(words: Sequence[str] | None = None) -> None:
    """Record the actions and write them as CSV, a row per control step.

    Args:
        words: of the command; those of ``sys.argv`` if None.

    Raises:
        SystemExit: they are no such command.
    """
    parser = argparse.ArgumentParser(
        "python -m benchmarks.interact_recipe", description=__doc__
    )
    parser.add_argument(
        "path", type=Path, metavar="FILE.csv", help="it is written anew if it exists"
    )
    path = parser.parse_args(words).path
    actions = record(interact_scene())
    head = "arm actions of pd_joint_delta_pos, 20 Hz; made by python -m benchmarks.interact_recipe"
    write_atomic(
        path,
        lambda temporary: np.savetxt(
            temporary, actions, fmt=f"%.{DIGITS}f", delimiter=",", header=head
        ),
    )


if __name__ == "__main__":
    main()
