"""Run mjhab under the real RLinf package: its environment worker, its wrapper for films, its advantages of GRPO.

`make test-rlinf` calls this. Nothing of Ray is started: the worker is made without its cluster, and its own code sets
up the environment and takes the steps of a rollout.
"""

# The library lives in an environment of its own, see the Makefile.
# pyright: reportMissingImports=false
from __future__ import annotations

import importlib.util
import re
import sys
import tempfile
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch

PAGE = Path(__file__).parents[2] / "docs" / "tutorials" / "rl_vla.md"
WORLDS, GROUP, CHUNK, CHUNKS, ACTIONS = 4, 2, 3, 4, 13


def register() -> None:
    """Load rlinf.envs with the lines of the documentation that make mjhab known there."""
    enum_line, branch = re.findall(
        r"```text\nclass SupportedEnvType\(Enum\):\n(.*?)\n\ndef get_env_cls[^\n]*\n(.*?)```",
        PAGE.read_text(encoding="utf-8"),
        re.DOTALL,
    )[0]
    spec = importlib.util.find_spec("rlinf.envs")
    assert spec is not None and spec.origin is not None
    text = Path(spec.origin).read_text(encoding="utf-8")
    for anchor, added in (
        ("class SupportedEnvType(Enum):\n", f"{enum_line}\n"),
        ("    env_type = SupportedEnvType(env_type)\n", branch),
    ):
        assert text.count(anchor) == 1, anchor
        before, after = text.split(anchor)
        # The branch comes before the name is made a member: it compares with the name.
        new = added + anchor if added is branch else anchor + added
        text = before + new + after
    module = importlib.util.module_from_spec(spec)
    sys.modules["rlinf.envs"] = module
    exec(compile(text, spec.origin, "exec"), vars(module))


def worker_of(folder: Path, *, auto_reset: bool) -> Any:
    """RLinf's environment worker with two groups of two worlds."""
    from omegaconf import OmegaConf
    from rlinf.workers.env.env_worker import EnvWorker

    env = {
        "env_type": "mjhab",
        "total_num_envs": WORLDS,
        "group_size": GROUP,
        "seed": 0,
        "auto_reset": auto_reset,
        "ignore_terminations": not auto_reset,
        "use_fixed_reset_state_ids": True,
        "use_rel_reward": True,
        "reward_mode": "raw",
        "max_episode_steps": CHUNK * CHUNKS,
        "video_cfg": {
            "save_video": True,
            "info_on_video": True,
            "fps": 20,
            "video_base_dir": str(folder),
        },
        "init_params": {
            "subtask": "close",
            "obs_mode": "rgb",
            "camera_size": 32,
            "horizon": CHUNK * CHUNKS,
            "threads": 1,
        },
    }
    model = {
        "model_type": "openpi",
        "num_action_chunks": CHUNK,
        "action_dim": ACTIONS,
    }
    worker: Any = EnvWorker.__new__(EnvWorker)
    worker.cfg = OmegaConf.create(
        {
            "env": {"train": env, "eval": env},
            "algorithm": {
                "adv_type": "grpo",
                "reward_type": "chunk_level",
                "group_size": GROUP,
                "gamma": 1.0,
            },
            "runner": {"task_type": "embodied"},
        }
    )
    worker.model_cfg = OmegaConf.create(model)
    worker.stage_num = worker._world_size = 1
    worker._rank = 0
    worker.enable_train, worker.enable_eval = True, True
    worker.train_enable_offload = worker.eval_enable_offload = False
    worker.use_external_reward_model = worker.use_training_pipeline = False
    worker.train_num_envs_per_stage = WORLDS
    worker.last_obs_list, worker.last_intervened_info_list = [], []
    worker.eval_prev_done = [torch.zeros(WORLDS, dtype=torch.bool)]
    worker.worker_timer = lambda label: nullcontext()
    worker._worker_info = worker._accelerator_type = None
    return worker


def set_up(worker: Any) -> None:
    """As `EnvWorker.init_worker` does on every process."""
    from rlinf.envs import get_env_cls

    made = get_env_cls("mjhab", worker.cfg.env.train)
    assert made.__module__ == "mjhab.integrations.rlinf"
    for name in ("env_list", "eval_env_list"):
        envs = worker._setup_env_and_wrappers(made, worker.cfg.env.train, WORLDS)
        setattr(worker, name, envs)
    worker._init_env()


def chunk_of(generator: torch.Generator) -> torch.Tensor:
    """Actions of a policy (WORLDS, CHUNK, ACTIONS)."""
    return torch.rand(WORLDS, CHUNK, ACTIONS, generator=generator) * 0.4 - 0.2


def check_rollout(worker: Any) -> None:
    """A rollout as RLinf collects it for GRPO: bootstrap, chunks, rewards, advantages within the groups."""
    from rlinf.utils.metric_utils import compute_loss_mask

    (begun,) = worker.bootstrap_step()
    states = begun.obs["states"]
    assert torch.equal(states[0], states[1]) and not torch.equal(states[0], states[2])
    assert begun.obs["main_images"].shape == (WORLDS, 32, 32, 3)
    assert len(begun.obs["task_descriptions"]) == WORLDS
    rewards, dones = [], [begun.dones]
    generator = torch.Generator().manual_seed(0)
    told: dict[str, Any] = {}
    for _ in range(CHUNKS):
        out, told = worker.env_interact_step(chunk_of(generator), 0)
        rewards.append(worker.compute_bootstrap_rewards(out, None, None))
        dones.append(out.dones)
    assert dones[-1][:, -1].all() and not torch.stack(dones[:-1]).any()
    assert set(told) >= {"success_once", "return", "episode_len", "reward"}
    assert told["episode_len"].tolist() == [CHUNK * CHUNKS] * WORLDS
    batch = {"rewards": torch.stack(rewards), "dones": torch.stack(dones)}
    paid = batch["rewards"].sum((0, 2))
    torch.testing.assert_close(paid, told["return"])
    # As RLinf's actor masks rollouts whose rewards are summed over a chunk.
    valid, count = compute_loss_mask(batch["dones"])
    batch |= {
        "loss_mask": valid.any(dim=-1, keepdim=True),
        "loss_mask_sum": count[..., -1:],
    }
    advantages = worker.compute_advantages_and_returns(batch)["advantages"]
    of_world = advantages[0].reshape(WORLDS // GROUP, GROUP, -1)[..., 0]
    # Of each group one try is better and one is worse, by RLinf's own formula.
    assert (of_world.sum(1).abs() < 1e-3).all() and (of_world.abs() > 0.1).all()
    before = worker.env_list[0].unwrapped.reset_state_ids.clone()
    worker.finish_rollout()
    assert not torch.equal(before, worker.env_list[0].unwrapped.reset_state_ids)
    print(f"a rollout of {WORLDS} worlds in groups of {GROUP}: return {paid.tolist()}")


def check_evaluation(worker: Any) -> None:
    """An evaluation whose worlds begin again by themselves."""
    (environment,) = worker.eval_env_list
    environment.reset()
    generator = torch.Generator().manual_seed(1)
    told: dict[str, Any] = {}
    for _ in range(CHUNKS):
        assert not told
        out, told = worker.env_evaluate_step(chunk_of(generator), 0)
    assert told["episode_len"].tolist() == [CHUNK * CHUNKS] * WORLDS
    assert out.final_obs is not None
    assert not torch.equal(out.final_obs["states"], out.obs["states"])
    assert environment.unwrapped.elapsed_steps.tolist() == [0] * WORLDS
    worker.finish_rollout("eval")


def main() -> None:
    register()
    import rlinf.envs.wrappers as wrappers

    assert wrappers.RecordVideo
    with tempfile.TemporaryDirectory() as folder:
        for auto_reset, check in ((False, check_rollout), (True, check_evaluation)):
            worker = worker_of(Path(folder), auto_reset=auto_reset)
            set_up(worker)
            check(worker)
            for env in (*worker.env_list, *worker.eval_env_list):
                env.close()
        films = [path for path in Path(folder).rglob("*.mp4") if path.stat().st_size]
        assert films, "RLinf's wrapper has written no film"
    print(f"RLinf drives mjhab; {len(films)} films")


if __name__ == "__main__":
    main()
