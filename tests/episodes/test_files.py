"""Files of generated episodes: any worker count and any interruption give the same file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from mjhab.episodes.files import (
    Factory,
    Recipe,
    make_file,
    manifest_path,
    partial_path,
    state_hash,
)
from mjhab.episodes.hab.format import read_hab
from tests.refusals import refused

RECIPE = Recipe("tidy_house", "val", 5, "builtin", 0, 6)


def silent(done: int, rejected: int) -> None:
    """Nobody watches."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "all.json.gz"
    told: list[tuple[int, int]] = []
    made = make_file(RECIPE, out, 1, lambda done, rejected: told.append((done, rejected)))
    assert [done for done, _ in told] == list(range(7)) and told[-1] == (
        made["episodes"],
        made["rejected"],
    )
    return out


def test_the_file_holds_the_episodes_and_the_manifest_their_hashes(whole: Path) -> None:
    file = read_hab(whole)
    manifest = json.loads(manifest_path(whole).read_text())
    assert [e.episode_id for e in file.episodes] == [str(i) for i in range(6)]
    assert {e.info["split"] for e in file.episodes} == {"val"}
    assert [len(e.target_names) for e in file.episodes] == [5] * 6
    assert (manifest["task"], manifest["seed"], manifest["count"]) == ("tidy_house", 5, 6)
    assert [row["hash"] for row in manifest["episodes"]] == [
        state_hash(e) for e in file.episodes
    ]
    assert [row["home"] for row in manifest["episodes"]] == [
        e.scene for e in file.episodes
    ]
    assert len({row["hash"] for row in manifest["episodes"]}) == 6
    assert not partial_path(whole).exists()


def test_one_episode_can_be_made_alone(whole: Path, tmp_path: Path) -> None:
    alone = tmp_path / "one.json"
    make_file(replace(RECIPE, first=4, count=1), alone, 1, silent)
    (one,) = read_hab(alone).episodes
    assert state_hash(one) == state_hash(read_hab(whole).episodes[4])


def test_workers_do_not_change_the_file(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "two.json.gz"
    make_file(RECIPE, out, 2, silent)
    assert out.read_bytes() == whole.read_bytes()


def test_an_interrupted_run_goes_on(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "all.json.gz"

    def stop(done: int, rejected: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_file(RECIPE, out, 1, stop)
    assert not out.exists() and not manifest_path(out).exists()
    partial = partial_path(out)
    text = partial.read_text()
    assert len(text.splitlines()) == 4
    partial.write_text(text[:-40])  # killed while it wrote the third
    made: list[int] = []
    row = Factory.row

    def counted(factory: Factory, index: int):
        made.append(index)
        return row(factory, index)

    monkeypatch.setattr(Factory, "row", counted)
    assert make_file(RECIPE, out, 1, silent)["episodes"] == 6
    assert made == [2, 3, 4, 5]
    assert out.read_bytes() == whole.read_bytes() and not partial.exists()


def test_nothing_is_replaced_unasked(whole: Path, tmp_path: Path) -> None:
    with refused(where=whole, said="exists; add --overwrite"):
        make_file(RECIPE, whole, 1, silent)
    out = tmp_path / "x.json"
    partial_path(out).write_text('{"format": "mjhab-episodes-1", "task": "set_table"}\n')
    with refused(where="x.json.partial", said="was left by a run with other options"):
        make_file(replace(RECIPE, count=1), out, 1, silent)
    make_file(replace(RECIPE, count=1), out, 1, silent, overwrite=True)
    assert len(read_hab(out).episodes) == 1
