"""The run folder survives crashes, resumes, and never deletes what it did not make."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_text
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import ZeroPolicy
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.store import (
    EvaluationFolder,
    StoreSink,
    config_hash,
    read_records,
)
from tests.refusals import refused
from tests.rollout.fake_env import FakeEnv

CONFIG = {"task": "set_table", "policy": "zero", "seed": 0, "episodes": 6, "worlds": 2}


def run(
    folder: EvaluationFolder, episodes: int = 6, env: FakeEnv | None = None
) -> list[EpisodeRecord]:
    with folder:
        return rollout(
            env or FakeEnv(2),
            ZeroPolicy(),
            folder.missing(episodes),
            seed=0,
            sinks=[StoreSink(folder)],
        )


def lines(path: Path) -> list[dict[str, Any]]:
    return [
        json.loads(line) for line in (path / "episodes.jsonl").read_text().splitlines()
    ]


def test_a_run_is_stored_and_read_back(tmp_path: Path) -> None:
    folder = EvaluationFolder.open(tmp_path / "a" / "run", CONFIG)
    records = run(folder)
    assert folder.records == records
    assert json.loads((folder.path / "config.json").read_text()) == CONFIG
    again = EvaluationFolder.open(folder.path, CONFIG, resume=True)
    assert again.records == records and list(again.missing(8)) == [6, 7]


@pytest.mark.parametrize(
    ("umask", "mode"), [(0o022, 0o644), (0o027, 0o640), (0o002, 0o664)]
)
def test_files_of_a_run_keep_the_umask(umask: int, mode: int, tmp_path: Path) -> None:
    before = os.umask(umask)
    try:
        run(EvaluationFolder.open(tmp_path / "run", CONFIG), 1)
        write_text(tmp_path / "summary.json", "{}")
        for path in filter(Path.is_file, tmp_path.rglob("*")):
            assert path.stat().st_mode & 0o777 == mode, path
    finally:
        os.umask(before)


def test_each_episode_is_on_disk_when_it_ends(tmp_path: Path) -> None:
    folder = EvaluationFolder.open(tmp_path, CONFIG)
    env = FakeEnv(2)
    env.interrupt_at = 300
    with pytest.raises(KeyboardInterrupt):
        run(folder, 50, env)
    done = [entry["index"] for entry in lines(tmp_path)]
    assert done and sorted(done) == [record.index for record in folder.records]


def test_resume_after_interrupt_equals_one_run(tmp_path: Path) -> None:
    whole = run(EvaluationFolder.open(tmp_path / "whole", CONFIG), 12)
    part = EvaluationFolder.open(tmp_path / "part", CONFIG)
    env = FakeEnv(2)
    env.interrupt_at = 280
    with pytest.raises(KeyboardInterrupt):
        run(part, 12, env)
    resumed = EvaluationFolder.open(
        tmp_path / "part", {**CONFIG, "worlds": 4}, resume=True
    )
    assert 0 < len(resumed.missing(12)) < 12
    run(resumed, 12, FakeEnv(4))
    assert resumed.records == whole


@pytest.mark.parametrize("cut", [1, 20, 400])
def test_a_torn_last_line_is_cut_off_and_run_again(tmp_path: Path, cut: int) -> None:
    records = run(EvaluationFolder.open(tmp_path, CONFIG))
    file = tmp_path / "episodes.jsonl"
    last = json.loads(file.read_text().splitlines()[-1])["index"]
    file.write_bytes(file.read_bytes()[:-cut])
    folder = EvaluationFolder.open(tmp_path, CONFIG, resume=True)
    assert list(folder.missing(6)) == [last]
    run(folder)
    assert folder.records == records and len(lines(tmp_path)) == 6


def test_damage_in_the_middle_is_an_error(tmp_path: Path) -> None:
    run(EvaluationFolder.open(tmp_path, CONFIG))
    file = tmp_path / "episodes.jsonl"
    text = file.read_text().splitlines(keepends=True)
    text[2] = text[2][:30] + "\n"
    file.write_text("".join(text))
    with refused(said="line 3"):
        EvaluationFolder.open(tmp_path, CONFIG, resume=True)


def test_a_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with refused("out", expected="empty, but holds notes.txt", advice="--overwrite"):
        EvaluationFolder.open(tmp_path, CONFIG)


def test_overwrite_deletes_only_own_files(tmp_path: Path) -> None:
    run(EvaluationFolder.open(tmp_path, CONFIG))
    (tmp_path / "films").mkdir()
    (tmp_path / "films" / "episode_00000.mp4").write_bytes(b"x")
    # What a killed process leaves of a film.
    (tmp_path / "films" / ".episode_00001.7.part.mp4").write_bytes(b"x")
    for name in ("notes.txt", "films/mine.mp4"):
        (tmp_path / name).write_text("mine")
    with EvaluationFolder.open(tmp_path, CONFIG, overwrite=True) as folder:
        assert folder.records == []
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [
        "config.json",
        "films",
        "notes.txt",
    ]
    assert [entry.name for entry in (tmp_path / "films").iterdir()] == ["mine.mp4"]


def test_resume_with_another_config_names_the_key(tmp_path: Path) -> None:
    run(EvaluationFolder.open(tmp_path, CONFIG))
    with refused(said="seed = 0, now it is 1"):
        EvaluationFolder.open(tmp_path, {**CONFIG, "seed": 1}, resume=True)
    EvaluationFolder.open(tmp_path, {**CONFIG, "worlds": 8, "episodes": 20}, resume=True)


def test_resume_of_a_folder_that_is_no_run(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with refused(
        "resume", expected="a folder with config.json", advice="nothing to resume"
    ):
        EvaluationFolder.open(tmp_path, CONFIG, resume=True)
    (tmp_path / "config.json").write_text("{")
    with refused(said="not valid JSON"):
        EvaluationFolder.open(tmp_path, CONFIG, resume=True)


def test_resume_of_nothing_starts(tmp_path: Path) -> None:
    assert list(
        EvaluationFolder.open(tmp_path / "new", CONFIG, resume=True).missing(2)
    ) == [
        0,
        1,
    ]


def test_both_switches_or_a_file_are_refused(tmp_path: Path) -> None:
    with refused("resume", True):
        EvaluationFolder.open(tmp_path, CONFIG, resume=True, overwrite=True)
    (tmp_path / "file").write_text("")
    with refused("out", expected="a folder, not a file"):
        EvaluationFolder.open(tmp_path / "file", CONFIG, overwrite=True)


def test_atomic_write_replaces_and_leaves_no_rest(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")
    write_text(tmp_path / "a.txt", "new")
    assert [(entry.name, entry.read_text()) for entry in tmp_path.iterdir()] == [
        ("a.txt", "new")
    ]


def test_a_folder_has_one_writer(tmp_path: Path) -> None:
    folder = EvaluationFolder.open(tmp_path, CONFIG)
    for switch in ({"resume": True}, {"overwrite": True}, {}):
        with refused(said="is being written by process"):
            EvaluationFolder.open(tmp_path, CONFIG, **switch)
    run(folder)
    folder.close()
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [
        "config.json",
        "episodes.jsonl",
    ]
    with EvaluationFolder.open(tmp_path, CONFIG, resume=True) as again:
        assert not again.missing(6)


def test_a_folder_that_could_not_be_opened_is_free(tmp_path: Path) -> None:
    run(EvaluationFolder.open(tmp_path, CONFIG))
    (tmp_path / "episodes.jsonl").write_text("{}\n{}\n")
    for _ in range(2):
        with refused(said="line 1"):
            EvaluationFolder.open(tmp_path, CONFIG, resume=True)


def test_a_refused_policy_leaves_nothing_but_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    for path in (tmp_path / "new", tmp_path / "mine"):
        with pytest.raises(UsageError), EvaluationFolder.open(path, CONFIG):
            raise UsageError("actions must be finite")
    assert [entry.name for entry in tmp_path.rglob("*")] == ["mine"]


def test_a_refusal_in_a_run_keeps_its_episodes(tmp_path: Path) -> None:
    run(EvaluationFolder.open(tmp_path, CONFIG))
    with pytest.raises(UsageError), EvaluationFolder.open(tmp_path, CONFIG, resume=True):
        raise UsageError("actions must be finite")
    assert len(read_records(tmp_path)) == 6


def test_a_killed_writer_leaves_nothing_in_the_way(tmp_path: Path) -> None:
    (tmp_path / "config.json.lock").write_text("process 1 on another machine\n")
    with EvaluationFolder.open(tmp_path, CONFIG) as folder:
        assert list(folder.missing(1)) == [0]


def test_records_name_their_config_and_foreign_ones_are_refused(tmp_path: Path) -> None:
    other = {**CONFIG, "policy": "random"}
    run(EvaluationFolder.open(tmp_path / "a", CONFIG))
    run(EvaluationFolder.open(tmp_path / "b", other), 8)
    assert {entry["config_hash"] for entry in lines(tmp_path / "a")} == {
        config_hash(CONFIG)
    }
    assert config_hash(CONFIG) != config_hash(other)
    with open(tmp_path / "a" / "episodes.jsonl", "a") as file:
        file.write((tmp_path / "b" / "episodes.jsonl").read_text())
    for read in (
        read_records,
        lambda path: EvaluationFolder.open(path, CONFIG, resume=True),
    ):
        with refused(
            where="line 7 of",
            said=f"another run: its config has the hash {config_hash(other)}",
        ):
            read(tmp_path / "a")
    with EvaluationFolder.open(tmp_path / "a", CONFIG, overwrite=True) as folder:
        assert folder.records == []


def test_keys_that_change_nothing_in_an_episode_are_not_in_the_hash() -> None:
    assert config_hash(
        {**CONFIG, "worlds": 9, "films": 3, "threads": 2, "home": None}
    ) == config_hash(CONFIG)
    assert config_hash({**CONFIG, "seed": 1}) != config_hash(CONFIG)


def test_runs_of_older_versions_stay_readable(tmp_path: Path) -> None:
    records = run(EvaluationFolder.open(tmp_path, CONFIG))
    file = tmp_path / "episodes.jsonl"
    old = [
        {key: value for key, value in entry.items() if key != "config_hash"}
        for entry in lines(tmp_path)
    ]
    file.write_text("".join(json.dumps(entry) + "\n" for entry in old))
    assert sorted(read_records(tmp_path), key=lambda record: record.index) == records


def test_a_record_that_names_no_config_is_not_continued(tmp_path: Path) -> None:
    """It may come from another run, and would count in the success rate of this one."""
    run(EvaluationFolder.open(tmp_path, CONFIG))
    file = tmp_path / "episodes.jsonl"
    foreign = {**lines(tmp_path)[0], "index": 99}
    del foreign["config_hash"]
    with open(file, "a") as out:
        out.write(json.dumps(foreign) + "\n")
    for read in (
        read_records,
        lambda path: EvaluationFolder.open(path, CONFIG, resume=True),
    ):
        with refused(where="episodes.jsonl (episode 99)", said="no config_hash"):
            read(tmp_path)


def test_an_episode_that_is_there_twice_is_an_error(tmp_path: Path) -> None:
    run(EvaluationFolder.open(tmp_path, CONFIG))
    file = tmp_path / "episodes.jsonl"
    with open(file, "a") as out:
        out.write(file.read_text().splitlines()[0] + "\n")
    for read in (
        read_records,
        lambda path: EvaluationFolder.open(path, CONFIG, resume=True),
    ):
        with refused(said="is there twice"):
            read(tmp_path)


@pytest.mark.parametrize("line", [0, -1])
@pytest.mark.parametrize("field", ["home", "task", "split", "subtask"])
def test_names_that_are_none_are_an_error_wherever_they_stand(
    tmp_path: Path, field: str, line: int
) -> None:
    """A finished line is never taken for one that a crash tore: it would be run again without a word."""
    run(EvaluationFolder.open(tmp_path, CONFIG))
    file = tmp_path / "episodes.jsonl"
    rows = [json.loads(text) for text in file.read_text().splitlines()]
    rows[line][field] = "../../x"
    file.write_text("".join(json.dumps(row) + "\n" for row in rows))
    before = file.read_bytes()
    with refused(where="episodes.jsonl", said=f"field '{field}' of the record"):
        EvaluationFolder.open(tmp_path, CONFIG, resume=True)
    assert file.read_bytes() == before
