"""Labels computed from stored signals are the recorded ones; what new rules change is told and written."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjhab.cli.main import main
from mjhab.data.select import relabel as module
from mjhab.data.select.relabel import relabel
from mjhab.data.store.checking import check
from mjhab.data.store.episode_data import EpisodeData, RunInfo
from mjhab.data.store.places import episodes
from mjhab.data.store.reading import open_shard
from mjhab.data.store.schema import STORED_CHECKS, DamagedError
from mjhab.data.store.shard import ShardWriter
from mjhab.tasks.plan import SubtaskKind
from mjhab.tasks.subtasks.registry import spec_of
from tests.data.fake_world import CHAIN, FakeEnv
from tests.data.make import record
from tests.refusals import command, refused


@pytest.mark.parametrize("subtask", ["", *(kind for kind, _ in CHAIN)])
def test_equals_what_was_recorded(tmp_path: Path, subtask: str) -> None:
    records, _ = record(tmp_path / "a.h5", range(16), FakeEnv(4, subtask))
    for episode, expected in zip(episodes(tmp_path / "a.h5"), records, strict=True):
        assert relabel(episode) == (expected, [])
    found = {entry.label for r in records for entry in r.subtasks}
    assert len(found) > (12 if not subtask else 2), found
    assert {e for r in records for _, e in r.events} >= {"success"}


def test_episodes_that_were_cut(tmp_path: Path) -> None:
    records, _ = record(tmp_path / "a.h5", range(12), max_steps=9)
    assert any(len(r.subtasks) == 0 for r in records) and any(
        len(r.subtasks) for r in records
    )
    assert any(
        step > (r.subtasks[-1].end_step if r.subtasks else 0)
        for r in records
        for step, _ in r.events
    )
    for episode, expected in zip(episodes(tmp_path / "a.h5"), records, strict=True):
        assert relabel(episode) == (expected, [])


def test_changed_rules_are_told_and_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.h5"
    records, _ = record(path, range(14))
    wanted = sum(
        entry.label != spec_of(SubtaskKind.PICK).labels[0]
        for r in records
        for entry in r.subtasks
        if entry.kind == "pick"
    )

    def strict(kind: np.ndarray, history: Any) -> np.ndarray:
        return np.zeros(1, np.int64) if kind[0] == 0 else real(kind, history)

    real = module.label_history

    def label(*options: str) -> dict[str, Any]:
        assert main(["label", str(tmp_path), "--json", *options]) == 0
        return json.loads(capsys.readouterr().out)

    subtasks = sum(len(r.subtasks) for r in records)
    assert label() == {"episodes": 14, "subtasks": subtasks, "changed": 0, "changes": 0}
    with monkeypatch.context() as patch:
        patch.setattr(module, "label_history", strict)
        assert wanted > 1 and label()["changed"] == wanted
        assert [e.record for e in episodes(path)] == records
        assert label("--write")["changed"] == wanted and label()["changed"] == 0
    assert check(path).clean
    for episode, old in zip(episodes(path), records, strict=True):
        new = episode.record
        assert dataclasses.replace(new, subtasks=old.subtasks) == old
        for entry in new.subtasks:
            assert (
                entry.kind != "pick" or entry.label == spec_of(SubtaskKind.PICK).labels[0]
            )
    assert label("--write")["changed"] == wanted
    assert [e.record for e in episodes(path)] == records
    assert (
        main(["label", str(path)]) == 0
        and "0 labels and 0 other things changed" in capsys.readouterr().out
    )


def test_a_record_that_does_not_fit_its_signals_is_refused(tmp_path: Path) -> None:
    record(tmp_path / "a.h5", range(8))
    for episode in episodes(tmp_path / "a.h5"):
        if len(episode.record.subtasks) > 1:
            old = episode.record
            wrong = dataclasses.replace(old.subtasks[1], index=4)
            episode.__dict__["record"] = dataclasses.replace(
                old, subtasks=(old.subtasks[0], wrong)
            )
            with pytest.raises(
                DamagedError,
                match=r"has subtask 4, and its signals are \d+ states of subtask 1",
            ):
                relabel(episode)
            return
    raise AssertionError("no episode got beyond its first subtask")


def test_a_shard_without_ee_contact_is_read_with_touch_in_its_place(
    tmp_path: Path,
) -> None:
    record(tmp_path / "new.h5", range(6))
    old = len(STORED_CHECKS) - 1
    assert STORED_CHECKS[old] == "ee_contact"
    with ShardWriter(tmp_path / "old.h5") as writer:
        for episode in episodes(tmp_path / "new.h5"):
            arrays = {
                path: episode.array(path) for path in episode.paths if path != "record"
            }
            cut = {
                path: arrays[path][:, :old]
                for path in ("signals/checks", "subtasks/checks")
            }
            columns = {"signals/checks": STORED_CHECKS[:old]}
            writer.append(
                EpisodeData(
                    episode.record, episode.run, "m", "cut", arrays | cut, columns
                )
            )
    assert check(tmp_path / "old.h5").clean
    for episode in episodes(tmp_path / "old.h5"):
        for k in range(len(episode.array("subtasks/step"))):
            _, history = episode.history(k)
            np.testing.assert_array_equal(history.ee_contact, history.touch)
    differ = 0
    for episode in episodes(tmp_path / "new.h5"):
        _, history = episode.history(0)
        differ += int((history.ee_contact != history.touch).sum())
    assert differ


@pytest.mark.parametrize(
    "words", [("label",), ("data", "report", "--out", "report.html")]
)
def test_data_of_a_subtask_that_is_not_registered_hint_at_its_plugin(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    record(Path("a.h5"), range(1), FakeEnv(subtask="pick"))
    with open_shard(Path("a.h5")) as shard:
        episode = next(iter(shard))
        arrays = {name: episode.array(name) for name in episode.paths if name != "record"}
        kinds = tuple(
            dataclasses.replace(s, kind="pushh") for s in episode.record.subtasks
        )
        told = dataclasses.replace(episode.record, subtasks=kinds)
    with ShardWriter(Path("b.h5")) as writer:
        writer.append(EpisodeData(told, RunInfo({"a": 1}), "m", "success", arrays))
    with refused("recorded subtask", "pushh", advice="MJHAB_PLUGINS=PATH"):
        command(*words, "b.h5")
