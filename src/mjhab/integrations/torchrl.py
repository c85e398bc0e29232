"""Training environments for torchrl, on both backends: ``to_torchrl(env)`` is a batched ``EnvBase``."""

from __future__ import annotations

from typing import Any

import torch
from gymnasium.vector import AutoresetMode, VectorEnv

from mjhab.core.errors import UsageError
from mjhab.core.libraries import missing_library
from mjhab.core.machine import pip_install
from mjhab.integrations.tensors import observation_tensors

SUCCESS = "success"
"""Entry of the TensorDicts: (W, 1) bool, whether the subtask is achieved now."""


def to_torchrl(env: VectorEnv) -> Any:
    """Wrap a vector environment as a ``torchrl.envs.EnvBase`` with batch size (W,).

    Observations are entries of the TensorDict: "state" (W, S), one per image, CAMERA/depth and so on, see
    `observation_tensors`, and SUCCESS.

    torchrl resets finished worlds itself (``rollout(..., break_when_any_done=False)``,
    collectors), so their last observation stays in "next"; "truncated" without "terminated" means that time was up.

    Args:
        env: of `mjhab.make_train` or `mjhab.make`, with ``autoreset="disabled"``.

    Raises:
        UsageError: torchrl is not installed, or the environment resets itself.
    """
    try:
        from torchrl.envs import EnvBase  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise missing_library(
            "to_torchrl", ("torchrl",), pip_install("torchrl")
        ) from error
    if env.metadata.get("autoreset_mode") != AutoresetMode.DISABLED:
        raise UsageError(
            "torchrl resets worlds itself; make the environment with autoreset='disabled'."
        )
    worlds = type("Worlds", (_TorchrlWorlds, EnvBase), {})
    return worlds(env)


class _TorchrlWorlds:
    """The methods of an EnvBase over the worlds of one mjhab environment.

    The class of torchrl is only there once it is imported: `to_torchrl` adds it as the second base.
    """

    device: Any
    batch_size: Any

    def __init__(self, env: VectorEnv) -> None:
        obs, info = env.reset(seed=env.unwrapped.config.seed)  # type: ignore[attr-defined]
        shown = _shown(obs, info)
        base: Any = super()
        base.__init__(device=shown["state"].device, batch_size=torch.Size([env.num_envs]))
        self._env = env
        self._numpy = not env.metadata.get("tensors", False)
        self._start: int | None = None
        self._set_specs(shown)

    def _set_specs(self, shown: dict[str, torch.Tensor]) -> None:
        """Set the specifications of observations, actions, reward and ends."""
        from torchrl.data import (  # pyright: ignore[reportMissingImports]
            Binary,
            Bounded,
            Composite,
            Unbounded,
        )

        flag = Binary(shape=(*self.batch_size, 1), dtype=torch.bool, device=self.device)
        seen: dict[str, Any] = {
            key: Unbounded(shape=value.shape, dtype=value.dtype, device=self.device)
            for key, value in shown.items()
        }
        self.observation_spec = Composite({**seen, SUCCESS: flag}, shape=self.batch_size)
        actions: Any = self._env.action_space
        low = torch.as_tensor(actions.low, device=self.device)
        high = torch.as_tensor(actions.high, device=self.device)
        self.action_spec = Bounded(
            low, high, shape=low.shape, dtype=low.dtype, device=self.device
        )
        self.reward_spec = Unbounded(shape=(*self.batch_size, 1), device=self.device)
        ends = {key: flag.clone() for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(ends, shape=self.batch_size)

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> Any:
        options = {}
        if tensordict is not None and "_reset" in tensordict.keys():  # noqa: SIM118 (not a dict)
            # torchrl keeps a trailing dimension of 1 in flags.
            mask = tensordict["_reset"].reshape(self.batch_size)
            options["reset_mask"] = mask.cpu().numpy() if self._numpy else mask
        obs, info = self._env.reset(seed=self._start, options=options)
        self._start = None
        nothing = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        return self._tensordict({**_shown(obs, info), **_ends(nothing, nothing)})

    def _step(self, tensordict: Any) -> Any:
        actions = tensordict["action"].detach()
        obs, reward, terminated, truncated, info = self._env.step(
            actions.cpu().numpy() if self._numpy else actions
        )
        ends = (torch.as_tensor(value)[:, None] for value in (terminated, truncated))
        entries = {**_shown(obs, info), **_ends(*ends)}
        return self._tensordict(
            {**entries, "reward": torch.as_tensor(reward).float()[:, None]}
        )

    def _set_seed(self, seed: int | None) -> None:
        # torchrl seeds before it resets, and a seed is for the next reset only.
        self._start = seed

    def _tensordict(self, entries: dict[str, torch.Tensor]) -> Any:
        from tensordict import TensorDict  # pyright: ignore[reportMissingImports]

        return TensorDict(entries, batch_size=self.batch_size, device=self.device)


def _ends(terminated: torch.Tensor, truncated: torch.Tensor) -> dict[str, torch.Tensor]:
    return {
        "done": terminated | truncated,
        "terminated": terminated,
        "truncated": truncated,
    }


def _shown(obs: dict[str, Any], info: dict[str, Any]) -> dict[str, torch.Tensor]:
    """What a policy sees of all worlds, and SUCCESS."""
    success = torch.as_tensor(info["success"])[:, None].bool()
    return {**observation_tensors(obs), SUCCESS: success}
