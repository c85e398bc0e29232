"""Expert episodes on both simulators for ``benchmarks.parity``: with the same actions on both, and with the expert
acting on each by itself."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_text
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink, StepView
from mjhab.sim.protocol import SimState
from mjhab.sim.warp.host_twin import HostTwin

MARKS = (1, 10, 100, 200)
"""Control steps after which the divergence is measured."""
KINDS = {"robot": "m or rad", "objects": "m", "turns": "rad", "links": "m or rad"}
"""What diverges, and its unit: robot joints, object positions, object orientations, doors and drawers."""
REWARD_TOLERANCE = 0.02
"""Normalised dense rewards this close agree."""
Row = dict[str, Any]
KEY = ("acting", "task", "subtask", "seed", "device", "index")
"""Fields that name a row of the log; ``device`` of the warp backend, None in logs that do not tell it."""


@dataclass(frozen=True)
class Leg:
    """A subtask of a task, and how its episodes are run.

    worlds: stepped together; threads: of the cpu backend, 0 for all cores; device: of the warp backend; whole: run on
    after success, to the horizon.
    """

    task: str
    subtask: str
    seed: int = 0
    worlds: int = 4
    threads: int = 0
    device: str = "cpu"
    whole: bool = False

    def make_env(self) -> SequentialTaskEnv:
        """Its environment on the cpu backend."""
        from mjhab.envs import make

        return make(
            task=self.task,
            subtask=self.subtask,
            num_envs=self.worlds,
            threads=self.threads,
            seed=self.seed,
            reward_mode="normalized_dense",
            autoreset="disabled",
            continuous=self.whole,
        )

    def make_twin(self) -> SequentialTaskEnv:
        """Its environment on the warp backend; what tries out states before a reset stays on the CPU."""
        from mjhab.sim.warp.simulator import WarpSimulator

        env = self.make_env()
        env.sim = HostTwin(
            WarpSimulator(env.layout, env.num_envs, self.device, env.controller.drives),
            env.sim,
        )
        env.state = env.sim.state()
        return env

    def key(self, acting: str, index: int) -> tuple[Any, ...]:
        """Names a row of the log."""
        return (acting, self.task, self.subtask, self.seed, self.device, index)


class Log:
    """Rows of finished episodes, in memory and in a file that a later run reads to go on.

    Args:
        path: JSON lines; None keeps nothing.

    Raises:
        UsageError: the file holds something else.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self.rows: dict[tuple[Any, ...], Row] = {}
        if path is not None and path.exists():
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
            # The last line is half a line if the run before was killed while it wrote.
            for line in lines[:-1] if lines and not lines[-1].endswith("\n") else lines:
                self._take(line)
            kept = "".join(json.dumps(row) + "\n" for row in self.rows.values())
            write_text(path, kept)

    def _take(self, line: str) -> None:
        try:
            # Older logs do not tell the device.
            row = {"device": None, **json.loads(line)}
            self.rows[tuple(row[name] for name in KEY)] = row
        except (ValueError, KeyError, TypeError) as error:
            raise UsageError(
                f"{self._path} is no log of benchmarks.parity: {line[:60]!r}"
            ) from error

    def add(self, leg: Leg, acting: str, index: int, row: Mapping[str, Any]) -> None:
        """Keep the row of an episode."""
        named = {**dict(zip(KEY, leg.key(acting, index), strict=True)), **row}
        self.rows[leg.key(acting, index)] = named
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            # Opened for every row, so that a killed run loses the last line at most.
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(named) + "\n")

    def missing(self, leg: Leg, acting: str, episodes: Sequence[int]) -> list[int]:
        """Those of the episodes that have no row."""
        return [index for index in episodes if leg.key(acting, index) not in self.rows]

    def of(
        self, leg: Leg, acting: str, episodes: Sequence[int] | None = None
    ) -> list[Row]:
        """Rows of the episodes, of all that there are by default, in the order of their indices."""
        begin = leg.key(acting, 0)[:-1]
        found = {key[-1]: row for key, row in self.rows.items() if key[:-1] == begin}
        return [
            found[index]
            for index in sorted(found)
            if episodes is None or index in episodes
        ]


def run_equal(
    leg: Leg,
    episodes: Sequence[int],
    done: Callable[[int, Row], None],
    max_steps: int | None = None,
) -> None:
    """Let the expert act on the cpu backend, give both backends its actions, and hand on a row of every episode.

    An episode is over when it is on the cpu backend, or after ``max_steps``. The row: "steps"; "success", "label",
    "reward" (mean), "taint" of [cpu, warp]; "close": steps in which the rewards agree; "drift": {step: {kind: largest
    difference}} at the MARKS that the episode reached.
    """
    from mjhab.experts import make_expert

    env = leg.make_env()
    rollout(
        env,
        make_expert(env),
        episodes,
        leg.seed,
        [Twin(leg.make_twin(), done)],
        max_steps,
    )


def run_own(leg: Leg, episodes: Sequence[int], done: Callable[[int, Row], None]) -> None:
    """Let the expert act on the warp backend by itself. The row: "steps", "success", "label", "reward", "taint"."""
    from mjhab.experts import make_expert

    env = leg.make_twin()
    rollout(env, make_expert(env), episodes, leg.seed, [_Alone(env.num_envs, done)])


class Twin(Sink[SequentialTaskEnv]):
    """Runs a second environment through what the first one goes through, and compares the two.

    Args:
        twin: like the environment that is rolled out, on the other simulator.
        done: gets the index and the row of every finished episode, see `run_equal`.
    """

    def __init__(self, twin: SequentialTaskEnv, done: Callable[[int, Row], None]) -> None:
        self._twin = twin
        self._done = done
        self._runs: list[_Run] = [_Run() for _ in range(twin.num_envs)]

    def on_reset(
        self, env: SequentialTaskEnv, info: Mapping[str, Any], mask: np.ndarray
    ) -> None:
        """Begin the same episodes in the twin."""
        worlds = np.flatnonzero(mask)
        specs = [info["episode_spec"][w] for w in worlds]
        options = {"episode": [spec["index"] for spec in specs], "reset_mask": mask}
        self._twin.reset(seed=specs[0]["seed"], options=options)
        for w in worlds:
            self._runs[w] = _Run()

    def on_step(self, env: SequentialTaskEnv, step: StepView) -> None:
        """Take the same step in the twin."""
        _, reward, _, _, info = self._twin.step(step.actions)
        drift = None
        for w in np.flatnonzero(step.active).tolist():
            run = self._runs[w]
            run.add(0, w, step.reward, step.info)
            run.add(1, w, reward, info)
            if int(step.steps[w]) in MARKS:
                drift = drift or difference(env.sim.state(), self._twin.sim.state())
                run.drift[str(step.steps[w])] = {
                    kind: float(f"{rows[w]:.4g}") for kind, rows in drift.items()
                }

    def on_episode_end(
        self, env: SequentialTaskEnv, world: int, record: EpisodeRecord
    ) -> None:
        """Hand on the row of the episode."""
        self._done(record.index, self._runs[world].row(record.steps))


class _Run:
    """What happened to the two twins [cpu, warp] in one episode."""

    def __init__(self) -> None:
        self.rewards: tuple[list[float], list[float]] = ([], [])
        self.won = [False, False]
        self.taint = [0, 0]
        self.labels: list[str | None] = [None, None]
        self.drift: dict[str, dict[str, float]] = {}

    def add(
        self, side: int, world: int, reward: np.ndarray, info: Mapping[str, Any]
    ) -> None:
        self.rewards[side].append(float(reward[world]))
        self.taint[side] |= int(info["taint"][world])
        self.won[side] |= bool(info["success"][world])
        ended = info["ended"][world]
        if ended is not None:
            self.labels[side] = str(ended["label"])

    def row(self, steps: int) -> Row:
        gaps = np.abs(np.subtract(*self.rewards))
        return {
            "steps": steps,
            "success": self.won,
            "label": self.labels,
            "taint": self.taint,
            "reward": [round(float(np.mean(side)), 6) for side in self.rewards],
            "close": int((gaps <= REWARD_TOLERANCE).sum()),
            "drift": self.drift,
        }


class _Alone(Sink[RolloutEnv]):
    """Hands on the row of every episode, see `run_own`."""

    def __init__(self, num_envs: int, done: Callable[[int, Row], None]) -> None:
        self._sum = np.zeros(num_envs)
        self._done = done

    def on_step(self, env: RolloutEnv, step: StepView) -> None:
        """Add the rewards of the worlds in which an episode runs."""
        self._sum += np.where(step.active, step.reward, 0.0)

    def on_episode_end(self, env: RolloutEnv, world: int, record: EpisodeRecord) -> None:
        """Hand on the row."""
        self._done(
            record.index,
            {
                "steps": record.steps,
                "success": record.success_once,
                "label": record.subtasks[-1].label if record.subtasks else None,
                "reward": round(float(self._sum[world]) / max(1, record.steps), 6),
                "taint": list(record.taint),
            },
        )
        self._sum[world] = 0.0


def difference(a: SimState, b: SimState) -> dict[str, np.ndarray]:
    """Largest difference (W,) of each of KINDS; turns are angles between orientations of objects."""
    dot = np.abs((a.object_pose[..., 3:] * b.object_pose[..., 3:]).sum(-1))
    # Divided by the lengths, as quaternions of float32 are not exactly of length 1.
    norms = np.linalg.norm(a.object_pose[..., 3:], axis=-1) * np.linalg.norm(
        b.object_pose[..., 3:], axis=-1
    )
    by_kind = {
        "robot": np.abs(a.robot_q - b.robot_q),
        "objects": np.linalg.norm(
            a.object_pose[..., :3] - b.object_pose[..., :3], axis=-1
        ),
        # The absolute value, because a quaternion and its negative are one turn.
        "turns": 2 * np.arccos(np.clip(dot / norms, 0.0, 1.0)),
        "links": np.abs(a.link_q - b.link_q),
    }
    return {kind: rows.max(axis=1, initial=0.0) for kind, rows in by_kind.items()}
