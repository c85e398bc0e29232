"""Sets of starts: written once, read by others, bound to their layout, continued after an interruption."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjhab.cli.main import main
from mjhab.config.env import EnvConfig
from mjhab.config.thresholds import task_config
from mjhab.episodes.rosters import roster
from mjhab.episodes.spawn_factory import CHUNK, SpawnFactory, make_set, partial_folder
from mjhab.episodes.spawn_sets import (
    SpawnRecipe,
    SpawnRow,
    SpawnSet,
    check_size,
    layout_digest,
    write,
)
from mjhab.episodes.spawns import ARM_NOISE
from mjhab.episodes.starts import StartMaker
from mjhab.layout.layout import Layout
from mjhab.robots.fetch.robot import ROBOT
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from tests.refusals import refused

RECIPE = SpawnRecipe(
    "set_table", "pick", "024_bowl", "train", seed=0, count=CHUNK + 8, pool=2
)


def quiet(done: int, fallbacks: int) -> None:
    """Tell nobody."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> SpawnSet:
    return make_set(RECIPE, tmp_path_factory.mktemp("sets") / "bowl.npz", 1, quiet)


@pytest.fixture(scope="module")
def layout() -> Layout:
    return Layout(open_pack("builtin"), roster("set_table"))


def test_a_set_gives_the_starts_it_was_made_of(made: SpawnSet, layout: Layout):
    found = SpawnSet.load(made.path, layout)
    assert (
        len(found) == RECIPE.count
        and found.recipe == RECIPE
        and found.digest == made.digest
    )
    assert found.fallbacks == 0 and len(found.homes) <= 2
    assert not partial_folder(made.path).exists()
    factory = SpawnFactory(RECIPE)
    for index in (0, 5, CHUNK, RECIPE.count - 1):
        row = found.row(index)
        own = factory.row(index)
        np.testing.assert_array_equal(row.qpos, own.qpos)
        np.testing.assert_array_equal(row.episode.object_pose, own.episode.object_pose)
        assert (
            row.episode.targets == own.episode.targets
            and row.episode.home == own.episode.home
        )
        assert (row.position, row.fallback, row.tries) == (
            own.position,
            own.fallback,
            own.tries,
        )


def test_an_environment_starts_from_the_set(made: SpawnSet, layout: Layout):
    config = EnvConfig(
        task="set_table", subtask="pick", target="024_bowl", spawns=str(made.path)
    )
    sim = CpuSimulator(layout, 1, 1)
    maker = StartMaker(sim, config, task_config(config, ROBOT))
    assert maker.spawn_set is not None
    for index in (3, 1 << 20):
        episode = maker.spawn_set.episode(7, index)
        assert (episode.seed, episode.index) == (7, index)
        start = maker.start(episode)
        row = maker.spawn_set.row(index)
        np.testing.assert_array_equal(start.qpos, row.qpos)
        assert (
            start.plan.subtasks[0].obj.startswith("024_bowl")
            and start.home == row.episode.home
        )
    online = StartMaker(
        sim,
        EnvConfig(task="set_table", subtask="pick", target="024_bowl"),
        maker.task_config,
    )
    np.testing.assert_array_equal(
        online.start(made.row(3).episode).qpos, made.row(3).qpos
    )


def test_rows_beyond_the_last_are_drawn_evenly(made: SpawnSet):
    numbers = [
        made.number(world * (1 << 20) + k) for world in range(1, 16) for k in range(40)
    ]
    assert max(numbers) < len(made)
    assert np.bincount(numbers, minlength=len(made)).min() >= 4
    assert [made.number(k) for k in range(5)] == [0, 1, 2, 3, 4]


def test_another_layout_is_refused_with_both_hashes(made: SpawnSet):
    other = Layout(open_pack("builtin"), roster("tidy_house"))
    with refused(where=made.path, said=made.header["layout"]) as error:
        SpawnSet.load(made.path, other)
    assert layout_digest(other) in str(error.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"subtask": "open", "target": ""}, "subtask 'pick'"),
        ({"target": ""}, "target"),
        ({"split": "val"}, "split"),
        ({"spawn_rule": "published"}, "spawn_rule"),
    ],
)
def test_another_purpose_is_refused(made: SpawnSet, change: dict[str, Any], words: str):
    options: dict[str, Any] = {
        "task": "set_table",
        "subtask": "pick",
        "target": "024_bowl",
    }
    config = EnvConfig(**options | change)
    with refused(said=words):
        made.check(config)


@pytest.mark.usefixtures("few_carry_postures")
def test_a_published_set_names_the_arms_it_was_drawn_from():
    recipe = SpawnRecipe(
        "set_table", "place", "013_apple", "train", 0, 2, pool=1, spawn_rule="published"
    )
    factory = SpawnFactory(recipe)
    apples = factory.starts.arms
    assert factory.header()["grasps"]["013_apple"] == apples.digest("013_apple")
    robot = factory.row(1).qpos[factory.sim.addresses.robot_q]
    away = [
        np.abs(robot[list(ROBOT.arm_columns)] - one.arm).max()
        for one in apples.arms("013_apple")
    ]
    assert min(away) <= ARM_NOISE[1] + 1e-9
    assert (
        SpawnFactory(replace(recipe, spawn_rule="front_box")).header()["grasps"]
        != factory.header()["grasps"]
    )


def test_damaged_files_are_refused(made: SpawnSet, tmp_path: Path):
    whole = made.path.read_bytes()
    broken = tmp_path / "broken.npz"
    for content in (whole[: len(whole) // 2], whole[:-30], b"", b"no zip at all"):
        broken.write_bytes(content)
        with refused(where="broken.npz"):
            SpawnSet.read(broken)
    with np.load(made.path) as data:
        arrays = dict(data)
    arrays["qpos"] = arrays["qpos"] + 1e-9
    np.savez(broken, **arrays)
    with refused(where="broken.npz", said="not what its header says"):
        SpawnSet.read(broken)
    np.savez(broken, something=np.zeros(3))
    with refused(where="broken.npz", said="no spawn set"):
        SpawnSet.read(broken)
    with refused(said="there is no file"):
        SpawnSet.read(tmp_path / "nothing.npz")


def forged(value: Any) -> Callable[[np.ndarray], np.ndarray]:
    def change(column: np.ndarray) -> np.ndarray:
        if isinstance(value, str):
            return np.full(column.shape, value)
        column = column.copy()
        column[0] = value
        return column

    return change


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("home", forged("../../x"), r"column 'home' must be a name"),
        ("home", forged("/etc/x"), r"column 'home' must be a name"),
        ("targets", forged("a b"), r"column 'targets' must be a name"),
        ("qpos", forged(np.nan), r"column 'qpos' has numbers that are not finite"),
        (
            "object_pose",
            forged(1e300),
            r"column 'object_pose' must be in the range",
        ),
        ("points", forged(-5000.0), r"column 'points' must be in the range"),
        (
            "link_q",
            lambda column: column[:-1],
            "column 'link_q' has shape (39, 9), which does not fit",
        ),
        ("qpos", lambda column: column[:, 0], r"column 'qpos' has shape"),
        (
            "position",
            lambda column: column.astype(float),
            r"column 'position' is float64",
        ),
    ],
)
def test_made_up_starts_are_refused(
    made: SpawnSet,
    tmp_path: Path,
    name: str,
    change: Callable[[np.ndarray], np.ndarray],
    message: str,
):
    header = {key: value for key, value in made.header.items() if key != "digest"}
    path = tmp_path / "forged.npz"
    write(path, header, {**made.columns, name: change(made.columns[name])})
    with refused(where="forged.npz", said=message):
        SpawnSet.read(path)


def test_a_set_that_could_not_be_read_is_not_written(
    made: SpawnSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with refused(said=("10,000,000 starts takes", "2,048", "at most", "starts")):
        check_size(made.columns, 10_000_000)
    size = sum(column.nbytes for column in made.columns.values())
    monkeypatch.setattr("mjhab.episodes.spawn_sets._MAX_COLUMNS_BYTES", size - 1)
    rows = len(made.columns["home"])
    with refused(said=f"make at most {rows - 1} starts"):
        write(tmp_path / "a.npz", made.header, made.columns)
    assert not list(tmp_path.iterdir())


def test_a_set_that_will_be_too_large_is_refused_before_it_is_made(
    tmp_path: Path,
) -> None:
    with refused(said="a spawn set of 1,000,000,000 starts"):
        make_set(replace(RECIPE, count=10**9), tmp_path / "a.npz", 1, quiet)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("field", ["task", "split", "subtask", "target"])
def test_a_recipe_with_a_name_that_is_none_is_refused(
    made: SpawnSet, tmp_path: Path, field: str
):
    header = {key: value for key, value in made.header.items() if key != "digest"}
    header["recipe"] = {**header["recipe"], field: "../x"}
    path = tmp_path / "forged.npz"
    write(path, header, made.columns)
    with refused(where="forged.npz", said=f"recipe, {field} must be a name"):
        SpawnSet.read(path)


def test_threads_and_interruptions_change_nothing(
    made: SpawnSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    out = tmp_path / "again.npz"
    row = SpawnFactory.row

    def stop_late(factory: SpawnFactory, index: int) -> SpawnRow:
        if index == CHUNK + 2:
            raise KeyboardInterrupt
        return row(factory, index)

    monkeypatch.setattr(SpawnFactory, "row", stop_late)
    with pytest.raises(KeyboardInterrupt):
        make_set(RECIPE, out, 2, quiet)
    assert not out.exists() and partial_folder(out).is_dir()
    asked: list[int] = []

    def note(factory: SpawnFactory, index: int) -> SpawnRow:
        asked.append(index)
        return row(factory, index)

    monkeypatch.setattr(SpawnFactory, "row", note)
    other = SpawnRecipe("set_table", "pick", "013_apple", "train", seed=0, count=1)
    with refused(where="again.npz.partial", said="other options"):
        make_set(other, out, 1, quiet)
    again = make_set(RECIPE, out, 2, quiet)
    assert sorted(asked) == list(range(CHUNK, RECIPE.count))
    assert again.digest == made.digest
    with refused(where="again.npz", said="exists"):
        make_set(RECIPE, out, 1, quiet)
    with refused("out", expected=".npz"):
        make_set(RECIPE, tmp_path / "set.h5", 1, quiet)
    assert make_set(other, out, 1, quiet, overwrite=True).recipe == other


def machine(capsys: pytest.CaptureFixture[str], *args: str) -> dict[str, Any]:
    assert main([*args, "--json"]) == 0
    return json.loads(capsys.readouterr().out.strip().splitlines()[-1])


def test_commands(capsys: pytest.CaptureFixture[str], made: SpawnSet, tmp_path: Path):
    out = tmp_path / "sets" / "close.npz"
    told = machine(
        capsys,
        "spawns",
        "make",
        "--out",
        str(out),
        *"--subtask close --count 3 --pool 1 --threads 1".split(),
    )
    assert (told["count"], told["subtask"], told["fallbacks"]) == (3, "close", 0)
    (out.parent / "half.npz").write_bytes(made.path.read_bytes()[:100])
    listed = machine(capsys, "spawns", "list", str(out.parent))
    assert [one["digest"] for one in listed["sets"]] == [told["digest"]]
    assert len(listed["unreadable"]) == 1 and "half.npz" in listed["unreadable"][0]
    assert main(["spawns", "list", str(out)]) == 0
    table = capsys.readouterr().out
    assert "close" in table and "1 sets" in table
    assert (
        main(["spawns", "make", "--out", str(tmp_path / "wave.npz"), "--subtask", "wave"])
        == 2
    )
    assert "unknown subtask" in capsys.readouterr().err
    assert main(["spawns", "list", str(tmp_path / "nothing")]) == 2


def test_starts_share_the_arrangements_of_the_pool() -> None:
    factory = SpawnFactory(RECIPE)
    assert factory.header()["grasps"] == {}
    np.testing.assert_array_equal(
        factory.episode(0).object_pose, factory.episode(2).object_pose
    )
    assert (factory.episode(0).object_pose != factory.episode(1).object_pose).any()
