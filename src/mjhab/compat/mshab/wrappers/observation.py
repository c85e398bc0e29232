"""Observations as MS-HAB's policies take them: state vector and depth, frames stacked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import torch

from mjhab.compat.mshab.tools.trees import flatten_state_dict, to_tensor
from mjhab.compat.mshab.worlds.sensors import FETCH_CAMERAS
from mjhab.compat.mshab.wrappers.forwarding import ForwardingWrapper
from mjhab.core.errors import fault, unknown_name
from mjhab.core.typed.checks import check

DEPTH_KEYS = ("fetch_head_depth", "fetch_hand_depth")
PIXELS = "pixels"


class _Shown(ForwardingWrapper):
    """A wrapper that shows observations in another form, and tells the environment below its space."""

    def observation(self, observation: Any) -> Any:
        """The observation in the form of this wrapper."""
        raise NotImplementedError

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step."""
        obs, *rest = self.env.step(action)
        return (self.observation(obs), *rest)  # type: ignore[return-value]

    def _take_space(self) -> None:
        """Set the spaces of the environment below to those of this wrapper's observations."""
        base: Any = self.env.unwrapped
        # Agents read the space of the lowest environment, whatever wrappers are around it.
        base.update_obs_space(self._of_blank(to_tensor(base._init_raw_obs)))

    def _of_blank(self, blank: Any) -> Any:
        return self.observation(blank)


class FetchDepthObservationWrapper(_Shown):
    """Shows the state as one vector, or in its parts, and the depth of both cameras (W, 1, h, w) [mm].

    Args:
        env: an environment of `worlds.env` that observes depth.
        cat_state: one vector "state" (W, 42) in place of "agent" and "extra".
        cat_pixels: one picture "all_depth" (W, 1, 2, h, w) of head and hand in place of two.

    Raises:
        UsageError: the environment shows no depth.
    """

    def __init__(
        self, env: gymnasium.Env, cat_state: bool = True, cat_pixels: bool = False
    ) -> None:
        super().__init__(env)
        self.cat_state = cat_state
        self.cat_pixels = cat_pixels
        mode = env.unwrapped.obs_mode  # type: ignore[attr-defined]
        if "depth" not in mode and "rgbd" not in mode:
            raise fault(
                type(self).__name__,
                f"needs depth, and obs_mode is {mode!r}; give 'depth' or 'rgbd'.",
            )
        self._take_space()

    def observation(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """State and depth of a nested observation."""
        shown = {name: observation[name] for name in ("agent", "extra")}
        if self.cat_state:
            shown = {"state": flatten_state_dict(shown, use_torch=True)}
        # (W, h, w, 1) to (W, 1, h, w): the same numbers in the same order.
        depth = [
            observation["sensor_data"][camera]["depth"].movedim(-1, 1)
            for camera in FETCH_CAMERAS
        ]
        if self.cat_pixels:
            return {**shown, "all_depth": torch.stack(depth, dim=-3)}
        return {**shown, **dict(zip(DEPTH_KEYS, depth, strict=True))}

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Begin episodes."""
        obs, info = self.env.reset(**kwargs)
        return self.observation(obs), info


class _Stack(_Shown):
    """Stacks the last frames of some entries, oldest first, before the dimensions of one frame.

    A world that begins an episode has its first frame in all places; others keep theirs (in the original, the frames
    of all worlds become the first one).
    """

    def __init__(
        self,
        env: gymnasium.Env,
        num_stack: int,
        stacking_keys: Sequence[str] | None = None,
    ) -> None:
        super().__init__(env)
        good = isinstance(num_stack, int) and num_stack > 0
        check(good, "num_stack", num_stack, "a whole number above 0")
        self._num_stack = num_stack
        known = env.unwrapped.single_observation_space.spaces  # type: ignore[attr-defined]
        self._keys = list(known if stacking_keys is None else stacking_keys)
        for key in self._keys:
            if key not in known:
                raise unknown_name("entry to stack", key, known)
        self._frames: dict[str, list[torch.Tensor]] = {}
        self._take_space()

    def _placed(self, obs: dict[str, Any], stacks: dict[str, Any]) -> dict[str, Any]:
        """The observation with stacks in place of single frames."""
        raise NotImplementedError

    def _of_blank(self, blank: Any) -> Any:
        obs = dict(blank)
        stacks = {
            key: self._joined([obs.pop(key)] * self._num_stack) for key in self._keys
        }
        return self._placed(obs, stacks)

    def _joined(self, frames: Sequence[Any]) -> Any:
        if isinstance(frames[0], Mapping):
            return {
                key: self._joined([frame[key] for frame in frames]) for key in frames[0]
            }
        # (W, ...) to (W, stack, ...)
        return torch.stack(list(frames), dim=1)

    def observation(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """The observation with the frames collected so far."""
        obs = dict(observation)
        stacks = {}
        for key in self._keys:
            frames = self._frames[key]
            frames.append(obs.pop(key))
            del frames[0]
            stacks[key] = self._joined(frames)
        return self._placed(obs, stacks)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Begin episodes, of all worlds or of those in ``options["env_idx"]``."""
        obs, info = self.env.reset(**kwargs)
        begun = (kwargs.get("options") or {}).get("env_idx")
        count = self.env.unwrapped.num_envs  # type: ignore[attr-defined]
        some = begun is not None and len(begun) < count and bool(self._frames)
        if begun is not None:
            begun = torch.as_tensor(begun)
        for key in self._keys:
            first = obs[key]
            kept = self._frames.get(key)
            self._frames[key] = [
                _with_rows(kept[at], first, begun) if some and kept else first
                for at in range(self._num_stack)
            ]
        # The newest place holds the present frame already.
        obs = dict(obs)
        stacks = {}
        for key in self._keys:
            obs.pop(key)
            stacks[key] = self._joined(self._frames[key])
        return self._placed(obs, stacks), info


def _with_rows(kept: Any, first: Any, rows: Any) -> Any:
    """A frame with the rows of worlds that begin an episode replaced by their first frame."""
    if isinstance(kept, Mapping):
        return {key: _with_rows(kept[key], first[key], rows) for key in kept}
    # A copy: right after a reset all places of a stack hold the same tensor.
    changed = kept.clone()
    changed[rows] = first[rows]
    return changed


class DepthFrameStack(_Stack):
    """Stacks the frames of depth below the key "pixels": (W, stack, 1, h, w).

    Args:
        env: a `FetchDepthObservationWrapper`.
        num_stack: number of frames.
        stacking_keys: entries that are stacked.

    Raises:
        UsageError: the environment has no such entry.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        num_stack: int,
        stacking_keys: Sequence[str] = DEPTH_KEYS,
    ) -> None:
        super().__init__(env, num_stack, stacking_keys)

    def _placed(self, obs: dict[str, Any], stacks: dict[str, Any]) -> dict[str, Any]:
        return {**obs, PIXELS: stacks}


class StackedDictObservationWrapper(_Stack):
    """Stacks the frames of all entries, the state among them, under their own keys.

    Args:
        env: a `FetchDepthObservationWrapper`.
        num_stack: number of frames.
        stacking_keys: entries that are stacked, and shown; all by default.

    Raises:
        UsageError: the environment has no such entry.
    """

    def _placed(self, obs: dict[str, Any], stacks: dict[str, Any]) -> dict[str, Any]:
        return stacks
