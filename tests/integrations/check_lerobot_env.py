"""Evaluate a policy of LeRobot in mjhab with the real lerobot package. `make test-lerobot-env` calls this."""

# The library lives in an environment of its own, see the Makefile.
# pyright: reportMissingImports=false
from __future__ import annotations

from types import SimpleNamespace

import torch
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env
from lerobot.envs.utils import env_to_policy_features, preprocess_observation
from lerobot.utils.import_utils import register_third_party_plugins


def main() -> None:
    register_third_party_plugins()
    config_class = EnvConfig.get_choice_class("mjhab")
    config = config_class(
        subtask="close", target="kitchen_counter/drawer3", image_size=32
    )
    features = env_to_policy_features(config)
    assert features["action"].shape == (13,) and features["observation.state"].shape == (
        34,
    )
    assert features["observation.environment_state"].shape == (11,)
    assert features["observation.images.head"].shape == (3, 32, 32)
    (worlds,) = make_env(config, n_envs=2)["mjhab"].values()
    obs, _ = worlds.reset(seed=[0, 1])
    batch = preprocess_observation(obs)
    for name, feature in features.items():
        if name != "action":
            assert tuple(batch[name].shape) == (2, *feature.shape), name
    print(_rolled_out(worlds))


def _rolled_out(worlds: object) -> str:
    """A rollout by lerobot's own function, of a policy that stands still for a few steps."""
    from lerobot.scripts import lerobot_eval

    class Still(torch.nn.Module):
        config = SimpleNamespace(use_amp=False)

        def reset(self) -> None:
            pass

        def select_action(self, batch: dict) -> torch.Tensor:
            assert all("top right drawer" in text for text in batch["task"])
            return torch.zeros(2, 13)

    for env in worlds.envs:  # type: ignore[attr-defined]
        env.unwrapped._max_episode_steps = 5

    def same(value: object) -> object:
        return value

    result = lerobot_eval.rollout(worlds, Still(), same, same, same, same, seeds=[0, 1])
    assert result["action"].shape == (2, 5, 13)
    assert not result["success"].any()
    return "lerobot runs mjhab: 2 episodes"


if __name__ == "__main__":
    main()
