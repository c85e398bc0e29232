"""Generation on a local Ray cluster. Run by ``make test-ray``, which installs Ray in an environment of its own."""

from __future__ import annotations

import dataclasses
import importlib
import os
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import mjhab
from mjhab.core.errors import UsageError
from mjhab.data.record.generation import generate
from mjhab.data.record.job import Standing
from mjhab.data.record.ray_workers import FOLDER, LOCAL, RayPool
from mjhab.data.store.checking import check
from mjhab.evaluation.evaluate import EvalSpec, run_evaluation
from mjhab.learning.runs.collection import Collector, Round
from mjhab.learning.runs.specs import Resources, Scene
from mjhab.rollout.policy import RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink
from tests.data.record.worker_pools import KEEP, InlinePool, job, kept


def workers(pool: Any) -> list[int]:
    """Process ids of its actors that are alive."""
    ray = importlib.import_module("ray")
    found = []
    for actor in list(pool._actors.values()):
        try:
            found.append(
                ray.get(actor.__ray_call__.remote(lambda _: os.getpid()), timeout=60)
            )
        except ray.exceptions.RayError:
            continue
    return found


@pytest.mark.parametrize("seed", range(2))
def test_a_worker_killed_in_the_middle_loses_and_doubles_nothing(
    tmp_path: Path, seed: int
) -> None:
    generate(job(tmp_path / "reference", KEEP, worlds=1, per_target=25), InlinePool())
    dice = random.Random(seed)
    killed = list[int]()
    out = tmp_path / "ray"
    pool = RayPool(LOCAL)

    def kill(now: Standing) -> None:
        if len(killed) < 2 and now.written >= 5 * (1 + len(killed)):
            killed.append(
                dice.choice([pid for pid in workers(pool) if pid not in killed])
            )
            os.kill(killed[-1], signal.SIGKILL)

    done = generate(job(out, KEEP, per_target=25, workers=2), pool, kill)
    assert len(killed) == 2 and done.complete and done.written == done.kept == 25
    assert kept(out) == kept(tmp_path / "reference") and check(out).clean


def test_a_run_stops_in_the_middle_of_an_episode(tmp_path: Path) -> None:
    told: list[Standing] = []
    pool: Any = RayPool(LOCAL)
    done = generate(
        job(tmp_path, episodes=100_000, workers=2),
        pool,
        told.append,
        lambda: len(told) > 5,
    )
    begun = time.monotonic()
    assert (
        not done.complete
        and len(kept(tmp_path)) == done.kept >= 3
        and check(tmp_path).clean
    )
    again = generate(job(tmp_path, episodes=done.kept + 5), RayPool(LOCAL), resume=True)
    assert (
        again.complete
        and list(kept(tmp_path)) == list(range(done.kept + 5))
        and time.monotonic() - begun < 60
    )


def test_a_cluster_that_is_not_there() -> None:
    with pytest.raises(UsageError, match="no Ray cluster can be reached"):
        RayPool("127.0.0.1:1")


@pytest.fixture
def two_nodes() -> Iterator[Any]:
    """A cluster of two nodes on this machine, of one core each: the address of the first is "auto"."""
    utils = importlib.import_module("ray.cluster_utils")
    cluster = utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.second = cluster.add_node(num_cpus=1)
    yield cluster
    importlib.import_module("ray").shutdown()
    cluster.shutdown()


def test_a_node_lost_in_the_middle_changes_no_bit_of_a_data_set(
    tmp_path: Path, two_nodes: Any
) -> None:
    generate(job(tmp_path / "reference", KEEP, worlds=1, per_target=25), InlinePool())
    lost = list[int]()

    def lose(now: Standing) -> None:
        if not lost and now.written >= 5:
            lost.append(now.written)
            two_nodes.remove_node(two_nodes.second, allow_graceful=False)

    out = tmp_path / "ray"
    pool = RayPool(two_nodes.address)
    done = generate(job(out, KEEP, per_target=25, workers=2), pool, lose)
    assert lost and done.complete and done.written == done.kept == 25
    assert kept(out) == kept(tmp_path / "reference") and check(out).clean


class PoolOfBlindNodes(RayPool):
    """A pool whose nodes see no folder of this machine: their files travel through Ray."""

    def _greet(self, number: int, theirs: Any) -> Any:
        return super()._greet(number, {**theirs, FOLDER: str(False)})


def test_nodes_without_a_shared_folder_send_their_files(
    tmp_path: Path, two_nodes: Any
) -> None:
    wanted = {"per_target": 15}
    for name, pool, more in (
        ("reference", InlinePool(), {"worlds": 1}),
        ("ray", PoolOfBlindNodes(two_nodes.address), {"workers": 2}),
    ):
        out = tmp_path / name
        asked = job(out, KEEP, **wanted, **more)
        spec = dataclasses.replace(asked.spec, rest=out / "rest")
        generate(dataclasses.replace(asked, spec=spec), pool)
    ours, theirs = (tmp_path / name for name in ("reference", "ray"))
    assert kept(theirs) == kept(ours) != {} and check(theirs).clean
    # Which failures are tried near the end of a quota depends on the workers.
    assert set(kept(theirs / "rest")) & set(kept(ours / "rest"))
    assert check(theirs / "rest").clean


def test_an_evaluation_on_two_nodes_has_the_records_of_one_process(
    tmp_path: Path, two_nodes: Any
) -> None:
    asked: dict[str, Any] = {
        "subtask": "close",
        "target": "kitchen_counter/drawer3",
        "home": "builtin_m1_02",
        "horizon": 20,
        "episodes": 8,
        "worlds": 2,
        "films": 0,
    }
    alone = mjhab.evaluate("random", out=tmp_path / "alone", **asked)
    lost = list[int]()

    class Loses(Sink[RolloutEnv]):
        """Takes a node away after the first finished episode."""

        def on_episode_end(
            self, env: RolloutEnv, world: int, record: EpisodeRecord
        ) -> None:
            if not lost:
                lost.append(record.index)
                two_nodes.remove_node(two_nodes.second, allow_graceful=False)

    ray = two_nodes.address
    spec = EvalSpec.of("random", out=tmp_path / "ray", workers=2, ray=ray, **asked)
    run = run_evaluation(spec, [Loses()])
    assert lost and run.records == alone.records


def test_a_round_of_dagger_on_two_nodes_is_that_of_one_process(
    tmp_path: Path, two_nodes: Any
) -> None:
    view = {"obs_mode": "state"}
    scene = Scene(subtask="close", target="kitchen_counter/drawer3", home="builtin_m1_02")
    wanted = Round(0, 4)
    folders = [tmp_path / name for name in ("alone", "ray")]
    for folder, address in zip(folders, ("", two_nodes.address), strict=True):
        resources = Resources(worlds=2, workers=2 if address else 1, threads=1)
        Collector(scene, view, resources, 0, address).collect(wanted, folder)
    assert kept(folders[0]) == kept(folders[1]) != {}
