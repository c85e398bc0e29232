"""The environment of RL frameworks for VLAs: groups of equal starts, chunks, partial resets, what is paid and told."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from mjhab.integrations.rlinf import RLinfEnv
from tests.refusals import refused

OPTIONS = {
    "task": "set_table",
    "subtask": "close",
    "target": "kitchen_counter/drawer3",
    "obs_mode": "rgb",
    "camera_size": 16,
    "horizon": 6,
    "threads": 1,
}
CFG = {"seed": 3, "group_size": 2, "init_params": OPTIONS, "num_starts": 50}
WORLDS = 4


@pytest.fixture(scope="module")
def env() -> Any:
    made = RLinfEnv(SimpleNamespace(**CFG), WORLDS)
    yield made
    made.close()


def actions(count: int | None = None) -> torch.Tensor:
    shape = (WORLDS, 13) if count is None else (WORLDS, count, 13)
    return torch.zeros(shape)


def test_the_worlds_of_a_group_begin_alike(env: Any) -> None:
    seen, infos = env.reset()
    ids = env.reset_state_ids
    assert ids[0] == ids[1] != ids[2] == ids[3] and (ids < 50).all()
    for name in ("states", "main_images", "wrist_images"):
        first, second, other, _ = seen[name]
        assert torch.equal(first, second) and not torch.equal(first, other)
    assert seen["main_images"].shape == (WORLDS, 16, 16, 3)
    assert seen["main_images"].dtype == torch.uint8
    sentences = seen["task_descriptions"]
    assert sentences[0] == sentences[1] and all("drawer" in text for text in sentences)
    assert set(infos) == {"success", "fail"}
    before = ids.clone()
    env.update_reset_state_ids()
    assert not torch.equal(before, env.reset_state_ids)
    again = RLinfEnv(CFG, WORLDS)
    assert torch.equal(again.reset_state_ids, before)
    assert not torch.equal(RLinfEnv(CFG, WORLDS, seed_offset=1).reset_state_ids, before)
    again.close()


def test_some_worlds_begin_again_and_the_others_go_on(env: Any) -> None:
    env.reset()
    seen, *_ = env.step(actions() + 0.5)
    fresh, _ = env.reset(options={"env_idx": [2, 0], "episode_id": [7, 9]})
    assert torch.equal(fresh["states"][[1, 3]], seen["states"][[1, 3]])
    assert not torch.equal(fresh["states"][[0, 2]], seen["states"][[0, 2]])
    assert env._episodes[[0, 2]].tolist() == [9, 7]
    assert env.elapsed_steps.tolist() == [0, 1, 0, 1]


def test_a_chunk_tells_its_ends_at_the_last_action(env: Any) -> None:
    env.reset()
    env.log.clear()
    observations, rewards, ends, cuts, infos = env.chunk_step(actions(4))
    assert len(observations) == len(infos) == 4 and rewards.shape == (WORLDS, 4)
    assert not ends.any() and not cuts.any() and not env.log
    _, rewards, ends, cuts, infos = env.chunk_step(actions(4))
    # The horizon is six: the last two actions come too late to be paid or counted.
    assert cuts.tolist() == [[False, False, False, True]] * WORLDS and not ends.any()
    assert infos[-1]["episode"]["episode_len"].tolist() == [6] * WORLDS
    assert (rewards == 0).all() and "final_observation" not in infos[-1]
    entry = env.log[0]
    assert entry["steps"] == 6 and not entry["success"] and "drawer" in entry["sentence"]
    assert len(env.log) == WORLDS


def test_episodes_begin_again_by_themselves_if_asked() -> None:
    cfg = {**CFG, "auto_reset": True, "reward_mode": "raw", "use_rel_reward": True}
    env = RLinfEnv({**cfg, "init_params": {**OPTIONS, "obs_mode": "state"}}, WORLDS)
    first, _ = env.reset()
    _, rewards, _, cuts, infos = env.chunk_step(actions(6))
    assert cuts[:, -1].all() and infos[-1]["_final_info"].all()
    last = infos[-1]["final_info"]["episode"]
    assert torch.allclose(last["return"], rewards.sum(1)) and (rewards != 0).any()
    final = infos[-1]["final_observation"]["states"]
    assert not torch.equal(final, first["states"])
    assert env.elapsed_steps.tolist() == [0] * WORLDS
    seen, *_ = env.step(actions())
    assert "main_images" not in seen
    env.close()


def test_success_is_paid_once_or_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = {**CFG, "ignore_terminations": True, "group_size": 1}
    env = RLinfEnv({**cfg, "init_params": {**OPTIONS, "obs_mode": "state"}}, 1)
    env.reset()
    step = env.env.step

    def succeeds(given: Any) -> Any:
        obs, reward, terminated, truncated, info = step(given)
        return (
            obs,
            reward,
            terminated | True,
            truncated,
            {**info, "success": terminated | True},
        )

    monkeypatch.setattr(env.env, "step", succeeds)
    _, reward, ends, _, infos = env.step(torch.zeros(1, 13))
    assert reward.tolist() == [1.0] and not ends.any()
    assert infos["episode"]["success_at_end"].all()
    env.ignore_terminations = False
    _, reward, ends, _, _ = env.step(torch.zeros(1, 13))
    assert ends.all() and env.log[-1]["success"]
    _, reward, ends, _, _ = env.step(torch.zeros(1, 13))
    assert reward.tolist() == [0.0] and not ends.any()
    env.close()


@pytest.mark.parametrize(
    ("change", "option"),
    [({"group_size": 3}, "group_size"), ({"reward_mode": "dense"}, "reward_mode")],
)
def test_wrong_entries_are_refused(change: dict[str, Any], option: str) -> None:
    with refused(option):
        RLinfEnv({**CFG, **change}, WORLDS)
