"""A student as a policy for the rollout loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mjhab.core.seeding import stream
from mjhab.learning.observation.encoder import EncodedObs, ObservationEncoder
from mjhab.learning.students.student import Student

if TYPE_CHECKING:
    from mjhab.envs.parts.worlds import PolicyWorlds

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
        env: PolicyWorlds,
        seed: int = 0,
        pool: int = 1,
        instruction: str = "",
    ) -> None:
        student.layout.check_env(env, pool)
        self.student = student
        self._seed = seed
        config = student.config
        layout = student.layout
        worlds = env.num_envs
        width = len(layout.actions)
        self._chunks = np.zeros((worlds, config.chunk, width), np.float32)
        self._step = np.zeros(worlds, np.int64)
        self._encoder = ObservationEncoder(env, layout, pool, instruction)

    def reset(self, mask: np.ndarray) -> None:
        """Forget the worlds in ``mask`` (W,)."""
        self._encoder.begin(mask)
        self._step[mask] = 0

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Actions (W, A) float32 in [-1, 1]."""
        place = self._step % self.student.config.execute
        due = np.flatnonzero(place == 0)
        # Without a history only the observations that chunks are predicted from count; features of images cost time.
        if len(due) or self.student.config.inputs.history > 1:
            self._plan(due, self._encoder.encode(obs, info), info)
        actions = self._chunks[np.arange(len(place)), place]
        self._step += 1
        self._encoder.executed(actions)
        # The encoder keeps the array as the previous action, and callers may add noise to theirs.
        return actions.copy()

    def plan(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """See `rollout.policy.Chunked`."""
        self._plan(np.arange(len(self._chunks)), self._encoder.encode(obs, info), info)
        self._step += 1
        return self._chunks.copy()

    def replace_action(self, actions: np.ndarray, replan: bool = False) -> None:
        """See `rollout.policy.Correctable`."""
        self._encoder.executed(actions.copy())
        if replan:
            # To the next multiple of ``execute``, at which a new chunk is due.
            self._step += -self._step % self.student.config.execute

    def _plan(
        self, worlds: np.ndarray, seen: EncodedObs, info: Mapping[str, Any]
    ) -> None:
        """Predict new chunks for the given worlds, INFERENCE_ROWS at a time."""
        for start in range(0, len(worlds), INFERENCE_ROWS):
            some = worlds[start : start + INFERENCE_ROWS]
            # Filled up by repeating worlds, since the last bits depend on the number of rows.
            rows = np.resize(some, INFERENCE_ROWS)
            noise = self._noise(rows, info)
            chunks = self.student.act(seen.vector[rows], seen.images[rows], noise)
            self._chunks[some] = chunks[: len(some)]

    def _noise(self, worlds: np.ndarray, info: Mapping[str, Any]) -> np.ndarray:
        """Standard normal noise (n, draws, chunk, A), a function of the seed, the episode and the control step."""
        shape = (self.student.draws, *self._chunks.shape[1:])
        noise = np.zeros((len(worlds), *shape), np.float32)
        if self.student.draws:
            for row, world in enumerate(worlds.tolist()):
                # By the episode and not by the world, so that the number of worlds does not matter.
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
        # Each member believes that its own action was executed.
        self.replace_action(actions)
        return actions

    def plan(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """See `rollout.policy.Chunked`; as long as the shortest chunk."""
        chunks = [member.plan(obs, info) for member in self.members]
        length = min(chunk.shape[1] for chunk in chunks)
        return np.mean([chunk[:, :length] for chunk in chunks], axis=0)

    def replace_action(self, actions: np.ndarray, replan: bool = False) -> None:
        """See `rollout.policy.Correctable`."""
        for member in self.members:
            member.replace_action(actions, replan)
