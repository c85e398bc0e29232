"""What a user of LeRobot does, with the real lerobot package. `make test-lerobot-env` calls this.

Demonstrations are recorded, exported, read by LeRobot's own reader and learned by its ACT; that policy is evaluated by
``lerobot-eval --env.type=mjhab``, and served to ``mjhab eval``.
"""

# The library lives in an environment of its own, see the Makefile.
# pyright: reportMissingImports=false
from __future__ import annotations

import json
import sys
import tempfile
import threading
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.scripts import lerobot_eval
from lerobot.utils.import_utils import register_third_party_plugins

import mjhab
from mjhab.cli.main import main as run_mjhab
from mjhab.data.store.places import episodes as recorded
from mjhab.integrations import lerobot as ours
from mjhab.serving.dialects.lerobot import LeRobot
from mjhab.serving.server import PolicyServer, ServerOptions

SCENE = {"subtask": "close", "target": "kitchen_counter/drawer3"}
EPISODES = 2
SIZE = 64
CHUNK = 8
STEPS = 12
"""Control steps of an evaluated episode."""


def exported(folder: Path) -> Path:
    """Record demonstrations and export them."""
    mjhab.generate(
        task="set_table",
        **SCENE,
        profile="ms_hab",
        split="train",
        episodes=EPISODES,
        images="rgb",
        camera_size=SIZE,
        until="success+2",
        out=folder / "shards",
        threads=1,
    )
    export = folder / "export"
    words = ["export", "lerobot", str(folder / "shards"), "--out", str(export), "--json"]
    assert run_mjhab(words) == 0
    return export


def read(export: Path, shards: Path) -> LeRobotDataset:
    """The export in LeRobot's reader; its rows are those of the shards."""
    data = LeRobotDataset(
        "mjhab/check",
        root=export,
        video_backend="pyav",
        delta_timestamps={"action": [k / ours.FPS for k in range(CHUNK)]},
    )
    made = {episode.name: episode for episode in recorded(shards)}
    assert data.num_episodes == len(made) == EPISODES
    for entry in data.meta.episodes:
        actions = made[entry["source"]].array("actions")
        first = data[entry["dataset_from_index"]]
        last = data[entry["dataset_to_index"] - 1]
        np.testing.assert_allclose(first["action"], actions[:CHUNK], atol=1e-6)
        np.testing.assert_allclose(last["action"][0], actions[-1], atol=1e-6)
        assert last["action_is_pad"][1:].all() and not last["action_is_pad"][0]
        assert first["observation.images.fetch_head"].shape == (3, SIZE, SIZE)
        assert "drawer" in first["task"]
    return data


def learned(data: LeRobotDataset, folder: Path) -> Path:
    """A small ACT policy after a few updates, saved as LeRobot saves it."""
    torch.manual_seed(0)
    config = ACTConfig(
        device="cpu",
        push_to_hub=False,
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        dim_model=32,
        n_heads=2,
        dim_feedforward=64,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
        pretrained_backbone_weights=None,
    )
    policy: Any = make_policy(config, ds_meta=data.meta)
    assert isinstance(policy, ACTPolicy)
    before, after = make_pre_post_processors(config, dataset_stats=data.meta.stats)
    batches = torch.utils.data.DataLoader(data, batch_size=8, shuffle=True)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-3)
    losses = []
    for _, batch in zip(range(4), batches, strict=False):
        loss, _ = policy.forward(before(batch))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert np.isfinite(losses).all() and losses[-1] < losses[0], losses
    place = folder / "act"
    for part in (policy, before, after):
        part.save_pretrained(place)
    return place


def evaluated(policy: Path, folder: Path) -> None:
    """``lerobot-eval`` with our environment."""
    words = {
        "policy.path": policy,
        "env.type": "mjhab",
        "env.image_size": SIZE,
        **{f"env.{name}": value for name, value in SCENE.items()},
        "eval.n_episodes": EPISODES,
        "eval.batch_size": EPISODES,
        "eval.use_async_envs": "false",
        "output_dir": folder / "eval",
        "seed": 0,
    }
    ours.MAX_SUBTASK_STEPS = STEPS
    sys.argv = ["lerobot-eval", *(f"--{key}={value}" for key, value in words.items())]
    register_third_party_plugins()
    lerobot_eval.eval_main()
    found = json.loads((folder / "eval" / "eval_info.json").read_text())
    assert found["overall"]["n_episodes"] == EPISODES, found


def served(policy: Path, folder: Path) -> None:
    """The same policy, asked by ``mjhab eval``: in the environments' own homes and for two worlds at once."""
    from lerobot_env_mjhab.serve import LeRobotPolicy

    server = PolicyServer(LeRobotPolicy(str(policy)), LeRobot(), ServerOptions(port=0))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    result = mjhab.evaluate(
        f"ws://127.0.0.1:{server.port}?dialect=lerobot&batch=yes",
        task="set_table",
        **SCENE,
        episodes=EPISODES,
        num_envs=2,
        horizon=STEPS,
        threads=1,
        out=folder / "served",
    )
    server.shutdown()
    assert [record.error for record in result.records] == [""] * EPISODES
    assert server.requests >= STEPS // CHUNK


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        data = read(exported(folder), folder / "shards")
        policy = learned(data, folder)
        evaluated(policy, folder)
        served(policy, folder)
    print(
        f"lerobot {version('lerobot')} reads, learns from, evaluates in and serves mjhab: "
        f"{EPISODES} episodes, {len(data)} frames"
    )


if __name__ == "__main__":
    main()
