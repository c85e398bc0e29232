"""Runs MS-HAB's own scripts, unchanged, with short runs on the CPU: ``make test-mshab MSHAB=/path/to/checkout``.

Only counts, paths and the device differ from the configuration files. The two data generators have their counts as
constants of the module, which ``--set`` gives other values. With ``VLA=/path/to/openpi``, a checkout of
github.com/liujiahao2077/openpi, an evaluation of a VLA that others published for MS-HAB runs, too (`vla_original`).
What is printed at the end, a line of JSON per script, says which script ran with which arguments, its exit status and
its time. The interpreter needs what the scripts import besides: omegaconf, dacite, wandb, tensorboardX, diffusers.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import torch

import mjhab.compat.mshab  # noqa: F401 - makes the ids known
from mjhab.compat.mshab.files.plans import plan_data_from_file, write_plan_data
from tests.compat.vla_original import evaluate_vla

TASK = "set_table"
EPISODES = 4
STEPS = 8
"""Control steps of an episode."""
CHAINS = "tidy_house"
"""Task of the generator of whole tasks: its first drive leads to an object, not to a piece of furniture."""
TIDIED = (
    "002_master_chef_can",
    "003_cracker_box",
    "004_sugar_box",
    "005_tomato_soup_can",
    "007_tuna_fish_can",
    "008_pudding_box",
    "009_gelatin_box",
    "010_potted_meat_can",
    "024_bowl",
)
"""Objects of which it loads a policy each."""
CANDIDATES = 16
"""Episodes among which one is looked for whose first drive a robot finishes that turns on its spot."""
TURN = 12
"""Number of the action that turns the base."""
SPEED = -0.2
TURNING_STEPS = 250
ALL_LABELS = {kind: None for kind in ("pick", "place", "navigate", "open", "close")}


class Runs:
    """Runs scripts in a folder of their own.

    Args:
        checkout: of MS-HAB. out: folder for plans, checkpoints, data and logs.
    """

    def __init__(self, checkout: Path, out: Path) -> None:
        self.checkout = checkout.resolve()
        self.out = out.resolve()
        self.out.mkdir(parents=True, exist_ok=True)
        self.data = self.out / "assets" / "data"
        root = self.data / "scene_datasets" / "replica_cad_dataset"
        self.rearrange = root / "rearrange"
        self.demos = root / "rearrange-dataset" / TASK / "pick"
        self.results: list[dict[str, object]] = []

    def run(self, name: str, *command: str | Path, **env: str) -> bool:
        """Run a command of this interpreter, with further variables; its output goes to ``<name>.log``."""
        whole = [sys.executable, *map(str, command)]
        env = {
            **os.environ,
            "MS_ASSET_DIR": str(self.out / "assets"),
            "WANDB_MODE": "disabled",
            **env,
        }
        start = time.perf_counter()
        with (self.out / f"{name}.log").open("w") as log:
            found = subprocess.run(
                whole, cwd=self.out, env=env, stdout=log, stderr=subprocess.STDOUT
            )
        seconds = round(time.perf_counter() - start, 1)
        told = " ".join(shlex.quote(part) for part in whole[1:])
        self.results.append(
            {"name": name, "rc": found.returncode, "s": seconds, "command": told}
        )
        print(json.dumps(self.results[-1]), flush=True)
        return found.returncode == 0

    def script(self, name: str, config: str, *arguments: str) -> bool:
        """Run one of MS-HAB's training or evaluation scripts with its own configuration file."""
        script = self.checkout / "mshab" / f"{name}.py"
        settings = self.checkout / "configs" / config
        return self.run(name, "-m", "mjhab.compat.mshab", script, settings, *arguments)

    def files(self, prefix: str, subtask: str, target: str = "all") -> list[str]:
        """Arguments for the plans of a subtask, and as many worlds as they have homes."""
        plans = (
            self.rearrange / "task_plans" / TASK / subtask / "train" / f"{target}.json"
        )
        rows = json.loads(plans.read_text())["plans"]
        homes = len({row["build_config_name"] for row in rows})
        spawns = self.rearrange / "spawn_data" / TASK / subtask / "train/spawn_data.pt"
        return [
            f"{prefix}.task_plan_fp={plans}",
            f"{prefix}.spawn_data_fp={spawns}",
            f"{prefix}.num_envs={homes}",
            f"{prefix}.max_episode_steps={STEPS}",
        ]

    def learn(self) -> None:
        """SAC, and PPO on another subtask."""
        worlds = self.files("env", "pick")
        self.script(
            "train_sac",
            "sac_pick.yml",
            *worlds,
            *self.files("eval_env", "pick"),
            "algo.total_timesteps=120",
            "algo.init_steps=40",
            "algo.batch_size=16",
            "algo.replay_buffer_capacity=2000",
            "algo.log_freq=40",
            "algo.save_freq=60",
            "algo.eval_freq=60",
        )
        self.script(
            "train_ppo",
            "ppo_pick.yml",
            "env.env_id=OpenSubtaskTrain-v0",
            *self.files("env", "open", "kitchen_counter"),
            *self.files("eval_env", "open", "kitchen_counter"),
            f"algo.num_steps={STEPS}",
            "algo.total_timesteps=64",
            "algo.num_minibatches=2",
            "algo.update_epochs=1",
            "algo.eval_freq=32",
            "eval_env.record_video=True",
        )

    def spread(self) -> None:
        """Put the checkpoint of SAC, still almost random, where those of all subtasks are looked for."""
        made = self.out / "mshab_exps" / "sac-pick"
        targets = {
            "pick": ("013_apple", "024_bowl", "all"),
            "place": ("013_apple", "024_bowl", "all"),
            "navigate": ("all",),
            "open": ("fridge", "kitchen_counter"),
            "close": ("fridge", "kitchen_counter"),
        }
        for subtask, names in targets.items():
            for name in names:
                place = self.data / "mshab_checkpoints" / "rl" / TASK / subtask / name
                place.mkdir(parents=True, exist_ok=True)
                shutil.copy(made / "models" / "latest.pt", place / "policy.pt")
                shutil.copy(made / "config.yml", place / "config.yml")

    def generate(self) -> None:
        """The generator of single subtasks makes the data for imitation, with labels of all kinds."""
        done = self.generator(
            "gen_data",
            {"SUBTASK_TO_EPISODE_LABELS": ALL_LABELS},
            TASK,
            "pick",
            "024_bowl",
        )
        if done:
            found = next((self.out / "mshab_exps").rglob("024_bowl/*.h5"))
            self.demos.mkdir(parents=True, exist_ok=True)
            for suffix in (".h5", ".json"):
                shutil.copy(found.with_suffix(suffix), self.demos / f"024_bowl{suffix}")

    def generator(self, name: str, constants: dict[str, object], *arguments: str) -> bool:
        """Run a data generator for 2 trajectories of 2 worlds."""
        counts = {"NUM_ENVS": 2, "MAX_TRAJECTORIES": 2, **constants}
        given = [
            part for each in counts.items() for part in ("--set", "{}={!r}".format(*each))
        ]
        script = self.checkout / "mshab/utils/gen" / f"{name}.py"
        return self.run(name, "-m", "mjhab.compat.mshab", *given, script, *arguments)

    def generate_chains(self) -> None:
        """The generator of whole tasks writes nothing of an episode without a finished subtask.

        So its policy of Navigate turns on its spot, in an episode that begins near the object.
        """
        where = ("--task", CHAINS, "--split", "train", "--out", str(self.rearrange))
        counts = ("--count", str(CANDIDATES), "--subtasks", "sequential", "--overwrite")
        if not self.run(
            "plans_chains", "-m", "mjhab", "episodes", "plans", *where, *counts
        ):
            return
        keep_finished(
            self.rearrange / "task_plans" / CHAINS / "sequential/train/all.json"
        )
        made = self.out / "mshab_exps" / "sac-pick"
        turning = torch.load(made / "models/latest.pt", weights_only=False)
        last = max(
            name
            for name in turning["agent"]
            if name.startswith("actor.") and name.endswith("bias")
        )
        turning["agent"][last.replace("bias", "weight")].zero_()
        turning["agent"][last].zero_()
        turning["agent"][last][TURN] = math.atanh(SPEED)
        kinds = self.data / "mshab_checkpoints" / "rl" / CHAINS
        for kind in ("pick", "place", "navigate"):
            names = ("all",) if kind == "navigate" else (*TIDIED, "all")
            for place in (kinds / kind / name for name in names):
                place.mkdir(parents=True, exist_ok=True)
                torch.save(turning, place / "policy.pt")
                shutil.copy(made / "config.yml", place / "config.yml")
        if self.generator("gen_data_sequential_task", {}, CHAINS):
            found = next((self.out / "mshab_exps").rglob(f"{CHAINS}/sequential/**/*.h5"))
            print(
                json.dumps(
                    {
                        "trajectories": len(
                            json.loads(found.with_suffix(".json").read_text())["episodes"]
                        )
                    }
                )
            )

    def imitate(self) -> None:
        """Behaviour cloning and the diffusion policy, from the data generated before."""
        common = (
            *self.files("eval_env", "pick"),
            f"algo.data_dir_fp={self.demos}",
            "algo.trajs_per_obj=1",
        )
        self.script(
            "train_bc", "bc_pick.yml", *common, "algo.epochs=1", "algo.batch_size=64"
        )
        self.script(
            "train_diffusion_policy",
            "dp_pick.yml",
            *common,
            "algo.batch_size=8",
            "algo.num_iterations=3",
            "algo.eval_freq=2",
            "algo.save_freq=2",
        )

    def evaluate(self) -> None:
        """The evaluation of whole tasks with a policy per subtask and object."""
        plans = self.rearrange / "task_plans" / TASK / "sequential/val/all.json"
        self.script(
            "evaluate",
            "evaluate.yml",
            f"task={TASK}",
            f"eval_env.task_plan_fp={plans}",
            "policy_type=rl_per_obj",
            "max_trajectories=2",
            "eval_env.num_envs=2",
            "eval_env.max_episode_steps=12",
        )

    def all(self, vla: Path | None) -> int:
        """Run everything; the number of scripts that failed.

        Args:
            vla: checkout with the evaluation of a VLA, if it is to run.
        """
        for split in ("train", "val"):
            where = ("--split", split, "--out", self.rearrange, "--overwrite")
            plans = ("episodes", "plans", "--task", TASK, "--count", EPISODES, *where)
            if not self.run(f"plans_{split}", "-m", "mjhab", *map(str, plans)):
                return 1
        self.learn()
        if (self.out / "mshab_exps/sac-pick/models/latest.pt").is_file():
            self.spread()
            self.generate()
            self.generate_chains()
            self.imitate()
            self.evaluate()
        failed = sum(result["rc"] != 0 for result in self.results)
        return failed + (vla is not None and not evaluate_vla(self, vla))


def keep_finished(file: Path) -> None:
    """Leave those plans in a file whose first drive a turning robot finishes."""
    data = plan_data_from_file(file)
    env = gymnasium.make(
        "SequentialTask-v0",
        num_envs=len(data.plans),
        obs_mode="state",
        sim_backend="cpu",
        task_plans=data.plans,
        scene_builder_cls=data.dataset,
        require_build_configs_repeated_equally_across_envs=False,
    )
    env.reset(seed=0)
    worlds: Any = env.unwrapped
    action = torch.zeros(len(data.plans), 13)
    action[:, TURN] = SPEED
    for _ in range(TURNING_STEPS):
        info = env.step(action)[-1]
        if info["subtask"].any():
            break
    found = [
        plan for plan, at in zip(worlds.task_plans, info["subtask"], strict=True) if at
    ]
    assert found, "no episode begins near its first object"
    env.close()
    data.plans = found[:1]
    write_plan_data(file, data)


def main() -> int:
    """Run the scripts of a checkout."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkout", type=Path, help="of MS-HAB")
    parser.add_argument("out", type=Path, help="folder for plans, data and logs")
    parser.add_argument("--vla", type=Path, help="checkout of openpi with examples/mshab")
    given = parser.parse_args()
    failed = Runs(given.checkout, given.out).all(given.vla)
    print(f"{failed} failed" if failed else "all ran unchanged")
    return min(failed, 1)


if __name__ == "__main__":
    sys.exit(main())
