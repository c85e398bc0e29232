"""Shards that somebody made up: names that lead elsewhere, and numbers no episode has. All with digests that fit."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from mjhab.cli.main import main
from mjhab.core.errors import MjhabError
from mjhab.data.select.dataset import WindowDataset
from mjhab.data.select.sets import split, stats
from mjhab.data.store.checking import check, repair
from mjhab.data.store.damage import refuse_damage
from mjhab.data.store.episode_data import EpisodeData, episode_digest
from mjhab.data.store.hdf5 import dataset, group, put_attributes, read_arrays
from mjhab.data.store.images import ImageFormat, encode
from mjhab.data.store.reading import open_shard
from mjhab.data.store.schema import DamagedError
from mjhab.data.store.shard import rewrite
from mjhab.data.store.writing import write_shard
from mjhab.rollout.records import EpisodeRecord
from tests.data.export.exporting import to_maniskill
from tests.data.fake_world import FakeEnv
from tests.data.make import numbered, one_episode, record, record_pictures
from tests.refusals import refused


@pytest.fixture(scope="module")
def picks(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A shard of three episodes."""
    path = tmp_path_factory.mktemp("picks") / "a.h5"
    record(path, range(3), FakeEnv(subtask="pick"))
    return path.read_bytes()


def everything(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


# -- names -------------------------------------------------------------------------------------------------------------

Forge = Callable[[EpisodeRecord, str], EpisodeRecord]
FIELDS: dict[str, Forge] = {
    "task": lambda r, name: replace(r, task=name),
    "home": lambda r, name: replace(r, home=name),
    "split": lambda r, name: replace(r, split=name),
    "subtask": lambda r, name: replace(r, subtask=name),
    "target": lambda r, name: replace(r, subtasks=(replace(r.subtasks[0], target=name),)),
    "target of the plan": lambda r, name: replace(
        r, plan=(replace(r.plan[0], target=name),)
    ),
    "kind": lambda r, name: replace(r, subtasks=(replace(r.subtasks[0], kind=name),)),
    "label": lambda r, name: replace(r, subtasks=(replace(r.subtasks[0], label=name),)),
    "event": lambda r, name: replace(r, events=((1, name),)),
}


@pytest.mark.parametrize(
    ("field", "name"),
    [("task", name) for name in ("{outside}", "a/../../../outside", "a\nb", "x" * 300)]
    + [(field, "../../outside") for field in FIELDS],
)
def test_a_name_in_a_record_leads_nowhere(
    tmp_path: Path, picks: bytes, field: str, name: str
) -> None:
    """Before, "/abs" and "../" in ``task`` made the export write there, and the episode was missing in the export."""
    inside = tmp_path / "inside"
    inside.mkdir()
    path = inside / "a.h5"
    path.write_bytes(picks)
    with open_shard(path) as shard:
        first = shard.names[0]
        forged = FIELDS[field](
            shard.episode(first).record, name.format(outside=tmp_path / "outside")
        )
    rewrite(path, {first: forged})
    before = everything(tmp_path)
    for act in (
        lambda: to_maniskill(path, inside / "set"),
        lambda: stats(path),
        lambda: WindowDataset(path),
    ):
        with pytest.raises(
            DamagedError, match=rf"episode {first} of .*must be a name.*mjhab data check"
        ):
            act()
    report = check(path)
    assert (
        list(report.damaged) == [(path, first)]
        and "must be a name" in report.damaged[path, first][0]
    )
    assert everything(tmp_path) == before
    assert repair(path).kept == 2
    assert to_maniskill(path, inside / "set").episodes == 2


@pytest.mark.parametrize("part", ["../x", "/tmp/x", "a b", "x" * 300, ""])
def test_a_part_of_a_split_is_a_name(tmp_path: Path, picks: bytes, part: str) -> None:
    (tmp_path / "a.h5").write_bytes(picks)
    before = everything(tmp_path)
    with refused(said="name of a part must be a name"):
        split([tmp_path / "a.h5"], tmp_path / "out", {part: 1.0})
    assert everything(tmp_path) == before


# -- numbers -----------------------------------------------------------------------------------------------------------


def spoilt(value: float) -> Callable[[np.ndarray], np.ndarray]:
    """Put a value into the second row."""

    def change(array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array[1] = value
        return array

    return change


def narrow(array: np.ndarray) -> np.ndarray:
    return array[:, :7]


CHANGES: dict[str, tuple[str, Callable[[np.ndarray], Any], str]] = {
    "actions nan": (
        "actions",
        spoilt(np.nan),
        r"actions has 13 numbers that are not finite, .*nan\) at \[1, 0\]",
    ),
    "actions inf": (
        "actions",
        spoilt(np.inf),
        r"actions has 13 numbers that are not finite",
    ),
    "actions of 7": ("actions", narrow, "actions has 7 columns, not 13"),
    "actions flat": (
        "actions",
        lambda a: a[:, 0],
        r"actions has shape \(20,\), not \(N, A\)",
    ),
    "actions short": ("actions", lambda a: a[:-1], "actions has 19 rows, not 20"),
    "actions wide": (
        "actions",
        lambda a: a.astype(np.float64),
        "actions is float64, not float32",
    ),
    "actions of text": (
        "actions",
        lambda a: np.full(a.shape, b"left"),
        r"actions is \|S4, not float32",
    ),
    "a number": (
        "actions",
        lambda _: np.float32(1.0),
        r"actions has shape \(\), not \(N, A\)",
    ),
    "qpos nan": (
        "states/qpos",
        spoilt(np.nan),
        "states/qpos has 30 numbers that are not finite",
    ),
    "qpos narrow": ("states/qpos", narrow, "states/qpos has 7 columns, not 30"),
    "qvel inf": (
        "states/qvel",
        spoilt(-np.inf),
        "states/qvel has 28 numbers that are not finite",
    ),
    "forces nan": (
        "signals/forces",
        spoilt(np.nan),
        "signals/forces has 3 numbers that are not finite",
    ),
    "checks narrow": ("signals/checks", narrow, r"signals/checks has 7 columns, not 18"),
    "reward nan": (
        "reward/total",
        spoilt(np.nan),
        "reward/total has 1 numbers that are not finite",
    ),
    "terms nan": (
        "reward/terms",
        spoilt(np.nan),
        "reward/terms has 2 numbers that are not finite",
    ),
    "state nan": (
        "obs/state",
        spoilt(np.nan),
        "obs/state has 5 numbers that are not finite",
    ),
    "state narrow": ("obs/state", lambda a: a[:, :3], "obs/state has 3 columns, not 5"),
    "state long": (
        "obs/state",
        lambda a: np.concatenate([a, a]),
        "obs/state has 42 rows, not 21",
    ),
    "late subtask": (
        "subtasks/step",
        lambda a: a + 99,
        "subtasks/step must begin with 0, grow, and not exceed N = 20",
    ),
    "no subtask": (
        "subtasks/step",
        lambda a: np.int32(0),
        r"subtasks/step has shape \(\), not \(K,\)",
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_numbers_no_episode_has(tmp_path: Path, picks: bytes, change: str) -> None:
    """Before, actions that are not finite or of 7 columns passed the check and were exported."""
    place, make, message = CHANGES[change]
    path = tmp_path / "a.h5"
    path.write_bytes(picks)
    with h5py.File(path, "r+") as file:
        name = sorted(group(file, "episodes"))[1]
        episode = group(file, f"episodes/{name}")
        columns = dict(episode[place].attrs)
        new = make(read_arrays(episode)[place])
        del episode[place]
        episode[place] = new
        episode[place].attrs.update(columns)
        put_attributes(episode, {"digest": episode_digest(read_arrays(episode))})
    report = check(path)
    assert list(report.damaged) == [(path, name)] and report.ok == 2
    with open_shard(path) as shard, pytest.raises(DamagedError, match=message):
        refuse_damage(shard.episode(name))
    before = everything(tmp_path)
    with pytest.raises(
        DamagedError, match=rf"episode {name} of .*is damaged: .*mjhab data repair"
    ):
        to_maniskill(path, tmp_path / "set")
    assert not (tmp_path / "set").exists() and before <= everything(tmp_path)
    done = repair(path)
    assert done.kept == 2 and list(done.lost) == [name]


RECORDS: dict[str, tuple[Callable[[EpisodeRecord], EpisodeRecord], str]] = {
    "forces": (
        lambda r: replace(r, force=r.force[:-1]),
        "its record has 19 forces, not 20",
    ),
    "nan": (
        lambda r: replace(r, peak_force=float("nan")),
        "its record has forces that are not finite",
    ),
    "index": (lambda r: replace(r, index=7), "its record is that of episode 7 of seed 0"),
    "seed": (lambda r: replace(r, seed=-3), "seed must be a whole number from 0"),
    "steps": (lambda r: replace(r, steps=-5), "steps must be a whole number from 0"),
    "plan": (
        lambda r: replace(r, subtasks=(replace(r.subtasks[0], index=9),)),
        "has subtask 9 of a plan of 1",
    ),
    "end": (
        lambda r: replace(r, subtasks=(replace(r.subtasks[0], end_step=999),)),
        "a subtask from step 0 to 999",
    ),
}


@pytest.mark.parametrize("change", RECORDS)
def test_records_that_do_not_fit_their_episode(
    tmp_path: Path, picks: bytes, change: str
) -> None:
    make, message = RECORDS[change]
    path = tmp_path / "a.h5"
    path.write_bytes(picks)
    with open_shard(path) as shard:
        name = shard.names[1]
        old = shard.episode(name).record
    rewrite(path, {name: make(old)})
    report = check(path)
    assert list(report.damaged) == [(path, name)]
    assert message in "; ".join(report.damaged[path, name])


# -- what an episode says of itself ------------------------------------------------------------------------------------


def forged(
    path: Path, picks: bytes, change: Callable[[h5py.File, h5py.Group], None]
) -> str:
    """Change the second episode of a copy, with a digest that fits; returns its name."""
    path.write_bytes(picks)
    with h5py.File(path, "r+") as file:
        name = sorted(group(file, "episodes"))[1]
        episode = group(file, f"episodes/{name}")
        change(file, episode)
        put_attributes(episode, {"digest": episode_digest(read_arrays(episode))})
    return name


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("label", b"no_such_label", "its record has label"),
        ("success", False, "its record has success True, its group False"),
        ("home", b"other", "its record has home"),
        ("index", 77, "its record has index 1, its group 77"),
        ("seed", 5, "its record has seed 0, its group 5"),
        ("style", b"{}", "its record has style"),
        ("ending", b"tired", "it ended by 'tired'"),
        ("steps", np.zeros((3, 3)), "attribute 'steps' must be int"),
        ("actors", np.zeros((3, 3)), "attribute 'actors' must be str"),
        ("actors", b"[3]", "attribute 'actors' must be a list of texts"),
        ("run", b"elsewhere", "its run elsewhere"),
    ],
)
def test_attributes_that_contradict_the_record(
    tmp_path: Path, picks: bytes, name: str, value: Any, message: str
) -> None:
    path = tmp_path / "a.h5"
    attribute = name

    def change(_: h5py.File, episode: h5py.Group) -> None:
        del episode.attrs[attribute]
        put_attributes(
            episode, {attribute: value.decode() if isinstance(value, bytes) else value}
        )

    name = forged(path, picks, change)
    report = check(path)
    assert list(report.damaged) == [(path, name)] and report.ok == 2
    assert message in "; ".join(report.damaged[path, name])


def test_an_episode_without_its_run_is_not_copied(tmp_path: Path, picks: bytes) -> None:
    path = tmp_path / "a.h5"
    path.write_bytes(picks)
    with h5py.File(path, "r+") as file:
        run = next(iter(group(file, "runs")))
        del file[f"runs/{run}"]
    with open_shard(path) as shard:
        names = shard.names
    with pytest.raises(DamagedError, match=f"its run {run}\\) is missing or damaged"):
        write_shard(tmp_path / "b.h5", {path: names})
    assert [one.name for one in tmp_path.iterdir()] == ["a.h5"]


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        ("", b"null"),
        ("", b"[1]"),
        ("", b"9" * 5000),
        ("", b"{}"),
        ("config", None),
        ("config/env", [1]),
        ("config/policy", "expert"),
        ("config/policy/name", {}),
        ("options", None),
        ("layout", []),
        ("layout/actions", 13),
        ("layout/sizes", {"qpos": "many"}),
        ("layout/columns", {"robot_q": None}),
        ("absent", "states/qpos"),
        ("licence", None),
    ],
)
def test_a_run_of_other_types_damages_its_episodes_and_ends_no_command(
    tmp_path: Path, picks: bytes, entry: str, value: Any
) -> None:
    path = tmp_path / "a.h5"
    path.write_bytes(picks)
    with h5py.File(path, "r+") as file:
        name = next(iter(group(file, "runs")))
        told = json.loads(bytes(dataset(file, f"runs/{name}")[()]))
        *above, last = entry.split("/")
        place = told
        for key in above:
            place = place.setdefault(key, {})
        place[last] = value
        data = value if not entry else json.dumps(told).encode()
        del file[f"runs/{name}"]
        file[f"runs/{name}"] = np.frombuffer(data, np.uint8)
    assert len(check(path).damaged) == 3
    for act in (lambda: stats(path), lambda: to_maniskill(path, tmp_path / "set")):
        with pytest.raises(MjhabError, match="cannot be read"):
            act()
    place = str(path)
    for command in (
        ["data", "query", place],
        ["label", place],
        ["replay", place, "--verify"],
    ):
        assert main(command) == 1, command


def large_header() -> bytes:
    """A PNG whose header states 60,000 x 60,000 pixels."""
    data = bytearray(encode(np.zeros((4, 4, 1), int), "depth", ImageFormat()))
    data[16:24] = struct.pack(">II", 60_000, 60_000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    return bytes(data)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (b"no picture", "frame 0 of images/head/depth: the bytes are no picture"),
        (
            encode(np.zeros((4, 4, 3), np.uint8), "rgb", ImageFormat()),
            "pixels I;16 or I, not RGB",
        ),
        (encode(np.zeros((4, 5000, 1), int), "depth", ImageFormat()), "5000 x 4 pixels"),
        (large_header(), "the bytes are no picture"),
    ],
)
def test_frames_that_are_no_pictures(tmp_path: Path, frame: bytes, message: str) -> None:
    source = tmp_path / "source.h5"
    record_pictures(source, range(2))
    path = tmp_path / "a.h5"

    def change(_: h5py.File, episode: h5py.Group) -> None:
        (camera,) = list(group(episode, "images"))[:1]
        pictures = group(episode, f"images/{camera}/depth")
        count = len(dataset(pictures, "ends"))
        del pictures["bytes"], pictures["ends"]
        pictures["bytes"] = np.frombuffer(frame * count, np.uint8)
        pictures["ends"] = np.arange(1, count + 1) * len(frame)

    name = forged(path, source.read_bytes(), change)
    with open_shard(path) as shard:
        (camera, output) = next(
            one for one in shard.episode(name).images if one[1] == "depth"
        )
        with pytest.raises(DamagedError):
            shard.episode(name).frame(camera, output, 0)
    report = check(path)
    told = "; ".join(report.damaged[path, name])
    assert message.replace("images/head", f"images/{camera}") in told and report.ok == 1


def test_bombs_are_not_unpacked(tmp_path: Path, picks: bytes) -> None:
    """Each takes a few kilobytes in the file and gigabytes in memory."""
    path = tmp_path / "a.h5"
    path.write_bytes(picks)
    with h5py.File(path, "r+") as file:
        first, second, third = (
            group(file, f"episodes/{name}") for name in group(file, "episodes")
        )
        for episode, place, shape in (
            (first, "actions", (10**9, 13)),
            (second, "record", (10**11,)),
            (third, "obs/extra_thing", (10**10,)),
        ):
            if place in episode:
                del episode[place]
            episode.create_dataset(place, shape, "f4", chunks=True, compression="gzip")
    report = check(path)
    assert len(report.damaged) == 3
    assert all("unpacks to" in wrong[0] for wrong in report.damaged.values())


# -- writing -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("place", "make", "message"),
    [
        CHANGES[name]
        for name in (
            "actions nan",
            "actions flat",
            "actions wide",
            "qpos nan",
            "state long",
        )
    ],
)
def test_the_writer_refuses_them(
    tmp_path: Path, place: str, make: Callable[[np.ndarray], np.ndarray], message: str
) -> None:
    whole = numbered(one_episode(tmp_path), 1)
    steps = whole.record.steps
    message = (
        message.replace("20", str(steps))
        .replace("21", str(steps + 1))
        .replace("42", str(2 * steps + 2))
    )
    with pytest.raises(ValueError, match=f"episode 1 does not fit the schema: {message}"):
        replace(whole, arrays={**whole.arrays, place: make(whole.arrays[place])})


def test_the_writer_knows_the_sizes_of_the_env(tmp_path: Path) -> None:
    whole: EpisodeData = one_episode(tmp_path)
    run = replace(
        whole.run, layout={"actions": ["a"] * 7, "sizes": {"qpos": 3, "ctrl": 5}}
    )
    with pytest.raises(
        ValueError,
        match=r"actions has 13 columns, not 7; .*states/qpos has 30 columns, not 3",
    ):
        replace(whole, run=run)


class Odd(FakeEnv):
    """An env whose reward is not a number from the third step on."""

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict]:
        obs, reward, terminated, truncated, info = super().step(actions)
        return obs, np.where(reward > 1.0, np.nan, reward), terminated, truncated, info


def test_the_recorder_refuses_them(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    record(path, range(1), FakeEnv(1, subtask="pick"))
    before: Any = path.read_bytes()
    with pytest.raises(
        MjhabError,
        match=r"episode 5 does not fit .*reward/total has .*not finite.*was not recorded",
    ):
        record(path, [5], Odd(1, subtask="pick"))
    assert path.read_bytes() == before
