# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""A stand-in for collectors of whole tasks, which have their counts as constants."""

import json
import sys
from pathlib import Path

import gymnasium as gym
import h5py
import numpy as np
import torch
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from mshab.envs.planner import NavigateSubtask
from mshab.envs.wrappers.record_seq_task import RecordEpisodeSequentialTask

NUM_ENVS = 189
MAX_TRAJECTORIES = 1000
LABEL: str = "long"

env = gym.make(
    "SequentialTask-v0",
    num_envs=NUM_ENVS,
    obs_mode="state",
    sim_backend="cpu",
    scene_builder_cls="ReplicaCADTidyHouseVal",
    max_episode_steps=8,
    # Wherever the robot stands it is there.
    task_cfgs={
        "navigate": {"navigated_successfully_dist": 99, "navigated_successfully_rot": 4}
    },
)
env = RecordEpisodeSequentialTask(
    env,
    sys.argv[1],
    trajectory_name="set",
    save_video=False,
    record_env_state=False,
    max_trajectories=MAX_TRAJECTORIES,
)
envs = ManiSkillVectorEnv(env, ignore_terminations=False)
envs.reset(seed=0)
worlds = envs.unwrapped
assert isinstance(worlds.task_plan[0], NavigateSubtask)
turn = torch.zeros(NUM_ENVS, 13)
turn[:, -1] = 1.0
for step in range(100):
    # Forwards it is not still; it is when it turns the other way.
    envs.step(turn if step % 8 < 2 else -turn)
    if env.reached_max_trajectories:
        break
envs.close()
about = json.loads((Path(sys.argv[1]) / "set.json").read_text())
with h5py.File(Path(sys.argv[1]) / "set.h5") as file:
    pointers = [
        np.asarray(file[f"traj_{i}/info/subtask"]).tolist() for i in range(len(file))
    ]
print(LABEL, [each["elapsed_steps"] for each in about["episodes"]], pointers)
