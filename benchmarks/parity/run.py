"""How far the two simulators drift apart, and whether they agree on what matters."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.parity.episodes import (
    KINDS,
    MARKS,
    REWARD_TOLERANCE,
    Leg,
    Log,
    Row,
    run_equal,
    run_own,
)
from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.progress import progress_bar
from mjhab.sim.backends import cuda_devices, resolve
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.subtasks.registry import SUBTASKS

NOT_COMPARED = (
    "pictures (tests/render/warp/test_cameras.py compares them, mjhab bench interact times them), which objects sleep, "
    "the order of contacts, spawns and teleports"
)


@dataclass(frozen=True)
class ParitySpec:
    """Measure the divergence of the two simulators from equal starts, and the agreement of whole episodes.

    Divergence: both backends execute the expert's actions computed on the cpu backend. Agreement: with --episodes, the
    outcomes, labels and rewards of expert episodes are compared one by one, once with equal actions and once with the
    expert acting on each backend separately.

    `python -m benchmarks.parity --worlds 8 --task all --subtask all --episodes 200 --log parity.jsonl`
    """

    worlds: int = 4
    """Number of starts for the divergence: episodes 0 to N-1 of every subtask; also the number of parallel worlds."""
    steps: int = 200
    """Control steps; divergence is printed after 1, 10, 100 and 200 of them."""
    episodes: int = 0
    """Expert episodes for the agreement, spread over the subtasks; 0 compares only the --worlds runs."""
    task: str = "set_table"
    """Task whose episodes are used, or all."""
    subtask: str = "pick"
    """Subtask, or all that the task has."""
    log: Path | None = None
    """File for finished episodes (JSON lines); with it the same command continues an interrupted run."""
    grasp_seconds: float = 5.0
    """Duration of shaking grasped objects on both backends [s]; 0 leaves the test out."""
    device: str = ""
    """Of the warp backend: cuda:0, ... or cpu (slow, for tests); the first CUDA device if absent, else cpu."""
    threads: int = 0
    """Threads of the cpu backend; 0 takes all cores."""
    seed: int = 0
    """Seed of the episodes."""
    json: bool = False
    """Print one line of JSON instead of tables."""


def measure_parity(spec: ParitySpec) -> dict[str, Any]:
    """Compare both backends.

    Returns:
        "steps": the marks; "qpos_max", "qpos_median": {kind: [largest difference in a world, largest and median over
        worlds, at each mark]}; "agree": shares of episodes (success), of ended subtasks (label) and of steps (reward)
        that agree under the same actions; "episodes_equal", "episodes_own": the like for every subtask and for "all",
        of the expert episodes (see `shares_equal`, `shares_own`), empty without; "grasps": see `grasp_parity`.

    Raises:
        UsageError: unknown task or subtask, or a log that is none.
    """
    resolve("warp")
    device = spec.device or ("cuda:0" if cuda_devices() else "cpu")
    legs = [
        Leg(task, subtask, spec.seed, spec.worlds, spec.threads, device)
        for task, subtask in pairs(spec.task, spec.subtask)
    ]
    log = Log(spec.log)
    drift = run_drift(legs, spec.steps, log)
    run_episodes(legs, spec.episodes, log)
    equal = shares(log, "equal", legs, equal_shares)
    own = shares(log, "own", legs, own_shares)
    judged = equal["all"] if equal else equal_shares(drift)
    grasps: list[dict[str, Any]] = []
    if spec.grasp_seconds:
        from benchmarks.parity.grasp import grasp_parity

        grasps = grasp_parity(spec.grasp_seconds, device, spec.threads, spec.seed)
    return {
        "device": device,
        "worlds": len(drift),
        **divergence(drift),
        "agree": {name: judged[name] for name in ("success", "label", "reward")},
        "episodes_equal": equal,
        "episodes_own": own,
        "grasps": grasps,
        "not_compared": NOT_COMPARED,
    }


def pairs(task: str, subtask: str) -> list[tuple[str, str]]:
    """Tasks and subtasks that the names stand for, of which "all" stands for all there are.

    Raises:
        UsageError: unknown names, or no such subtask in that task.
    """
    for kind, given, valid in (("task", task, TASKS), ("subtask", subtask, SUBTASKS)):
        if given not in (*valid, "all"):
            raise unknown_name(kind, given, (*valid, "all"))
    tasks = TASKS.names() if task == "all" else (task,)
    found = [(t, s) for t in tasks for s in TASKS[t].subtasks if subtask in ("all", s)]
    if not found:
        raise UsageError(
            f"task {task!r} has no subtask {subtask!r}; it has {', '.join(TASKS[task].subtasks)}."
        )
    return found


def run_drift(legs: list[Leg], steps: int, log: Log) -> list[Row]:
    """Rows of `run_equal` of as many episodes as there are worlds, ``steps`` long whether they succeed or not."""
    rows = []
    for leg in legs:
        # The length is part of the name, so that a run with another one starts anew.
        acting = f"drift{steps}"
        indices = range(leg.worlds)
        if missing := log.missing(leg, acting, indices):
            add = functools.partial(log.add, leg, acting)
            run_equal(dataclasses.replace(leg, whole=True), missing, add, steps)
        rows += log.of(leg, acting, indices)
    return rows


def run_episodes(legs: list[Leg], episodes: int, log: Log) -> None:
    """Run expert episodes, spread over the legs, under the same actions on both and with the expert by itself."""
    each = -(-episodes // len(legs))
    plans = [(leg, acting) for acting in ("equal", "own") for leg in legs]
    with progress_bar("expert episodes", len(plans) * each) as advance:
        for leg, acting in plans:
            missing = log.missing(leg, acting, range(each))
            # The bar begins where the log ends.
            for _ in range(each - len(missing)):
                advance()

            # Defaults bind the leg of this turn of the loop.
            def done(index: int, row: Row, leg: Leg = leg, acting: str = acting) -> None:
                log.add(leg, acting, index, row)
                advance()

            if missing:
                (run_equal if acting == "equal" else run_own)(leg, missing, done)


def divergence(rows: Sequence[Row]) -> dict[str, Any]:
    """ "steps", "qpos_max" and "qpos_median" of rows of `run_equal`: see `measure_parity`."""
    marks = [mark for mark in MARKS if all(str(mark) in row["drift"] for row in rows)]
    table = {
        f"qpos_{name}": {
            kind: [
                float(f"{reduce([row['drift'][str(mark)][kind] for row in rows]):.4g}")
                for mark in marks
            ]
            for kind in KINDS
        }
        for name, reduce in (("max", np.max), ("median", np.median))
    }
    return {"steps": marks, **table}


def shares(
    log: Log,
    acting: str,
    legs: Sequence[Leg],
    reduce: Callable[[Sequence[Any]], dict[str, Any]],
) -> dict[str, dict[str, Any]]:
    """``reduce`` of the episodes in the log, for every leg by its name and for "all" of them; empty without any."""
    found = {f"{leg.task} {leg.subtask}": log.of(leg, acting) for leg in legs}
    if acting == "own":
        known = {leg: {row["index"]: row for row in log.of(leg, "equal")} for leg in legs}
        found = {
            name: [(known[leg][row["index"]], row) for row in rows]
            for leg, (name, rows) in zip(legs, found.items(), strict=True)
        }
    found = {name: rows for name, rows in found.items() if rows}
    every = [row for rows in found.values() for row in rows]
    return {name: reduce(rows) for name, rows in found.items()} | (
        {"all": reduce(every)} if every else {}
    )


def equal_shares(rows: Sequence[Row]) -> dict[str, Any]:
    """Of rows of `run_equal`: number of "episodes" and of "steps"; shares that agree of episodes ("success"), of those
    with a label ("label") and of steps ("reward"); success rates of each; "mean_reward": of episodes in which it
    agrees; "tainted": on either.
    """
    labels = [row["label"] for row in rows if any(row["label"])]
    steps = sum(row["steps"] for row in rows)
    return {
        "episodes": len(rows),
        "steps": steps,
        "success": share([row["success"][0] == row["success"][1] for row in rows]),
        "label": share([a == b for a, b in labels]),
        "reward": round(sum(row["close"] for row in rows) / max(1, steps), 4),
        "mean_reward": share(
            [abs(a - b) <= REWARD_TOLERANCE for a, b in (row["reward"] for row in rows)]
        ),
        "success_cpu": share([row["success"][0] for row in rows]),
        "success_warp": share([row["success"][1] for row in rows]),
        "tainted": sum(any(row["taint"]) for row in rows),
    }


def own_shares(pairs_of_rows: Sequence[tuple[Row, Row]]) -> dict[str, Any]:
    """Of episodes (row of `run_equal`, row of `run_own`): the like, with the mean reward of an episode for "reward"."""
    return {
        "episodes": len(pairs_of_rows),
        "success": share([a["success"][0] == b["success"] for a, b in pairs_of_rows]),
        "label": share([a["label"][0] == b["label"] for a, b in pairs_of_rows]),
        "reward": share(
            [
                abs(a["reward"][0] - b["reward"]) <= REWARD_TOLERANCE
                for a, b in pairs_of_rows
            ]
        ),
        "success_cpu": share([a["success"][0] for a, _ in pairs_of_rows]),
        "success_warp": share([b["success"] for _, b in pairs_of_rows]),
        "tainted": sum(bool(b["taint"]) for _, b in pairs_of_rows),
    }


def share(hits: Any) -> float | None:
    """Mean of booleans; None without any."""
    return round(float(np.mean(hits)), 4) if len(hits) else None
