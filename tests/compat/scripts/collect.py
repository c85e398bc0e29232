# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""A stand-in for data collectors, and for evaluations of models that go on after failures."""

import json
import sys
from pathlib import Path

import gymnasium as gym
import h5py
import torch
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from mshab.envs import PickSubtaskTrainEnv, SequentialTaskEnv
from mshab.envs.planner import PickSubtask
from mshab.envs.wrappers import RecordEpisode

OUT = Path(sys.argv[1])


class Counting(gym.Wrapper):
    """Written for Gymnasium before 1.0: attributes of the environment below are its own."""

    def step(self, action):
        assert self.agent.robot.qpos.shape == (self.num_envs, 15)
        return super().step(action)


env = gym.make(
    "PickSubtaskTrain-v0",
    num_envs=2,
    obs_mode="rgbd",
    control_mode="pd_joint_delta_pos",
    robot_uids="fetch",
    reward_mode="normalized_dense",
    shader_dir="minimal",
    sim_backend="cpu",
    render_mode="rgb_array",
    add_event_tracker_info=True,
    sensor_configs=dict(width=32, height=24),
    max_episode_steps=3,
)
base = env.unwrapped
assert isinstance(base, PickSubtaskTrainEnv) and isinstance(base, SequentialTaskEnv)
env = RecordEpisode(
    Counting(env),
    OUT,
    trajectory_name="set",
    label_episode=True,
    max_steps_per_video=3,
    info_on_video=True,
    record_env_state=False,
    source_type="test",
)
envs = ManiSkillVectorEnv(env, ignore_terminations=True, record_metrics=True)
obs, info = envs.reset(seed=1)
assert isinstance(base.task_plan[0], PickSubtask)
names = [entity.name for entity in base.subtask_objs[0]._objs]
assert all(name.startswith("env-") for name in names), names
seen = []
for _ in range(6):
    obs, reward, terminated, truncated, info = envs.step(torch.zeros(2, 13))
    seen.append(obs["sensor_data"]["fetch_head"]["rgb"].float().mean())
    if "final_info" in info:
        assert info["final_info"]["episode"]["episode_len"].tolist() == [3, 3]
envs.close()
with h5py.File(OUT / "set.h5") as file:
    shapes = {
        name: file[f"traj_0/{name}"].shape
        for name in ("actions", "obs/agent/qpos", "obs/sensor_data/fetch_hand/depth")
    }
    print("trajectories", len(file), json.dumps({k: list(v) for k, v in shapes.items()}))
about = json.loads((OUT / "set.json").read_text())
print("labels", [episode["label"] for episode in about["episodes"]])
print("films", sorted(path.name for path in OUT.glob("*.mp4")))
