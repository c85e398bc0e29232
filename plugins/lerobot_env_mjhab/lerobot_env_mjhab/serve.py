"""Serve a policy of LeRobot to mjhab: ``python -m lerobot_env_mjhab.serve --policy FOLDER --port 8000``.

``mjhab eval --policy ws://localhost:8000 --dialect lerobot --batch`` then asks for all worlds at once. The policy is
one that was trained on an export of mjhab: its images have up to three names, its state 34 or 42 numbers.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from threading import Lock
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import OBS_IMAGES

from mjhab.envs.observations.state import state_dim
from mjhab.evaluation.served.action_spaces import DEFAULT_SPACE
from mjhab.evaluation.served.own_state import OWN_STATE, STATE_PARTS
from mjhab.robots.registry import robot_named
from mjhab.serving.dialects.lerobot import IMAGE_NAMES, SENTENCE, LeRobot
from mjhab.serving.server import PolicyServer, ServerOptions


class LeRobotPolicy:
    """A policy of LeRobot as what `PolicyServer` serves; connections take turns.

    Args:
        folder: what ``save_pretrained`` or ``lerobot-train`` wrote, with the processors.
        actions: name of the action space, see `mjhab.evaluation.served.action_spaces`.
        device: of torch.
    """

    def __init__(
        self, folder: str, actions: str = DEFAULT_SPACE, device: str = "cpu"
    ) -> None:
        config = PreTrainedConfig.from_pretrained(folder)
        config.device = device
        self._policy = get_policy_class(config.type).from_pretrained(
            folder, config=config
        )
        self._policy.eval()
        self._before, self._after = make_pre_post_processors(
            config,
            pretrained_path=folder,
            preprocessor_overrides={"device_processor": {"device": device}},
        )
        self._config = config
        self._actions = actions
        self._lock = Lock()

    def metadata(self) -> Mapping[str, Any]:
        """The greeting: which observations the policy was trained with."""
        images = self._config.image_features
        told: dict[str, Any] = {
            "policy": self._config.type,
            "action_space": self._actions,
            IMAGE_NAMES: [name.removeprefix(f"{OBS_IMAGES}.") for name in images],
        }
        if images:
            told["image_resolution"] = list(next(iter(images.values())).shape[1:])
        state = self._config.robot_state_feature
        if state is not None and state.shape[0] == state_dim(robot_named(), own=True):
            told[STATE_PARTS] = OWN_STATE
        return told

    def session(self) -> LeRobotPolicy:
        """A connection; chunks are whole answers, so nothing is kept of an episode."""
        return self

    def reset(self) -> None:
        """Nothing: see `session`."""

    def close(self) -> None:
        """Nothing: the policy goes on serving others."""

    def infer(self, request: Mapping[str, Any], batch: int | None) -> np.ndarray:
        """Chunks (B, H, A)."""
        tasks = request[SENTENCE]
        seen: dict[str, Any] = {SENTENCE: tasks if batch else [tasks]}
        for key in self._config.input_features:
            value = torch.from_numpy(np.array(request[key]))
            value = value if batch else value[None]
            if key.startswith(OBS_IMAGES):
                value = value.permute(0, 3, 1, 2).float() / 255.0
            seen[key] = value
        with self._lock, torch.inference_mode():
            chunk = self._policy.predict_action_chunk(self._before(seen))
            steps = [self._after(chunk[:, k]) for k in range(chunk.shape[1])]
        return torch.stack(steps, dim=1).float().cpu().numpy()


def main() -> None:
    """Serve until Ctrl-C; the first line printed is the port."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--policy", required=True, metavar="FOLDER")
    parser.add_argument("--port", type=int, default=8000)
    parser.add_argument("--actions", default=DEFAULT_SPACE)
    parser.add_argument("--device", default="cpu")
    asked = parser.parse_args()
    policy = LeRobotPolicy(asked.policy, asked.actions, asked.device)
    server = PolicyServer(policy, LeRobot(), ServerOptions(port=asked.port))
    print(server.port, flush=True)
    try:
        server.run()
    except KeyboardInterrupt:
        server.shutdown()


if __name__ == "__main__":
    main()
