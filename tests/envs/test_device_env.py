"""Environments on the warp backend against those on the cpu backend, on Warp's CPU device: few worlds, few steps."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, cast

import gymnasium
import numpy as np
import pytest
import torch

from mjhab.core.arrays import map_record
from mjhab.core.conventions.names import PUBLISHED, Conventions
from mjhab.core.rotations import pose_inv, pose_mul
from mjhab.envs import make, make_train
from mjhab.envs.parts.reporting import CHECKERS
from mjhab.envs.wrappers import FrameStack
from mjhab.sim.backends import cuda_devices
from mjhab.sim.protocol import TAINTS
from mjhab.tasks.labelling.events import event_names
from mjhab.tasks.plan import SubtaskKind
from mjhab.tasks.subtasks.registry import SUBTASKS, event_columns, limits_of
from tests.missing import need_warp
from tests.no_sync import NoSync
from tests.refusals import refused
from tests.warp_device import TEST_DEVICE

need_warp()

WORLDS = 2
HORIZON = 12
DEVICE: dict[str, Any] = {"backend": "warp", "device": TEST_DEVICE, "starts": 4}
PICTURES: dict[str, Any] = {"obs_mode": "depth", "camera_size": 8}
KINDS = [
    ("tidy_house", "pick"),
    ("tidy_house", "place"),
    ("tidy_house", "navigate"),
    ("set_table", "open"),
    ("set_table", "close"),
]


def actions_of(step: int, dim: int, gripper: int) -> np.ndarray:
    """Slow random motion; the gripper stays shut and opens at the end."""
    out = 0.3 * np.random.default_rng(step).uniform(-1, 1, (WORLDS, dim)).astype(
        np.float32
    )
    out[:, gripper] = -1.0 if step < HORIZON - 2 else 1.0
    return out


@pytest.fixture(scope="module")
def env() -> Any:
    """Short Picks with small pictures, shared by the tests that reset what they need."""
    return make(
        task="tidy_house",
        subtask="pick",
        num_envs=WORLDS,
        horizon=3,
        **PICTURES,
        **DEVICE,
    )


@contextmanager
def autoreset(env: Any, mode: str) -> Iterator[Any]:
    before = env.config
    env.config = dataclasses.replace(env.config, autoreset=mode)
    env.reset()
    yield env
    env.config = before


@contextmanager
def waiting_forbidden(device: str) -> Iterator[None]:
    """On CUDA, torch raises where it waits for the device."""
    if device == "cpu":
        yield
        return
    torch.cuda.set_sync_debug_mode("error")
    yield
    torch.cuda.set_sync_debug_mode("default")


def idle(env: Any, steps: int = 1) -> Any:
    for _ in range(steps - 1):
        env.step(torch.zeros(WORLDS, len(env.action_table)))
    return env.step(torch.zeros(WORLDS, len(env.action_table)))


# -- the same as on the cpu ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("task", "subtask"), KINDS)
def test_episodes_are_those_of_the_cpu_backend(task: str, subtask: str) -> None:
    options = {
        "task": task,
        "subtask": subtask,
        "num_envs": WORLDS,
        "reward_mode": "normalized_dense",
    }
    cpu = make(**options, horizon=HORIZON, threads=1)
    dev = make(**options, horizon=HORIZON, **DEVICE)
    assert (
        dev.observation_space == cpu.observation_space
        and dev.action_space == cpu.action_space
    )
    theirs, _ = cpu.reset(options={"episode": [0, 1]})
    ours, info = dev.reset()
    np.testing.assert_array_equal(dev.sim.qpos.numpy(), cpu.sim.qpos.astype(np.float32))
    assert dev.episode_spec(1) == cpu.episode_spec(1)
    compare(ours, theirs)
    records: list[Any] = []
    for step in range(HORIZON):
        actions = actions_of(step, len(cpu.action_table), cpu.controller.gripper)
        theirs, reward, *ends, told = cpu.step(actions)
        ours, our_reward, *our_ends, info = dev.step(torch.as_tensor(actions))
        np.testing.assert_allclose(our_reward.numpy(), reward, atol=2e-2)
        for flags, expected in zip(our_ends, ends, strict=True):
            np.testing.assert_array_equal(flags.numpy(), expected)
        final, expected = (
            (info["final_info"], told["final_info"])
            if step == HORIZON - 1
            else (info, told)
        )
        for name in (*CHECKERS, "pointer", "kind", "steps_left", "success", "fail"):
            np.testing.assert_array_equal(
                final[name].numpy(), expected[name], err_msg=f"{name} in step {step}"
            )
        assert final["reward_terms"].keys() == expected["reward_terms"].keys()
        assert (
            event_names(expected["kind"], final["event_flags"])
            == expected["events"].tolist()
        )
        records = expected["ended"]
    compare(info["final_obs"], told["final_obs"])
    assert final["ended"].all() and info["ended"].all()
    for w, (mine, record) in enumerate(zip(dev.records(), records, strict=True)):
        close = {
            name: pytest.approx(record[name], rel=0.02, abs=0.5)
            for name in ("peak_force", "peak_finger_force", "cumulative_force")
        }
        assert mine == record | close
        assert SUBTASKS[subtask].labels[int(final["label"][w])] == record["label"]
    # The next episodes: two worlds further.
    assert [dev.episode_spec(w)["index"] for w in range(WORLDS)] == [2, 3]
    cpu.reset(options={"episode": [2, 3]})
    np.testing.assert_array_equal(dev.sim.qpos.numpy(), cpu.sim.qpos.astype(np.float32))


def compare(ours: dict[str, torch.Tensor], theirs: dict[str, np.ndarray]) -> None:
    assert ours.keys() == theirs.keys()
    for key, value in theirs.items():
        assert ours[key].numpy().dtype == value.dtype
        # Of an object just let go, the CPU engine's own pose moves by 0.03 for actions that differ by 1e-5; between the
        # engines, one of them in single precision, one number of a held object's quaternion differs by 0.07.
        atol = 0.1 if key in ("extra/obj_pose_wrt_base", "state") else 0.02
        np.testing.assert_allclose(ours[key].numpy(), value, atol=atol, err_msg=key)


def test_a_full_turn_and_the_other_quaternion_are_the_same_state(env: Any) -> None:
    obs, _ = env.reset(seed=0)
    flip = env.state.object_pose.new_tensor([1.0, 1, 1, -1, -1, -1, -1])
    turn = torch.zeros_like(env.state.robot_q)
    turn[:, 2] = 2 * np.pi
    state = dataclasses.replace(
        env.state,
        robot_q=env.state.robot_q + turn,
        object_pose=env.state.object_pose * flip,
        body_quat=-env.state.body_quat,
    )
    seen = env.observer.observe(state, env.focus, env.signals)
    torch.testing.assert_close(seen["state"], obs["state"], rtol=0.0, atol=1e-4)
    for key in ("extra/tcp_pose_wrt_base", "extra/obj_pose_wrt_base"):
        assert bool((seen[key][:, 3] >= 0).all()) and bool((obs[key][:, 3] >= 0).all())


def test_profiles_are_the_same_on_the_device() -> None:
    """The axes of this object differ by 87 degrees between the profiles."""
    options = {
        "task": "tidy_house",
        "subtask": "place",
        "target": "010_potted_meat_can",
        "num_envs": 1,
        "profile": "ms_hab",
    }
    cpu = make_train(**options, threads=1)
    dev = make_train(**options, **(DEVICE | {"starts": 2}))
    theirs, _ = cpu.reset(options={"episode": [0]})
    ours, _ = dev.reset(options={"episode": [0]})
    compare(ours, theirs)
    for each in (Conventions(), PUBLISHED):
        seen = np.asarray(dev.state_as(each))
        np.testing.assert_allclose(seen, cpu.state_as(each), atol=0.02)
    assert not torch.allclose(dev.state_as(Conventions()), ours["state"], atol=0.5)
    assert torch.equal(dev.state_as(dev.config.conventions), ours["state"])
    np.testing.assert_array_equal(dev.sim.qpos.numpy(), cpu.sim.qpos.astype(np.float32))
    assert dev.config.profile == "ms_hab" and dev.task_config == cpu.task_config
    assert (
        dev.task_config.stillness == "published"
        and limits_of(dev.task_config, "place").horizon == 100
    )
    for step in range(3):
        actions = actions_of(step, len(cpu.action_table), cpu.controller.gripper)[:1]
        _, reward, *_ = cpu.step(actions)
        _, ours, *_ = dev.step(torch.as_tensor(actions))
        np.testing.assert_allclose(ours.numpy(), reward, atol=2e-2)
    assert dev.signals.is_grasped.all()
    with refused("stillness", "absolute"):
        make(**options, **DEVICE, stillness="absolute")
    with refused(where="FrameStack", said="works on numpy arrays"):
        FrameStack(dev)


def test_training_draws_the_same_starts() -> None:
    options = {
        "task": "set_table",
        "subtask": "close",
        "num_envs": 1,
        "episode_pool": 3,
        "seed": 5,
    }
    cpu = make_train(**options, threads=1)
    dev = make_train(**options, **(DEVICE | {"starts": 2}))
    cpu.reset(options={"episode": [1]})
    dev.reset(options={"episode": [1]})
    np.testing.assert_array_equal(dev.sim.qpos.numpy(), cpu.sim.qpos.astype(np.float32))
    assert dev.config.reward == cpu.config.reward == "normalized_dense"


def test_a_chain_teleports_to_where_it_does_on_the_cpu() -> None:
    options = {"task": "tidy_house", "num_envs": WORLDS, "reward_mode": "dense"}
    cpu = make(**options, threads=1)
    dev = make(**options, **(DEVICE | {"starts": 2}))
    cpu.reset(options={"episode": [0, 1]})
    dev.reset()
    np.testing.assert_array_equal(dev.sim.qpos.numpy(), cpu.sim.qpos.astype(np.float32))
    for _ in range(3):
        actions = np.zeros((WORLDS, len(cpu.action_table)), np.float32)
        _, reward, *_, told = cpu.step(actions)
        _, ours, *_, info = dev.step(torch.as_tensor(actions))
        np.testing.assert_array_equal(info["pointer"].numpy(), told["pointer"])
        np.testing.assert_allclose(ours.numpy(), reward, atol=0.02)
    # Picks succeed when somebody says so: then the robot leaps to the goal, its hands empty.
    assert (info["kind"] == int(SubtaskKind.PICK)).all()
    everyone = torch.ones(WORLDS, dtype=torch.bool, device=dev.device)
    dev.progress = dataclasses.replace(dev.progress, pointer=dev.progress.pointer + 1)
    dev._renew(~everyone, everyone, dev.start_row)
    for w in range(WORLDS):
        goal = np.array(dev.pool.plans[w].subtasks[2].goal_pos)
        base = dev.state.robot_q[w, :3].numpy()
        np.testing.assert_allclose(
            base, dev.pool.teleport_poses[w, 2, :3].numpy(), atol=1e-6
        )
        assert np.hypot(*(base[:2] - goal[:2])) <= 2.0


def test_landings_are_tried_in_the_state_that_is_to_be_expected() -> None:
    env = make(task="set_table", threads=1)
    episode = env.make_episode(0, 0)
    plan = env.source.start(episode).plan
    a = env.sim.addresses
    bowl = env.layout.object_names.index(plan.subtasks[3].obj)
    link = env.layout.link_ids.index(plan.subtasks[1].link)
    low, high = env.layout.links[link].link.range
    seen = {}
    # Before and after Open, with the bowl in the hand, on the table, and on the way to the apple.
    for position in (0, 2, 4, 6, 8):
        assert plan.subtasks[position].kind == SubtaskKind.NAVIGATE
        qpos = env.starts.foresee(episode, plan, position)
        seen[position] = (
            (qpos[a.link_q[link]] - low) / (high - low) >= 0.85,
            qpos[a.object_q[bowl] :][:3],
        )
    assert [bool(opened) for opened, _ in seen.values()] == [
        False,
        True,
        True,
        True,
        False,
    ]
    np.testing.assert_array_equal(seen[0][1], episode.object_pose[bowl, :3])
    assert np.linalg.norm(seen[2][1] - seen[0][1]) > 0.1, "it moves with the drawer"
    np.testing.assert_array_equal(
        seen[4][1], env.layout.parked_poses[bowl, :3], err_msg="carried: out of the way"
    )
    for position in (6, 8):
        np.testing.assert_allclose(
            seen[position][1], plan.subtasks[5].goal_pos, atol=0.002
        )


def test_what_is_held_leaps_along() -> None:
    from mjhab.envs.device.teleport_poses import Teleporter

    rng = np.random.default_rng(0)
    qpos = torch.as_tensor(rng.uniform(-1, 1, (3, 29)))
    qpos[:, 15:].unflatten(1, (2, 7))[..., 3:] /= (
        qpos[:, 15:].unflatten(1, (2, 7))[..., 3:].norm(dim=-1, keepdim=True)
    )
    force = torch.zeros(3, 2, 2, 3, dtype=qpos.dtype)
    force[0, :, 1, 0] = force[1, 0, 1, 0] = (
        1.0  # world 0 holds object 1 with both fingers, world 1 touches it
    )
    state = SimpleNamespace(
        robot_q=qpos[:, :15],
        object_pose=qpos[:, 15:].unflatten(1, (2, 7)),
        finger_force=force,
    )
    addresses = SimpleNamespace(robot_q=np.arange(15), object_q=np.array([15, 22]))
    teleport_pose = torch.as_tensor(rng.uniform(-1, 1, (3, 15)))
    teleporter = Teleporter(cast("Any", addresses), torch.device("cpu"))
    moved = teleporter.moved(
        qpos, cast("Any", state), teleport_pose, torch.tensor([1, 1, -1])
    )
    np.testing.assert_array_equal(moved[0, 3:22], qpos[0, 3:22])
    np.testing.assert_array_equal(moved[:, :3], teleport_pose[:, :3])
    before, after = (
        pose_mul(pose_inv(_base(q[0, :3])), q[0, 22:].numpy()) for q in (qpos, moved)
    )
    np.testing.assert_allclose(after, before, atol=1e-12)
    for w in (1, 2):
        np.testing.assert_array_equal(moved[w, :15], teleport_pose[w])
        np.testing.assert_array_equal(moved[w, 15:], qpos[w, 15:])


def _base(pose: torch.Tensor) -> np.ndarray:
    x, y, yaw = pose.tolist()
    return np.array([x, y, 0.0, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


# -- masks -----------------------------------------------------------------------------------------------------------


def test_a_reset_leaves_every_bit_of_the_other_worlds(env: Any) -> None:
    with autoreset(env, "disabled"):
        idle(env)
        before = env.sim.get_world(0)
        was = map_record(lambda x: x[0].clone(), env.progress)
        _, info = env.reset(
            options={"reset_mask": torch.tensor([False, True]), "episode": [3]}
        )
        for name, value in env.sim.get_world(0).items():
            np.testing.assert_array_equal(value, before[name], err_msg=name)
        assert dataclasses.asdict(
            map_record(lambda x: x[0], env.progress)
        ) == dataclasses.asdict(was)
        assert info["steps_left"].tolist() == [2, 3] and env.episode_spec(1)["index"] == 3
        np.testing.assert_array_equal(env.sim.qpos[1], env.pool.qpos[3])


def test_a_seed_draws_the_next_starts_of_the_pool(env: Any) -> None:
    pool = env.pool
    begun = []
    for seed in (1, 2, 1):
        env.draw_starts(seed)
        env.reset()
        first = env.start_row
        env.reset()
        np.testing.assert_array_equal(env.start_row, (first + WORLDS) % pool.count)
        begun.append(first.tolist())
    assert begun[0] == begun[2] != begun[1] and env.pool is pool
    env.reset(seed=pool.seed)
    assert env.start_row.tolist() == [0, 1]


def test_disabled_autoreset_leaves_finished_worlds(env: Any) -> None:
    with autoreset(env, "disabled"):
        *_, truncated, info = idle(env, 3)
        assert truncated.all() and info["ended"].all() and "final_obs" not in info
        *_, truncated, info = idle(env)
        assert (
            not truncated.any()
            and not info["ended"].any()
            and (info["steps_left"] == 0).all()
        )


def test_next_step_autoreset_takes_a_step(env: Any) -> None:
    with autoreset(env, "next_step"):
        *_, truncated, info = idle(env, 3)
        assert truncated.all() and (info["steps_left"] == 0).all()
        _, reward, _, truncated, info = idle(env)
        assert (
            not truncated.any()
            and (info["steps_left"] == 3).all()
            and (reward == 0).all()
        )
        np.testing.assert_array_equal(env.sim.qpos, env.pool.qpos[env.start_row])


def test_a_world_that_breaks_is_given_up_alone(env: Any) -> None:
    env.reset()
    env.sim.engine.qvel_t[1, 0] = torch.nan
    _, _, _, truncated, info = idle(env)
    assert truncated.tolist() == [False, True] and info["nan_resets"].tolist() == [0, 1]
    assert info["final_info"]["taint"].tolist() == [0, 1 << TAINTS.index("nan")] and info[
        "taint"
    ].tolist() == [0, 0]
    assert (
        torch.isfinite(info["final_obs"]["state"]).all()
        and torch.isfinite(info["robot_force"]).all()
    )
    assert env.records()[0] is None and env.records()[1] is not None


def test_overflow_and_bad_actions_raise_in_evaluation(env: Any) -> None:
    env.reset()
    env.check_taint()
    tainted = int(env.tainted)
    env.sim.engine.overflow_t[0] = int(row_bit())
    *_, info = idle(env, 3)
    assert (
        info["final_info"]["taint"][0] == 1 << TAINTS.index("constraint_overflow")
        and int(env.tainted) > tainted
    )
    rows = env.sim.engine.sizes.rows
    with refused(said=f"set buffers={{'rows': {2 * rows}}}"):
        env.check_taint()
    env.sim.engine.overflow_seen.zero_()
    env.step(torch.full((WORLDS, len(env.action_table)), torch.inf))
    with refused("actions", "2 others"):
        env.check_taint()
    env.bad_actions = env.bad_actions * 0


def row_bit() -> int:
    import mujoco_warp

    return int(mujoco_warp.OverflowType.NEFC)


@pytest.mark.parametrize("device", sorted({TEST_DEVICE, "cpu", *cuda_devices()}))
def test_a_step_never_waits_for_the_device(
    env: Any, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import warp as wp

    if device != TEST_DEVICE:
        options = DEVICE | PICTURES | {"device": device}
        env = make(
            task="tidy_house", subtask="pick", num_envs=WORLDS, horizon=3, **options
        )
    env.reset()
    idle(env, 4)
    actions = torch.zeros((WORLDS, len(env.action_table)), device=env.device)
    begun = env.count.clone()

    def refuse(*_: Any) -> None:
        raise AssertionError("an array goes to the host")

    monkeypatch.setattr(wp.array, "numpy", refuse)
    with NoSync() as watched, waiting_forbidden(device):
        for _ in range(3):
            *_, info = env.step(actions)
    assert watched.seen > 100 and (env.count == begun + 1).all()
    assert not info["ended"].any()


# -- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "option"),
    [
        ({"reset_mask": [True]}, "reset_mask"),
        ({"episode": [0, 4]}, "options['episode']"),
        ({"episode": [0.5, 1.0]}, "options['episode']"),
        ({"episode": "ab"}, "options['episode']"),
        ({"episodes": [0]}, "reset option"),
    ],
)
def test_bad_reset_options_are_told(
    env: Any, options: dict[str, Any], option: str
) -> None:
    with refused(option):
        env.reset(options=options)


def test_bad_actions_and_seeds_are_told(env: Any) -> None:
    env.reset()
    with refused("actions", (2, 3), expected="(2, 13)"):
        env.step(torch.zeros(2, 3))
    with refused("seed", [1, 2], expected="one number"):
        env.reset(seed=[1, 2])
    with refused("reset_mask", [True, False]):
        env.reset(seed=9, options={"reset_mask": torch.tensor([True, False])})
    env.reset(seed=np.int64(env.pool.seed))


@pytest.mark.parametrize(
    ("options", "option"),
    [
        ({"backend": "gpu"}, "backend"),
        ({"starts": -1}, "starts"),
        ({"device": "cuda:77"}, "device"),
        ({"render_mode": "rgb_array"}, "render_mode"),
        ({"buffers": {"contact": 5}}, "buffer"),
        ({"buffers": {"rows": 0}}, "buffer 'rows'"),
    ],
)
def test_bad_configurations_are_told(options: dict[str, Any], option: str) -> None:
    with refused(option):
        make(**{"task": "tidy_house", "subtask": "pick", **DEVICE, **options})


def test_a_plain_gymnasium_env_runs_on_the_cpu_backend() -> None:
    with refused("backend", "warp"):
        gymnasium.make("mjhab/PickSubtaskTrain-v1", backend="warp")


def test_wrappers_for_numpy_refuse_tensors(env: Any) -> None:
    with refused(where="FrameStack", said="backend='cpu'"):
        FrameStack(env, 2)


def test_event_flags_have_the_columns_of_the_events(env: Any) -> None:
    _, info = env.reset()
    assert (
        info["event_flags"].shape == (WORLDS, len(event_columns()))
        and not info["event_flags"].any()
    )
