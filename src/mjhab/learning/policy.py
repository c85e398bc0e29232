"""A student as a policy for the rollout loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mjhab.core.names import kind_of
from mjhab.core.seeding import stream
from mjhab.learning.demos import base_velocity, nearness
from mjhab.learning.layout import ActingEnv
from mjhab.learning.students.student import Student

INFERENCE_ROWS = 16
"""Fixed batch size of inference [worlds]. The last bits of the actions depend on the batch size, because it changes the
order of summation."""


class StudentPolicy:
    """Runs a student network: it keeps the history and executes the first actions of every predicted chunk.

    Args:
        student: network, for instance from `checkpoint.load_student`.
        env: environment that the policy will act in; its layout must match the student's.
        seed: of the noise that flow matching or diffusion start from.
        pool: the environment's images are so many times as wide and high as the student's, which sees means of
            ``pool`` x ``pool`` pixels.
        instruction: what a student with sentences is told in place of the episodes' instructions; "" for these.

    Raises:
        UsageError: the environment's observations or actions do not match the student's.
    """

    name = "student"

    def __init__(
        self,
        student: Student,
        env: ActingEnv,
        seed: int = 0,
        pool: int = 1,
        instruction: str = "",
    ) -> None:
        student.layout.check_env(env, pool)
        self.student = student
        self._env = env
        self._seed = seed
        self._pool = pool
        self._instruction = instruction
        config = student.config
        layout = student.layout
        worlds = env.num_envs
        width = len(layout.actions)
        self._last = np.zeros((worlds, width), np.float32)
        self._chunks = np.zeros((worlds, config.chunk, width), np.float32)
        self._step = np.zeros(worlds, np.int64)
        self._vectors = np.zeros(
            (worlds, config.inputs.history, layout.width), np.float32
        )
        size = config.inputs.image_size
        shape = (len(layout.image_keys), size, size) if layout.image_keys else (0, 0, 0)
        self._images = np.zeros((worlds, config.inputs.history, *shape), np.uint8)

    def reset(self, mask: np.ndarray) -> None:
        """Forget the worlds in ``mask`` (W,)."""
        self._last[mask] = 0.0
        self._step[mask] = 0

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Actions (W, A) float32 in [-1, 1]."""
        self._remember(obs, info)
        place = self._step % self.student.config.execute
        self._plan(np.flatnonzero(place == 0), info)
        actions = self._chunks[np.arange(len(place)), place]
        self._step += 1
        self._last = actions.copy()
        return actions

    def replace_action(self, actions: np.ndarray) -> None:
        """Tell that ``actions`` (W, A) are executed instead of those that ``act`` returned last."""
        self._last = actions.copy()

    def _remember(self, obs: Any, info: Mapping[str, Any]) -> None:
        """Append the current observation to the history; the first one of an episode fills the whole history."""
        vector, images = self._see(obs, info)
        begin = self._step == 0
        self._vectors[begin] = vector[begin, None]
        self._images[begin] = images[begin, None]
        self._vectors = np.concatenate([self._vectors[:, 1:], vector[:, None]], axis=1)
        self._images = np.concatenate([self._images[:, 1:], images[:, None]], axis=1)

    def _see(self, obs: Any, info: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        layout = self.student.layout
        parts = [np.asarray(obs["state"], np.float32)]
        if layout.inputs.base_velocity:
            state = self._env.state
            parts.append(base_velocity(state.robot_q, state.robot_qd))
        if layout.inputs.link_state:
            parts.append(self._env.link_state())
        if layout.inputs.previous_action:
            parts.append(self._last)
        if layout.condition_width:
            parts.append(self._conditions(info))
        images = [
            pooled(nearness(np.asarray(obs[key])[..., 0]), self._pool)
            for key in layout.image_keys
        ]
        seen = (
            np.stack(images, axis=1)
            if images
            else np.zeros((len(parts[0]), 0, 0, 0), np.uint8)
        )
        return np.concatenate(parts, axis=1), seen

    def _conditions(self, info: Mapping[str, Any]) -> np.ndarray:
        layout = self.student.layout
        codes = np.zeros((len(self._step), layout.condition_width), np.float32)
        sentences = [self._instruction] * len(codes)
        if layout.inputs.sentence and not self._instruction:
            # That of the active subtask: it changes within a chain.
            sentences = info["instruction"]
        for w, episode in enumerate(info["episode_spec"]):
            if episode is not None:
                plan = episode["plan"]
                entry = plan[min(int(info["pointer"][w]), len(plan) - 1)]
                codes[w] = layout.condition(
                    entry["kind"], kind_of(entry["target"]), sentences[w]
                )
        return codes

    def _plan(self, worlds: np.ndarray, info: Mapping[str, Any]) -> None:
        """Predict new chunks for the given worlds, INFERENCE_ROWS at a time."""
        for start in range(0, len(worlds), INFERENCE_ROWS):
            some = worlds[start : start + INFERENCE_ROWS]
            rows = np.resize(some, INFERENCE_ROWS)
            vector = self._vectors[rows].reshape(INFERENCE_ROWS, -1)
            images = self._images[rows]
            channels = images.shape[1] * images.shape[2]
            images = images.reshape(INFERENCE_ROWS, channels, *images.shape[3:])
            chunks = self.student.act(vector, images, self._noise(rows, info))
            self._chunks[some] = chunks[: len(some)]

    def _noise(self, worlds: np.ndarray, info: Mapping[str, Any]) -> np.ndarray:
        """Standard normal noise (n, draws, chunk, A), a function of the seed, the episode and the control step."""
        config = self.student.config
        shape = (self.student.draws, config.chunk, self._last.shape[1])
        noise = np.zeros((len(worlds), *shape), np.float32)
        if self.student.draws:
            for row, world in enumerate(worlds.tolist()):
                index = int((info["episode_spec"][world] or {}).get("index", 0))
                random = stream(self._seed, "student", index, int(self._step[world]))
                noise[row] = random.standard_normal(shape, np.float32)
        return noise


class StudentEnsemble:
    """Several students act together: the mean of their actions is executed.

    Students that were trained separately err differently, so their mean errs less.

    Args:
        members: policies in the same environment.
    """

    name = "student"

    def __init__(self, members: Sequence[StudentPolicy]) -> None:
        self.members = tuple(members)

    def reset(self, mask: np.ndarray) -> None:
        """Forget the worlds in ``mask`` (W,)."""
        for member in self.members:
            member.reset(mask)

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Actions (W, A) float32 in [-1, 1]."""
        actions = np.mean([member.act(obs, info) for member in self.members], axis=0)
        for member in self.members:
            member.replace_action(actions)
        return actions


def pooled(images: np.ndarray, factor: int) -> np.ndarray:
    """Images (W, H, W') uint8 reduced to means of ``factor`` x ``factor`` pixels."""
    if factor == 1:
        return images
    worlds, height, width = images.shape
    blocks = images.reshape(worlds, height // factor, factor, width // factor, factor)
    return np.rint(blocks.mean(axis=(2, 4))).astype(np.uint8)
