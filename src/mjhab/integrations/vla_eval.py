"""A benchmark class for the vla-eval package: ``benchmark: mjhab.integrations.vla_eval:MjhabBenchmark``.

Tasks are the rows of a track of `mjhab score` and the episodes of a task those of the row, so that numbers of both can
be compared. Works with vla-eval 0.8 (``pip install vla-eval``).
"""

# The library lives in an environment of its own, see the Makefile.
# pyright: reportMissingImports=false
from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.specs import IMAGE_RGB, LANGUAGE, RAW, DimSpec

import mjhab.envs as envs
from mjhab.core.errors import UsageError, unknown_name
from mjhab.envs.observations.modes import STATE_KEY, camera_key
from mjhab.envs.observations.state import state_dim
from mjhab.evaluation.score.manifest import ScoreRow, manifest
from mjhab.evaluation.served.action_spaces import ActionReader, space_named
from mjhab.robots.registry import DEFAULT_ROBOT, robot_named

CAMERAS = ("head", "wrist")
"""Names of the images, in the order of the robot's cameras."""
MAX_STEPS = {"subtasks": 500, "chains": 8000, "ms_hab_7": 500}
"""Bounds [control steps] that no episode reaches: the environment ends each at its own horizon."""
RANGE = (-1.0, 1.0)


class MjhabBenchmark(StepBenchmark):
    """Subtasks or chains of mjhab for model servers of vla-eval.

    A model sees two RGB images, the state (S,) and the instruction of the active subtask.

    Args:
        track: "subtasks", "chains" or "ms_hab_7", see `evaluation.score.manifest`.
        split: "train", "val" or "test"; "" for that of the track's official scores.
        rows: names of some of the rows, such as "set_table.pick"; None for all.
        actions: name of the action space of the model, see `evaluation.served.action_spaces`.
        camera_size: side of the images [px].
        robot: name of the robot, see `mjhab robots list`; it has two cameras, the first on its head or column.

    Raises:
        UsageError: an unknown name.
    """

    render_backends: ClassVar[frozenset[str]] = frozenset({"cpu", "gpu"})

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """Nothing is to be configured: images are drawn on the CPU, without OpenGL."""
        return {}

    def __init__(
        self,
        track: str = "subtasks",
        split: str = "",
        rows: Sequence[str] | None = None,
        actions: str = "ee",
        camera_size: int = 224,
        robot: str = DEFAULT_ROBOT,
    ) -> None:
        super().__init__()
        asked = manifest(track, split)
        known = {row.name: row for row in asked.rows}
        for name in rows or ():
            if name not in known:
                raise unknown_name("row", name, known)
        space_named(actions)
        self._asked = asked
        self._rows = {name: known[name] for name in rows or known}
        self._actions = actions
        self._size = camera_size
        self._robot = robot_named(robot)
        self._env: Any = None
        self._row: ScoreRow | None = None
        self._reader: ActionReader | None = None
        self._info: dict[str, Any] = {}
        self._success = False

    def get_tasks(self) -> list[dict[str, Any]]:
        """One per row."""
        return [
            {"name": name, "suite": f"mjhab_{self._asked.track}"} for name in self._rows
        ]

    def reset(self, task: dict[str, Any]) -> Any:
        """Begin an episode of the row of this name; ``task["episode_idx"]`` counts on over the seeds."""
        row = self._rows[task["name"]]
        # Making an environment takes seconds; episodes of one row share it.
        if row is not self._row:
            self._open(row)
        turn, index = divmod(int(task.get("episode_idx", 0)), row.episodes)
        options = {"episode": np.array([index]), "reset_mask": np.ones(1, bool)}
        seed = self._asked.seeds[turn]
        obs, self._info = self._env.reset(seed=seed, options=options)
        self._success = False
        self._recorder.record_video(self._image(obs, 0))
        return obs

    def step(self, action: dict[str, Any]) -> StepResult:
        """Take one control step with ``action["actions"]``.

        Raises:
            UsageError: another number of values than the action space has, or numbers that are not finite.
        """
        assert self._reader is not None
        given = action.get("actions", action.get("action"))
        sent = np.asarray(given, np.float32).reshape(1, -1)
        problem = self._reader.problem(sent)
        if problem:
            raise UsageError(problem)
        obs, reward, terminated, truncated, info = self._env.step(self._reader.read(sent))
        self._info = info
        self._success |= bool(info["success"][0])
        done = bool(terminated[0] or truncated[0])
        self._recorder.record_video(self._image(obs, 0))
        self._recorder.record_step(
            reward=float(reward[0]), done=done, success=self._success, action=sent[0]
        )
        return StepResult(obs=obs, reward=float(reward[0]), done=done, info={})

    def make_obs(self, raw_obs: Any, task: dict[str, Any]) -> dict[str, Any]:
        """Images, state and instruction."""
        return {
            "images": {name: self._image(raw_obs, k) for k, name in enumerate(CAMERAS)},
            "states": np.asarray(raw_obs[STATE_KEY][0], np.float32),
            "task_description": self._info["instruction"][0],
        }

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        """ "success"; "completed", the share of the plan that is done; "cumulative_force" [N x control steps]."""
        spec = self._info["episode_spec"][0]
        completed = 1.0 if self._success else self._info["pointer"][0] / len(spec["plan"])
        return {
            "success": self._success,
            "completed": float(completed),
            "cumulative_force": float(self._info["cumulative_force"][0]),
        }

    def get_metric_keys(self) -> dict[str, str]:
        """Means of what `get_step_result` gives."""
        return {"success": "mean", "completed": "mean", "cumulative_force": "mean"}

    def get_metadata(self) -> dict[str, Any]:
        """Bounds of an evaluation."""
        episodes = min(self._asked.count(row) for row in self._rows.values())
        steps = MAX_STEPS[self._asked.track]
        return {"max_steps": steps, "max_episodes_per_task": episodes}

    def get_action_spec(self) -> dict[str, DimSpec]:
        """All numbers of an action as one part."""
        controller_table = self._table()
        width = len(ActionReader(self._actions, controller_table).names)
        return {"actions": DimSpec("actions", width, f"mjhab_{self._actions}", RANGE)}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """Two images, the state and the instruction."""
        state = DimSpec("state", state_dim(self._robot), RAW.format)
        return {**dict.fromkeys(CAMERAS, IMAGE_RGB), "state": state, "language": LANGUAGE}

    def get_hold_action(self, last_action: dict[str, Any] | None) -> dict[str, Any]:
        """All-zero: joints and base keep still."""
        width = len(ActionReader(self._actions, self._table()).names)
        return {"actions": np.zeros(width, np.float32)}

    def render(self) -> np.ndarray | None:
        """A view over the robot's shoulder."""
        return None if self._env is None else self._env.render_world(0)

    def cleanup(self) -> None:
        """Close the environment."""
        if self._env is not None:
            self._env.close()
            self._env = None
            self._row = None

    def _table(self) -> Any:
        from mjhab.robots.controllers import make_controller

        mode = space_named(self._actions).control_mode
        return make_controller(mode, robot=self._robot).table

    def _open(self, row: ScoreRow) -> None:
        self.cleanup()
        self._env = envs.make(
            robot=self._robot.name,
            task=row.task,
            subtask=row.subtask,
            target=row.target,
            split=self._asked.split,
            profile=self._asked.profile,
            num_envs=1,
            obs_mode="rgb",
            camera_size=self._size,
            control_mode=space_named(self._actions).control_mode,
            autoreset="disabled",
        )
        self._row = row
        self._reader = ActionReader(self._actions, self._env.action_table)

    def _image(self, obs: Any, camera: int) -> np.ndarray:
        return obs[camera_key(self._robot.camera_names[camera], "rgb")][0]
