"""What the robot's cameras see of the target: ``python -m benchmarks.sight``."""

from __future__ import annotations

import sys
import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command import run_command
from mjhab.cli.output import Listing, report
from mjhab.evaluation.evaluate import run_evaluation
from mjhab.evaluation.filming import scene_of
from mjhab.evaluation.specs import EvalSpec
from mjhab.render.pictures.film_camera import shares_in_sight
from mjhab.render.pictures.viewpoint import Viewpoint
from mjhab.rollout.policy import RolloutEnv
from mjhab.rollout.sinks import Sink, StepView

SIZE_PX = 64
SEEN = 0.5
"""Least share of the points of a target that counts as seen."""


@dataclass(frozen=True)
class SightSpec:
    """Measure in which share of control steps each camera sees the target of the scripted expert.

    `python -m benchmarks.sight --episodes 20`

    The target is the object of a Pick, the goal of a Place, the handle of a drawer or door. A camera sees it if at
    least half of five points on it (within 4 cm) are in its image with nothing more than 12 cm in front of them.
    """

    task: str = "set_table"
    """The task."""
    subtasks: tuple[str, ...] = ("pick", "place", "open", "close")
    """The subtasks."""
    looks: tuple[str, ...] = ("ahead", "target")
    """What the head does, as in --style look=..."""
    episodes: int = 20
    """Episodes of every subtask."""
    every: int = 5
    """Control steps between two measurements."""
    seed: int = 0
    """Seed of the episodes."""
    json: bool = False
    """Print one line of JSON instead of a table."""


class SightSink(Sink[RolloutEnv]):
    """Counts in which control steps each camera sees the target.

    Args:
        every: control steps between two measurements.
    """

    def __init__(self, every: int) -> None:
        self.seen: dict[str, list[bool]] = defaultdict(list)
        self._every = every

    def on_step(self, env: Any, step: StepView) -> None:
        """Measure the worlds whose turn it is."""
        for world in np.flatnonzero(step.active & (step.steps % self._every == 0)):
            for camera, seen in cameras_see(env, int(world)).items():
                self.seen[camera].append(seen)


def cameras_see(env: Any, world: int) -> Mapping[str, bool]:
    """Whether each camera of the robot sees what is worked on in a world."""
    renderer = env.observer.renderer
    names = env.layout.robot.camera_names
    scene = scene_of(env, world)
    depth = renderer.robot_views(env.state, env.homes, SIZE_PX, ("depth",))["depth"][
        world
    ]
    pos, mat = renderer.camera_poses(env.state)
    fovy = renderer.fields_of_view()
    found = {}
    for k, name in enumerate(names):
        eye, axes = pos[world, k], mat[world, k]
        view = Viewpoint(eye, eye - axes[:, 2], float(fovy[k]), axes[:, 1])
        found[name] = bool(shares_in_sight(view, depth[k], scene.target[None])[0] >= SEEN)
    return found


def measure(spec: SightSpec) -> dict[str, Any]:
    """Shares of control steps [%] and of episodes with success, by subtask and look."""
    rows = []
    for subtask in spec.subtasks:
        for look in spec.looks:
            sink = SightSink(spec.every)
            # What the sink counts is all that is wanted of the run.
            with tempfile.TemporaryDirectory() as folder:
                asked = EvalSpec.of(
                    "expert",
                    task=spec.task,
                    subtask=subtask,
                    episodes=spec.episodes,
                    worlds=1,
                    seed=spec.seed,
                    films=0,
                    style=(f"look={look}",),
                    out=Path(folder) / "run",
                )
                run = run_evaluation(asked, [sink])
            rows.append(
                {
                    "subtask": subtask,
                    "look": look,
                    "seen": {
                        name: round(100 * float(np.mean(seen)), 1)
                        for name, seen in sink.seen.items()
                    },
                    "success_once": round(100 * float(run.summary["success_once"]), 1),
                    "steps": round(float(np.mean([r.steps for r in run.records])), 1),
                    "episodes": spec.episodes,
                }
            )
    return {"task": spec.task, "rows": rows}


def run(spec: SightSpec) -> int:
    """Measure and print; returns 0."""
    found = measure(spec)
    cameras = list(found["rows"][0]["seen"])
    seen = (f"{name} sees %" for name in cameras)
    rows = [
        (
            row["subtask"],
            row["look"],
            *(row["seen"][name] for name in cameras),
            row["success_once"],
            row["steps"],
        )
        for row in found["rows"]
    ]
    title = f"What the cameras see of the target, {found['task']}"
    columns = ("subtask", "look", *seen, "success %", "steps")
    report(spec.json, found, Listing(title, columns, rows))
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command line."""
    return run_command("sight", SightSpec, run, words, {"episodes": 1, "every": 1})


if __name__ == "__main__":
    sys.exit(main())
