"""Start states from recorded whole tasks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mjhab
from mjhab.data.store.places import episodes
from mjhab.episodes.spawn_sets import SpawnSet
from tests.refusals import refused

EPISODES = 2


@pytest.fixture(scope="module")
def chains(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Whole tasks of a robot that stands still: it is teleported to the fridge, and Open begins."""
    out = tmp_path_factory.mktemp("chains") / "run"
    mjhab.generate(
        "zero",
        task="set_table",
        home="builtin_m0_00",
        episodes=EPISODES,
        horizon=4,
        worlds=1,
        profile="ms_hab",
        navigate="teleport",
        out=out,
    )
    return out


@pytest.fixture(scope="module")
def found(chains: Path, tmp_path_factory: pytest.TempPathFactory) -> SpawnSet:
    out = tmp_path_factory.mktemp("set") / "open.npz"
    return mjhab.chain_starts(chains, subtask="open", out=out)


def test_a_start_is_the_state_in_which_the_subtask_began(
    chains: Path, found: SpawnSet
) -> None:
    assert len(found) == EPISODES
    env = mjhab.make(
        task="set_table",
        subtask="open",
        home="builtin_m0_00",
        split="train",
        spawns=str(found.path),
        profile="ms_hab",
        num_envs=EPISODES,
        autoreset="disabled",
    )
    _, info = env.reset(seed=0, options={"episode": range(EPISODES)})
    for world, episode in enumerate(sorted(episodes(chains), key=lambda e: e.name)):
        active = episode.array("subtasks/active")
        position = int(active[-1])
        assert episode.record.plan[position].kind == "open"
        began = int(np.flatnonzero(active == position)[0])
        assert began > 0, "the teleport before it takes a control step"
        wanted = episode.array("states/qpos")[began]
        assert (env.sim.get_world(world)["qpos"] == wanted).all()
        (entry,) = info["episode_spec"][world]["plan"]
        assert entry["target"] == episode.record.plan[position].target
        assert info["instruction"][world]


def test_starts_may_lie_later_in_single_subtasks(tmp_path: Path) -> None:
    run = tmp_path / "run"
    scene = {"task": "set_table", "subtask": "open", "target": "fridge/top_door"}
    mjhab.generate("random", **scene, episodes=2, horizon=6, worlds=1, out=run)
    late = mjhab.chain_starts(run, subtask="open", after=(3, 5), out=tmp_path / "a.npz")
    assert len(late) == 4
    env = mjhab.make(
        **{**scene, "target": ""},
        split="train",
        spawns=str(late.path),
        num_envs=4,
        autoreset="disabled",
    )
    _, info = env.reset(seed=0, options={"episode": range(4)})
    stored = [
        episode.array("states/qpos")[step]
        for episode in sorted(episodes(run), key=lambda each: each.name)
        for step in (3, 5)
    ]
    for world, wanted in enumerate(stored):
        assert (env.sim.get_world(world)["qpos"] == wanted).all()
        (entry,) = info["episode_spec"][world]["plan"]
        assert (entry["kind"], entry["target"]) == ("open", "fridge/top_door")
    with refused("after", (60,), expected="less: no open of these"):
        mjhab.chain_starts(run, subtask="open", after=(60,), out=tmp_path / "none.npz")


def test_what_has_succeeded_is_no_start(tmp_path: Path) -> None:
    run = tmp_path / "run"
    scene = {"subtask": "close", "target": "kitchen_counter/drawer3"}
    mjhab.generate("expert", **scene, episodes=1, worlds=1, out=run)
    (episode,) = episodes(run)
    first = int(np.flatnonzero(episode.array("reward/success"))[0])
    with refused("after", (first + 1,)):
        mjhab.chain_starts(
            run, subtask="close", after=(first + 1,), out=tmp_path / "a.npz"
        )
    before = mjhab.chain_starts(
        run, subtask="close", after=(first, first + 1), out=tmp_path / "b.npz"
    )
    assert len(before) == 1


def test_the_file_says_what_it_is_for(found: SpawnSet) -> None:
    recipe = SpawnSet.read(found.path).recipe
    assert (recipe.task, recipe.subtask, recipe.split) == ("set_table", "open", "train")
    assert recipe.joint_dynamics == "published"


@pytest.mark.parametrize(
    ("options", "given", "expected"),
    [
        ({"subtask": "close"}, "close", "open/"),
        ({"subtask": "open", "target": "024_bowl"}, "open/024_bowl", "open/"),
        ({"subtask": "opne"}, "opne", "open"),
    ],
)
def test_a_subtask_that_did_not_begin_is_refused_with_those_that_did(
    chains: Path, tmp_path: Path, options: dict[str, str], given: str, expected: str
) -> None:
    with refused(said=given) as error:
        mjhab.chain_starts(chains, **options, out=tmp_path / "s.npz")
    assert expected in str(error.value)
    assert not (tmp_path / "s.npz").exists()


def test_starts_are_taken_from_whole_tasks_alone(tmp_path: Path) -> None:
    mjhab.generate(
        "zero", subtask="open", episodes=1, horizon=2, worlds=1, out=tmp_path / "open"
    )
    with refused("subtask", "open"):
        mjhab.chain_starts(tmp_path / "open", subtask="open", out=tmp_path / "s.npz")


def test_a_file_is_not_replaced_unasked(chains: Path, found: SpawnSet) -> None:
    with refused(where="open.npz", said="overwrite"):
        mjhab.chain_starts(chains, subtask="open", out=found.path)
    assert len(mjhab.chain_starts(chains, subtask="open", out=found.path, overwrite=True))


def test_a_filter_chooses_among_episodes_of_several_environments(
    chains: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    mjhab.generate(
        "zero",
        task="tidy_house",
        home="builtin_m0_00",
        episodes=1,
        horizon=4,
        worlds=1,
        profile="ms_hab",
        navigate="teleport",
        out=other,
    )
    both = (chains, other)
    with refused(said="'set_table'") as error:
        mjhab.chain_starts(both, subtask="open", out=tmp_path / "s.npz")
    assert "'tidy_house'" in str(error.value)
    found = mjhab.chain_starts(
        both, subtask="open", where="task == 'set_table'", out=tmp_path / "s.npz"
    )
    assert len(found) == EPISODES
