"""Evaluation as a library function: what `mjhab eval` does, from Python, on an env without physics."""

from __future__ import annotations

import json
import random
import tracemalloc
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjhab
from mjhab.core.errors import MjhabError, UsageError
from mjhab.data.record.ray_workers import check_node, node_identity
from mjhab.evaluation import evaluate as library
from mjhab.evaluation import spread
from mjhab.evaluation.evaluate import EvalSpec, EvaluationInterrupted, run_evaluation
from mjhab.rollout.films import HumanView
from mjhab.rollout.policy import RolloutEnv, ZeroPolicy
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink
from mjhab.rollout.store import read_records
from tests.data.record.worker_pools import InlinePool
from tests.refusals import refused
from tests.rollout.fake_env import FakeEnv


class Stage:
    """Stands in for the real environment; remembers what was asked for."""

    def __init__(self) -> None:
        self.built: list[FakeEnv] = []
        self.options: list[dict[str, Any]] = []
        self.interrupt_at: int | None = None

    def make_env(self, spec: EvalSpec, options: Mapping[str, Any]) -> FakeEnv:
        env = FakeEnv(min(spec.asked.num_envs, spec.episodes))
        env.interrupt_at = self.interrupt_at
        self.built.append(env)
        self.options.append(dict(options))
        return env


def small_view(*_: int) -> HumanView:
    """Frames of the size in which films are encoded in no time."""
    return HumanView(64, 48)


@pytest.fixture(autouse=True)
def stage(monkeypatch: pytest.MonkeyPatch) -> Stage:
    stage = Stage()
    monkeypatch.setattr(library, "make_env", stage.make_env)
    # A camera that looks for hand and target needs the robot, which the stand-in lacks.
    monkeypatch.setattr(spread, "FilmCrew", small_view)
    monkeypatch.setattr(spread, "make_env", stage.make_env)
    return stage


class Own(ZeroPolicy):
    """A policy of a user."""

    name = "own"
    env_options = {"obs_mode": "depth", "camera_size": 32}  # noqa: RUF012


class Knowing(ZeroPolicy):
    """A policy that is made from its environment."""

    def __init__(self, env: RolloutEnv) -> None:
        super().__init__()
        self.env = env


def test_a_run_folder_with_report_and_films(stage: Stage, tmp_path: Path) -> None:
    run = mjhab.evaluate("zero", episodes=3, worlds=2, films=1, out=tmp_path / "run")
    names = sorted(entry.name for entry in run.path.iterdir())
    assert names == [
        "config.json",
        "episodes.jsonl",
        "films",
        "report.html",
        "summary.json",
    ]
    assert [entry.name for entry in (run.path / "films").iterdir()] == [
        "episode_00000.mp4"
    ]
    assert run.report.read_text().count("<video") == 1 and run.film_problem is None
    assert [record.index for record in run.records] == [0, 1, 2] and run.summary[
        "episodes"
    ] == 3
    assert list(run.records) == sorted(
        read_records(run.path), key=lambda record: record.index
    )
    assert json.loads((run.path / "config.json").read_text()) == run.config
    assert stage.built[0].closed


def test_all_ways_to_give_a_policy_are_one(stage: Stage, tmp_path: Path) -> None:
    runs = [
        mjhab.evaluate(policy, episodes=4, films=0, out=str(tmp_path / str(number)))
        for number, policy in enumerate(
            ["zero", ZeroPolicy(), ZeroPolicy, Knowing, lambda env: Knowing(env)]
        )
    ]
    assert all(run.records == runs[0].records for run in runs)
    assert [run.config["policy"] for run in runs] == [
        "zero",
        "zero",
        "zero",
        "zero",
        "<lambda>",
    ]


def test_what_the_policy_needs_and_what_the_user_asks_for(
    stage: Stage, tmp_path: Path
) -> None:
    asked = {"episodes": 1, "films": 0}
    run = mjhab.evaluate(
        Own(), **asked, camera_size=64, horizon=np.int64(5), out=tmp_path / "a"
    )
    assert stage.options[0] == {"obs_mode": "depth", "camera_size": 64, "horizon": 5}
    assert run.config["env"] == stage.options[0] and run.config["policy"] == "own"
    mjhab.evaluate(Own, **asked, env={"obs_mode": "rgb"}, out=tmp_path / "b")
    assert stage.options[1] == {"obs_mode": "rgb", "camera_size": 32}


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"episods": 3}, dict(option="option of an evaluation", given="episods")),
        ({"autoreset": "same_step"}, dict(option="option of an evaluation")),
        ({"env": {"task": "set_tabel"}}, dict(option="task", expected="set_table")),
        ({"task": "set_tabel"}, dict(option="task", given="set_tabel")),
        ({"target": "024_bowl"}, dict(option="target", given="024_bowl")),
        ({"episodes": 0}, dict(option="episodes", given=0)),
        ({"episodes": 10**18}, dict(option="episodes", given=10**18)),
        ({"episodes": "3"}, dict(option="episodes", given="3")),
        ({"worlds": 10**8}, dict(option="worlds", expected="at most 10,000,000")),
        ({"films": 10**6}, dict(option="films", expected="at most 10,000")),
        ({"threads": True}, dict(option="threads", given=True)),
        ({"seed": 2**63}, dict(option="seed", given=2**63)),
        ({"horizon": 10**20}, dict(option="horizon", given=10**20)),
        ({"frame_stack": 10**9}, dict(option="frame_stack", given=10**9)),
        ({"style": ("speed=0.5",)}, dict(option="style", given=("speed=0.5",))),
        ({"instruction": "shut it"}, dict(option="instruction", given="shut it")),
        ({"instruction": "", "subtask": "close"}, dict(option="instruction", given="")),
        ({"instruction": " . ", "subtask": "close"}, dict(option="instruction")),
        (
            {"instruction": "shut it", "subtask": "close"},
            dict(where="policy zero", said="takes no instruction"),
        ),
        (
            {"instruction": "shut it", "subtask": "close", "policy": ZeroPolicy},
            dict(where="policy zero", said="takes no instruction"),
        ),
        ({"policy": "nobody"}, dict(option="policy", given="nobody")),
        ({"policy": object()}, dict(where="object", said="has no reset and no act")),
        ({"policy": FakeEnv}, dict(where="FakeEnv", said="has no act")),
    ],
)
def test_bad_input_leaves_nothing(
    stage: Stage, tmp_path: Path, options: dict[str, Any], told: dict[str, Any]
) -> None:
    with refused(**told):
        mjhab.evaluate(**{"out": tmp_path / "run", "policy": "zero", **options})
    assert not (tmp_path / "run").exists() and all(env.closed for env in stage.built)


def test_episodes_take_memory_only_when_they_run(stage: Stage, tmp_path: Path) -> None:
    """A list of the indices would take 200 MB."""
    episodes = 5_000_000
    for resume in (False, True):
        stage.interrupt_at = 200
        tracemalloc.start()
        with pytest.raises(EvaluationInterrupted):
            mjhab.evaluate(
                "zero", episodes=episodes, films=0, out=tmp_path, resume=resume
            )
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 60e6


def test_ctrl_c_reports_and_goes_on_to_the_caller(stage: Stage, tmp_path: Path) -> None:
    stage.interrupt_at = 200
    with pytest.raises(EvaluationInterrupted) as caught:
        mjhab.evaluate("zero", episodes=30, films=0, out=tmp_path)
    kept = caught.value.run
    assert isinstance(caught.value, KeyboardInterrupt) and 0 < len(kept.records) < 30
    assert (
        f"Partial: {len(kept.records)} of 30" in kept.report.read_text()
        and stage.built[0].closed
    )
    stage.interrupt_at = None
    whole = mjhab.evaluate("zero", episodes=30, films=0, out=tmp_path, resume=True)
    assert (
        len(whole.records) == 30
        and whole.records
        == mjhab.evaluate("zero", episodes=30, out=tmp_path, resume=True).records
    )
    assert len(stage.built) == 2, "nothing was left to run the third time"


def test_further_sinks_hear_the_rollout(tmp_path: Path) -> None:
    class Log(Sink):
        ended: list[int] = []  # noqa: RUF012

        def on_episode_end(self, env: Any, world: int, record: Any) -> None:
            self.ended.append(record.index)

    run_evaluation(EvalSpec.of("zero", episodes=3, films=0, out=tmp_path), [Log()])
    assert sorted(Log.ended) == [0, 1, 2]


def test_default_folders_are_valid_names() -> None:
    spec = EvalSpec.of(subtask="pick")
    assert (
        library.default_out(spec, "ws://host:80/a b").name
        == "set_table_pick_ws-host-80-a-b_seed0"
    )


class Drawing(ZeroPolicy):
    """Draws from the global generators, as policies of others do."""

    name = "drawing"

    def __init__(self, env: RolloutEnv) -> None:
        super().__init__()
        import torch

        self.drawn = [random.random(), np.random.rand(), float(torch.rand(()))]

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        self.drawn.append(np.random.rand())
        return super().act(obs, info)


def test_the_seed_of_the_run_seeds_the_global_generators(tmp_path: Path) -> None:
    import torch

    def drawn(seed: int, out: str) -> list[float]:
        made: list[Drawing] = []

        def make(env: RolloutEnv) -> Drawing:
            made.append(Drawing(env))
            return made[0]

        mjhab.evaluate(make, episodes=2, seed=seed, films=0, out=tmp_path / out)
        return made[0].drawn

    def state() -> list[Any]:
        legacy: Any = np.random.get_state()
        return [
            random.getstate(),
            legacy[1].tolist(),
            legacy[2:],
            torch.get_rng_state().tolist(),
        ]

    before = state()
    first = drawn(3, "a")
    # Training goes on drawing as if there had been no evaluation.
    assert state() == before
    np.random.rand(5)
    assert drawn(3, "b") == first and len(first) > 4
    other = drawn(4, "c")
    assert all(a != b for a, b in zip(first, other, strict=False))
    assert drawn(2**40, "d")[0] != first[0]


class HeardSink(Sink[RolloutEnv]):
    """Hears what a progress bar needs."""

    def __init__(self) -> None:
        self.begun: list[int] = []
        self.ended: list[int] = []

    def on_begin(self, env: RolloutEnv, episodes: Collection[int]) -> None:
        self.begun = list(episodes)

    def on_episode_end(self, env: RolloutEnv, world: int, record: EpisodeRecord) -> None:
        self.ended.append(record.index)


@pytest.mark.parametrize("deaths", [0.0, 0.15])
def test_several_workers_make_the_records_of_one_process(
    deaths: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options: dict[str, Any] = {"worlds": 2, "films": 2}
    alone = mjhab.evaluate("random", episodes=11, out=tmp_path / "alone", **options)
    pool = InlinePool(seed=3, deaths=deaths)
    monkeypatch.setattr(spread, "make_pool", lambda workers, ray: pool)
    heard = HeardSink()
    options |= {"workers": 3, "out": tmp_path / "spread"}
    mjhab.evaluate("random", episodes=4, **options)
    again = EvalSpec.of("random", episodes=11, resume=True, **options)
    run = run_evaluation(again, [heard])
    assert pool.stopped and (pool.died > 0) == (deaths > 0)
    assert heard.begun == sorted(heard.ended) == list(range(4, 11))
    assert run.records == alone.records
    films = [sorted(f.name for f in (r.path / "films").iterdir()) for r in (run, alone)]
    assert films[0] == films[1] and len(films[0]) == 2


def test_a_worker_that_dies_again_and_again_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spread, "make_pool", lambda workers, ray: InlinePool(0, 1.0))
    with pytest.raises(MjhabError, match="died 3 times"):
        mjhab.evaluate("zero", episodes=6, workers=2, films=0, out=tmp_path / "run")


def test_policies_that_several_processes_cannot_ask_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with refused("workers", 2, expected="0, and no --ray, with a served policy"):
        mjhab.evaluate("ws://127.0.0.1:1", subtask="pick", workers=2, out=out)
    with refused(said="cannot be sent to worker processes"):
        mjhab.evaluate(lambda env: ZeroPolicy(), workers=2, out=out)
    assert not out.exists()


def test_a_node_of_another_version_or_arithmetic_is_refused() -> None:
    same = {**node_identity(), "node": "other"}
    check_node(same)
    with pytest.raises(UsageError, match=r"mjhab 0\.0\.1, this machine"):
        check_node({**same, "mjhab": "0.0.1"})
    with pytest.raises(UsageError, match="arithmetic"):
        check_node({**same, "arithmetic": "0"})
