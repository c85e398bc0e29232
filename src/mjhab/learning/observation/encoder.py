"""The one encoder of what a learned policy sees: of rows of any source, and of running worlds with their histories."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from mjhab.core.arrays import Array, as_like, namespace, zeros
from mjhab.core.conventions.names import Conventions
from mjhab.core.names import kind_of
from mjhab.learning.observation.depth import pooled
from mjhab.learning.observation.parts import (
    IMAGE_KEY_PREFIX,
    InputSpec,
    StepSource,
    SubtaskConditioning,
    code_of,
    conditioning_parts,
    image_parts,
    parts_of,
    width_of,
)
from mjhab.learning.observation.state import observed_state
from mjhab.tasks.subtasks.registry import SUBTASKS

if TYPE_CHECKING:
    from mjhab.envs.device.env import DeviceEnv
    from mjhab.envs.parts.worlds import PolicyWorlds


@dataclass(frozen=True, eq=False)
class EncodedObs:
    """N encoded observations, numpy or torch. vector (N, V) float32. images (N, C, height, width) uint8; C may be 0."""

    vector: Array
    images: Array


def encode(source: StepSource, spec: InputSpec) -> EncodedObs:
    """Encode the observations of one control step, or of the steps of an episode, without a history.

    Raises:
        UsageError: the source lacks what a part needs.
    """
    parts = [part.encode(source, spec) for part in parts_of(spec.inputs)]
    xp = namespace(parts[0])
    vector = xp.concat(parts, axis=1)
    channels = [
        channel
        for part in image_parts(spec.inputs)
        for channel in part.encode(source, spec)
    ]
    # An array of size 0, so that nobody asks whether there are images.
    none = xp.astype(zeros((len(vector), 0, 0, 0), vector), xp.uint8)
    images = xp.stack(channels, axis=1) if channels else none
    return EncodedObs(xp.astype(vector, xp.float32, copy=False), images)


class ObservationEncoder:
    """Encodes what the worlds of an environment show, step by step, with the histories and the previous actions.

    Args:
        env: environment of either backend.
        spec: what the policy sees.
        pool: the environment's images are so many times as wide and high as the policy's, which sees means of
            ``pool`` x ``pool`` pixels.
        instruction: told in place of the episodes' instructions; "" for these.
    """

    def __init__(
        self, env: PolicyWorlds, spec: InputSpec, pool: int = 1, instruction: str = ""
    ) -> None:
        self.spec = spec
        self._env = env
        self._pool = pool
        self._instruction = instruction
        # Made at the first observation, which tells library and device.
        self._previous: Array = None
        self._conditioning: Array = None
        self._aims: Array = None
        self._fresh: Array = None
        self._subtasks: list[tuple[Any, int, str] | None] = []
        self._vectors: Array = None
        self._images: Array = None

    def begin(self, mask: Array) -> None:
        """Episodes begin in the worlds of ``mask`` (W,) bool: no previous action, and a history of what comes next."""
        if self._conditioning is None:
            # Nothing has been encoded yet: every world begins.
            return
        xp = namespace(self._previous)
        # Not in place: the caller's array of actions may be the same one.
        self._previous = xp.where(mask[:, None], 0.0, self._previous)
        self._fresh = self._fresh | mask

    def executed(self, actions: Array) -> None:
        """Tell which actions (W, A) float32 in [-1, 1] are executed before the next observation."""
        self._previous = actions

    def encode(
        self, obs: Mapping[str, Any], info: Mapping[str, Any], again: bool = False
    ) -> EncodedObs:
        """Encode the observations of a control step.

        Args:
            obs: observations.
            info: of the same step.
            again: only the worlds of ``begin`` have changed since the last call; the histories of the others stay.

        Returns:
            vector (W, history * V), images (W, history * C, height, width).
        """
        if self._conditioning is None:
            self._start(_float32(obs["state"]))
        self._tell(info)
        source = LiveSource(
            self._env,
            obs,
            self._previous,
            self._conditioning,
            self._aims,
            self.spec.conventions,
        )
        seen = encode(source, self.spec)
        self._vectors = self._remember(self._vectors, seen.vector, again)
        self._images = self._remember(
            self._images, pooled(seen.images, self._pool), again
        )
        # Of the same library and device, which a new array would have to be told.
        self._fresh = self._fresh & False
        worlds, length, channels, *size = self._images.shape
        xp = namespace(seen.vector)
        return EncodedObs(
            xp.reshape(self._vectors, (worlds, -1)),
            xp.reshape(self._images, (worlds, length * channels, *size)),
        )

    def _start(self, like: Array) -> None:
        """Make the arrays, of the library and device of the observations."""
        worlds = self._env.num_envs
        width = sum(
            width_of(part, self.spec) for part in conditioning_parts(self.spec.inputs)
        )
        # Actions may have been executed before the first observation was encoded.
        if self._previous is None:
            self._previous = zeros((worlds, len(self.spec.actions)), like)
        self._conditioning = zeros((worlds, width), like)
        self._aims = zeros((worlds, 1), like) > 0
        # All worlds begin.
        self._fresh = ~self._aims[:, 0]
        self._subtasks = [None] * worlds

    def _remember(self, history: Array, now: Array, again: bool) -> Array:
        """Append ``now`` (W, ...) to a history (W, H, ...); fresh worlds get a history of ``now`` only."""
        now = now[:, None]
        length = self.spec.inputs.history
        # No history is kept where nothing will read it.
        if length == 1 or not math.prod(now.shape):
            return now
        xp = namespace(now)
        whole = xp.broadcast_to(now, (now.shape[0], length, *now.shape[2:]))
        if history is None:
            return whole
        # A step that is encoded again is the last entry already.
        moved = history if again else xp.concat([history[:, 1:], now], axis=1)
        mask = xp.reshape(self._fresh, (now.shape[0],) + (1,) * (now.ndim - 1))
        return xp.where(mask, whole, moved)

    def _tell(self, info: Mapping[str, Any]) -> None:
        """Code the active subtask of the worlds in which it is another one than in the last step."""
        inputs = self.spec.inputs
        # Nothing reads codes, so that the worlds' episodes need not be looked at.
        if not (conditioning_parts(inputs) or inputs.target_in_hand):
            return
        episodes = info.get("episode_spec")
        if episodes is None:
            # On a device `info` describes no episodes; environments there that train have one subtask per episode.
            for world in namespace(self._fresh).nonzero(self._fresh)[0].tolist():
                self._tell_world(
                    world, cast("DeviceEnv", self._env).episode_spec(world), 0, info
                )
            return
        for world, episode in enumerate(episodes):
            if episode is None:
                self._subtasks[world] = None
                self._conditioning[world] = 0.0
            else:
                last = len(episode["plan"]) - 1
                # A finished plan points past its end, and goes on being told its last subtask.
                pointer = min(int(info["pointer"][world]), last)
                self._tell_world(world, episode, pointer, info)

    def _tell_world(
        self,
        world: int,
        episode: Mapping[str, Any],
        pointer: int,
        info: Mapping[str, Any],
    ) -> None:
        sentence = self._sentence(world, episode, pointer, info)
        known = self._subtasks[world]
        if known is not None and known[0] is episode and known[1:] == (pointer, sentence):
            return
        self._subtasks[world] = (episode, pointer, sentence)
        entry = episode["plan"][pointer]
        subtask = SubtaskConditioning(entry["kind"], kind_of(entry["target"]), sentence)
        self._conditioning[world] = as_like(
            code_of(subtask, self.spec), self._conditioning
        )
        if self.spec.inputs.target_in_hand:
            self._aims[world] = SUBTASKS[subtask.kind].aims_at_goal

    def _sentence(
        self,
        world: int,
        episode: Mapping[str, Any],
        pointer: int,
        info: Mapping[str, Any],
    ) -> str:
        """The instruction of a world's active subtask; "" if the policy reads none."""
        if not self.spec.inputs.sentence or self._instruction:
            return self._instruction
        sentences = info.get("instruction")
        return episode["instructions"][pointer] if sentences is None else sentences[world]


@dataclass(frozen=True, eq=False)
class LiveSource:
    """`StepSource` of the worlds of an environment in one control step.

    obs: observations of the step. previous (W, A), conditioning_codes (W, T), aims (W, 1): see `StepSource`.
    conventions: of the state.
    """

    env: PolicyWorlds
    obs: Mapping[str, Any]
    previous: Array
    conditioning_codes: Array
    aims: Array
    conventions: Conventions

    def state(self) -> Array:
        state = observed_state(self.env, self.obs, self.conventions)
        return _float32(state)

    def base_motion(self) -> tuple[Array, Array]:
        state = self.env.state
        return state.robot_q, state.robot_qd

    def link_state(self) -> Array:
        return self.env.link_state()

    def previous_action(self) -> Array:
        return self.previous

    def conditioning(self) -> Array:
        return self.conditioning_codes

    def aims_at_goal(self) -> Array:
        return self.aims

    def image(self, camera: str, output: str) -> Array:
        return self.obs[f"{IMAGE_KEY_PREFIX}{camera}/{output}"]


def _float32(array: Array) -> Array:
    xp = namespace(array)
    return xp.astype(array, xp.float32, copy=False)
