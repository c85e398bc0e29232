# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""A stand-in for training scripts: a small actor on frames of depth and state, updated from what was collected."""

import sys

import gymnasium as gym
import mani_skill.envs  # noqa: F401
import torch
from mani_skill.utils import common
from mshab.envs.make import EnvConfig, make_env
from mshab.utils.array import recursive_slice, to_tensor

STEPS = int(sys.argv[1])


class Actor(torch.nn.Module):
    def __init__(self, state, frames, actions):
        super().__init__()
        self.see = torch.nn.Sequential(
            torch.nn.Conv2d(frames, 4, 8, 8), torch.nn.ReLU(), torch.nn.Flatten()
        )
        self.act = torch.nn.Linear(4 * 16 * 16 + state, actions)

    def forward(self, obs):
        pixels = torch.cat([x.flatten(1, 2) for x in obs["pixels"].values()], 1)
        seen = self.see(1 - torch.tanh(pixels / 1000))
        return torch.tanh(self.act(torch.cat([seen, obs["state"]], 1)))


config = EnvConfig(
    env_id="PickSubtaskTrain-v0",
    num_envs=2,
    max_episode_steps=STEPS,
    record_video=False,
    extra_stat_keys="<list>success, robot_cumulative_force</list>",
    env_kwargs={"add_event_tracker_info": "True", "robot_force_mult": 0.001},
)
envs = make_env(config)
assert isinstance(envs.single_action_space, gym.spaces.Box)
space = envs.unwrapped.single_observation_space
assert list(space["pixels"].spaces) == ["fetch_head_depth", "fetch_hand_depth"]
obs, _ = envs.reset(seed=0)
envs.action_space.seed(0)
obs = to_tensor(obs, dtype="float")
actor = Actor(space["state"].shape[0], 6, envs.single_action_space.shape[0])
optimizer = torch.optim.Adam(actor.parameters(), lr=1e-3)
for _ in range(2 * STEPS):
    action = actor(obs)
    after, reward, terminated, truncated, info = envs.step(action.detach().clone())
    assert reward.dtype == torch.float32 and not terminated.any()
    if truncated.any():
        assert info["_episode"].all() and "final_observation" in info
        assert (info["episode"]["l"] == STEPS).all()
        one = recursive_slice(info["final_observation"], torch.tensor([True, False]))
        assert one["state"].shape == (1, 42)
    loss = ((action - 0.1) ** 2).mean() - 0.0 * reward.mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    obs = to_tensor(after, dtype="float")
returns = common.to_tensor(envs.return_queue).float()
print("episodes", len(returns), "return", float(returns.mean()) / envs.max_episode_steps)
print("stats", [len(rows) for rows in envs.extra_stats.values()])
envs.close()
