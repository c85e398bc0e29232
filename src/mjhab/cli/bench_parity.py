"""``mjhab bench parity``: how far the two simulators drift apart, and whether they agree on what matters."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjhab.cli.gpu_options import BenchParityOptions
from mjhab.cli.host_twin import HostTwin
from mjhab.cli.output import at_least, print_json, print_table, progress_bar
from mjhab.core.errors import UsageError
from mjhab.rollout.loop import rollout
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink, StepView
from mjhab.sim.backends import cuda_devices, resolve
from mjhab.sim.protocol import SimState

MARKS = (1, 10, 100, 200)
"""Control steps after which the divergence is printed."""
KINDS = {"robot": "m or rad", "objects": "m", "turns": "rad", "links": "m or rad"}
REWARD_TOLERANCE = 0.02
"""Normalised dense rewards this close agree."""
NOT_COMPARED = "pictures (the warp backend has no cameras yet), sleep, the order of contacts, spawns and teleports"


def bench_parity(options: BenchParityOptions) -> int:
    """Print what `measure_parity` finds."""
    for name in ("worlds", "steps"):
        at_least(name, getattr(options, name), 1)
    for name in ("episodes", "threads", "seed"):
        at_least(name, getattr(options, name), 0)
    at_least("grasp-seconds", options.grasp_seconds, 0.0)
    if options.subtask not in ("pick", "place", "open", "close"):
        raise UsageError(f"--subtask must be pick, place, open or close, got {options.subtask!r}.")
    found = measure_parity(options)
    if options.json:
        print_json(found)
        return 0
    marks = [f"step {mark}" for mark in found["steps"]]
    rows = [[f"{kind} [{KINDS[kind]}]", *(f"{x:.2g}" for x in found["qpos_max"][kind])] for kind in KINDS]
    print_table(f"largest difference in {options.worlds} worlds", ("what", *marks), rows)
    rows = [[f"{kind} [{KINDS[kind]}]", *(f"{x:.2g}" for x in found["qpos_median"][kind])] for kind in KINDS]
    print_table("median over the worlds", ("what", *marks), rows)
    print_table("share that agrees", ("what", "share"), list(found["agree"].items()))
    if found["grasps"]:
        rows = [
            [row["object"], *(row[b][key] for b in ("cpu", "warp") for key in ("slip_mm", "dropped"))]
            for row in found["grasps"]
        ]
        columns = ("object", "cpu slip [mm]", "cpu dropped", "warp slip [mm]", "warp dropped")
        print_table(f"{options.grasp_seconds:g} s of shaking", columns, rows)
    print(f"Not compared: {NOT_COMPARED}.")
    return 0


def measure_parity(options: BenchParityOptions) -> dict[str, Any]:
    """Compare both backends.

    Returns:
        "steps": the marks; "qpos_max", "qpos_median": {kind: [largest difference in a world, largest and median over
        worlds, at each mark]}; "agree": shares of worlds (success), of ended subtasks (label), of steps (reward)
        that agree, from the expert on either backend with ``episodes`` and else from the runs under equal actions;
        "grasps": see `grasp_parity`.
    """
    resolve("warp")
    device = options.device or ("cuda:0" if cuda_devices() else "cpu")
    env, twin = (make_env(options, options.worlds) for _ in range(2))
    use_warp(twin, device)
    drift, agree = lockstep(env, twin, options)
    closed = closed_loop(options, device) if options.episodes else None
    grasps: list[dict[str, Any]] = []
    if options.grasp_seconds:
        from mjhab.cli.parity_grasp import grasp_parity

        grasps = grasp_parity(options.grasp_seconds, device, options.threads, options.seed)
    marks = [mark for mark in MARKS if mark <= options.steps]
    table = {
        f"qpos_{name}": {kind: [float(f"{reduce(drift[mark][kind]):.4g}") for mark in marks] for kind in KINDS}
        for name, reduce in (("max", np.max), ("median", np.median))
    }
    return {
        "device": device, "worlds": options.worlds, "steps": marks, **table, "agree": (closed or agree),
        "agree_equal_actions": agree, "episodes": options.episodes, "grasps": grasps, "not_compared": NOT_COMPARED,
    }  # fmt: skip


def make_env(options: BenchParityOptions, worlds: int) -> Any:
    """An environment on the cpu backend."""
    from mjhab.envs import make

    return make(
        task=options.task, subtask=options.subtask, num_envs=worlds, threads=options.threads, seed=options.seed,
        reward_mode="normalized_dense", autoreset="disabled",
    )  # fmt: skip


def use_warp(env: Any, device: str) -> None:
    """Put an environment on the warp backend; what tries out states before a reset stays on the CPU."""
    from mjhab.sim.warp import WarpSimulator

    env.sim = HostTwin(WarpSimulator(env.layout, env.num_envs, device, env.controller.drives), env.sim)
    env.state = env.sim.state()


def lockstep(
    env: Any, twin: Any, options: BenchParityOptions
) -> tuple[dict[int, dict[str, np.ndarray]], dict[str, float | None]]:
    """Run the expert on ``env`` and the same actions on ``twin``.

    Returns:
        At each mark the difference {kind: (W,)}; and the shares that agree. Worlds whose episode is over on either
        side count for rewards no more.
    """
    from mjhab.experts import make_expert

    policy = make_expert(env)
    worlds = np.arange(env.num_envs)
    (obs, info), _ = (e.reset(seed=options.seed, options={"episode": worlds}) for e in (env, twin))
    policy.reset(np.ones(len(worlds), bool))
    drift: dict[int, dict[str, np.ndarray]] = {}
    over = np.zeros(len(worlds), bool)
    close: list[np.ndarray] = []
    won = np.zeros((2, len(worlds)), bool)
    labels: list[list[str | None]] = [[None] * len(worlds) for _ in range(2)]
    with progress_bar("equal actions", options.steps) as advance:
        for step in range(1, options.steps + 1):
            actions = np.asarray(policy.act(obs, info), np.float32)
            mine, theirs = env.step(actions), twin.step(actions)
            obs, info = mine[0], mine[4]
            if step in MARKS:
                drift[step] = difference(env.sim.state(), twin.sim.state())
            close.append(np.abs(mine[1] - theirs[1])[~over] <= REWARD_TOLERANCE)
            for side, result in enumerate((mine, theirs)):
                won[side] |= result[4]["success"] & ~over
                _note_labels(labels[side], result[4]["ended"], over)
            over |= mine[2] | mine[3] | theirs[2] | theirs[3]
            advance()
    same = [a == b for a, b in zip(*labels, strict=True) if a or b]
    agree = {"success": share(won[0] == won[1]), "label": share(same), "reward": share(np.concatenate(close))}
    return drift, agree


def _note_labels(labels: list[str | None], ended: Any, over: np.ndarray) -> None:
    for world, entry in enumerate(ended):
        if entry is not None and not over[world]:
            labels[world] = str(entry["label"])


def difference(a: SimState, b: SimState) -> dict[str, np.ndarray]:
    """Largest difference (W,) of each kind; turns are angles between orientations of objects."""
    dot = np.abs((a.object_pose[..., 3:] * b.object_pose[..., 3:]).sum(-1))
    norms = np.linalg.norm(a.object_pose[..., 3:], axis=-1) * np.linalg.norm(b.object_pose[..., 3:], axis=-1)
    by_kind = {
        "robot": np.abs(a.robot_q - b.robot_q),
        "objects": np.linalg.norm(a.object_pose[..., :3] - b.object_pose[..., :3], axis=-1),
        "turns": 2 * np.arccos(np.clip(dot / norms, 0.0, 1.0)),
        "links": np.abs(a.link_q - b.link_q),
    }
    return {kind: rows.max(axis=1, initial=0.0) for kind, rows in by_kind.items()}


class _Returns(Sink):
    """Sums the rewards of every episode: ``returns`` by episode index."""

    def __init__(self, num_envs: int) -> None:
        self.returns: dict[int, float] = {}
        self._sum = np.zeros(num_envs)

    def on_step(self, env: Any, step: StepView) -> None:
        """Add the rewards of the worlds in which an episode runs."""
        self._sum += np.where(step.active, step.reward, 0.0)

    def on_episode_end(self, env: Any, world: int, record: EpisodeRecord) -> None:
        """Close the sum of a world."""
        self.returns[record.index] = float(self._sum[world]) / max(1, record.steps)
        self._sum[world] = 0.0


def closed_loop(options: BenchParityOptions, device: str) -> dict[str, float | None]:
    """Let the expert act on each backend by itself; shares of episodes whose success, label and mean reward agree,
    and the success rate of each.
    """
    from mjhab.experts import make_expert

    records, returns = [], []
    for backend in ("cpu", "warp"):
        env = make_env(options, min(options.worlds, options.episodes))
        if backend == "warp":
            use_warp(env, device)
        sums = _Returns(env.num_envs)
        records.append(rollout(env, make_expert(env), range(options.episodes), options.seed, [sums]))
        returns.append([sums.returns[record.index] for record in records[-1]])
    won = [np.array([record.success_once for record in side]) for side in records]
    labels = [[[s.label for s in record.subtasks] for record in side] for side in records]
    gap = np.abs(np.subtract(*returns))
    return {
        "success": share(won[0] == won[1]),
        "label": share([a == b for a, b in zip(*labels, strict=True)]),
        "reward": share(gap <= REWARD_TOLERANCE),
        "success_rate_cpu": share(won[0]),
        "success_rate_warp": share(won[1]),
    }


def share(hits: Any) -> float | None:
    """Mean of booleans; None without any."""
    return round(float(np.mean(hits)), 4) if len(hits) else None
