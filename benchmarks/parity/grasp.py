"""The grasp hold test of ``benchmarks.parity``: the same held objects, shaken on both simulators."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from benchmarks.grasp import (
    BENCH_OBJECTS,
    DROP_DISTANCE,
    GRIP_TARGET,
    SETTLE_STEPS,
    GraspBench,
    shake_motion,
)
from mjhab.core.arrays import to_numpy
from mjhab.core.joints import BASE_X, BASE_XY, BASE_Y, BASE_YAW
from mjhab.core.rotations import mat_from_quat
from mjhab.core.seeding import stream
from mjhab.core.timing import STEP_SECONDS
from mjhab.layout.layout import Layout
from mjhab.scenes.packs import open_pack
from mjhab.sim.backends import open_simulator

PLACE = (14.0, 14.0)
"""Where the robots stand [m]: beyond the home, on its endless floor."""


def grasp_parity(
    seconds: float, device: str, threads: int, seed: int
) -> list[dict[str, Any]]:
    """Shake every object of the grasp bench for ``seconds`` on both backends, a world for each; ``device`` of warp.

    Returns:
        One row per object: "object", and for each backend "slip_mm" (largest displacement in the frame of the hand)
        and "dropped".
    """
    pack = open_pack("builtin")
    layout = Layout(dataclasses.replace(pack, homes=pack.homes[:1]), BENCH_OBJECTS)
    slips = {
        name: _shake(layout, name, seconds, device, threads, seed)
        for name in ("cpu", "warp")
    }
    return [
        {"object": obj}
        | {
            name: {
                "slip_mm": round(1e3 * float(slip[i]), 2),
                "dropped": bool(slip[i] > DROP_DISTANCE),
            }
            for name, slip in slips.items()
        }
        for i, obj in enumerate(BENCH_OBJECTS)
    ]


def _shake(
    layout: Layout, backend: str, seconds: float, device: str, threads: int, seed: int
) -> np.ndarray:
    """(number of objects,) largest displacement [m] in the hand."""
    worlds = len(BENCH_OBJECTS)
    home = layout.pack.homes[0].name
    there = device if backend == "warp" else ""
    sim: Any = open_simulator(backend, layout, worlds, threads=threads, device=there)
    qpos = np.stack([_held(sim, home, slot) for slot in range(worlds)])
    rest = qpos[0, sim.addresses.robot_q]
    sim.reset(range(worlds), [home] * worlds, qpos)
    phase = stream(seed, "grasp_bench").uniform(0.0, 2 * np.pi, 7)
    begin = _in_hand(sim)
    slip = np.zeros(worlds)
    for k in range(round(seconds / STEP_SECONDS)):
        goal, forward, turn = shake_motion(layout.robot, k * STEP_SECONDS, rest, phase)
        # One backend has float32: both get the same commands in double precision.
        measured = to_numpy(sim.state().robot_q).astype(np.float64)
        ctrl = measured + np.clip(goal - measured, -0.1, 0.1)
        ctrl[:, BASE_X] = forward * np.cos(measured[:, BASE_YAW])
        ctrl[:, BASE_Y] = forward * np.sin(measured[:, BASE_YAW])
        ctrl[:, BASE_YAW] = turn
        ctrl[:, layout.robot.columns.fingers] = GRIP_TARGET
        sim.step(ctrl)
        slip = np.maximum(slip, np.linalg.norm(_in_hand(sim) - begin, axis=1))
    return slip


def _held(sim: Any, home: str, slot: int) -> np.ndarray:
    """(nq,) state with the object of a slot in the hand, after the grip has settled."""
    # Settled by MuJoCo for both backends, so that they begin with the same grip.
    bench = GraspBench(BENCH_OBJECTS[slot])
    for _ in range(SETTLE_STEPS):
        bench.step(bench.rest, 0.0, 0.0)
    qpos = sim.model(home).qpos0.copy()
    robot = bench.data.qpos[bench.qpos].copy()
    robot[BASE_XY] += PLACE
    qpos[sim.addresses.robot_q] = robot
    thing = bench.data.body(bench.object)
    start = sim.addresses.object_q[slot]
    qpos[start : start + 7] = [*(thing.xpos + np.array([*PLACE, 0.0])), *thing.xquat]
    return qpos


def _in_hand(sim: Any) -> np.ndarray:
    """(W, 3) position of each world's own object in the frame of the hand."""
    state = sim.state()
    hand = sim.addresses.robot_body[sim.layout.robot.tcp]
    own = np.arange(sim.num_worlds)
    pos = to_numpy(state.object_pose).astype(np.float64)[own, own, :3]
    turn = mat_from_quat(to_numpy(state.body_quat).astype(np.float64)[:, hand])
    return np.einsum(
        "wji,wj->wi", turn, pos - to_numpy(state.body_pos).astype(np.float64)[:, hand]
    )
