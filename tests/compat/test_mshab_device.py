"""MS-HAB's ids over worlds on a device: the same names, tensors that stay there. Warp's CPU device stands for a GPU."""

from __future__ import annotations

from typing import Any

import gymnasium
import pytest
import torch

import mjhab.compat.mshab  # noqa: F401  (registers the ids)
from mjhab.compat.mshab.wrappers.vector import ManiSkillVectorEnv
from tests.missing import need_warp
from tests.refusals import refused
from tests.warp_device import TEST_DEVICE

need_warp()

STEPS = 2


@pytest.fixture(scope="module")
def vector() -> Any:
    env = gymnasium.make(
        "PickSubtaskTrain-v0",
        num_envs=2,
        obs_mode="state_dict",
        sim_backend="warp",
        render_mode="rgb_array",
        add_event_tracker_info=True,
        max_episode_steps=STEPS,
        mjhab_options={"device": TEST_DEVICE, "starts": 4},
    )
    return ManiSkillVectorEnv(env, ignore_terminations=True, record_metrics=True)


def test_worlds_on_a_device_show_what_those_on_the_host_do(vector: Any) -> None:
    seen, told = vector.reset(seed=0)
    host: Any = gymnasium.make(
        "PickSubtaskTrain-v0",
        num_envs=2,
        obs_mode="state_dict",
        add_event_tracker_info=True,
    )
    theirs, told_there = host.reset(seed=0)
    assert list(told) == list(told_there)
    for name, values in told.items():
        if isinstance(values, torch.Tensor):
            assert values.dtype == told_there[name].dtype, name
    # Start i of the pool is episode i; world 0 of the host begins with it, too.
    for part in ("agent", "extra"):
        assert list(seen[part]) == list(theirs[part])
        for name, values in seen[part].items():
            assert values.dtype == theirs[part][name].dtype
            assert torch.allclose(
                values[0].float(), theirs[part][name][0].float(), atol=2e-3
            )
    ours, there = (each.unwrapped.get_state_dict() for each in (vector, host))
    for part in ("actors", "articulations"):
        assert list(ours[part]) == list(there[part])
        for name, values in ours[part].items():
            assert torch.allclose(values[0], there[part][name][0], atol=2e-3), name


def test_tensors_of_a_device_never_pass_through_numpy(
    vector: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    vector.reset(seed=0)

    def refuse(*_: Any, **__: Any) -> Any:
        raise AssertionError("a tensor of the device was copied to the host")

    with monkeypatch.context() as patched:
        for name in ("numpy", "cpu", "tolist", "__array__"):
            patched.setattr(torch.Tensor, name, refuse)
        patched.setattr(torch, "from_numpy", refuse)
        obs, _, _, _, info = vector.step(torch.zeros(2, 13))
    base = vector.unwrapped
    shown = (obs["agent"]["qpos"], info["robot_force"], base.subtask_objs[0].pose.p)
    assert all(values.device == base.device for values in shown)
    qpos = base.worlds.observe()["agent/qpos"]
    assert torch.equal(obs["agent"]["qpos"], qpos)


def test_a_whole_task_runs_on_a_device() -> None:
    env: Any = gymnasium.make(
        "SequentialTask-v0",
        num_envs=1,
        sim_backend="warp",
        obs_mode="state_dict",
        mjhab_options={"device": TEST_DEVICE, "starts": 1},
    )
    _, info = env.reset(seed=0)
    left = info["subtasks_steps_left"].item()
    _, reward, terminated, _, info = env.step(torch.zeros(1, 13))
    assert info["subtasks_steps_left"].item() == left - 1
    assert reward.item() == 0 and not terminated.item()
    assert "obj_at_goal_progressive_5" in info
    assert info["success"].dtype == torch.bool


def test_worlds_on_a_device_begin_anew_when_time_is_up(vector: Any) -> None:
    first, _ = vector.reset(seed=0)
    for step in range(1, STEPS + 1):
        obs, reward, _, truncated, info = vector.step(torch.zeros(2, 13))
        assert reward.dtype == torch.float32
        assert truncated.tolist() == [step == STEPS] * 2
    assert info["final_info"]["episode"]["episode_len"].tolist() == [STEPS] * 2
    assert info["elapsed_steps"].tolist() == [0, 0]
    assert not torch.equal(obs["agent"]["qpos"], first["agent"]["qpos"])
    base = vector.unwrapped
    assert base.subtask_objs[0].pose.p.shape == (2, 3)
    assert len(set(base.task_plan[0].composite_subtask_uids)) == 2
    with refused(said="sim_backend='cpu'"):
        base.render()
    with refused(said="leave out env_idx"):
        vector.reset(seed=1, options={"env_idx": [0]})
