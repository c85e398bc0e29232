"""Select, count, merge and split, from Python and from the command line."""

from __future__ import annotations

import json
import shutil
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import h5py
import pytest

from mjhab.cli.main import main
from mjhab.data.select.facts import target_of
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import first_of_targets, merge, select, split, stats
from mjhab.data.store.checking import check
from mjhab.data.store.hdf5 import dataset, group
from mjhab.data.store.places import episodes
from mjhab.data.store.schema import VERSION
from tests.data.fake_world import FakeEnv
from tests.data.make import record
from tests.refusals import command, refused


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("set")
    record(folder / "chain.h5", range(12))
    record(folder / "pick.h5", range(8), FakeEnv(2, "pick"))
    return folder


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    return shutil.copytree(original, tmp_path / "set")


def attributes(*places: Path) -> dict[str, Any]:
    return {e.name: e.attributes for e in episodes(places)}


def test_select_and_stats(folder: Path) -> None:
    records = [e.record for e in episodes(folder)]
    tainted = [r for r in records if r.taint]
    assert tainted and {r.index for r in tainted} == {4}
    found = select(folder, Filter("steps > 2"))
    assert (len(found.matched), found.of) == (
        sum(r.steps > 2 and not r.taint for r in records),
        20,
    )
    assert found.tainted == sum(r.steps > 2 for r in tainted)
    assert len(select(folder).matched) == 20 and len(
        select(folder, Filter("tainted")).matched
    ) == len(tainted)
    numbers = stats(folder)
    assert numbers["of"] == numbers["episodes"] == 20 and numbers["shards"] == 2
    assert numbers["labels"] == Counter(s.label for r in records for s in r.subtasks)
    assert [row["subtask"] for row in numbers["rows"]] == ["chain", "pick"]
    assert sum(row["steps"] for row in numbers["rows"]) == sum(r.steps for r in records)
    assert numbers["bytes"] == sum(p.stat().st_size for p in folder.iterdir())
    assert stats(folder, Filter("steps < 0"))["episodes"] == 0


def test_the_first_of_every_target_are_those_with_the_lowest_indices(
    folder: Path,
) -> None:
    found = select(folder)
    kept = first_of_targets(found, 1)
    by_target: dict[str, list[int]] = defaultdict(list)
    for one in found.records:
        by_target[target_of(one)].append(one.index)
    chosen = [
        one
        for place, one in zip(found.matched, found.records, strict=True)
        if place in kept
    ]
    assert {target_of(one): one.index for one in chosen} == {
        target: min(indices) for target, indices in by_target.items()
    }
    assert kept == [place for place in found.matched if place in set(kept)]
    assert first_of_targets(found, 1000) == found.matched


def test_merge(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "all.h5"
    done = merge([folder], out)
    assert (done.written, done.left_out, done.repeated) == (20, 0, 0)
    assert attributes(out) == attributes(folder) and check(out).ok == 20
    done = merge([folder / "pick.h5"], out)
    assert (done.written, done.repeated) == (0, 8) and check(out).ok == 20
    part = merge(
        [folder], tmp_path / "part.h5", Filter("subtask == 'pick' and not tainted")
    )
    assert (part.written, part.left_out) == (7, 13)
    assert sum(e.run.config["env"]["subtask"] == "pick" for e in episodes(out)) == 8
    with refused("out"):
        merge([folder, out], out)


def test_merge_refuses_two_contents_of_one_episode(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.h5"
    merge([folder / "pick.h5"], other)
    with h5py.File(other, "r+") as file:
        name = sorted(group(file, "episodes"))[2]
        group(file, f"episodes/{name}").attrs["digest"] = "0" * 64
    with refused(
        where="other.h5", said="differs from one of the same config, seed and index"
    ):
        merge([folder, other], tmp_path / "out.h5")


def test_a_data_set_is_not_written_into_itself(folder: Path) -> None:
    before = sorted(folder.rglob("*"))
    for work in (
        lambda: split([folder], folder, {"a": 0.5}),
        lambda: split([folder], folder / "parts", {"a": 0.5}),
        lambda: merge([folder], folder / "all.h5"),
    ):
        with refused("out"):
            work()
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize("by", ["episode", "home", "target"])
def test_split(folder: Path, tmp_path: Path, by: str) -> None:
    sizes = split([folder], tmp_path / "a", {"train": 0.6, "val": 0.4}, by)
    parts = {name: attributes(tmp_path / "a" / f"{name}.h5") for name in sizes}
    assert {**parts["train"], **parts["val"]} == attributes(folder)
    assert not parts["train"].keys() & parts["val"].keys() and sum(sizes.values()) == 20
    if by == "episode":
        assert sizes == {"train": 12, "val": 8}
    if by == "home":
        homes = {name: {a["home"] for a in part.values()} for name, part in parts.items()}
        assert homes["train"] and homes["val"] and not homes["train"] & homes["val"]
    merge([folder], tmp_path / "one.h5")
    assert (
        split([tmp_path / "one.h5"], tmp_path / "b", {"train": 0.6, "val": 0.4}, by)
        == sizes
    )
    assert attributes(tmp_path / "b" / "val.h5") == parts["val"]
    split([folder], tmp_path / "c", {"train": 0.6, "val": 0.4}, by, seed=1)
    assert by != "episode" or attributes(tmp_path / "c" / "val.h5") != parts["val"]


def test_split_refuses(folder: Path, tmp_path: Path) -> None:
    for parts in ({}, {"a": 0.0}, {"a": 0.7, "b": 0.4}, {"a": -1.0}):
        with refused("shares", expected="positive, with a sum of at most 1"):
            split([folder], tmp_path / "out", parts)
    split([folder], tmp_path / "out", {"a": 0.5})
    with refused(where="a.h5", said="exists already"):
        split([folder], tmp_path / "out", {"a": 0.5})
    merge([folder / "pick.h5"], folder / "again.h5")
    with refused(said="mjhab data merge"):
        split([folder], tmp_path / "more", {"a": 0.5})


def test_a_copied_shard_counts_once_or_not_at_all(tmp_path: Path) -> None:
    """Its episodes would count twice in every number; `merge` leaves the copies out."""
    record(tmp_path / "set" / "a.h5", range(2))
    shutil.copy(tmp_path / "set" / "a.h5", tmp_path / "set" / "a (copy).h5")
    for read in (select, stats, lambda place: list(episodes(place))):
        with refused(said="a (copy).h5 and in"):
            read(tmp_path / "set")
    (tmp_path / "link.h5").symlink_to(tmp_path / "set" / "a.h5")
    assert len(list(episodes([tmp_path / "set" / "a.h5", tmp_path / "link.h5"]))) == 2
    done = merge([tmp_path / "set"], tmp_path / "one.h5")
    assert (done.written, done.repeated) == (2, 2) and select(tmp_path / "one.h5").of == 2


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, Any]:
    code = main(["data", *map(str, words), "--json"])
    out = capsys.readouterr().out.strip()
    return code, json.loads(out) if out else None


def test_commands(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(capsys, "check", folder)[1] == {
        "episodes": 20,
        "ok": 20,
        "damaged": 0,
        "unreadable": [],
        "unfinished": [],
        "doubled": 0,
        "schemas": {str(VERSION): 20},
        "problems": [],
    }
    code, found = run(
        capsys, "query", folder, "--where", "subtask == 'pick'", "--list", "2"
    )
    assert code == 0 and (found["matched"], found["of"], found["tainted_left_out"]) == (
        7,
        20,
        1,
    )
    assert [row["index"] for row in found["episodes"]] == [0, 1] and found["episodes"][0][
        "target"
    ] == "024_bowl"
    assert (
        run(
            capsys,
            "query",
            folder,
            "--preset",
            "pick_paper",
            "--where",
            "tainted or true",
        )[1]["tainted_left_out"]
        == 0
    )
    assert run(capsys, "stats", folder)[1]["episodes"] == 20
    assert (
        run(capsys, "merge", folder, "--out", tmp_path / "m.h5", "--where", "success")[1][
            "repeated"
        ]
        == 0
    )
    sizes = run(
        capsys,
        "split",
        folder,
        "--out",
        tmp_path / "s",
        "--parts",
        "train=0.5",
        "val=0.25",
    )[1]
    assert sizes == {"parts": {"train": 10, "val": 5}}
    repaired = {
        "kept": 20,
        "lost": 0,
        "finished": 0,
        "damaged_files": [],
        "indexed": True,
    }
    assert run(capsys, "repair", folder)[1] == repaired
    assert "max_force" in dict(
        (row[0], row) for row in run(capsys, "fields")[1]["fields"]
    )


def test_tables(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, text in (
        (["query", folder, "--where", "steps > 2", "--list", "3"], "of 20 episodes"),
        (["stats", folder], "Recorded episodes"),
        (["check", folder], "20 episodes, 20 ok, 0 damaged, 0 shards unreadable"),
        (["repair", folder], "20 episodes kept, 0 lost"),
        (["fields"], "pick_paper"),
    ):
        assert main(["data", *map(str, words)]) == 0
        assert text in capsys.readouterr().out


@pytest.mark.parametrize(
    "words",
    [
        ("data", "stats"),
        ("data", "check"),
        ("data", "repair"),
        ("data", "query"),
        ("data", "merge", "--out", "{new}"),
        ("data", "split", "--out", "{new}"),
        ("label", "--write"),
        ("export", "maniskill", "--out", "{new}"),
    ],
    ids=" ".join,
)
def test_no_shards_at_all_are_refused(words: tuple[str, ...], tmp_path: Path) -> None:
    new = tmp_path / "new.h5"
    with refused(said="name shards (*.h5), or folders of shards."):
        command(*(word.replace("{new}", str(new)) for word in words))
    assert not new.exists()


@pytest.mark.parametrize("out", ["merged", "folder"])
def test_merge_takes_names_that_are_found_in_a_folder(
    folder: Path, tmp_path: Path, out: str
) -> None:
    (tmp_path / "folder").mkdir()
    with refused("--out"):
        command("data", "merge", str(folder), "--out", str(tmp_path / out))
    assert not (tmp_path / "merged").exists() and not list(tmp_path.rglob("*.lock"))


def test_damage_fails_the_check_and_is_repaired(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with h5py.File(folder / "pick.h5", "r+") as file:
        name = sorted(group(file, "episodes"))[3]
        dataset(file, f"episodes/{name}/actions")[0, 0] += 1.0
    (folder / "foreign.h5").write_text("hello")
    code, report = run(capsys, "check", folder)
    assert code == 1 and (report["ok"], report["damaged"], len(report["unreadable"])) == (
        19,
        1,
        1,
    )
    wrong = "its bytes are not those that were written (digest)"
    assert report["problems"] == [
        {"shard": str(folder / "pick.h5"), "episode": name, "wrong": wrong}
    ]
    assert (
        main(["data", "check", str(folder)]) == 1 and "digest" in capsys.readouterr().out
    )
    (folder / "foreign.h5").unlink()
    assert main(["data", "repair", str(folder)]) == 0
    assert "7 episodes saved, 1 lost; the damaged file is" in capsys.readouterr().out
    assert run(capsys, "check", folder)[0] == 0


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("query", "--where", "max_forse < 3"), dict(said="Did you mean 'max_force'")),
        (("query", "--preset", "pick"), dict(option="preset", given="pick")),
        (("query", "--list", "-1"), dict(option="list", given=-1)),
        (
            ("split", "--out", "x", "--parts", "train"),
            dict(option="parts", given="train"),
        ),
        (
            ("split", "--out", "x", "--parts", "a=1", "a=1"),
            dict(option="parts", given="a=1"),
        ),
        (("split", "--out", "x", "--by", "homes"), dict(option="--by", given="homes")),
    ],
)
def test_bad_options(
    folder: Path,
    words: tuple[str, ...],
    told: dict[str, Any],
) -> None:
    with refused(**told):
        command("data", words[0], str(folder), *words[1:])
    with refused(where="nowhere", said="does not exist"):
        command("data", "query", str(folder / "nowhere"))
