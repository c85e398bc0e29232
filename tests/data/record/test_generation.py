"""Data sets by several workers: the same set whoever works and dies; stopped and resumed; full disks; wrong folders."""

from __future__ import annotations

import errno
import functools
import json
import multiprocessing
import os
import random
import signal
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from mjhab.core.errors import MjhabError
from mjhab.data.record.generation import generate
from mjhab.data.record.job import GENERATION_CONFIG, TRIED, Job, Standing
from mjhab.data.record.messages import EpisodeDone, Request, WorkerReady
from mjhab.data.record.pools import ProcessPool
from mjhab.data.record.ray_workers import _Actor
from mjhab.data.record.workers import Stage
from mjhab.data.store.checking import check
from mjhab.data.store.episode_data import EpisodeData
from mjhab.data.store.episode_files import EpisodeFiles, lock_set
from mjhab.data.store.packing import pack
from mjhab.data.store.storage import StorageError
from mjhab.rollout.policy import RandomPolicy
from tests.data.record.worker_pools import KEEP, InlinePool, after, build, job, kept
from tests.refusals import refused

COUNT = 16
"""Episodes to keep; not every one that is tried passes."""


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict[int, str]:
    """What one worker with one world keeps."""
    out = tmp_path_factory.mktemp("reference") / "set"
    done = generate(job(out, KEEP, worlds=1, per_target=COUNT, chunk=1), InlinePool())
    assert done.complete and (done.written, done.kept, done.wanted) == (
        COUNT,
        COUNT,
        COUNT,
    )
    assert (
        done.tried > COUNT and done.passed >= COUNT and sum(done.labels.values()) == COUNT
    )
    assert done.bytes == sum(path.stat().st_size for path in out.rglob("*.h5"))
    return kept(out)


def test_a_worker_on_a_node_that_sees_no_folder_hands_over_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = tmp_path / "node"
    node.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(node))
    out, rest = tmp_path / "out", tmp_path / "rest"
    actor = _Actor()
    begun = actor.begin(replace(job(out, KEEP).spec, rest=rest), out, False)
    assert isinstance(begun.messages[0], WorkerReady)
    seen = set[tuple[int, str]]()
    for first in (0, 8):
        answer = actor.run(Request(tuple(range(first, first + 8))))
        stored = [said for said in answer.messages if isinstance(said, EpisodeDone)]
        names = {(folder, name) for folder, name, _ in answer.files}
        # Episodes that pass lie in the first folder, the others in that of the rest, and each is told once.
        passed = sum(said.outcome.passes for said in stored)
        assert [sum(folder == k for folder, _ in names) for k in (0, 1)] == [
            passed,
            len(stored) - passed,
        ]
        assert not names & seen
        seen |= names
    assert {folder for folder, _ in seen} == {0, 1}
    assert not [path for path in node.rglob("*") if path.is_file()]
    assert not out.exists() and not rest.exists()


@pytest.mark.parametrize(
    ("workers", "worlds", "chunk", "deaths"),
    [(2, 2, 3, 0.0), (5, 1, 2, 0.0), (3, 2, 4, 0.2)],
)
def test_workers_and_deaths_do_not_change_the_set(
    tmp_path: Path,
    reference: dict[int, str],
    workers: int,
    worlds: int,
    chunk: int,
    deaths: float,
) -> None:
    pool = InlinePool(seed=workers, deaths=deaths)
    done = generate(
        job(tmp_path, KEEP, worlds, per_target=COUNT, workers=workers, chunk=chunk), pool
    )
    assert done.complete and done.written == done.kept == COUNT and pool.stopped
    assert kept(tmp_path) == reference and check(tmp_path).clean
    assert (pool.died > 0) == (deaths > 0)


def test_failures_are_kept_without_a_filter(tmp_path: Path) -> None:
    done = generate(job(tmp_path, episodes=20, workers=3), InlinePool(deaths=0.1))
    assert (
        done.complete
        and list(kept(tmp_path)) == list(range(20))
        and done.tried == done.passed == 20
    )
    assert len(done.labels) > 3


def test_quotas_of_labels(tmp_path: Path) -> None:
    done = generate(
        job(tmp_path / "three", episodes=45, per_label=2, workers=3), InlinePool(1)
    )
    assert done.complete and max(done.labels.values()) == 2 and len(done.labels) > 3
    generate(job(tmp_path / "one", episodes=45, per_label=2), InlinePool(2))
    assert kept(tmp_path / "one") == kept(tmp_path / "three")


def test_a_stopped_run_goes_on_where_it_was(
    tmp_path: Path, reference: dict[int, str]
) -> None:
    work = job(tmp_path, KEEP, per_target=COUNT, workers=2)
    first = generate(work, InlinePool(3), stopped=after(12))
    assert not first.complete and 0 < first.kept < COUNT
    written = first.written
    for n in range(20):
        now = generate(work, InlinePool(n, deaths=0.1), stopped=after(25), resume=True)
        written += now.written
        if now.complete:
            break
    assert now.complete and written == now.kept == COUNT and kept(tmp_path) == reference
    again = generate(work, InlinePool(), resume=True)
    assert again.complete and again.written == 0 and kept(tmp_path) == reference


def test_a_raised_quota_gives_the_set_of_the_larger_one(
    tmp_path: Path, reference: dict[int, str]
) -> None:
    generate(job(tmp_path, KEEP, per_target=10, workers=3), InlinePool(1))
    assert len(kept(tmp_path)) == 10
    told: list[Standing] = []
    generate(
        job(tmp_path, KEEP, per_target=COUNT, workers=1),
        InlinePool(2),
        told.append,
        resume=True,
    )
    assert kept(tmp_path) == reference
    assert [s.kept for s in told] == sorted(s.kept for s in told) and told[
        -1
    ].kept == COUNT == told[-1].wanted


def test_a_quota_that_cannot_be_filled_ends_with_the_episodes(tmp_path: Path) -> None:
    done = generate(
        job(tmp_path, "steps > 10000", episodes=10, per_target=3, workers=2), InlinePool()
    )
    assert done.complete and (done.kept, done.tried, done.passed) == (0, 10, 0)
    lines = (tmp_path / TRIED).read_text().splitlines()
    assert sorted(json.loads(line)["index"] for line in lines) == list(range(10))
    # Half a line, as a kill in the middle of writing it leaves.
    (tmp_path / TRIED).write_text("\n".join(lines)[:-5])
    again = generate(
        job(tmp_path, "steps > 10000", episodes=12, per_target=3),
        InlinePool(),
        resume=True,
    )
    assert again.tried == 12 and len((tmp_path / TRIED).read_text().splitlines()) == 12


class FailingPolicy(RandomPolicy):
    """Ends every third episode with an error until ``works`` is set."""

    works = False

    def __init__(self) -> None:
        super().__init__(0)
        self.indices: list[int] = []

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        self.indices = [spec["index"] for spec in info["episode_spec"]]
        return super().act(obs, info)

    def fault(self, world: int) -> str:
        fails = not self.works and self.indices[world] % 3 == 0
        return "no answer within 30 s" if fails else ""


class OncePolicy(FailingPolicy):
    """Ends every episode with an error that another worker has begun before."""

    owners: ClassVar[dict[int, FailingPolicy]] = {}

    def fault(self, world: int) -> str:
        owner = self.owners.setdefault(self.indices[world], self)
        return "no answer within 30 s" if owner is not self and not self.works else ""


def build_failing(policy: type[FailingPolicy]) -> Stage:
    return replace(build(), policy=policy())


def failing(work: Job, policy: type[FailingPolicy]) -> Job:
    stage = functools.partial(build_failing, policy)
    return replace(work, spec=replace(work.spec, build=stage))


@pytest.mark.parametrize("keep", ["", "steps > 0"])
def test_episodes_that_the_policy_cannot_finish_are_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keep: str
) -> None:
    work = failing(job(tmp_path, keep, episodes=9, workers=2), FailingPolicy)
    done = generate(work, InlinePool(deaths=0.1))
    assert done.errors == {"no answer within 30 s": 3} and done.complete
    assert list(kept(tmp_path)) == [1, 2, 4, 5, 7, 8] and done.kept == 6
    assert not (tmp_path / TRIED).exists()
    monkeypatch.setattr(FailingPolicy, "works", True)
    done = generate(work, InlinePool(), resume=True)
    assert not done.errors and (done.written, done.kept) == (3, 9)
    assert list(kept(tmp_path)) == list(range(9))


def test_a_lost_episode_that_fails_the_second_time_is_not_waited_for(
    tmp_path: Path, reference: dict[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(OncePolicy, "owners", {})
    work = job(tmp_path, KEEP, per_target=COUNT, workers=3, chunk=4)
    work = failing(work, OncePolicy)
    # The pool dies with an episode that was promised to be kept.
    done = generate(work, InlinePool(seed=0, deaths=0.2))
    assert done.complete and done.errors and done.kept == COUNT - 1
    monkeypatch.setattr(OncePolicy, "works", True)
    done = generate(work, InlinePool(), resume=True)
    assert done.complete and not done.errors and kept(tmp_path) == reference


@pytest.mark.parametrize(
    "line",
    [
        "null",
        "[]",
        "{}",
        '{"index":"1","target":"all","label":"","passes":true}',
        "9" * 5000,
    ],
)
def test_tried_episodes_that_are_none_are_refused(tmp_path: Path, line: str) -> None:
    generate(job(tmp_path, "steps > 10000", episodes=2), InlinePool())
    (tmp_path / TRIED).write_text(f"{line}\n")
    with refused(where=TRIED, said="damaged"):
        generate(job(tmp_path, "steps > 10000", episodes=2), InlinePool(), resume=True)


def workers() -> list[int]:
    """Process ids of the workers that live."""
    return [process.pid or 0 for process in multiprocessing.active_children()]


def test_processes_killed_at_random_lose_and_double_nothing(
    tmp_path: Path, reference: dict[int, str]
) -> None:
    pool = ProcessPool()
    dice = random.Random(5)
    killed = list[int]()

    def kill(now: Standing) -> None:
        if len(killed) < 2 and now.written >= 4 * (1 + len(killed)):
            time.sleep(0.05 * dice.random())
            killed.append(dice.choice([pid for pid in workers() if pid not in killed]))
            os.kill(killed[-1], signal.SIGKILL)

    done = generate(job(tmp_path, KEEP, per_target=COUNT, workers=2), pool, kill)
    assert len(killed) == 2 and done.complete and done.written == COUNT
    assert kept(tmp_path) == reference and check(tmp_path).clean and not workers()


def test_processes_stop_in_the_middle_of_an_episode(tmp_path: Path) -> None:
    pool = ProcessPool()
    begun = time.monotonic()
    told: list[Standing] = []
    done = generate(
        job(tmp_path, episodes=100_000, workers=1),
        pool,
        told.append,
        lambda: len(told) > 5,
    )
    assert (
        not done.complete
        and done.kept >= 3
        and not workers()
        and time.monotonic() - begun < 20
    )
    assert check(tmp_path).clean and len(kept(tmp_path)) == done.kept


def test_a_full_disk_stops_and_can_be_resumed(
    tmp_path: Path, reference: dict[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = EpisodeFiles.append
    left = [8]

    def append(self: EpisodeFiles, data: EpisodeData) -> int:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(28, "No space left on device")
        return real(self, data)

    work = job(tmp_path, KEEP, per_target=COUNT, workers=2)
    with monkeypatch.context() as patch:
        patch.setattr(EpisodeFiles, "append", append)
        pool = InlinePool()
        with pytest.raises(
            StorageError,
            match=r"the disk is full.*Continue with `mjhab generate --resume`",
        ):
            generate(work, pool)
        assert pool.stopped and len(kept(tmp_path)) == 8
    assert (
        generate(work, InlinePool(), resume=True).complete and kept(tmp_path) == reference
    )


def test_the_disk_of_the_list_of_tries_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("mjhab.data.record.generation._Run._log", full)
    with pytest.raises(StorageError, match=r"No space left.*--resume"):
        generate(job(tmp_path, "steps > 10000", episodes=10), InlinePool())


def test_a_worker_that_always_dies_or_fails_is_given_up(tmp_path: Path) -> None:
    with pytest.raises(MjhabError, match="died 3 times"):
        generate(
            job(tmp_path / "a", "steps > 10000", episodes=10), InlinePool(deaths=1.0)
        )


def test_nobody_packs_what_is_being_generated_nor_the_other_way_round(
    tmp_path: Path,
) -> None:
    work = job(tmp_path, episodes=3)
    with refused(said="is being written"):
        generate(work, InlinePool(), lambda now: now.written and pack(tmp_path))
    with lock_set(tmp_path), refused(said="is being written"):
        generate(work, InlinePool(), resume=True)
    assert generate(work, InlinePool(), resume=True).kept == pack(tmp_path).episodes == 3
    # The packed ones count.
    more = generate(job(tmp_path, episodes=5), InlinePool(), resume=True)
    assert (more.written, more.kept) == (2, 5)
    assert len(kept(tmp_path)) == 5


def test_folders_that_cannot_be_used(tmp_path: Path) -> None:
    generate(job(tmp_path / "a", episodes=3), InlinePool())
    with refused("out", advice="Give --resume"):
        generate(job(tmp_path / "a", episodes=3), InlinePool())
    with refused(said="started with keep = '', now it is"):
        generate(job(tmp_path / "a", "success", episodes=3), InlinePool(), resume=True)
    (tmp_path / "a" / GENERATION_CONFIG).unlink()
    with refused(
        "resume", expected="a folder with generation.json", advice="nothing to resume"
    ):
        generate(job(tmp_path / "a", episodes=3), InlinePool(), resume=True)
    with refused("out", expected="a folder, not a file"):
        file = min((tmp_path / "a").rglob("*.h5"))
        generate(job(file, episodes=3), InlinePool())
    (tmp_path / "a" / GENERATION_CONFIG).write_text('{"keep": ""}')
    work = job(tmp_path / "a", episodes=5)
    with refused(where="a", said="is being written"):
        generate(
            work,
            InlinePool(),
            lambda _: generate(work, InlinePool(), resume=True),
            resume=True,
        )
    other = replace(
        work, spec=replace(work.spec, build=functools.partial(build, 2, "pick"))
    )
    with refused(where=tmp_path, said="another configuration"):
        generate(other, InlinePool(), resume=True)
    assert generate(work, InlinePool(), resume=True).kept == 5
