"""What test_clear_table runs in a process of its own."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

import mjhab

STEPS = 8


def steps(env: Any) -> Any:
    """Some control steps of the expert; returns the last info."""
    expert = mjhab.make_expert(env)
    obs, info = env.reset()
    for _ in range(STEPS):
        obs, _, _, _, info = env.step(expert.act(obs, info))
    return info


if __name__ == "__main__":
    whole: Any = gymnasium.make_vec(
        "mjhab/ClearTable-v1", num_envs=1, threads=1
    ).unwrapped
    info = steps(whole)
    plan = info["episode_spec"][0]["plan"]
    kinds = [entry["kind"] for entry in plan]
    fetch = ["navigate", "pick", "navigate", "place"]
    assert kinds == [*fetch, "navigate", "open", *fetch, "navigate", "close"]
    assert plan[5]["target"] == plan[11]["target"] == "fridge/top_door"
    # What is opened is where the apple goes: the handle is at the fridge, not at the table.
    np.testing.assert_array_equal(plan[4]["goal"], plan[5]["goal"])
    assert np.linalg.norm(np.subtract(plan[5]["goal"], plan[9]["goal"])) < 1.5
    assert "clear" in info["episode_spec"][0]["instruction"]
    for subtask in ("pick", "place", "navigate", "open", "close"):
        alone = mjhab.make(task="clear_table", subtask=subtask, num_envs=1, threads=1)
        info = steps(alone)
        assert info["episode_spec"][0]["plan"][0]["kind"] == subtask
        assert not info["spawn_fallback"][0]
        if subtask == "close":
            # The door stands open, and the apple lies on the shelf behind it.
            assert not info["closed"][0]
            apple = alone.layout.object_names.index("013_apple_:0000")
            goal = alone.episodes_now[0].targets[1].goal_pos
            assert np.linalg.norm(alone.state.object_pose[0, apple, :3] - goal) < 0.05
        alone.close()
    print("all of ClearTable works")
