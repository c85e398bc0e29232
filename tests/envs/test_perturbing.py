"""Perturbations: what each axis changes, and that nothing else does; refusals; plug-ins."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjhab
import mjhab.envs as envs
from mjhab.config.env import EnvConfig
from mjhab.config.perturbing import (
    AXES,
    LEVELS,
    PERTURBATIONS,
    Drawn,
    Perturbation,
    PerturbationPlan,
    Quantity,
    axes_text,
    parse_axes,
)
from mjhab.core.errors import UsageError
from mjhab.core.joints import BASE_XY
from mjhab.core.rotations import pose_inv, pose_mul
from mjhab.envs.perturbations.language import with_synonym, with_typo
from mjhab.envs.perturbations.pixels import blur, light_table, recolour, relight
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.episodes.moved_furniture import (
    Things,
    carried,
    is_possible,
    is_version,
    moved_pieces,
    version_name,
    with_moved_furniture,
)
from mjhab.robots.fetch.robot import ROBOT
from mjhab.scenes.freespace import shared_map
from mjhab.scenes.spec import Geom
from mjhab.tasks.subtasks.registry import SUBTASKS

PAGE = Path(__file__).parents[2] / "docs" / "perturbations.md"
SIDE = 32
RGB = "sensor_data/fetch_head/rgb"
DEPTH = "sensor_data/fetch_head/depth"
NEAR = "sensor_data/fetch_head/target_depth"
NEAR_RGB = "sensor_data/fetch_head/target_rgb"
SEEN = "rgbd+target_depth+target_rgb"


def build(perturb: Any = "", **options: Any) -> SequentialTaskEnv:
    usual = {"task": "tidy_house", "subtask": "pick", "num_envs": 1, "threads": 1}
    return envs.make(**{**usual, "autoreset": "disabled", "perturb": perturb, **options})


def begin(env: SequentialTaskEnv, *indices: int, seed: int = 0) -> tuple[dict, dict]:
    return env.reset(seed=seed, options={"episode": np.array(indices)})


def walk(env: SequentialTaskEnv, steps: int, seed: int = 5) -> tuple[dict, dict]:
    """Some control steps with the same actions in every world."""
    random = np.random.default_rng(seed)
    obs: dict = {}
    info: dict = {}
    for _ in range(steps):
        action = random.uniform(-1, 1, (1, ROBOT.action.dim)).astype(np.float32)
        obs, _, _, _, info = env.step(np.repeat(action, env.num_envs, axis=0))
    return obs, info


@pytest.fixture(scope="module")
def clean() -> dict[str, Any]:
    """Observations, sentence and state of the episode without perturbations, at its start and after some steps."""
    env = build(obs_mode=SEEN, camera_size=SIDE)
    first, info = begin(env, 3)
    start = env.state_digest(0)
    last, _ = walk(env, 4)
    spec = info["episode_spec"][0]
    assert "perturbation" not in spec
    found = {"first": first, "last": last, "spec": spec, "start": start}
    found["end"] = env.state_digest(0)
    env.close()
    return found


def perturbed(axes: str, steps: int = 4) -> dict[str, Any]:
    """The same of the episode with perturbations."""
    env = build(axes, obs_mode=SEEN, camera_size=SIDE)
    first, info = begin(env, 3)
    start = env.state_digest(0)
    last, _ = walk(env, steps)
    found = {"first": first, "last": last, "spec": info["episode_spec"][0]}
    found |= {"start": start, "end": env.state_digest(0)}
    env.close()
    return found


def same(one: Mapping[str, Any], other: Mapping[str, Any], *keys: str) -> bool:
    return all(np.array_equal(one[key], other[key]) for key in keys)


# -- what is asked for -------------------------------------------------------------------------------------------------


def test_axes_are_read_in_one_form() -> None:
    config = EnvConfig(perturb="noise:2, camera:3", randomise={"light": 1})
    assert (config.perturb, config.randomise) == ("camera:3,noise:2", "light:1")
    assert axes_text(parse_axes({"noise": 2, "camera": 3})) == config.perturb
    assert parse_axes("all:2") == dict.fromkeys(AXES, 2)
    assert not EnvConfig().perturbations and parse_axes(" , ") == {}


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ("camrea:3", "unknown axis of perturbation 'camrea'. Did you mean 'camera'?"),
        ("camrea", "Did you mean 'camera'"),
        ("camera:6", "level of camera must be 1 to 5, got 6"),
        ("camera:0", "level of camera must be 1 to 5, got 0"),
        ("camera", "perturb must be AXIS:LEVEL"),
        ("camera:a", "perturb must be AXIS:LEVEL"),
        ("all:2,noise:1", "unknown axis of perturbation 'all'"),
        ("camera:1,camera:2", "names 'camera' twice"),
        ({"camera": True}, "level of camera must be 1 to 5"),
        ({"camera": 2.0}, "level of camera must be 1 to 5"),
        (3, "perturb must be a text or a mapping"),
    ],
)
def test_what_is_none_is_refused(asked: Any, words: str) -> None:
    with pytest.raises(UsageError, match=re.escape(words)):
        EnvConfig(perturb=asked)
    with pytest.raises(UsageError, match="fixed or drawn"):
        EnvConfig(perturb="light:1", randomise="light:2")


def test_levels_are_numbers_that_grow() -> None:
    assert set(PERTURBATIONS) >= set(AXES)
    for name in AXES:
        axis = PERTURBATIONS[name]
        assert axis.name == name and axis.about and axis.hooks and axis.quantities
        for key, quantity in axis.quantities.items():
            falling = key == "gap"
            levels = quantity.levels[::-1] if falling else quantity.levels
            assert len(levels) == LEVELS and list(levels) == sorted(levels)


def test_what_reaches_a_policy() -> None:
    """A policy that sees depth and reads nothing, and one of each kind more."""
    wanted = {
        ((), False): {"layout", "start", "noise"},
        (("depth",), False): {"camera", "layout", "start", "noise"},
        (("rgb",), False): {*AXES} - {"language"},
        ((), True): {"layout", "start", "noise", "language"},
    }
    for (images, reads), axes in wanted.items():
        assert {a for a in AXES if PERTURBATIONS[a].reaches(images, reads)} == axes


def test_the_page_lists_the_numbers() -> None:
    page = PAGE.read_text(encoding="utf-8")
    for name in AXES:
        for key, quantity in PERTURBATIONS[name].quantities.items():
            numbers = " | ".join(f"{value:g}" for value in quantity.levels)
            row = f"| {name} | {key} | {quantity.meaning} | {quantity.unit or '-'} | {numbers} |"
            assert row in page, row


def test_draws_depend_on_seed_index_axis_and_level_alone() -> None:
    both = PerturbationPlan({"camera": 3, "noise": 2}, {})
    alone = PerturbationPlan({"camera": 3}, {})
    (camera, _), (again,) = both.drawn(1, 7, ROBOT), alone.drawn(1, 7, ROBOT)
    assert camera == again
    others = [
        alone.drawn(2, 7, ROBOT),
        alone.drawn(1, 8, ROBOT),
        PerturbationPlan({"camera": 4}, {}).drawn(1, 7, ROBOT),
    ]
    turns = [one.values["fetch_head"]["turn"] for (one,) in [(again,), *others]]
    unit = [np.array(turn) / np.linalg.norm(turn) for turn in turns]
    assert all(not np.allclose(unit[0], other) for other in unit[1:])


def test_random_levels_are_drawn_per_episode() -> None:
    plan = PerturbationPlan({}, {"noise": 2, "camera": 5})
    levels = [
        {one.axis: one.level for one in plan.drawn(0, index, ROBOT)}
        for index in range(60)
    ]
    # Level 0 leaves an axis out.
    assert {each.get("noise", 0) for each in levels} == {0, 1, 2}
    assert {each.get("camera", 0) for each in levels} == {0, 1, 2, 3, 4, 5}


# -- what changes, and what does not -----------------------------------------------------------------------------------


def test_pictures_change_and_nothing_else(clean: dict[str, Any]) -> None:
    state = ("state", "sensor_param/fetch_head/extrinsic_cv")
    for axes, changed in (
        ("camera:3", (RGB, DEPTH, NEAR, NEAR_RGB)),
        ("light:3", (RGB, NEAR_RGB)),
        ("colours:3", (RGB, NEAR_RGB)),
    ):
        found = perturbed(axes)
        assert (found["start"], found["end"]) == (clean["start"], clean["end"]), axes
        assert found["spec"]["instruction"] == clean["spec"]["instruction"]
        assert tuple(found["spec"]["perturbation"]) == (axes.partition(":")[0],)
        for moment in ("first", "last"):
            one, other = found[moment], clean[moment]
            assert same(one, other, *state), axes
            for key in (RGB, DEPTH, NEAR, NEAR_RGB):
                assert same(one, other, key) == (key not in changed), (axes, key)


def test_textures_are_those_of_others_of_the_same_kind() -> None:
    axis = PERTURBATIONS["colours"]
    image = np.arange(200) < 80
    found = {}
    for level in (1, 5):
        amounts = {n: q.levels[level - 1] for n, q in axis.quantities.items()}
        drawn = Drawn(0, 3, "colours", level, amounts)
        looks = found[level] = axis.looks(drawn, image)
        np.testing.assert_array_equal(image[looks], image)
        changed = (looks != np.arange(200)).mean()
        assert abs(changed - amounts["textures"]) < 0.1
    assert axis.looks(drawn, np.zeros(3, bool)).max() < 3


def test_materials_are_drawn_as_others(clean: dict[str, Any]) -> None:
    """Of a plugin that exchanges materials alone, which the rasterizer does not draw beyond the scene."""
    exchange = Exchange()
    with registered(exchange):
        found = perturbed("exchange:1", steps=1)
        assert not same(found["first"], clean["first"], RGB)
        assert same(found["first"], clean["first"], DEPTH)
        exchange.by = 0
        assert same(perturbed("exchange:1", steps=1)["first"], clean["first"], RGB)
        exchange.by = 10**6
        with pytest.raises(UsageError, match="looks must return"):
            perturbed("exchange:1", steps=1)


def test_noise_of_sensing_and_acting(clean: dict[str, Any]) -> None:
    found = perturbed("noise:4")
    assert found["start"] == clean["start"] and found["end"] != clean["end"]
    depth, true = found["first"][DEPTH], clean["first"][DEPTH]
    holes = (depth == 0) & (true > 0)
    assert 0.05 < holes.mean() < 0.2
    kept = ~holes & (true > 0)
    assert set(np.unique(depth[kept] % 20)) == {0}
    assert np.abs(depth[kept].astype(int) - true[kept]).max() <= 10
    assert not same(found["first"], clean["first"], RGB)
    near, there = found["first"][NEAR], clean["first"][NEAR]
    # The same holes, at the same places of the image, and no other distances.
    assert ((near == 0) & (there > 0)).any() and set(near[near != there]) == {0}
    assert not same(found["first"], clean["first"], NEAR_RGB)


def test_actions_come_late() -> None:
    """Without noise of their own, the states are those of the clean episode some steps before."""
    env = build()
    begin(env, 3)
    action = np.full((1, ROBOT.action.dim), 0.6, np.float32)
    still = env.controller.still(env.state)
    still[:, env.controller.gripper] = env.grip
    for each in (still, still, action):
        env.step(each)
    wanted = env.state_digest(0)
    env.close()
    late = Late()
    with registered(late):
        env = build("late:2")
        begin(env, 3)
        for _ in range(3):
            env.step(action)
        assert env.state_digest(0) == wanted
        env.close()


def test_language_says_the_same_in_other_words(clean: dict[str, Any]) -> None:
    found = perturbed("language:4", steps=1)
    assert found["start"] == clean["start"]
    assert found["spec"]["instruction"] != clean["spec"]["instruction"]
    assert found["spec"]["instructions"] == (found["spec"]["instruction"],)


SENTENCES = (
    "pick up the left master chef can from the right part of the kitchen counter",
    "set the bowl down on the dining table",
    "open the top right drawer of the kitchen counter",
    "move the soup can on the table to another place there",
    "set the table: put the bowl from the fridge on the dining table, then put the apple on the sofa",
    "sort the groceries",
)


def test_no_level_of_language_leaks_an_id_or_loses_the_request() -> None:
    axis = PERTURBATIONS["language"]
    seen: dict[int, set[str]] = {}
    for level in range(1, LEVELS + 1):
        amounts = {n: q.levels[level - 1] for n, q in axis.quantities.items()}
        for number, text in enumerate(SENTENCES):
            for index in range(20):
                drawn = Drawn(0, index, "language", level, amounts)
                said = axis.sentence(drawn, text, number)
                assert said == axis.sentence(drawn, text, number)
                assert said.isprintable() and not re.search(r"[_{}]|\d", said)
                if level == 1:
                    assert text in said and said != text
                seen.setdefault(level, set()).add(said)
    assert all(len(said) > 30 for said in seen.values())
    assert axis.sentence(Drawn(0, 0, "language", 5, amounts), "", 0) == ""


def test_synonyms_and_typing_errors() -> None:
    random = np.random.default_rng(0)
    said = {with_synonym("set the table", random) for _ in range(20)}
    assert said == {"lay the table"}
    said = {with_synonym(SENTENCES[3], random) for _ in range(60)}
    # "place" is a thing there, not what is asked for.
    assert all(text.endswith("another place there") for text in said)
    assert with_synonym("stare at it", random) == "stare at it"
    for _ in range(200):
        typed = with_typo("pick up the bowl", random)
        assert abs(len(typed) - 16) <= 1 and typed.startswith("p")
    assert with_typo("go to it", random) == "go to it"


def test_the_robot_starts_elsewhere(clean: dict[str, Any]) -> None:
    env = build("start:4", num_envs=2)
    _, info = begin(env, 3, 4)
    spec = info["episode_spec"][0]["perturbation"]["start"]
    assert np.hypot(*spec["base"][:2]) == pytest.approx(0.2)
    assert (
        spec["redrawn"] >= 0 and info["episode_spec"][0]["home"] == clean["spec"]["home"]
    )
    here = env.state.robot_q[0, BASE_XY].copy()
    env.close()
    env = build()
    begin(env, 3)
    there = env.state.robot_q[0, BASE_XY]
    # One control step of settling is part of a reset.
    np.testing.assert_allclose(here - there, spec["base"][:2], atol=1e-6)
    assert env.state_digest(0) == clean["start"]
    env.close()


def test_what_is_held_stays_in_the_hand() -> None:
    poses = []
    for axes in ("", "start:3"):
        env = build(axes, subtask="place")
        begin(env, 1)
        start = env.source.start(env.make_episode(0, 1))
        slot = env.layout.object_names.index(start.plan.subtasks[0].obj)
        own = int(env.sim.addresses.object_q[slot])
        hand = env.starts.sampler.scratch.tcp_pose(start.home, start.qpos)
        poses.append(pose_mul(pose_inv(hand), start.qpos[own : own + 7]))
        env.close()
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-9)


FEW: dict[str, Any] = {"split": "val", "home": "builtin_m3_0[0-2]"}


@pytest.fixture(scope="module")
def layouts() -> Iterator[tuple[SequentialTaskEnv, SequentialTaskEnv]]:
    """An environment with and one without perturbed layouts, in a few homes."""
    pair = build("layout:3", **FEW), build(**FEW)
    yield pair
    for env in pair:
        env.close()


def test_distractors_stand_beside_the_target(layouts: Any) -> None:
    env, plain = layouts
    pack = env.layout.pack
    kept = []
    for index in range(4):
        one, other = env.make_episode(0, index), plain.make_episode(0, index)
        told = one.perturbed["layout"]
        home, version = (pack.homes_by_name[each.home] for each in (other, one))
        # What stands on a chair is moved with it.
        pose = carried(pack, home, version, other.object_pose)
        apart = np.linalg.norm(one.object_pose[:, :3] - pose[:, :3], axis=1)
        assert (apart > 0.03).sum() == told.get("distractors", 0)
        targets = [env.layout.object_names.index(t.obj) for t in one.targets]
        assert (apart[targets] < 0.02).all()
        kept.append("kept" in told)
        # Where nothing fits beside the target the objects stay, and the record tells it.
        assert told["redrawn"] == 20 if kept[-1] else told["redrawn"] < 20
    assert any(kept) and not all(kept)


def test_chairs_are_moved_and_ways_stay_free(layouts: Any) -> None:
    """In a version of the home, which no episode is drawn in, and only where the episode stays possible."""
    env, plain = layouts
    pack = env.layout.pack
    found = {}
    for index in range(4):
        one, other = env.make_episode(0, index), plain.make_episode(0, index)
        told = one.perturbed["layout"]
        home, version = (pack.homes_by_name[each.home] for each in (other, one))
        pieces = moved_pieces(home, version)
        assert len(pieces) == told["moved"] and is_version(version) == bool(pieces)
        assert told["refused"] == 2 or pieces
        shifts = [np.subtract(b.pos, a.pos) for a, b in pieces]
        assert all(0.0 < np.hypot(*by[:2]) <= 0.3 and by[2] == 0 for by in shifts)
        found[index] = (one.home, pieces)
        free, before = (shared_map(h, pack).navigable().sum() for h in (version, home))
        assert free >= 0.9 * before
    assert any("chair_01" in {a.template for a, _ in p} for _, p in found.values())
    index = next(index for index, (_, pieces) in found.items() if pieces)
    _, info = begin(env, index)
    assert info["episode_spec"][0]["home"] == found[index][0]
    walk(env, 1)


def test_what_makes_an_episode_impossible_is_refused() -> None:
    """A piece on which an object stands or where it is to be put, and a version in which the base does not come."""
    pack = mjhab.open_pack("builtin")
    home = pack.homes_by_name["builtin_m3_00"]
    larger = with_moved_furniture(pack, [home.name], (0.3,))
    version = larger.homes_by_name[version_name(home.name, 0.3, 0)]
    nothing = Things(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2)))
    pieces = moved_pieces(home, version)
    before, after = next(pair for pair in pieces if pair[0].template == "chair_01")
    seat = larger.props["chair_01"].receptacles[0].pos[2]
    for x, y, z in ((*before.pos[:2], seat), (*after.pos[:2], 0.05)):
        place = np.array([[x, y, z + 0.03]])
        handled = nothing._replace(handled=place)
        assert not is_possible(larger, home, version, handled)
    # Other objects on a chair are moved with it.
    place = np.array([[*before.pos[:2], seat + 0.03]])
    assert is_possible(larger, home, version, nothing._replace(others=place))
    poses = np.array([[*place[0], 1.0, 0.0, 0.0, 0.0]])
    moved = carried(larger, home, version, poses)
    np.testing.assert_allclose(moved[0, :3], [*after.pos[:2], seat + 0.03])
    x0, y0, x1, y1 = home.floor
    wall = Geom("box", (0.05, (y1 - y0) / 2, 1.0), ((x0 + x1) / 2, (y0 + y1) / 2, 1.0))
    halved = dataclasses.replace(version, name="halved", walls=(*version.walls, wall))
    assert not is_possible(larger, home, halved, nothing)
    # What stands in front of a drawer keeps it shut.
    at = next(at for at in home.articulations if at.template == "kitchen_counter")
    out = np.array([np.cos(at.yaw), np.sin(at.yaw)]) * 0.5
    handle = (float(at.pos[0] + out[0]), float(at.pos[1] + out[1]))
    front = dataclasses.replace(before, pos=(*handle, before.pos[2]))
    props = tuple(front if at == before else at for at in home.props)
    shut = dataclasses.replace(home, name="shut", props=props)
    assert not is_possible(larger, home, shut, nothing)


# -- reproducible ------------------------------------------------------------------------------------------------------


def test_worlds_and_snapshots_do_not_matter() -> None:
    axes = "camera:2,noise:3,start:2"
    env = build(axes, num_envs=2, obs_mode="depth", camera_size=SIDE)
    begin(env, 4, 3)
    walk(env, 3)
    state = env.get_state(1)
    # A restored world is awake, see `CpuSimulator.get_world`.
    env.set_state(1, state)
    obs, _ = walk(env, 3, seed=6)
    wanted = env.state_digest(1)
    begin(env, 3, 4)
    env.set_state(0, state)
    again, _ = walk(env, 3, seed=6)
    assert env.state_digest(0) == wanted
    np.testing.assert_array_equal(again[DEPTH][0], obs[DEPTH][1])
    env.close()


def test_recorded_episodes_are_replayed_and_drawn_again(tmp_path: Path) -> None:
    asked = {"task": "tidy_house", "subtask": "pick", "horizon": 4, "worlds": 1}
    made = {"policy": "random", "episodes": 1, "per_target": 0, "threads": 1}
    axes = "camera:4,start:2,language:3,noise:2"
    images = {"images": "depth", "camera_size": SIDE}
    out = tmp_path / "set"
    mjhab.generate(out=out, perturb=axes, **made, **asked, **images)
    found = mjhab.replay(out, verify=True, worlds=1)
    assert (found.exact, found.episodes) == (1, 1)


# -- plug-ins and backends ---------------------------------------------------------------------------------------------


class Late(Perturbation):
    name = "late"
    about = "late actions"
    quantities = {"delay": Quantity("control steps", (1, 2, 3, 4, 5), "delay")}  # noqa: RUF012

    def delay(self, drawn: Drawn) -> int:
        return int(drawn.amounts["delay"])


class Exchange(Perturbation):
    name = "exchange"
    about = "materials in turn"
    by = 1

    def looks(self, drawn: Drawn, image: np.ndarray) -> np.ndarray:
        numbers = np.arange(len(image)) + self.by
        return numbers % len(image) if self.by < len(image) else numbers


class Broken(Perturbation):
    """Raises, or returns what it must not, where it is told."""

    name = "broken"
    about = "nothing good"

    def __init__(self, act: Any = None, said: Any = None, start: Any = None) -> None:
        self._act, self._said, self._start = act, said, start

    def act(self, drawn: Drawn, action: Any, frame: Any, step: int) -> Any:
        return action if self._act is None else self._act(action)

    def sentence(self, drawn: Drawn, text: str, number: int) -> str:
        return text if self._said is None else self._said(text)

    def start(self, drawn: Drawn, scene: Any, attempt: int) -> Any:
        return None if self._start is None else self._start(scene)


@contextmanager
def registered(axis: Perturbation) -> Iterator[None]:
    mjhab.register_perturbation(axis)
    try:
        yield
    finally:
        PERTURBATIONS.remove(axis.name)


def boom(*_: Any) -> Any:
    raise KeyError("no such thing")


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (Broken(act=boom), "'broken': act raised KeyError: 'no such thing'"),
        (Broken(act=lambda a: a[:3]), "act must return 13 finite numbers"),
        (Broken(act=lambda a: a * np.nan), "act must return 13 finite numbers"),
        (Broken(said=boom), "'broken': sentence raised KeyError"),
        (Broken(said=lambda text: ""), "sentence must return one line of text, got ''"),
        (Broken(said=lambda text: "a\nb"), "sentence must return one line of text"),
        (Broken(start=boom), "'broken': start raised KeyError"),
        (
            Broken(start=lambda scene: (np.zeros(3), {})),
            "start must return finite numbers",
        ),
    ],
)
def test_a_plugin_that_breaks_is_named(broken: Perturbation, words: str) -> None:
    with registered(broken):
        env = build("broken:1")
        with pytest.raises(UsageError, match=re.escape(words)):
            begin(env, 3)
            walk(env, 1)
        env.close()


def test_registering() -> None:
    class Nothing(Perturbation):
        name = "nothing"

    class Short(Late):
        quantities = {"delay": Quantity("", (1.0, 2.0), "two levels")}  # noqa: RUF012

    class Taken(Late):
        name = "camera"

    for axis, words in (
        (Nothing(), "changes nothing"),
        (Short(), "levels of delay must be 5 numbers"),
        (Taken(), "must be registered once: mjhab itself"),
        (Late, "Make one first"),
    ):
        with pytest.raises(UsageError, match=words):
            mjhab.register_perturbation(axis)  # type: ignore[arg-type]
    assert "late" not in PERTURBATIONS


def test_a_device_has_what_the_host_makes() -> None:
    PerturbationPlan({"start": 3, "language": 1}, {"layout": 2}).check_device()
    with pytest.raises(UsageError, match="does not perturb camera, noise, only") as no:
        PerturbationPlan({"start": 3, "camera": 1}, {"noise": 2}).check_device()
    assert no.value.given == ["camera", "noise"]


# -- pixels ------------------------------------------------------------------------------------------------------------


def test_pixels() -> None:
    every = np.repeat(np.arange(256, dtype=np.uint8).reshape(16, 16, 1), 3, axis=2)
    wall = np.full((16, 16), 2.0, np.float32)
    behind = np.array([0.0, 0.0, 1.0])

    def lit(side: float, gain: float, toward: np.ndarray = behind) -> np.ndarray:
        image = every.copy()
        table = light_table(np.full(3, gain), side)
        relight(image[None], wall[None], np.full(1, 16.0), toward[None], table, True)
        return image

    np.testing.assert_array_equal(lit(0.0, 1.0), every)
    brighter = lit(0.0, 2.0).astype(int)
    assert (brighter.ravel()[3:-3] > every.ravel()[3:-3]).all()
    # A wall across the line of sight: light from behind the camera falls on it, light from behind the wall does not.
    for one, other in (
        (lit(0.2, 1.0), lit(0.0, 1.6)),
        (lit(0.2, 1.0, -behind), lit(0.0, 0.8)),
    ):
        assert np.abs(one.astype(int) - other).max() <= 1
    image = every.copy()
    seg = np.zeros((16, 16), np.int32)
    seg[8:] = 1
    swap = np.eye(3, dtype=np.float32)
    recolour(image[None], seg[None], np.stack([swap, 0.0 * swap]))
    assert (image[:8] == every[:8]).all() and not image[8:].any()
    spot = np.zeros((9, 9, 3), np.uint8)
    spot[4, 4] = 200
    blur(spot[None], 1.0)
    assert 0 < spot[4, 5, 0] == spot[5, 4, 0] == spot[4, 3, 0] < spot[4, 4, 0] < 200
    np.testing.assert_array_equal(spot, spot[::-1, ::-1])
    plain = np.full((5, 5, 3), 77, np.uint8)
    blur(plain[None], 0.7)
    assert (plain == 77).all()


def test_light_from_a_side_throws_shadows() -> None:
    """A board 0.35 m in front of a wall, and light from behind the camera on the right: the shadow is on the left."""
    wall = np.full((64, 64), 2.0, np.float32)
    wall[:, 24:40] = 1.65
    table = light_table(np.ones(3), 0.5)
    toward = np.array([[0.6, 0.0, 0.8]])
    with_shadows, without = (
        np.full((64, 64, 3), 120, np.uint8),
        np.full((64, 64, 3), 120, np.uint8),
    )
    for image, shadows in ((with_shadows, True), (without, False)):
        relight(image[None], wall[None], np.full(1, 64.0), toward, table, shadows)
    darker = np.any(with_shadows < without, axis=2)
    # What would stand in the way beyond the edge of the image is not seen.
    darker = darker[16:48]
    assert darker[:, 18:22].all() and not darker[:, 26:38].any()
    assert not darker[:, :12].any() and not darker[:, 44:].any()


def test_every_subtask_begins_with_every_axis() -> None:
    """One control step of each kind with all axes at once."""
    axes = ",".join(f"{axis}:2" for axis in AXES)
    for kind in ("open", "close", "navigate"):
        assert kind in SUBTASKS
        env = build(axes, task="set_table", subtask=kind, **FEW)
        _, info = begin(env, 0)
        assert set(info["episode_spec"][0]["perturbation"]) == set(AXES)
        walk(env, 1)
        env.close()
