"""Effect of MuJoCo's sleeping islands on results and speed: the same commands with sleep and without, on both engines.

Both engines put to sleep what has lain still (every speed below the model's ``sleep_tolerance`` for ten substeps), keep
it where it is until something touches it, and leave it out of the solver. On the warp backend a start sleeps at once.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import mujoco
import numpy as np

from benchmarks.parity.episodes import KINDS, Leg, difference
from mjhab.core.arrays import map_record, to_numpy
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.protocol import SimState


@dataclass(frozen=True, eq=False)
class Recording:
    """What every variant runs: homes and states (W, nq) at the start, commands (T, W, nu) of the expert."""

    env: SequentialTaskEnv
    homes: list[str]
    qpos: np.ndarray
    commands: np.ndarray


def sleep_cost(leg: Leg, steps: int) -> list[dict[str, Any]]:
    """Run ``steps`` control steps of the expert's commands on either engine, with sleep and without.

    Returns:
        A row for each: "engine" ("C" or "warp"), "sleep", "ms" (processor time of a control step of all worlds; on a
        GPU time), "awake_dofs" (largest number in any world after a control step; the warp backend's buffer ``awake``
        must hold it), "nv" (all there are), "tainted" worlds, "difference": largest per kind at the end from the same
        engine with sleep.
    """
    recording = _record(leg, steps)
    rows = []
    for engine, run in (("C", _run_c), ("warp", _run_warp)):
        asleep, asleep_end = run(recording, leg, True)
        awake, awake_end = run(recording, leg, False)
        apart = {
            kind: float(f"{rows.max():.3g}")
            for kind, rows in difference(asleep_end, awake_end).items()
        }
        rows.append(
            {"engine": engine, "sleep": True}
            | asleep
            | {"difference": dict.fromkeys(KINDS, 0.0)}
        )
        rows.append({"engine": engine, "sleep": False} | awake | {"difference": apart})
    return rows


def _record(leg: Leg, steps: int) -> Recording:
    from mjhab.experts import make_expert

    env = leg.make_env()
    policy = make_expert(env)
    obs, info = env.reset(seed=leg.seed, options={"episode": range(leg.worlds)})
    policy.reset(np.ones(leg.worlds, bool))
    homes = list(env.homes)
    qpos = env.sim.qpos.copy()
    commands = []
    for _ in range(steps):
        obs, _, _, _, info = env.step(np.asarray(policy.act(obs, info), np.float32))
        commands.append(env.ctrl)
    return Recording(env, homes, qpos, np.stack(commands))


def _run_c(
    recording: Recording, leg: Leg, sleep: bool
) -> tuple[dict[str, Any], SimState]:
    env = recording.env
    sim = CpuSimulator(env.layout, leg.worlds, leg.threads, env.controller.drives)
    if not sleep:
        sim.model = _without_sleep(sim.model)
    sim.reset(range(leg.worlds), recording.homes, recording.qpos)
    spent = 0.0
    awake = 0
    for number, command in enumerate(recording.commands):
        begun = time.process_time()
        sim.step(command)
        spent += time.process_time() - begun
        if number:  # everything is awake in the first ten substeps
            awake = max(
                awake,
                *(sim.batch.get_data(world).nv_awake for world in range(leg.worlds)),
            )
    return _row(spent, recording, awake, sim), _copy(sim.state())


def _without_sleep(
    model_of: Callable[[str], mujoco.MjModel],
) -> Callable[[str], mujoco.MjModel]:
    """Gives models of homes of its own, in which nothing falls asleep."""

    @cache
    def wakeful(home: str) -> mujoco.MjModel:
        # A copy: the simulator shares its models with others through the cache.
        model = copy.copy(model_of(home))
        model.opt.sleep_tolerance = 0.0
        return model

    return wakeful


def _run_warp(
    recording: Recording, leg: Leg, sleep: bool
) -> tuple[dict[str, Any], SimState]:
    from mjhab.sim.warp.probe import synchronize
    from mjhab.sim.warp.simulator import BufferSizes, WarpSimulator

    env = recording.env
    sizes = (
        None
        if sleep
        # Awake objects touch more than the default buffers hold.
        else BufferSizes(contacts=2048 * leg.worlds, ccd=1024 * leg.worlds, rows=4096)
    )
    sim = WarpSimulator(env.layout, leg.worlds, leg.device, env.controller.drives, sizes)
    rows, ctrl, rings = sim.start_rows(recording.homes, recording.qpos)
    if not sleep:
        sim.engine.model.opt.sleep_tolerance.zero_()
        rings = rings.new_full(rings.shape, -1)
    everyone = rows >= 0
    sim.reset_masked(everyone, rows, sim.qpos.new_tensor(recording.qpos), ctrl, rings)
    clock = time.perf_counter if sim.device.is_cuda else time.process_time
    commands = [sim.qpos.new_tensor(command) for command in recording.commands]
    spent = 0.0
    awake = 0
    for number, command in enumerate(commands):
        synchronize(sim.device)
        begun = clock()
        sim.step(command)
        synchronize(sim.device)
        spent += clock() - begun if number else 0.0  # the first loads kernels
        awake = max(awake, int(sim.engine.data.nv_awake.numpy().max()))
    row = _row(spent * len(commands) / max(1, len(commands) - 1), recording, awake, sim)
    return row, _copy(sim.state())


def _row(spent: float, recording: Recording, awake: int, sim: Any) -> dict[str, Any]:
    return {
        "ms": round(1e3 * spent / len(recording.commands), 2),
        "awake_dofs": awake,
        "nv": int(recording.env.sim.batch.qvel.shape[1]),
        "tainted": int((to_numpy(sim.taint()) != 0).sum()),
    }


def _copy(state: SimState) -> SimState:
    return map_record(lambda rows: to_numpy(rows).copy(), state)
