"""MS-HAB's ids: what an environment shows is what ours shows, under its names, types and order."""

from __future__ import annotations

import json
import logging
from typing import Any, ClassVar

import gymnasium
import h5py
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import mjhab.compat.mshab  # noqa: F401  (registers the ids)
from mjhab.compat.mshab.files.plans import MsHabTaskPlan
from mjhab.compat.mshab.files.subtasks import OpenSubtask, PickSubtask
from mjhab.compat.mshab.worlds.arguments import Arguments, read_arguments
from mjhab.compat.mshab.worlds.draws import PlanDraw
from mjhab.compat.mshab.worlds.limits import default_configs, overrides_of
from mjhab.compat.mshab.worlds.pose import PoseBatch
from mjhab.compat.mshab.wrappers.action import FetchActionWrapper
from mjhab.compat.mshab.wrappers.observation import (
    DepthFrameStack,
    FetchDepthObservationWrapper,
    StackedDictObservationWrapper,
)
from mjhab.compat.mshab.wrappers.record import RecordEpisode
from mjhab.compat.mshab.wrappers.statistics import VectorRecordEpisodeStatistics
from mjhab.compat.mshab.wrappers.vector import ManiSkillVectorEnv
from tests.refusals import refused

PICK = "PickSubtaskTrain-v0"


def made(env_id: str = PICK, **options: Any) -> Any:
    given = {
        "num_envs": 2,
        "obs_mode": "depth",
        "sensor_configs": {"width": 16, "height": 16},
    }
    return gymnasium.make(env_id, **{**given, **options})


@pytest.fixture(scope="module")
def env() -> Any:
    return made(max_episode_steps=4, add_event_tracker_info=True)


def test_an_observation_is_ours_in_their_order_and_types(env: Any) -> None:
    obs, info = env.reset(seed=3)
    assert list(obs) == ["agent", "extra", "sensor_param", "sensor_data"]
    assert list(obs["agent"]) == ["qpos", "qvel"]
    assert list(obs["extra"]) == [
        "tcp_pose_wrt_base",
        "obj_pose_wrt_base",
        "goal_pos_wrt_base",
        "is_grasped",
    ]
    ours = env.unwrapped.worlds.observe()
    for key, value in ours.items():
        folder, *rest = key.split("/")
        if rest and key != "extra/is_grasped":
            place: Any = obs[folder]
            for name in rest:
                place = place[name]
            assert torch.equal(place, torch.from_numpy(value)), key
    assert obs["extra"]["is_grasped"].dtype == torch.bool
    assert obs["extra"]["is_grasped"].shape == (2,)
    assert obs["sensor_data"]["fetch_hand"]["depth"].shape == (2, 16, 16, 1)
    assert obs["sensor_data"]["fetch_hand"]["depth"].dtype == torch.int16
    row = {key: _first(value) for key, value in obs.items()}
    assert env.unwrapped.single_observation_space.contains(row)
    assert info["reconfigure"] in (True, False)


def _first(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _first(value) for key, value in tree.items()}
    return tree[0].numpy()


def test_info_has_their_names_and_our_signals(env: Any) -> None:
    env.reset(seed=3)
    action = np.full((2, 13), 0.3, np.float32)
    for step in range(1, 6):
        _, reward, terminated, truncated, info = env.step(action)
        base = env.unwrapped
        judged = base.worlds.outcome_signals
        assert info["elapsed_steps"].tolist() == [step, step]
        assert info["subtasks_steps_left"].tolist() == [199 - step] * 2
        assert truncated.tolist() == [step >= 4] * 2
        assert torch.equal(terminated, info["success"] | info["fail"])
        assert reward.dtype == torch.float32
        for name, ours in (
            ("is_grasped", "is_grasped"),
            ("robot_rest", "robot_rest"),
            ("cumulative_force_within_limit", "force_ok"),
        ):
            assert info[name].tolist() == getattr(judged, ours).tolist()
        force = torch.from_numpy(judged.target_force).float()
        assert torch.equal(info["robot_target_pairwise_force"], force)
    assert (info["subtask_type"] == 0).all() and (info["subtask"] == 0).all()
    assert "obj_at_goal" not in info and "articulation_open" not in info


def test_attributes_that_scripts_read(env: Any) -> None:
    obs, _ = env.reset(seed=3)
    base = env.unwrapped
    hand = base.agent.base_link.pose.inv() * base.agent.tcp.pose
    told = obs["extra"]["tcp_pose_wrt_base"]
    assert torch.allclose(hand.p, told[:, :3], atol=1e-5)
    target = (base.agent.base_link.pose.inv() * base.subtask_objs[0].pose).raw_pose
    seen = obs["extra"]["obj_pose_wrt_base"]
    assert torch.allclose(target[:, :3], seen[:, :3], atol=1e-5)
    # One quaternion and its negative are one rotation.
    assert torch.allclose((target[:, 3:] * seen[:, 3:]).sum(1).abs(), torch.ones(2))
    assert base.agent.robot.qpos[:, 3:].allclose(obs["agent"]["qpos"])
    assert base.subtask_pointer.tolist() == [0, 0] and base.task_ids.tolist() == [0]
    assert base.task_plan[0].type == "pick"
    assert len(set(base.task_plan[0].composite_subtask_uids)) == 2
    for uid in base.task_plan[0].composite_subtask_uids:
        assert base.base_task_plans[(uid,)].subtasks[0].uid == uid
    assert base.subtask_articulations[0]._objs[1].name.startswith("env-1_")
    assert "pick up" in base.instructions[0] or base.instructions[0]
    with pytest.raises(AttributeError, match="not 'scene_idxs'"):
        _ = base.agent.scene_idxs


def test_states_are_in_the_layout_of_maniskill(env: Any) -> None:
    env.reset(seed=3)
    base = env.unwrapped
    worlds = base.worlds
    state = worlds.state
    generator = np.random.default_rng(0)
    # Nothing moves after a reset.
    for values in (state.object_vel, state.robot_qd, state.link_qd):
        values[:] = generator.normal(size=values.shape)
    told = base.get_state_dict()
    layout = worlds.layout
    assert len(told["actors"]) == len(layout.roster)
    for slot, (name, kind) in enumerate(
        zip(layout.object_names, layout.objects, strict=True)
    ):
        row = told["actors"][name.replace("_:000", "-")]
        ours, spin = state.object_pose[:, slot], state.object_vel[:, slot]
        turn = Rotation.from_quat(ours[:, 3:], scalar_first=True)
        scan = turn * Rotation.from_euler("z", kind.scan_yaw)
        seen = Rotation.from_quat(row[:, 3:7].double().numpy(), scalar_first=True)
        assert (scan.inv() * seen).magnitude().max() < 1e-5
        linear = np.concatenate([ours[:, :3], spin[:, :3]], axis=1)
        np.testing.assert_allclose(row[:, [0, 1, 2, 7, 8, 9]], linear, atol=1e-5)
        np.testing.assert_allclose(row[:, 10:], turn.apply(spin[:, 3:]), atol=1e-5)
    found = told["articulations"]
    assert set(found) == {"fetch", "fridge-0", "kitchen_counter-0"}
    assert found["fetch"][1, :13].tolist() == pytest.approx([0, 0, 0.02, 1, *[0] * 9])
    assert torch.equal(found["fetch"][:, 13:28], base.agent.robot.qpos)
    assert torch.equal(found["fetch"][:, 28:], base.agent.robot.qvel)
    for furniture in ("fridge", "kitchen_counter"):
        at = [i for i, link in enumerate(layout.links) if link.articulation == furniture]
        signs = [-1 if layout.links[i].link.mirrored else 1 for i in at]
        joints = [state.link_q[:, at] * signs, state.link_qd[:, at] * signs]
        row = found[f"{furniture}-0"]
        np.testing.assert_allclose(row[:, 13:], np.concatenate(joints, 1), atol=1e-6)
        for world, home in enumerate(worlds.homes):
            placed = layout.articulation_placement(
                layout.pack.homes_by_name[home], furniture
            )
            root = [*placed.pos, *placed.rotation, *[0] * 6]
            np.testing.assert_allclose(row[world, :13], root, atol=1e-6)
    env.reset(seed=3)


def test_a_partial_reset_leaves_the_other_worlds(
    env: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    env.reset(seed=5)
    obs, *_ = env.step(np.zeros((2, 13), np.float32))
    pictures = {name: seen["depth"] for name, seen in obs["sensor_data"].items()}
    before = {name: depth.clone() for name, depth in pictures.items()}
    for depth in pictures.values():
        # A script may write into what it was given.
        depth[:] = 1
    observer = env.unwrapped.worlds.observer
    drawn: list[int] = []
    draw = observer.draw

    def counted(state: Any, homes: Any, *more: Any) -> Any:
        drawn.append(len(homes))
        return draw(state, homes, *more)

    monkeypatch.setattr(observer, "draw", counted)
    after, info = env.reset(options={"env_idx": torch.tensor([1])})
    assert torch.equal(after["agent"]["qpos"][0], obs["agent"]["qpos"][0])
    assert not torch.equal(after["agent"]["qpos"][1], obs["agent"]["qpos"][1])
    assert info["elapsed_steps"].tolist() == [1, 0]
    assert info["subtasks_steps_left"].tolist() == [198, 199]
    # The world that begins is drawn, and no other.
    assert drawn == [1]
    for name, seen in after["sensor_data"].items():
        assert torch.equal(seen["depth"][0], before[name][0])
        assert not torch.equal(seen["depth"][1], before[name][1])
    observer._drawn = None
    whole = env.unwrapped.worlds.observe()
    assert drawn == [1, 2]
    for name, seen in after["sensor_data"].items():
        told = torch.from_numpy(whole[f"sensor_data/{name}/depth"])
        assert torch.equal(seen["depth"], told)


@pytest.mark.parametrize(
    ("given", "option"),
    [
        ({"seed": "a"}, "seed"),
        ({"seed": [1, 2, 3]}, "seed"),
        ({"options": {"env_idx": [2]}}, "env_idx"),
        ({"options": {"env_idx": [-1]}}, "env_idx"),
        ({"options": {"env_idx": torch.tensor([True, False])}}, "env_idx"),
        ({"options": {"env_ids": [0]}}, "reset option"),
        ({"options": [0]}, "options"),
    ],
)
def test_a_reset_that_means_nothing_is_refused(
    env: Any, given: dict[str, Any], option: str
) -> None:
    with refused(option):
        env.reset(**given)


def test_the_first_reset_begins_all_worlds() -> None:
    fresh = gymnasium.make("PickSubtaskTrain-v0", num_envs=2, obs_mode="state")
    for chosen in ([1], [0, 0], []):
        with refused("env_idx", chosen, "first reset"):
            fresh.reset(options={"env_idx": chosen})
    fresh.reset(options={"env_idx": [1, 0]})
    fresh.close()


def test_what_is_not_answered_is_told(env: Any) -> None:
    env.reset(seed=0)
    with refused("action"):
        env.step("still")
    with refused(said="task_plan_idxs needs task_plans"):
        env.reset(options={"task_plan_idxs": [0, 0]})
    with pytest.raises(AttributeError, match="does not answer 'scene'"):
        _ = env.unwrapped.scene


def test_seeds_decide_episodes(env: Any) -> None:
    one, _ = env.reset(seed=11)
    two, _ = env.reset(seed=12)
    again, _ = env.reset(seed=11)
    assert torch.equal(one["agent"]["qpos"], again["agent"]["qpos"])
    assert not torch.equal(one["agent"]["qpos"], two["agent"]["qpos"])


def test_wrappers_stack_depth_and_hold_the_head_still(env: Any) -> None:
    bare = made(max_episode_steps=2)
    seen = DepthFrameStack(FetchDepthObservationWrapper(bare), 3)
    space = bare.unwrapped.single_observation_space
    assert list(space["pixels"].spaces) == ["fetch_head_depth", "fetch_hand_depth"]
    assert space["pixels"]["fetch_head_depth"].shape == (3, 1, 16, 16)
    venv = VectorRecordEpisodeStatistics(
        ManiSkillVectorEnv(FetchActionWrapper(seen), ignore_terminations=True),
        extra_stat_keys=["success"],
        max_episode_steps=2,
    )
    obs, _ = venv.reset(seed=0)
    frames = obs["pixels"]["fetch_hand_depth"]
    assert torch.equal(frames[:, 0], frames[:, 2])
    action = torch.ones(2, 13)
    obs, *_ = venv.step(action)
    assert action[:, 8:10].eq(0).all() and action[:, [0, 7, 10, 11, 12]].eq(1).all()
    assert torch.equal(obs["pixels"]["fetch_hand_depth"][:, 1], frames[:, 2])
    obs, _, _, truncated, info = venv.step(action)
    assert truncated.all() and info["episode"]["l"].tolist() == [2, 2]
    last = info["final_observation"]["pixels"]["fetch_hand_depth"]
    fresh = obs["pixels"]["fetch_hand_depth"]
    assert torch.equal(fresh[:, 0], fresh[:, 2]) and not torch.equal(last, fresh)
    assert [
        len(queue) for queue in (venv.return_queue, venv.success_before_fail_queue)
    ] == [2, 2]
    assert venv.extra_stats["success"][0].shape == (2,)
    assert venv.summary()["episodes"] == 2


def test_all_entries_are_stacked_with_the_state(env: Any) -> None:
    bare = made()
    stacked = StackedDictObservationWrapper(FetchDepthObservationWrapper(bare), 2)
    obs, _ = stacked.reset(seed=0)
    assert obs["state"].shape == (2, 2, 42)
    assert bare.unwrapped.single_observation_space["state"].shape == (2, 42)


def test_episodes_without_a_step_are_cleaned_away(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    bare = made(obs_mode="state")
    monkeypatch.setattr(bare.unwrapped, "close", bool)
    for clean in (True, False):
        recorded = RecordEpisode(
            bare, tmp_path, trajectory_name="a", save_video=False, clean_on_close=clean
        )
        recorded.reset(seed=0)
        recorded.flush_trajectory(ignore_empty_transition=False, env_idxs_to_flush=[1])
        recorded.flush_trajectory()
        recorded.step(np.zeros((2, 13), np.float32))
        recorded.close()
        lengths = [1, 1] if clean else [0, 1, 1]
        with h5py.File(tmp_path / "a.h5") as file:
            assert sorted(file) == [f"traj_{i}" for i in range(len(lengths))]
            for number, length in enumerate(lengths):
                one: Any = file[f"traj_{number}"]
                assert one["actions"].shape == (length, 13)
                assert one["obs"].shape == (length + 1, 42)
                assert one["success"].shape == one["rewards"].shape == (length,)
        told = json.loads((tmp_path / "a.json").read_text())["episodes"]
        assert [one["elapsed_steps"] for one in told] == lengths
        assert [one["episode_id"] for one in told] == list(range(len(lengths)))


def test_depth_is_needed_where_it_is_shown() -> None:
    with refused(where="FetchDepthObservationWrapper", said="needs depth"):
        FetchDepthObservationWrapper(made(obs_mode="state_dict"))


# -- both rules of termination -----------------------------------------------------------------------------------------


class _Told:
    """A vector environment that tells given successes and failures of one world."""

    num_envs = 1
    unwrapped: Any
    device = torch.device("cpu")
    metadata: ClassVar[dict[str, Any]] = {}

    def __init__(self, success: list[int], fail: list[int]) -> None:
        self.unwrapped = self
        self._steps = list(zip(success, fail, strict=True))

    def reset(self, **_: Any) -> tuple[dict, dict]:
        return {}, {}

    def step(self, _: Any) -> tuple[Any, ...]:
        success, fail = self._steps.pop(0)
        info: dict[str, Any] = {
            "success": torch.tensor([bool(success)]),
            "fail": torch.tensor([bool(fail)]),
        }
        done = torch.tensor([not self._steps])
        if not self._steps:
            info = {"final_info": info}
        return {}, torch.ones(1), torch.tensor([False]), done, info


@pytest.mark.parametrize(
    ("success", "fail", "once", "strict"),
    [
        ([0, 1, 0], [0, 0, 1], 1, 1),
        ([0, 0, 1], [0, 1, 0], 1, 0),
        ([0, 0, 0], [0, 0, 0], 0, 0),
    ],
)
def test_success_is_told_under_both_rules(
    success: list[int], fail: list[int], once: int, strict: int, monkeypatch: Any
) -> None:
    monkeypatch.setattr("gymnasium.vector.VectorWrapper.__init__", _take)
    counted = VectorRecordEpisodeStatistics(_Told(success, fail), max_episode_steps=3)  # type: ignore[arg-type]
    counted.reset()
    for _ in success:
        *_, info = counted.step(None)
    assert info["episode"]["s_o"].item() == once
    assert info["episode"]["s_t"].item() == strict
    assert counted.summary()["success_once"] == once
    assert counted.summary()["success_before_fail"] == strict


def _take(self: Any, env: Any) -> None:
    self.env = env


def test_a_whole_task_goes_on_after_a_failure() -> None:
    env = made(
        "SequentialTask-v0",
        obs_mode="state",
        num_envs=1,
        task_cfgs={"navigate": {"horizon": 2, "robot_cumulative_force_limit": 0.0}},
    )
    env.reset(seed=0)
    for step in range(1, 5):
        _, reward, terminated, _, info = env.step(np.zeros(13, np.float32))
        assert info["subtasks_steps_left"].item() == 1 - step
        assert info["fail"].item() == (step >= 1) == terminated.item()
        assert info["elapsed_steps"].item() == step and reward.item() == 0
    assert "obj_at_goal_progressive_5" in info
    assert env.unwrapped.task_ids.tolist()[:4] == [2, 3, 2, 0]


# -- draws -------------------------------------------------------------------------------------------------------------


class _Starts:
    """Starts of six plans in three homes; plan 0 has two."""

    def __init__(self) -> None:
        self.options: dict[str, Any] = {}
        self.plans = [
            MsHabTaskPlan([PickSubtask("024_bowl-0")], f"home{i // 2}.json", f"e{i}.json")
            for i in range(6)
        ]

    def of(self, plan: int, spawn: int) -> int:
        return 10 * plan + spawn

    def spawns(self, plan: int) -> int:
        return 2 if plan == 0 else 1


HOMES = {"home0.json": 0, "home1.json": 1, "home2.json": 2}


def drawing(num_envs: int, **options: Any) -> PlanDraw:
    return PlanDraw(Arguments("pick", num_envs, **options), _Starts(), HOMES)  # type: ignore[arg-type]


def test_homes_are_repeated_equally_and_plans_are_those_of_the_home() -> None:
    draw = drawing(6)
    assert draw.build_config_idxs == [0, 0, 1, 1, 2, 2]
    seen = set()
    for _ in range(40):
        rows = draw.rows(range(6), {})
        seen.update(zip(draw.build_config_idxs, (row // 10 for row in rows), strict=True))
    assert seen == {(home, 2 * home + k) for home in range(3) for k in range(2)}


def test_a_world_draws_the_same_whatever_others_do() -> None:
    one, other = drawing(3), drawing(3)
    for draw in (one, other):
        draw.begin([4, 5, 6], range(3))
    both = [one.rows(range(3), {}) for _ in range(3)]
    alone = [other.rows([2], {}) for _ in range(3)]
    assert [row[2] for row in both] == [row[0] for row in alone]


def test_what_is_chosen_is_taken_and_told() -> None:
    draw = drawing(3)
    options = {
        "task_plan_idxs": torch.tensor([0, 1, 1]),
        "spawn_selection_idxs": [1, None, 0],
    }
    assert draw.rows(range(3), options) == [1, 30, 50]
    assert draw.task_plan_idxs.tolist() == [0, 1, 1]
    assert draw.spawn_selection_idxs == [1, 0, 0]
    with refused("task_plan_idxs", 2, "below 2"):
        draw.rows(range(3), {"task_plan_idxs": [2, 0, 0]})
    draw.build([2, 2, 0])
    assert draw.plan(0).build_config_name == "home2.json"
    with refused("build_config_idxs", [9, 0, 0]):
        draw.build([9, 0, 0])


def test_the_number_of_worlds_must_fit_the_homes() -> None:
    with refused("num_envs", 4, "a multiple of 3"):
        drawing(4)
    assert drawing(4, equal_homes=False).build_config_idxs == [0, 0, 1, 1]


# -- arguments ---------------------------------------------------------------------------------------------------------


def test_arguments_that_cannot_be_honoured_are_refused() -> None:
    plan = MsHabTaskPlan(
        [OpenSubtask("fridge", "fridge-0", 2, 0, "013_apple-0", [0, 0, 0])]
    )
    pick = MsHabTaskPlan([PickSubtask("024_bowl-0")])
    for given, option, said in (
        ({"robot_uids": "panda"}, "robot_uids", "'fetch'"),
        ({"obs_mode": "dept"}, "obs_mode", "depth"),
        ({"render_mode": "human"}, "render_mode", "rgb_array"),
        ({"sim_backend": "vulkan"}, "sim_backend", "cpu"),
        ({"robot_force_mult": 0.1}, "robot_force_mult", "0.001"),
        ({"reward_mode": "shaped"}, "reward_mode", "dense"),
        ({"sensor_configs": {"fov": 1}}, "entry of sensor_configs", "width"),
        ({"num_enws": 3}, "argument of MS-HAB's environments", "num_envs"),
        ({"task_cfgs": {"pickle": {}}}, "subtask in task_cfgs", "pick"),
        ({"task_cfgs": "pick"}, "task_cfgs", "a mapping"),
        ({"task_cfgs": {"pick": {"horizon": "a"}}}, "task_cfgs['pick']['horizon']", "a"),
        ({"task_plans": [plan]}, "task_plans", "plans of one pick each"),
        ({"task_plans": "plans.json"}, "task_plans", "plan_data_from_file"),
        ({"scene_builder_cls": 4}, "scene_builder_cls", "name"),
        ({"shader_dir": "minimall"}, "shader_dir", "minimal"),
        ({"add_event_tracker_info": "yes"}, "add_event_tracker_info", "True or False"),
        ({"reconfiguration_freq": "x"}, "reconfiguration_freq", "whole number"),
        ({"sensor_configs": {"fetch_hed": {}}}, "camera in sensor_configs", "fetch_head"),
        ({"sensor_configs": {"width": "9"}}, "size in sensor_configs", "whole number"),
        ({"mjhab_options": {"num_envs": 3}}, "mjhab_options", "num_envs beside"),
    ):
        with refused(option) as caught:
            read_arguments("pick", given)
        assert said in str(caught.value), given
    with refused(said="OpenSubtaskTrain-v0"):
        read_arguments("pick", {"task_plans": [plan]})
    with refused(said="spawn_data_fp"):
        read_arguments("pick", {"task_plans": [pick]})
    with refused("render_mode", "human"):
        gymnasium.make("PickSubtaskTrain-v0", render_mode="human")
    with refused(said="needs task_plans"):
        read_arguments("pick", {"spawn_data_fp": "x.pt"})


def test_arguments_without_meaning_are_told_once(caplog: Any) -> None:
    with caplog.at_level(logging.WARNING, "mjhab"):
        for _ in range(2):
            read_arguments("pick", {"viewer_camera_configs": {"fov": 1}})
    told = [text for text in caplog.messages if "viewer_camera_configs" in text]
    assert len(told) <= 1
    assert read_arguments("pick", {"sim_backend": "gpu"}).backend == "auto"
    assert read_arguments("pick", {"sensor_configs": {"width": 224}}).camera_size == (
        128,
        224,
    )


def test_homes_are_built_anew_by_the_number_of_worlds_unless_told() -> None:
    for given, anew in (
        ({}, True),
        ({"reconfiguration_freq": None, "num_envs": 2}, False),
        ({"num_envs": 2, "reconfiguration_freq": 1}, True),
        ({"reconfiguration_freq": 0}, False),
    ):
        assert read_arguments("pick", given).redraws_homes is anew, given


def test_limits_become_our_options() -> None:
    configs = default_configs("")
    ours = overrides_of(configs, ("pick", "place", "open", "close", "navigate"))
    assert ours["pick.force_limit"] == 5000 and ours["open_fraction_door"] == 0.75
    assert ours["goal_tol"] == 0.15 and ours["ignore_arm"] is False
    configs["place"].update({"goal_type": "zone", "ee_rest_thresh": 0.1})
    assert overrides_of(configs, ("place",))["goal_type"] == "zone"
    with refused("task_cfgs: ee_rest_thresh"):
        overrides_of(configs, ("pick", "place"))


def test_poses_multiply_and_invert() -> None:
    generator = torch.Generator().manual_seed(0)
    quat = torch.nn.functional.normalize(torch.randn(5, 4, generator=generator), dim=1)
    pose = PoseBatch.create_from_pq(torch.randn(5, 3, generator=generator), quat)
    whole = pose.to_transformation_matrix()
    assert torch.allclose(
        (pose * pose.inv()).to_transformation_matrix(),
        torch.eye(4).expand(5, 4, 4),
        atol=1e-5,
    )
    assert torch.allclose(
        (pose * pose).to_transformation_matrix(), whole @ whole, atol=1e-5
    )
