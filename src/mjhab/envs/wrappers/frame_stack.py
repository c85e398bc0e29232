"""Frame stacking for vector environments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper

from mjhab.core.errors import fault, wrong_value
from mjhab.core.typed.checks import check_least
from mjhab.envs.spaces import batched, with_entries
from mjhab.envs.wrappers.base import check_key, dict_space, map_final, require_images


class FrameStack(VectorWrapper):
    """Stacks the last frames of some keys on a new axis 1: (W, ...) becomes (W, num_stack, ...), oldest first.

    The first observation of an episode fills all its frames. A world's frames never reach back into its previous
    episode and never change when another world is reset:

    - SAME_STEP: the step that ends an episode returns the first frame of the next one, repeated; ``info["final_obs"]``
      holds the last frames of the old one.
    - NEXT_STEP: the step that ends an episode returns its last frames; the step after, which resets, the first frame.
    - DISABLED, and ``reset(options={"reset_mask": mask})`` in any mode: frames of the worlds in the mask start anew,
      the others keep every byte.

    Args:
        env: vector environment with dict observations and ``metadata["autoreset_mode"]``.
        num_stack: number of frames; None: ``frame_stack`` of the environment's configuration, which profiles set.
        keys: what to stack; default: all images. Other keys pass unchanged.

    Raises:
        UsageError: num_stack below 1, or another number than the environment's ``frame_stack`` where that is not 1;
            unknown keys, no images and no keys, no autoreset mode.
    """

    def __init__(
        self,
        env: VectorEnv,
        num_stack: int | None = None,
        keys: Sequence[str] | None = None,
    ) -> None:
        super().__init__(env)
        num_stack = _frames_of(env, num_stack)
        check_least("num_stack", num_stack, 1, where="FrameStack")
        mode = env.metadata.get("autoreset_mode")
        if not isinstance(mode, AutoresetMode):
            raise wrong_value(
                f"metadata['autoreset_mode'] of {env}",
                mode,
                "an AutoresetMode",
                where="FrameStack",
            )
        # torchrl's GymWrapper looks for it; Gymnasium's wrappers do not pass it on.
        self.autoreset_mode = mode
        space = dict_space(env, "FrameStack")
        if keys is None:
            keys = [leaf.path[0] for leaf in require_images(env, "FrameStack")]
        for key in keys:
            check_key(key, space)
        self.num_stack = num_stack
        self.keys = tuple(keys)
        self._mode = mode
        stacked = {key: _stacked(space[key], num_stack) for key in self.keys}
        self.single_observation_space = with_entries(space, stacked)
        self.observation_space = batched(self.single_observation_space, env.num_envs)
        self._frames: dict[str, np.ndarray] = {}
        self._ended = np.zeros(env.num_envs, bool)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict]:
        """Reset worlds (all, or those in ``options["reset_mask"]``) and start their frames anew."""
        # Read before the call: a wrapper below may take the mask out of the options.
        mask = np.array(
            (options or {}).get("reset_mask", np.ones(self.num_envs, bool)), bool
        )
        obs, info = self.env.reset(seed=seed, options=options)
        if self._frames:
            self._fill(mask, obs)
        else:
            self._frames = {
                key: np.repeat(obs[key][:, None], self.num_stack, axis=1)
                for key in self.keys
            }
        self._ended[mask] = False
        return self._observation(obs), info

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step; see the class for what the frames are when an episode ends.

        Raises:
            UsageError: called before the first reset.
        """
        if not self._frames:
            raise fault("FrameStack", "call reset() before step().")
        obs, reward, terminated, truncated, info = self.env.step(actions)
        info = map_final(info, self._final)
        done = np.asarray(terminated) | np.asarray(truncated)
        restart = {
            AutoresetMode.SAME_STEP: done,
            AutoresetMode.NEXT_STEP: self._ended,
        }.get(self._mode)
        self._shift(obs)
        if restart is not None and restart.any():
            self._fill(restart, obs)
        self._ended = done
        return self._observation(obs), reward, terminated, truncated, info

    def get_frames(self, world: int) -> dict[str, np.ndarray]:
        """Frames (num_stack, ...) of one world by key, to keep beside a saved state of the environment."""
        return {key: frames[world].copy() for key, frames in self._frames.items()}

    def set_frames(self, world: int, frames: dict[str, np.ndarray]) -> None:
        """Put back what `get_frames` gave; other worlds keep every byte."""
        for key, value in frames.items():
            self._frames[key][world] = value

    def _final(self, final: dict[str, Any]) -> dict[str, Any]:
        """The final observation, stacked with the frames before it."""
        before = {key: self._frames[key][:, 1:] for key in self.keys}
        return {
            **final,
            **{
                key: np.concatenate([before[key], final[key][:, None]], axis=1)
                for key in self.keys
            },
        }

    def _shift(self, obs: dict[str, Any]) -> None:
        for key, frames in self._frames.items():
            # Frame by frame: moving them all at once would overlap, and numpy would copy them first.
            for k in range(self.num_stack - 1):
                frames[:, k] = frames[:, k + 1]
            frames[:, -1] = obs[key]

    def _fill(self, mask: np.ndarray, obs: dict[str, Any]) -> None:
        for key in self.keys:
            self._frames[key][mask] = obs[key][mask][:, None]

    def _observation(self, obs: dict[str, Any]) -> dict[str, Any]:
        # Copies, because the caller may keep or modify them.
        return {**obs, **{key: frames.copy() for key, frames in self._frames.items()}}


def _frames_of(env: VectorEnv, wanted: int | None) -> int:
    """How many frames to stack: what is wanted, or what the configuration of the environment says.

    Raises:
        UsageError: the two contradict each other.
    """
    config = getattr(env.unwrapped, "config", None)
    configured = getattr(config, "frame_stack", 1)
    if wanted is None or configured in (1, wanted):
        return configured if wanted is None else wanted
    advice = f"Leave out num_stack, or make the environment with frame_stack={wanted}."
    expected = f"{configured}, the frame_stack of the environment"
    raise wrong_value("num_stack", wanted, expected, advice, "FrameStack")


def _stacked(space: spaces.Space, num: int) -> spaces.Box:
    if not isinstance(space, spaces.Box):
        raise fault("FrameStack", f"only arrays can be stacked, got a space {space}.")
    low, high = (np.repeat(bound[None], num, axis=0) for bound in (space.low, space.high))
    return spaces.Box(low, high, dtype=space.dtype)  # type: ignore[arg-type]
