"""Training environments for torchrl, on both backends: ``to_torchrl(env)`` is a batched ``EnvBase``."""

from __future__ import annotations

from typing import Any

import torch
from gymnasium.vector import AutoresetMode, VectorEnv

from mjhab.core.errors import UsageError

SUCCESS = "success"
"""Entry of the TensorDicts: (W, 1) bool, whether the subtask is achieved now."""


def to_torchrl(env: VectorEnv) -> Any:
    """Wrap a vector environment as a ``torchrl.envs.EnvBase`` with batch size (W,).

    Observations are entries of the TensorDict: "state" (W, 42), one per image, "fetch_head/depth" and so on, with the
    channel first, and SUCCESS. torchrl resets finished worlds itself (``rollout(..., break_when_any_done=False)``,
    collectors), so their last observation stays in "next"; "truncated" without "terminated" means that time was up.

    Args:
        env: of `mjhab.make_train` or `mjhab.make`, with ``autoreset="disabled"``.

    Raises:
        UsageError: torchrl is not installed, or the environment resets itself.
    """
    try:
        from tensordict import TensorDict  # pyright: ignore[reportMissingImports]
        from torchrl.data import (  # pyright: ignore[reportMissingImports]
            Binary,
            Bounded,
            Composite,
            Unbounded,
        )
        from torchrl.envs import EnvBase  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise UsageError("to_torchrl needs torchrl: pip install torchrl") from error
    if env.metadata.get("autoreset_mode") != AutoresetMode.DISABLED:
        raise UsageError(
            "torchrl resets worlds itself; make the environment with autoreset='disabled'."
        )
    numpy = not env.metadata.get("tensors", False)
    worlds = env.num_envs

    class Worlds(EnvBase):
        """The worlds of one mjhab environment."""

        def __init__(self) -> None:
            obs, info = env.reset(seed=env.unwrapped.config.seed)  # type: ignore[attr-defined]
            device = torch.as_tensor(obs["state"]).device
            super().__init__(device=device, batch_size=torch.Size([worlds]))
            flag = (worlds, 1)
            shown = self._shown(obs, info)
            self.observation_spec = Composite(
                {
                    SUCCESS: Binary(shape=flag, dtype=torch.bool, device=device),
                    **{
                        key: Unbounded(shape=value.shape, dtype=value.dtype, device=device)
                        for key, value in shown.items()
                        if key != SUCCESS
                    },
                },
                shape=(worlds,),
            )
            low, high = (
                torch.as_tensor(limit, device=device)
                for limit in (env.action_space.low, env.action_space.high)  # type: ignore[attr-defined]
            )
            self.action_spec = Bounded(low, high, shape=low.shape, dtype=low.dtype, device=device)
            self.reward_spec = Unbounded(shape=flag, device=device)
            self.done_spec = Composite(
                {
                    key: Binary(shape=flag, dtype=torch.bool, device=device)
                    for key in ("done", "terminated", "truncated")
                },
                shape=(worlds,),
            )
            self._seed: int | None = None

        def _reset(self, tensordict: Any = None, **kwargs: Any) -> Any:
            options = {}
            if tensordict is not None and "_reset" in tensordict.keys():  # noqa: SIM118 (not a dict)
                mask = tensordict["_reset"].reshape(worlds)
                options["reset_mask"] = mask.cpu().numpy() if numpy else mask
            obs, info = env.reset(seed=self._seed, options=options)
            self._seed = None
            nothing = torch.zeros(worlds, 1, dtype=torch.bool, device=self.device)
            return self._told({**self._shown(obs, info), **self._ends(nothing, nothing)})

        def _step(self, tensordict: Any) -> Any:
            actions = tensordict["action"].detach()
            obs, reward, terminated, truncated, info = env.step(
                actions.cpu().numpy() if numpy else actions
            )
            ends = (torch.as_tensor(value)[:, None] for value in (terminated, truncated))
            entries = {**self._shown(obs, info), **self._ends(*ends)}
            return self._told({**entries, "reward": torch.as_tensor(reward).float()[:, None]})

        def _set_seed(self, seed: int | None) -> None:
            self._seed = seed

        def _told(self, entries: dict[str, torch.Tensor]) -> Any:
            return TensorDict(entries, batch_size=self.batch_size, device=self.device)

        def _ends(self, terminated: torch.Tensor, truncated: torch.Tensor) -> dict[str, Any]:
            done = terminated | truncated
            return {"done": done, "terminated": terminated, "truncated": truncated}

        def _shown(self, obs: dict[str, Any], info: dict[str, Any]) -> dict[str, torch.Tensor]:
            shown = {
                "state": torch.as_tensor(obs["state"]).float(),
                SUCCESS: torch.as_tensor(info["success"])[:, None].bool(),
            }
            for key, value in obs.items():
                if key.startswith("sensor_data/") and not key.endswith("pointcloud"):
                    image = torch.as_tensor(value).float().movedim(-1, 1)
                    shown[key.removeprefix("sensor_data/")] = image
            return shown

    return Worlds()
