"""An MS-HAB policy in mjhab's environments, with the observations of MS-HAB's wrappers and the actions of its robot."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from mjhab.core.arrays import to_numpy
from mjhab.core.conventions.names import PUBLISHED, Conventions
from mjhab.core.errors import UsageError, wrong_value
from mjhab.core.seeding import stream
from mjhab.paper.ms_hab.checkpoint import load_network
from mjhab.paper.ms_hab.network import CAMERAS, IMAGE_SIDE_PX, STATE_SIZE, Network

if TYPE_CHECKING:
    from mjhab.config.env import EnvConfig
    from mjhab.envs.parts.worlds import PolicyWorlds

ENV_OPTIONS: dict[str, Any] = {
    "profile": "ms_hab",
    "obs_mode": "depth",
    "cameras": tuple(name.removesuffix("_depth") for name in CAMERAS),
    "camera_size": IMAGE_SIDE_PX,
    "control_mode": "pd_joint_delta_pos",
}
"""Options of the environment that these policies were trained in. They can act under another profile, too."""
HEAD_ACTIONS = slice(8, 10)
"""Head pan and tilt among the 13 actions; MS-HAB sets them to zero in training and evaluation (``stationary_head``,
mshab/envs/make.py)."""
_STATE = "state"
_WORLDS_AT_ONCE_ON_CPU = 1
"""Batch size of inference on a CPU. Larger batches are no faster there and round differently, so an episode's result
would depend on the number of worlds."""


def ms_hab_policy(path: Path | str, env: PolicyWorlds) -> MsHabPolicy:
    """Load the policy of an MS-HAB checkpoint (``ms_hab:CHECKPOINT.pt``) for an environment.

    Raises:
        UsageError: the checkpoint cannot be used (see ``load_network``), or the environment lacks observations that
            the policy needs.
    """
    check_environment(env.config)
    return policy_of(*load_network(Path(path)), env)


def policy_of(name: str, network: Network, env: PolicyWorlds) -> MsHabPolicy:
    """The policy of a network of `load_network` in an environment that `check_environment` accepts."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    is_published = Conventions.of(vars(env.config)) == PUBLISHED
    state = None if is_published else lambda: to_numpy(env.state_as(PUBLISHED))
    return MsHabPolicy(name, network, device, state)


def check_environment(config: EnvConfig) -> None:
    """Refuse an environment without the observations and the control mode of MS-HAB's policies.

    Raises:
        UsageError: the message names every option that differs.
    """
    size = (
        (config.camera_size,) * 2
        if isinstance(config.camera_size, int)
        else tuple(config.camera_size)
    )
    wrong = []
    if not {"depth", "rgbd"} & set(config.obs_mode.split("+")):
        wrong.append(
            f"obs_mode is {config.obs_mode!r}, not one with depth (such as 'depth')"
        )
    if not set(ENV_OPTIONS["cameras"]) <= set(config.cameras):
        wrong.append(f"cameras are {tuple(config.cameras)}, not {ENV_OPTIONS['cameras']}")
    if size != (IMAGE_SIDE_PX, IMAGE_SIDE_PX):
        wrong.append(f"camera_size is {size}, not {IMAGE_SIDE_PX}")
    if config.control_mode != ENV_OPTIONS["control_mode"]:
        wrong.append(
            f"control_mode is {config.control_mode!r}, not {ENV_OPTIONS['control_mode']!r}"
        )
    if wrong:
        raise UsageError(
            f"policies of MS-HAB take depth images of two cameras and return joint deltas, but in this environment "
            f"{'; '.join(wrong)}. Make it with {', '.join(f'{key}={value!r}' for key, value in ENV_OPTIONS.items())}."
        )


class MsHabPolicy:
    """Acts as in MS-HAB's evaluation (mshab/evaluate.py): deterministic actions, frames stacked oldest first.

    The first observation of an episode fills all frames. The diffusion policy executes 8 of 16 planned actions before
    it plans again; its noise is a function of the episode only. Head actions are zero.

    Args:
        layout: name of the network's layout.
        network: from ``load_network``.
        device: torch device.
        state: returns the state (W, 42) of the present observations in MS-HAB's conventions (`PUBLISHED`), for
            environments that observe others. None: that of the observations is.
    """

    def __init__(
        self,
        layout: str,
        network: Network,
        device: str = "cpu",
        state: Callable[[], np.ndarray] | None = None,
    ) -> None:
        self.name = f"ms_hab:{layout}"
        self._device = torch.device(device)
        self._network = network.to(self._device)
        self._state = state
        self._frames: dict[str, np.ndarray] = {}
        self._fresh = np.zeros(0, bool)
        self._planned: list[deque[np.ndarray]] = []
        self._noise: list[np.random.Generator | None] = []

    def reset(self, mask: np.ndarray) -> None:
        """Forget the worlds in ``mask`` (W,) bool."""
        if len(self._fresh) != len(mask):
            self._fresh = np.ones(len(mask), bool)
            self._planned = [deque() for _ in mask]
            self._noise = [None] * len(mask)
            self._frames = {}
        self._fresh[mask] = True
        for w in np.flatnonzero(mask).tolist():
            self._planned[w].clear()
            self._noise[w] = None

    def act(self, obs: Mapping[str, Any], info: Mapping[str, Any]) -> np.ndarray:
        """Actions (W, 13) float32 in [-1, 1].

        Raises:
            UsageError: the observations lack the state or a depth image, or have other shapes.
        """
        self._see(obs)
        due = [w for w, planned in enumerate(self._planned) if not planned]
        at_once = (
            _WORLDS_AT_ONCE_ON_CPU if self._device.type == "cpu" else max(1, len(due))
        )
        for start in range(0, len(due), at_once):
            self._plan(due[start : start + at_once], info)
        actions = np.stack([planned.popleft() for planned in self._planned])
        actions[:, HEAD_ACTIONS] = 0.0
        return actions

    def _see(self, obs: Mapping[str, Any]) -> None:
        """Append observations to the frames of the last steps; in fresh worlds they fill all frames."""
        looked_at = _looked_at(obs, self._network.cameras, len(self._fresh))
        if self._state is not None:
            looked_at[_STATE] = self._state()
        for name, seen in looked_at.items():
            if name not in self._frames:
                self._frames[name] = np.repeat(
                    seen[:, None], self._network.frames, axis=1
                )
            frames = self._frames[name]
            # A copy, because source and target overlap.
            frames[:, :-1] = frames[:, 1:].copy()
            frames[:, -1] = seen
            frames[self._fresh] = seen[self._fresh, None]
        self._fresh[:] = False

    def _plan(self, worlds: list[int], info: Mapping[str, Any]) -> None:
        depth = {
            camera: self._tensor(self._frames[camera][worlds])
            for camera in self._network.cameras
        }
        state = self._tensor(self._frames[_STATE][worlds])
        noise = self._tensor(np.stack([self._draw(w, info) for w in worlds]))
        with torch.inference_mode():
            plans = self._network.plan(depth, state, noise).clamp(-1.0, 1.0).cpu().numpy()
        for w, plan in zip(worlds, plans, strict=True):
            self._planned[w].extend(plan.astype(np.float32))

    def _draw(self, world: int, info: Mapping[str, Any]) -> np.ndarray:
        """Noise for one plan of a world, from the random stream of its episode."""
        if not self._network.noise_shape:
            return np.zeros((), np.float32)
        generator = self._noise[world]
        if generator is None:
            # A world without an episode waits for its first one; its actions are not executed.
            episode = info["episode_spec"][world] or {"seed": 0, "index": 0}
            generator = stream(
                int(episode["seed"]), "policy", "ms_hab", int(episode["index"])
            )
            self._noise[world] = generator
        return generator.standard_normal(self._network.noise_shape, dtype=np.float32)

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.asarray(values, np.float32)).to(self._device)


def _looked_at(
    obs: Mapping[str, Any], cameras: Sequence[str], worlds: int
) -> dict[str, np.ndarray]:
    """State (W, 42) and depth (W, 128, 128) [mm] by the names used in MS-HAB.

    Raises:
        UsageError: something is missing or has another shape.
    """
    keys = {
        name: f"sensor_data/{name.removesuffix('_depth')}/depth" for name in cameras
    } | {_STATE: _STATE}
    shapes = dict.fromkeys(cameras, (worlds, IMAGE_SIDE_PX, IMAGE_SIDE_PX, 1)) | {
        _STATE: (worlds, STATE_SIZE)
    }
    missing = [key for key in keys.values() if key not in obs]
    if missing:
        raise UsageError(
            f"policies of MS-HAB need {', '.join(keys.values())}; the observations lack {', '.join(missing)}. They "
            f"have: {', '.join(obs)}. Make the environment with obs_mode={ENV_OPTIONS['obs_mode']!r}, without wrappers."
        )
    seen = {}
    for name, key in keys.items():
        values = to_numpy(obs[key])
        if values.shape != shapes[name]:
            raise wrong_value(
                f"observation {key}",
                values.shape,
                f"of shape {shapes[name]} for policies of MS-HAB",
            )
        seen[name] = values if name == _STATE else values[..., 0]
    return seen
