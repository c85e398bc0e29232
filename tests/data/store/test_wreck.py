"""A shard that is cut anywhere, or whose index is damaged, gives back every episode whose bytes are all there."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
from h5py import h5o  # type: ignore[attr-defined]

from mjhab.cli.main import main
from mjhab.data.store.checking import check, repair
from mjhab.data.store.damage import problems_in
from mjhab.data.store.episode_data import EpisodeData, RunInfo
from mjhab.data.store.hdf5 import group
from mjhab.data.store.places import episodes
from mjhab.data.store.reading import open_shard
from mjhab.data.store.schema import DamagedError
from mjhab.data.store.shard import ShardWriter
from mjhab.data.store.wreck import HEADER, Wreck
from tests.data.make import numbered, one_episode

COUNT = 16
RUNS = 11
"""More than HDF5 keeps in a group without an index."""


@pytest.fixture(scope="module")
def made(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, list[int], dict[str, str]]:
    """A shard of many runs, its length after every episode, and the digest of every episode in order."""
    folder = tmp_path_factory.mktemp("whole")
    template = one_episode(folder)
    path = folder / "whole.h5"
    lengths: list[int] = []
    digests: dict[str, str] = {}
    with ShardWriter(path) as writer:
        for index in range(COUNT):
            data: EpisodeData = replace(
                numbered(template, index),
                run=RunInfo({"a": 1}, {"part": index * RUNS // COUNT}),
            )
            writer.append(data)
            lengths.append(path.stat().st_size)
            digests[data.name] = str(
                open_shard(path).episode(data.name).attributes["digest"]
            )
    return path, lengths, digests


@pytest.mark.parametrize("share", [0.10, 0.25, 0.50, 0.75, 0.92, 0.99, 0.9999])
def test_every_whole_episode_of_a_cut_shard_is_recovered(
    tmp_path: Path, made: tuple[Path, list[int], dict[str, str]], share: float
) -> None:
    source, lengths, digests = made
    path = tmp_path / "a.h5"
    path.write_bytes(source.read_bytes())
    size = int(lengths[-1] * share)
    os.truncate(path, size)
    whole = list(digests)[: sum(length <= size for length in lengths)]
    done = repair(path)
    saved = {
        episode.name: str(episode.attributes["digest"]) for episode in episodes(path)
    }
    assert done.kept == len(saved) and set(whole) <= set(saved)
    # One more may be there: what is written last of it is the index of the shard.
    assert len(saved) <= len(whole) + 1
    assert saved == {name: digests[name] for name in saved}
    assert check(path).clean
    assert done.kept_as is not None and done.kept_as.stat().st_size == size
    with ShardWriter(path) as writer:
        assert writer.names == set(saved)


def test_a_turned_bit_in_a_cut_shard_is_still_found(
    tmp_path: Path, made: tuple[Path, list[int], dict[str, str]]
) -> None:
    source, lengths, digests = made
    size = lengths[COUNT // 2]
    good = source.read_bytes()[:size]
    path = tmp_path / "a.h5"
    before = lengths[0]
    for at in range(before + 100, lengths[4], (lengths[4] - before) // 6):
        path.write_bytes(good[:at] + bytes([good[at] ^ 16]) + good[at + 1 :])
        repair(path)
        saved = {
            episode.name: str(episode.attributes["digest"]) for episode in episodes(path)
        }
        assert saved == {name: digests[name] for name in saved}
        assert len(saved) >= COUNT // 2 - 1 and check(path).clean


def test_a_damaged_index_loses_nothing(
    tmp_path: Path,
    made: tuple[Path, list[int], dict[str, str]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    source, _, digests = made
    path = tmp_path / "a.h5"
    path.write_bytes(source.read_bytes())
    with open_shard(path) as shard:
        index = group(shard.file, "episodes")
        at = h5o.get_info(index.id).addr
    data = bytearray(path.read_bytes())
    assert data[at : at + 4] == HEADER
    data[at + 20] ^= 1
    path.write_bytes(data)
    with pytest.raises(DamagedError, match="mjhab data repair"):
        open_shard(path)
    assert main(["data", "repair", str(path)]) == 0
    assert (
        f"{COUNT} episodes kept, 0 lost; how many more are lost is unknown"
        in capsys.readouterr().out
    )
    path.write_bytes(data)
    done = repair(path)
    assert done.kept == COUNT and not done.lost and not done.indexed
    assert {episode.name for episode in episodes(path)} == set(digests)


def test_headers_that_are_none_are_passed_over(
    tmp_path: Path, made: tuple[Path, list[int], dict[str, str]]
) -> None:
    """The four bytes may stand anywhere, also where nothing but chance or malice put them."""
    source, _, digests = made
    path = tmp_path / "a.h5"
    filler = (HEADER + b"\x02\x00" + b"\xff" * 40) * 50
    path.write_bytes(source.read_bytes() + filler)
    wreck = Wreck(path)
    assert wreck.names == sorted(digests) and wreck.indexed
    assert not any(problems_in(wreck, name) for name in wreck.names)
    wreck.close()
