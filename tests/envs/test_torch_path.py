"""The code of the step on torch tensors: the values of numpy, the right types, and nothing a GPU would wait for."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import mjhab.envs as envs
from mjhab.core.arrays import map_record, to_numpy
from mjhab.envs.device.fields import GoalFields
from mjhab.envs.observations.entry import CameraInputs
from mjhab.envs.observations.state import state_observation, state_table
from mjhab.envs.parts.nav_distance import NavDistance
from mjhab.envs.parts.plan_tables import Rows, look_up
from mjhab.envs.parts.rewarding import Rewarder, RewardInputs, RewardRules
from mjhab.envs.parts.sensing import Sensing
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.robots.controllers import BASES, CONTROL_MODES, make_controller
from mjhab.robots.fetch.model import REST_QPOS
from mjhab.sim.protocol import SimState
from mjhab.tasks import label_state
from mjhab.tasks import progress as progress_rules
from mjhab.tasks.labelling import events, labels
from mjhab.tasks.measure import measure
from mjhab.tasks.plan import SubtaskKind
from mjhab.tasks.scoring import RewardOptions
from mjhab.tasks.subtasks.registry import name_of
from tests.no_sync import NoSync
from tests.refusals import refused

WORLDS = 8
STEPS = 4
TOLERANCE = {torch.float64: 1e-12, torch.float32: 2e-5}
"""Largest difference [SI units] from numpy, beside the same share of the value."""
DTYPES = list(TOLERANCE)


def as_torch(value: Any, dtype: torch.dtype) -> Any:
    """Arrays, records and dicts of arrays as tensors: float of ``dtype``, int64, bool; images keep their type."""
    if dataclasses.is_dataclass(value):
        return map_record(lambda field: as_torch(field, dtype), value)
    if isinstance(value, dict):
        return {name: as_torch(array, dtype) for name, array in value.items()}
    tensor = torch.from_numpy(np.ascontiguousarray(value))
    return tensor.to(dtype) if tensor.dtype == torch.float64 else tensor


def assert_same(found: Any, wanted: Any, dtype: torch.dtype, name: str = "") -> None:
    """``found`` has the values of numpy's ``wanted``, floats to the tolerance of ``dtype``, and numbers of its type."""
    if dataclasses.is_dataclass(wanted):
        for field in dataclasses.fields(wanted):
            old = getattr(wanted, field.name)
            if old is not None:
                assert_same(
                    getattr(found, field.name), old, dtype, f"{name}.{field.name}"
                )
    elif isinstance(wanted, dict):
        assert list(found) == list(wanted)
        for key, old in wanted.items():
            assert_same(found[key], old, dtype, f"{name}[{key}]")
    elif isinstance(wanted, bool):
        # Whether any world needs a part of the work: on the device that is not asked, and the answer is True.
        assert found is True, name
    else:
        kinds = {
            "f": (dtype, torch.float32),
            "i": (torch.int64, torch.int32, torch.int16),
            "b": (torch.bool,),
        }
        assert found.dtype in {**kinds, "u": (torch.uint8,)}[wanted.dtype.kind], name
        assert tuple(found.shape) == wanted.shape, name
        tolerance = (
            max(TOLERANCE[dtype], 1e-6)
            if wanted.dtype == np.float32
            else TOLERANCE[dtype]
        )
        np.testing.assert_allclose(
            to_numpy(found), wanted, rtol=tolerance, atol=tolerance, err_msg=name
        )


@pytest.fixture(
    scope="module",
    params=[("set_table", "sphere"), ("tidy_house", "zone")],
    ids=["set_table", "zone"],
)
def history(request: pytest.FixtureRequest) -> tuple[SequentialTaskEnv, list[SimState]]:
    """An environment and its states while it moves at random."""
    task, goal_type = request.param
    env: SequentialTaskEnv = envs.make(
        task=task,
        num_envs=WORLDS,
        threads=1,
        autoreset="disabled",
        overrides={"goal_type": goal_type},
    )
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    states = []
    for _ in range(STEPS):
        for _ in range(5):
            env.step(rng.uniform(-1, 1, (WORLDS, env.controller.dim)))
        states.append(_touched(map_record(np.copy, env.state), env, rng))
    return env, states


def _touched(
    state: SimState, env: SequentialTaskEnv, rng: np.random.Generator
) -> SimState:
    """The state with forces, touches and open links, of which random motions bring few."""
    low, high = np.array([ref.link.range for ref in env.layout.links]).T
    return dataclasses.replace(
        state,
        finger_force=rng.normal(0.0, 5.0, state.finger_force.shape),
        finger_net=rng.exponential(20.0, state.finger_net.shape),
        link_force=rng.exponential(20.0, state.link_force.shape),
        touch=rng.random(state.touch.shape) < 0.5,
        link_q=rng.uniform(low, high, state.link_q.shape),
        object_vel=rng.normal(0.0, 0.5, state.object_vel.shape),
    )


def pointers(
    env: SequentialTaskEnv, rng: np.random.Generator, kind: SubtaskKind | None = None
) -> np.ndarray:
    """(W,) places in the plans, one past the end included; with a kind: only of subtasks of it."""
    length = env.tables.arrays.length
    if kind is None:
        return rng.integers(0, length + 1)
    return np.array(
        [rng.choice(np.flatnonzero(row == kind)) for row in env.tables.arrays.kind]
    )


class Follower:
    """What a step computes after physics, in one library."""

    def __init__(
        self,
        env: SequentialTaskEnv,
        like: Any,
        kinds: list[SubtaskKind],
        mode: str,
        published: bool,
    ) -> None:
        layout = env.layout
        self.robot = layout.robot
        addresses = env.sim.addresses
        stillness = "published" if published else "absolute"
        # A subtask alone is judged continuously, as in training.
        self.config = dataclasses.replace(
            env.task_config, continuous=len(kinds) == 1, stillness=stillness
        )
        options = (
            RewardOptions(formula="published", normaliser="published")
            if published
            else RewardOptions()
        )
        self.sensing = Sensing(layout, addresses, WORLDS, like)
        names = [name_of(kind) for kind in kinds]
        rules = RewardRules(self.config, mode, options, kinds=names)
        self.rewarder = Rewarder(WORLDS, rules, layout, self.sensing, like)
        self.notes: label_state.LabelState | None = None

    def step(
        self, state: SimState, tables: Rows, progress: Any, joint_start: Any
    ) -> dict[str, Any]:
        focus = look_up(tables, progress.pointer, self.config)
        world = self.sensing.world_state(state, tables, focus, joint_start)
        progress = progress_rules.accumulate(
            progress, world.robot_force, world.fingers_force
        )
        signals = measure(world, tables.arrays, progress, self.config, focus.active)
        after, outcome = progress_rules.advance(
            progress, signals, tables.arrays, self.config
        )
        inputs = RewardInputs(state, world, signals, focus, progress)
        reward, terms = self.rewarder.step(inputs)
        self.rewarder.begin(outcome.ended, inputs)
        context = self.sensing.context(state, focus, signals)
        before = label_state.start(signals) if self.notes is None else self.notes
        self.notes = label_state.restart(
            label_state.update(before, signals), outcome.ended, signals
        )
        return {
            "focus": focus,
            "world": world,
            "signals": signals,
            "after": after,
            "outcome": outcome,
            "restarted": progress_rules.reset_rows(
                after, outcome.ended, tables.arrays, self.config
            ),
            "reward": reward,
            "terms": terms,
            "context": context,
            "obs": state_observation(state_table(self.robot), context),
            "tcp": self.sensing.tcp_pose(state),
            "label": labels.label(self.notes, signals.kind),
            "events": events.edge_events(
                signals.kind, before.now, label_state.watch(signals)
            ),
        }


@given(seed=st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=30)
def test_the_compiled_sensing_has_the_bits_of_the_array_functions(
    history: tuple[SequentialTaskEnv, list[SimState]], seed: int
) -> None:
    """Random subtasks, finished plans among them, contacts, poses of any sign and numbers that are not finite."""
    env, states = history
    rng = np.random.default_rng(seed)
    state = _touched(states[int(rng.integers(len(states)))], env, rng)
    pose = state.object_pose * rng.choice((-1.0, 0.0, 1.0, np.nan), (1, 1, 7))
    state = dataclasses.replace(
        state, object_pose=pose, ee_contact=rng.random(state.ee_contact.shape) < 0.5
    )
    focus = look_up(env.tables, pointers(env, rng), env.task_config)
    plain = Sensing(env.layout, env.sim.addresses, WORLDS)
    assert type(env.sensing) is not Sensing
    assert env.signals is not None
    wanted, found = (
        (
            sensing.world_state(state, env.tables, focus, env.joint_start),
            sensing.context(state, focus, env.signals),
        )
        for sensing in (plain, env.sensing)
    )
    for have, want in zip(found, wanted, strict=True):
        for field in dataclasses.fields(want):
            assert_bits(getattr(have, field.name), getattr(want, field.name))


def assert_bits(found: np.ndarray, wanted: np.ndarray) -> None:
    assert found.dtype == wanted.dtype
    np.testing.assert_array_equal(found, wanted)
    if wanted.dtype.kind == "f":
        known = ~np.isnan(wanted)
        np.testing.assert_array_equal(np.signbit(found)[known], np.signbit(wanted)[known])


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_signs_of_quaternions_do_not_matter(
    history: tuple[SequentialTaskEnv, list[SimState]], dtype: torch.dtype
) -> None:
    """The base a full turn on, objects with the other quaternion: the same observation, as on numpy."""
    env, states = history
    state = states[-1]
    turn = np.zeros(state.robot_q.shape[1])
    turn[2] = 2 * np.pi
    flip = np.array([1.0, 1, 1, -1, -1, -1, -1])
    other = dataclasses.replace(
        state, robot_q=state.robot_q + turn, object_pose=state.object_pose * flip
    )
    like = torch.zeros(0, dtype=dtype)
    sensing = Sensing(env.layout, env.sim.addresses, WORLDS, like)
    seen = [
        state_observation(
            state_table(env.layout.robot),
            sensing.context(
                as_torch(each, dtype),
                as_torch(env.focus, dtype),
                as_torch(env.signals, dtype),
            ),
        )["state"]
        for each in (state, other)
    ]
    np.testing.assert_allclose(to_numpy(seen[0]), to_numpy(seen[1]), atol=2e-5)
    assert env.signals is not None
    on_numpy = state_observation(
        state_table(env.layout.robot), env.sensing.context(state, env.focus, env.signals)
    )["state"]
    np.testing.assert_allclose(to_numpy(seen[0]), on_numpy, atol=2e-5)


def follow_both(
    history: tuple[SequentialTaskEnv, list[SimState]],
    kind: SubtaskKind | None,
    mode: str,
    dtype: torch.dtype,
    published: bool = False,
) -> None:
    """Fold the states in numpy and in torch, at random places of the plans, and compare everything in every step."""
    env, states = history
    kinds = list(SubtaskKind) if kind is None else [kind]
    rows = Rows(
        env.tables.arrays,
        env.tables.obj,
        env.tables.link,
        env.tables.target,
        env.tables.held,
    )
    tensors = as_torch(rows, dtype)
    host = Follower(env, np.zeros(0), kinds, mode, published)
    device = Follower(env, torch.zeros(0, dtype=dtype), kinds, mode, published)
    rng = np.random.default_rng(2)
    begun = progress_rules.start(rows.arrays, env.task_config)
    for number, state in enumerate(states):
        progress = dataclasses.replace(
            begun, pointer=pointers(env, rng, kind), steps_left=rng.integers(1, 3, WORLDS)
        )
        given = (state, rows, progress, env.joint_start)
        wanted = host.step(*given)
        moved = (
            as_torch(state, dtype),
            tensors,
            as_torch(progress, dtype),
            as_torch(env.joint_start, dtype),
        )
        if number == 0:
            device.step(*moved)  # Constants go to the device once.
            device.rewarder.begin(torch.ones(WORLDS, dtype=torch.bool), None)  # type: ignore[arg-type]
            device.notes = None
        with NoSync() as watch:
            found = device.step(*moved)
        assert watch.seen > 100
        for name, part in wanted.items():
            assert_same(found[name], part, dtype, name=name)
        assert (
            found["obs"]["state"].dtype == torch.float32
            and found["reward"].dtype == dtype
        )


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "mode", ["dense", "normalized_dense", "sparse", "pointer", "none"]
)
def test_all_that_follows_physics_is_the_same(
    history: Any, mode: str, dtype: torch.dtype
) -> None:
    follow_both(history, None, mode, dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_what_is_judged_and_earned_as_published_is_the_same(
    history: Any, dtype: torch.dtype
) -> None:
    follow_both(history, None, "normalized_dense", dtype, published=True)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", list(SubtaskKind))
def test_the_reward_of_one_kind_is_the_same(
    history: Any, kind: SubtaskKind, dtype: torch.dtype
) -> None:
    env, _ = history
    if env.config.task == "tidy_house" and kind in (SubtaskKind.OPEN, SubtaskKind.CLOSE):
        assert not (env.tables.arrays.kind == kind).any()
        return
    follow_both(history, kind, "dense", dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("mode", CONTROL_MODES)
def test_every_control_mode_is_the_same(mode: str, base: str, dtype: torch.dtype) -> None:
    options: dict[str, Any] = {
        "base": base,
        "stationary": ("head",) if base == "holonomic" else (),
    }
    host = make_controller(mode, WORLDS, **options)
    device = make_controller(mode, WORLDS, like=torch.zeros(0, dtype=dtype), **options)
    rng = np.random.default_rng(3)
    q = np.array(REST_QPOS) + rng.normal(0.0, 0.2, (WORLDS, 15))
    everyone = np.ones(WORLDS, bool)
    some = np.arange(WORLDS) % 2 == 0
    for number in range(4):
        state: Any = _Pose(q)
        moved: Any = _Pose(as_torch(q, dtype))
        mask = everyone if number == 0 else some
        actions = rng.uniform(-1.2, 1.2, (WORLDS, host.dim)).astype(np.float32)
        if number == 0:  # Constants go to the device once.
            warm = make_controller(
                mode, WORLDS, like=torch.zeros(0, dtype=dtype), **options
            )
            warm.ctrl(warm.still(moved), moved)
        given = torch.from_numpy(actions)
        flags = torch.from_numpy(mask)
        host.reset(mask, state)
        with NoSync():
            device.reset(flags, moved)
            still = device.still(moved)
            command = device.ctrl(given, moved)
        assert_same(still, host.still(state), dtype)
        assert_same(command, host.ctrl(actions, state), dtype)
        assert still.dtype == torch.float32 and command.dtype == dtype
        q = q + rng.normal(0.0, 0.02, q.shape)
    world = host.get_state(3)
    device.set_state(3, world)
    assert all(isinstance(row, np.ndarray) for row in device.get_state(3).values())
    for name, row in device.get_state(3).items():
        np.testing.assert_allclose(row, world[name], atol=1e-6)


@dataclasses.dataclass(frozen=True)
class _Pose:
    robot_q: Any


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("mode", ["rgbd+seg", "pointcloud"])
def test_what_cameras_see_is_the_same(mode: str, dtype: torch.dtype) -> None:
    env: SequentialTaskEnv = envs.make(
        task="tidy_house",
        subtask="pick",
        num_envs=2,
        threads=1,
        obs_mode=mode,
        camera_size=(12, 16),
    )
    env.reset(seed=0)
    seer = env.observer
    pos, mat = seer.renderer.camera_poses(env.state, seer.cameras)
    outputs = ("depth", "rgb", "seg")
    images = seer.renderer.robot_views(
        env.state, env.homes, seer.size, outputs, seer.cameras
    )
    images["depth"][0, 0, 0, 0] = 40.0  # Farther than an int16 counts in millimetres.
    intrinsic = seer._intrinsic
    views = CameraInputs(
        env.layout.robot, images, pos, mat, env.state.robot_q[:, :3], intrinsic
    )
    moved = CameraInputs(
        env.layout.robot,
        *(
            as_torch(part, dtype)
            for part in (images, pos, mat, env.state.robot_q[:, :3], intrinsic)
        ),
    )
    rows = [
        entry for entry in seer.table if entry.key.startswith(("sensor", "pointcloud"))
    ]
    assert len(rows) >= 3
    for entry in rows:
        entry.compute(moved)
        with NoSync():
            found = entry.compute(moved)
        wanted = entry.compute(views)
        assert to_numpy(found).dtype == wanted.dtype == entry.dtype, entry.key
        tolerance = 1e-5 if wanted.dtype == np.float32 else 0
        np.testing.assert_allclose(
            to_numpy(found), wanted, atol=tolerance, rtol=tolerance, err_msg=entry.key
        )


@pytest.mark.parametrize("dtype", DTYPES)
def test_ways_to_goals_are_those_of_the_host_to_a_millimetre(
    history: Any, dtype: torch.dtype
) -> None:
    env, _ = history
    rng = np.random.default_rng(4)
    goals = [(env.homes[w], env.tables.arrays.goal_pos[w, 0]) for w in range(WORLDS)]
    asked: list[str] = []

    def maps(home: str) -> Any:
        asked.append(home)
        return env.starts.sampler.map(home)

    fields = GoalFields([*goals, goals[2]], maps, "cpu")
    assert sorted(asked) == sorted(set(env.homes)), "a map is asked for once"
    assert fields.index.dtype == torch.int64 and fields.index[-1] == fields.index[2]
    assert len(set(fields.index.tolist())) == WORLDS
    ways = NavDistance(env.layout, WORLDS, env.starts.sampler.map)
    for world, (home, goal) in enumerate(goals):
        ways.begin(world, home, goal[:2])
    for spread in (3.0, 9.0, 25.0):
        xy = rng.uniform(-spread, spread, (WORLDS, 2))
        moved = torch.from_numpy(xy).to(dtype)
        with NoSync():
            found = fields.at(fields.index[:WORLDS], moved)
        assert found.dtype == dtype
        np.testing.assert_allclose(to_numpy(found), ways.at(xy), atol=1e-3)
    nothing = fields.at(torch.full((WORLDS,), -1), moved)
    np.testing.assert_array_equal(to_numpy(nothing), np.zeros(WORLDS))
    assert GoalFields([], maps, "cpu").at(torch.full((1,), -1), moved[:1]).tolist() == [
        0.0
    ]


def test_a_table_of_ways_too_large_for_the_device_is_refused(
    history: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    env, _ = history
    monkeypatch.setattr("mjhab.envs.device.fields.MAX_BYTES", 1000)
    with refused(said="fewer starts"):
        GoalFields([(env.homes[0], (0.0, 0.0))], env.starts.sampler.map, "cpu")
