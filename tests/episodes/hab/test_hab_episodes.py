"""HAB episodes on a layout: the same start comes back from a file, real episodes rest where the file puts them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjhab.core.errors import UsageError
from mjhab.core.names import kind_of
from mjhab.core.rotations import mat_from_quat
from mjhab.envs import make
from mjhab.episodes.episode import Episode
from mjhab.episodes.generator import EpisodeMaker
from mjhab.episodes.hab.format import HabEpisode, HabFile, read_hab, write_hab
from mjhab.episodes.hab.reader import (
    FileEpisodes,
    file_roster,
    joint_positions,
    number_of_root,
    object_poses,
)
from mjhab.episodes.hab.writer import to_hab
from mjhab.episodes.homes import require_furniture
from mjhab.episodes.rosters import roster
from mjhab.layout.layout import Layout
from mjhab.scenes.pack_source import PackRequest
from mjhab.scenes.packs import open_pack
from mjhab.scenes.spec import Home
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.household.prepare_groceries import FRIDGE_PREOPEN_RAD
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.household.spec import TargetRule, TaskSpec
from tests.real_data import real_data
from tests.refusals import refused

PATH = Path("some.json.gz")


@cache
def world(task: str) -> tuple[CpuSimulator, Home, tuple[Episode, ...]]:
    """A simulator, one home and three episodes of a task in it."""
    pack = open_pack("builtin")
    sim = CpuSimulator(Layout(pack, roster(task)), 1, 1)
    maker = EpisodeMaker(sim, task, "train", home=pack.homes[0].name)
    return sim, pack.homes[0], tuple(maker.make(0, i)[0] for i in range(3))


def hab(task: str, k: int = 0) -> HabEpisode:
    sim, home, episodes = world(task)
    return to_hab(sim.layout, home, episodes[k])


def from_file(task: str, *episodes: HabEpisode, **options: Any) -> FileEpisodes:
    return FileEpisodes(world(task)[0], HabFile(episodes, path=PATH), task, **options)


@pytest.mark.parametrize("task", ["tidy_house", "prepare_groceries", "set_table"])
def test_an_episode_comes_back_from_its_file(task: str, tmp_path: Path) -> None:
    sim, _, episodes = world(task)
    path = tmp_path / "episodes.json.gz"
    write_hab(path, HabFile(tuple(hab(task, k) for k in range(len(episodes)))))
    source = FileEpisodes(sim, read_hab(path), task)
    assert sorted(file_roster(source.file, sim.layout.pack)) == sorted(sim.layout.roster)
    for k, made in enumerate(episodes):
        read, rest = source.settled(k)
        assert rest.fallen == () and rest.moved.max() < 0.003
        assert (read.home, read.task, read.split) == (made.home, task, "train")
        np.testing.assert_allclose(
            read.object_pose[:, :3], made.object_pose[:, :3], atol=0.003
        )
        np.testing.assert_allclose(read.link_q, made.link_q, atol=0.01)
        for a, b in zip(read.targets, made.targets, strict=True):
            assert (a.obj, a.start_link, a.goal_link) == (
                b.obj,
                b.start_link,
                b.goal_link,
            )
            np.testing.assert_allclose(a.goal_pos, b.goal_pos, atol=2e-6)
            np.testing.assert_allclose(a.start_pos, b.start_pos, atol=0.003)
            np.testing.assert_allclose(a.handle_pos, b.handle_pos)


def test_receptacles_are_found_without_the_lists() -> None:
    for task in ("set_table", "prepare_groceries"):
        whole = hab(task)
        bare = replace(
            whole, target_receptacles=(), goal_receptacles=(), name_to_receptacle={}
        )
        told, found = (from_file(task, e).episode(0, 0).targets for e in (whole, bare))
        assert told == found


def test_links_are_numbered_as_in_the_benchmark() -> None:
    assert hab("set_table").target_receptacles == (
        ("kitchen_counter_:0000", 7),
        ("fridge_:0000", 1),
    )
    groceries = hab("prepare_groceries")
    assert groceries.ao_states["fridge_:0000"].keys() == {"2"}
    markers = {m.name: m.link for m in hab("set_table").markers}
    assert (
        markers["cab_push_point_5"] == "drawer3"
        and markers["fridge_push_point"] == "top_door"
    )


@pytest.mark.parametrize(
    ("states", "drawer", "root"),
    [
        ({"2": 1.5}, 7, 0),
        ({"2": 1.5}, None, 0),
        ({"1": 1.5}, None, -1),
        ({"1": 1.5}, 6, -1),
        ({}, 6, -1),
        ({}, 7, 0),
    ],
)
def test_both_ways_of_numbering_links_are_told_apart(
    states: dict[str, float], drawer: int | None, root: int
) -> None:
    sim, home, _ = world("set_table")
    plain = hab("set_table")
    listed = (("kitchen_counter_:0000", drawer), ("fridge_:0000", None))
    episode = replace(
        plain, ao_states={"fridge_:0000": states}, target_receptacles=listed
    )
    assert (
        number_of_root(sim.layout, home, episode, object_poses(sim.layout, episode))
        == root
    )
    read = from_file("set_table", episode).episode(0, 0)
    door = sim.layout.link_ids.index("fridge/top_door")
    assert read.link_q[door] == pytest.approx(
        FRIDGE_PREOPEN_RAD if states else 0.0, abs=0.05
    )
    assert read.targets[0].start_link == "kitchen_counter/drawer3"


def test_links_may_be_named() -> None:
    episode = replace(hab("set_table"), ao_states={"fridge_:0000": {"bottom_door": 0.7}})
    sim = world("set_table")[0]
    door = sim.layout.link_ids.index("fridge/bottom_door")
    assert from_file("set_table", episode).episode(0, 0).link_q[door] == pytest.approx(
        0.7, abs=0.05
    )


def test_copies_that_an_episode_does_not_use_are_parked() -> None:
    whole = hab("tidy_house")
    few = replace(whole, rigid_objs=whole.rigid_objs[:3], targets={}, info={})
    few = replace(few, targets={few.instances[0]: whole.rigid_objs[5][1]})
    source = from_file("tidy_house", whole, few)
    layout = world("tidy_house")[0].layout
    pose = source.episode(0, 1).object_pose
    used = [layout.object_names.index(name) for name in few.instances]
    parked = np.setdiff1d(np.arange(layout.num_objects), used)
    np.testing.assert_allclose(pose[parked], layout.parked_poses[parked], atol=0.002)
    assert np.abs(pose[used, :2]).max() < 20
    assert len(source.episode(0, 1).targets) == 1


def test_roster_is_the_most_of_each_type() -> None:
    def having(*kinds: str) -> HabEpisode:
        objects = tuple((f"{kind}.object_config.json", np.eye(4)) for kind in kinds)
        return replace(hab("tidy_house"), rigid_objs=objects)

    file = HabFile(
        (having("024_bowl", "024_bowl", "013_apple"), having("024_bowl", "004_sugar_box"))
    )
    found = file_roster(file, open_pack("builtin"))
    assert found == ("004_sugar_box", "013_apple", "024_bowl", "024_bowl")


def test_an_object_that_does_not_exist_is_named() -> None:
    odd = replace(
        hab("tidy_house"), rigid_objs=(("024_bowll.object_config.json", np.eye(4)),)
    )
    with refused(
        where="some.json.gz",
        said=("episodes[0].rigid_objs[0]", "Did you mean '024_bowl'"),
    ):
        file_roster(HabFile((odd,), path=PATH), open_pack("builtin"))


def changed(task: str, **changes: Any) -> HabEpisode:
    return replace(hab(task), **changes)


def at(value: float, axis: int) -> HabEpisode:
    """An episode whose first object starts at a coordinate of the file (+y up) [m]."""
    (name, matrix), *others = hab("tidy_house").rigid_objs
    matrix = matrix.copy()
    matrix[axis, 3] = value
    return changed("tidy_house", rigid_objs=((name, matrix), *others))


def test_what_does_not_fit_the_layout_is_named() -> None:
    bad = {
        r"episodes\[0\]\.scene_id: unknown scene 'builtin_m0_0'\. Did you mean": changed(
            "tidy_house", scene_id="x/builtin_m0_0.scene_instance.json"
        ),
        r"episodes\[0\]: targets must be 1 to 5 for tidy_house, got 0": changed(
            "tidy_house", targets={}
        ),
        r"episodes\[0\]\.targets: unknown object '013_apple_:0000'": changed(
            "tidy_house", targets={"013_apple_:0000": np.eye(4)}
        ),
        r"episodes\[0\]\.ao_states\['fridge_:0000'\]\['top_dor'\]: unknown link .*top_door": changed(
            "tidy_house", ao_states={"fridge_:0000": {"top_dor": 1.0}}
        ),
        r"episodes\[0\]\.ao_states\['fridge_:0000'\]\['2'\]: 9 is outside the range 0 to": changed(
            "tidy_house", ao_states={"fridge_:0000": {"2": 9.0}}
        ),
        r"episodes\[0\]\.ao_states: these numbers are not links": changed(
            "tidy_house", ao_states={"fridge_:0000": {"9": 1.0}}
        ),
        r"episodes\[0\]\.rigid_objs\[0\]: \(50\.00, .* m is not in 'builtin_m0_00', which extends from \(-2": at(
            50.0, 0
        ),
        r"episodes\[0\]\.rigid_objs\[0\]: \(.*, -30\.00\) m is not in": at(-30.0, 1),
    }
    for message, episode in bad.items():
        with pytest.raises(UsageError, match=r"some\.json\.gz: " + message):
            from_file("tidy_house", episode)


def test_set_table_needs_something_to_open() -> None:
    whole = hab("set_table")
    matrix = whole.rigid_objs[-2][1].copy()
    matrix[1, 3] += 1.0
    lifted = replace(
        whole,
        rigid_objs=(
            *whole.rigid_objs[:-2],
            (whole.rigid_objs[-2][0], matrix),
            whole.rigid_objs[-1],
        ),
        target_receptacles=(),
        goal_receptacles=(),
    )
    with refused(said=("episodes[0].rigid_objs:", "starts in no drawer or fridge")):
        from_file("set_table", lifted)


@pytest.fixture
def stowing() -> Iterator[str]:
    """A task that puts an apple into the fridge, which its plan opens and closes."""
    rule = TargetRule(
        start=("dining_table",),
        goal=("fridge_shelf",),
        object="013_apple",
        opens="goal",
        link="fridge_door",
    )
    name = "stow"
    TASKS.add(name, TaskSpec(name, ("stow",), (rule,), ("013_apple",), clutter_copies=0))
    yield name
    TASKS.remove(name)
    world.cache_clear()


def test_a_file_leads_to_the_handle_of_what_is_opened_at_the_goal(stowing: str) -> None:
    made = world(stowing)[2][0]
    read = from_file(stowing, hab(stowing)).episode(0, 0)
    assert read.targets[0].goal_link == "fridge/top_door"
    np.testing.assert_allclose(
        read.targets[0].handle_pos, made.targets[0].handle_pos, atol=1e-9
    )


def test_a_goal_outside_of_what_is_to_be_opened_is_named(stowing: str) -> None:
    whole = hab(stowing)
    ((name, matrix),) = whole.targets.items()
    lifted = matrix.copy()
    lifted[1, 3] += 1.0
    episode = replace(
        whole, targets={name: lifted}, target_receptacles=(), goal_receptacles=()
    )
    with refused(said=("episodes[0].targets:", "is in no drawer or fridge")):
        from_file(stowing, episode)


def test_a_home_without_a_fridge_is_refused_for_set_table() -> None:
    pack = open_pack("builtin")
    bare = replace(
        pack.homes[1],
        articulations=tuple(
            p for p in pack.homes[1].articulations if p.template != "fridge"
        ),
    )
    with refused(
        where="task 'set_table'",
        said="needs furniture with the role 'fridge_shelf', which these homes of pack "
        f"'builtin' lack: '{bare.name}'",
    ):
        require_furniture(pack, [pack.homes[0], bare], "set_table")
    require_furniture(pack, [bare], "tidy_house")
    sim = CpuSimulator(
        Layout(replace(pack, homes=(pack.homes[0], bare)), roster("set_table")), 1, 1
    )
    with refused(said="role 'fridge_shelf'"):
        EpisodeMaker(sim, "set_table", bare.split, home=bare.name)
    episode = replace(hab("set_table"), scene_id=f"{bare.name}.scene_instance.json")
    with refused(where="some.json.gz", said="role 'fridge_shelf'"):
        FileEpisodes(sim, HabFile((episode,), path=PATH), "set_table")


def test_the_env_runs_the_episodes_of_a_file(tmp_path: Path) -> None:
    _, home, episodes = world("tidy_house")
    first = hab("tidy_house")
    one = replace(
        first, targets={name: first.targets[name] for name in first.target_names[:1]}
    )
    path = tmp_path / "two.json"
    write_hab(path, HabFile((hab("tidy_house", 1), one)))
    env = make(
        task="tidy_house",
        num_envs=3,
        episodes_file=str(path),
        split="val",
        autoreset="disabled",
    )
    _, info = env.reset(seed=3, options={"episode": np.array([0, 1, 2])})
    told = info["episode_spec"]
    assert [e["index"] for e in told] == [0, 1, 2] and {e["home"] for e in told} == {
        home.name
    }
    assert [len(e["plan"]) for e in told] == [20, 4, 20]
    assert told[1]["plan"][1]["target"] == episodes[0].targets[0].obj
    assert told[2]["plan"] == told[0]["plan"], "after the last the file begins again"
    _, _, _, _, info = env.step(np.zeros((3, 13), np.float32))
    assert not info["taint"].any()
    kind = episodes[1].targets[2].obj.split("_:")[0]
    alone = make(
        task="tidy_house",
        subtask="pick",
        target=kind,
        episodes_file=str(path),
        autoreset="disabled",
    )
    _, info = alone.reset(seed=0, options={"episode": np.array([0])})
    assert info["episode_spec"][0]["plan"][0]["target"].startswith(kind)
    with refused(
        where="two.json", said="none of its 2 episodes is in home 'builtin_m1_00'"
    ):
        make(task="tidy_house", episodes_file=str(path), home="builtin_m1_00")


def test_a_target_is_no_other_type_whose_name_begins_like_it() -> None:
    """With the objects "mug" and "mug_tall", an episode about the tall one has no target "mug"."""
    kind = kind_of(hab("tidy_house").target_names[0])
    assert len(from_file("tidy_house", hab("tidy_house"), target=kind)) == 1
    with pytest.raises(UsageError, match=f"with target '{kind[:-1]}'"):
        from_file("tidy_house", hab("tidy_house"), target=kind[:-1])


def test_real_episodes_stay_at_rest() -> None:
    path = real_data("hab_episodes", "tidy_house_v3_sc1_staging_01.json.gz")
    pack = open_pack(str(real_data("replica_cad")))
    file = read_hab(path)
    layout = Layout(pack, file_roster(file, pack))
    source = FileEpisodes(CpuSimulator(layout, 1, 1), file, "tidy_house")
    assert len(source) == 50
    total = Counter[str]()
    fallen = Counter[str]()
    for k in range(0, 50, 10):
        episode, rest = source.settled(k)
        total.update(name.split("_:")[0] for name in rest.names)
        fallen.update(name.split("_:")[0] for name in rest.fallen)
        (target,) = episode.targets
        assert (target.start_link, target.goal_link) == ("", "")
        slot = layout.object_names.index(target.obj)
        np.testing.assert_allclose(target.start_pos, episode.object_pose[slot, :3])
        upright = mat_from_quat(episode.object_pose[:, 3:])[:, 2, 2]
        assert (upright > 0.9).mean() > 0.95
    assert total.total() == 5 * 30
    assert fallen.total() <= 0.01 * total.total(), fallen


def test_states_of_furniture_that_is_welded_unless_asked_for() -> None:
    folder = str(real_data("replica_cad"))
    file = read_hab(real_data("hab_episodes", "tidy_house_v3_sc1_staging_01.json.gz"))
    # Numbers of the data set: left cupboard doors open towards negative angles.
    states = {
        "kitchenCupboard_01_:0000": {"2": -1.0, "3": 0.5},
        "chestOfDrawers_01_:0000": {"2": 0.1},
    }
    episode = replace(file.episodes[0], ao_states=states)
    welded, opening = (
        Layout(open_pack(name), file_roster(file, open_pack(name)))
        for name in (
            folder,
            PackRequest(
                folder,
                ("kitchen_cupboards", "chest_of_drawers"),
                scenes=(episode.scene,),
            ),
        )
    )
    with pytest.raises(
        ValueError,
        match=r"\['2'\]: 'kitchenCupboard_01' is welded shut in this pack \(--articulate",
    ):
        joint_positions(welded, episode, 0)
    found = dict(
        zip(opening.link_ids, joint_positions(opening, episode, 0).tolist(), strict=True)
    )
    assert {name: q for name, q in found.items() if q} == {
        "kitchenCupboard_01/kitchencupboard_doorWhole_1L": 1.0,
        "kitchenCupboard_01/kitchencupboard_doorWhole_1R": 0.5,
        "chestOfDrawers_01/drawer_topL": 0.1,
    }
    home = next(h for h in opening.pack.homes if h.name == episode.scene)
    assert number_of_root(opening, home, episode, object_poses(opening, episode)) == 0
    assert number_of_root(welded, home, episode, object_poses(welded, episode)) == 0
    made = Episode(
        0,
        0,
        "tidy_house",
        "train",
        home.name,
        object_poses(opening, episode),
        np.array([*found.values()]),
        (),
    )
    assert to_hab(opening, home, made).ao_states == states
