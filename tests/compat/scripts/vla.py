# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""A stand-in for evaluations of a VLA: colours and a sentence go to a policy server, chunks of actions come back."""

import collections
import sys

import gymnasium as gym
import mshab.envs  # noqa: F401
import numpy as np
import torch
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from mshab.envs.wrappers import FetchActionWrapper

EPISODES, STEPS, CHUNK = int(sys.argv[1]), 4, 3


class Colours(gym.ObservationWrapper):
    """Both pictures and the posture, as such scripts write it: the space is that of the environment below."""

    def __init__(self, env):
        super().__init__(env)
        base = env.unwrapped
        base.update_obs_space(self.observation(base._init_raw_obs))

    def observation(self, observation):
        seen = observation["sensor_data"]
        return {
            "image": seen["fetch_head"]["rgb"],
            "wrist": seen["fetch_hand"]["rgb"],
            "state": observation["agent"]["qpos"],
        }


class Server:
    """Answers as a policy server does."""

    calls = 0

    def infer(self, element):
        self.calls += 1
        assert element["image"].shape == element["wrist"].shape == (64, 64, 3)
        assert element["image"].dtype == np.uint8 and element["image"].std() > 0
        assert element["state"].shape == (12,) and element["prompt"]
        return {"actions": np.full((CHUNK, 13), 0.1, np.float32)}


def resized(picture):
    return picture.cpu().numpy().repeat(2, axis=0).repeat(2, axis=1)


env = gym.make(
    "CloseSubtaskTrain-v0",
    num_envs=1,
    obs_mode="rgb",
    control_mode="pd_joint_delta_pos",
    robot_uids="fetch",
    sim_backend="gpu",
    sensor_configs=dict(width=32, height=32),
    max_episode_steps=STEPS,
)
env = FetchActionWrapper(Colours(env))
envs = ManiSkillVectorEnv(env, ignore_terminations=True, record_metrics=True)
assert envs.single_observation_space["image"].shape == (32, 32, 3)
server, told = Server(), []
for episode in range(EPISODES):
    obs, _ = envs.reset(seed=7 + episode, options={"reconfigure": True})
    plan: collections.deque = collections.deque()
    done = False
    while not done:
        if not plan:
            element = {name: resized(obs[name][0]) for name in ("image", "wrist")}
            element |= {"state": obs["state"][0].cpu().numpy(), "prompt": "close it"}
            plan.extend(server.infer(element)["actions"])
        action = torch.from_numpy(plan.popleft().copy())[None]
        obs, _, terminated, truncated, info = envs.step(action)
        done = bool(terminated[0] or truncated[0])
    told.append(info["final_info"]["episode"])
envs.close()
once = [bool(one["success_once"][0]) for one in told]
at_end = [bool(one["success_at_end"][0]) for one in told]
print("lengths", [int(one["episode_len"][0]) for one in told], "calls", server.calls)
print("once", sum(once), "at end", sum(at_end), "of", len(told))
