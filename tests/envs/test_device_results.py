"""What a step on the device gives out and takes in: pictures of the right episode, tensors that stay, no gradients."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from mjhab.envs import make
from tests.missing import need_warp
from tests.refusals import refused
from tests.warp_device import TEST_DEVICE

need_warp()

WORLDS = 2
DEVICE: dict[str, Any] = {"backend": "warp", "device": TEST_DEVICE, "starts": 4}
PICTURES: dict[str, Any] = {"obs_mode": "depth", "camera_size": 8}


@pytest.fixture(scope="module")
def env() -> Any:
    """Short Picks with small pictures, shared by tests that reset it."""
    return make(
        task="tidy_house",
        subtask="pick",
        num_envs=WORLDS,
        horizon=3,
        **PICTURES,
        **DEVICE,
    )


def idle(env: Any, steps: int = 1) -> Any:
    for _ in range(steps - 1):
        env.step(torch.zeros(WORLDS, len(env.action_table)))
    return env.step(torch.zeros(WORLDS, len(env.action_table)))


def test_pictures_after_a_reset_are_those_of_the_new_episode(env: Any) -> None:
    env.reset(seed=0)
    for _ in range(2):
        idle(env)
    # World 1 shall go on when world 0 ends.
    env.progress = dataclasses.replace(
        env.progress,
        steps_left=env.progress.steps_left + torch.tensor([0, 5], device=env.device),
    )
    obs, _, _, truncated, info = idle(env)
    assert truncated.tolist() == [True, False] and info["_final_obs"].tolist() == [
        True,
        False,
    ]
    pictures = [key for key in obs if key.endswith("depth")]
    assert len(pictures) == 2
    again = env._observe()
    final = info["final_obs"]
    kept = {key: final[key].clone() for key in pictures}
    for key in pictures:
        np.testing.assert_array_equal(
            obs[key], again[key], err_msg="of the present state, all drawn anew"
        )
        np.testing.assert_array_equal(obs[key][1], final[key][1])
        assert not torch.equal(obs[key][0], final[key][0])
    idle(env, 2)
    for key in pictures:
        np.testing.assert_array_equal(
            final[key], kept[key], err_msg="a copy of their own"
        )


def test_a_teleport_changes_the_pictures() -> None:
    dev = make(task="tidy_house", num_envs=1, **PICTURES, **(DEVICE | {"starts": 1}))
    obs, _ = dev.reset()
    # A Pick that succeeds when somebody says so is followed by a leap.
    everyone = torch.ones(1, dtype=torch.bool, device=dev.device)
    dev.progress = dataclasses.replace(
        dev.progress, pointer=torch.full_like(dev.progress.pointer, 2)
    )
    before = dev._observe()
    changed = dev._renew(~everyone, everyone, dev.start_row)
    assert changed.all()
    after = dev._observe(changed)
    for key in (key for key in obs if key.endswith("depth")):
        assert not torch.equal(after[key], before[key])
        np.testing.assert_array_equal(after[key], dev._observe()[key])


def tensors_in(value: Any) -> list[torch.Tensor]:
    if isinstance(value, torch.Tensor):
        return [value]
    parts = (
        value.values()
        if isinstance(value, dict)
        else value
        if isinstance(value, tuple)
        else ()
    )
    return [tensor for part in parts for tensor in tensors_in(part)]


def test_what_a_step_returns_stays_as_it_is(env: Any) -> None:
    # Warp writes behind the back of torch: a view of the engine's memory would change in the hands of a learner.
    env.reset()
    actions = torch.full((WORLDS, len(env.action_table)), 0.3)
    env.step(actions)
    kept = tensors_in(env.step(actions))
    copies = [tensor.clone() for tensor in kept]
    for _ in range(2):
        env.step(-actions)
    assert len(kept) > 40
    for tensor, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(tensor, copy)


def test_gradients_of_a_policy_stay_out_of_the_engine(env: Any) -> None:
    env.reset()
    actions = torch.zeros(WORLDS, len(env.action_table), requires_grad=True)
    obs, reward, *_ = env.step(actions * 2.0)
    assert not env.sim.engine.ctrl_t.requires_grad and not env.grip.requires_grad
    assert not reward.requires_grad and not any(
        value.requires_grad for value in obs.values()
    )


@pytest.mark.parametrize("work", ["reset", "step", "pool"])
def test_a_device_that_is_full_is_told(
    env: Any, work: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise RuntimeError("CUDA out of memory. Tried to allocate 2 GiB")

    from mjhab.envs.device import env as module

    env.reset()
    told = refused(said=f"2 worlds do not fit into the memory of {TEST_DEVICE}; try 1")
    if work == "pool":
        monkeypatch.setattr(module, "StartPool", full)
        with told:
            make(task="tidy_house", subtask="pick", num_envs=WORLDS, **DEVICE)
        return
    with monkeypatch.context() as patched, told:
        patched.setattr(env, "_sense", full)
        env.reset() if work == "reset" else idle(env)
    env.reset()
