"""Every page in the common style, full and empty, with short and long names: for tests and for the browser."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from benchmarks.reward import figure as reward_figure
from mjhab.bench.experts.report import render_experts
from mjhab.bench.experts.rows import RowResult
from mjhab.data.store.images import ImageFormat
from mjhab.learning.runs.report import render_training_report
from mjhab.learning.runs.run import TrainingFolder
from mjhab.paper.reproduce.results import page as reproduce_page
from mjhab.render.film import FilmWriter
from mjhab.reports.compared.page import (
    ComparedRun,
    pairs_of,
    render_comparison,
)
from mjhab.reports.dataset import render_data_report
from mjhab.reports.interact import interact_page
from mjhab.reports.pages import Section, render_sections
from mjhab.reports.plots import labels_figure
from mjhab.reports.run import render_report
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RandomPolicy
from mjhab.rollout.records import EpisodeRecord
from mjhab.tasks.subtasks.registry import SUBTASKS
from tests.data.fake_world import FakeEnv as DataEnv
from tests.data.make import record
from tests.rollout.fake_env import FakeEnv

LONG = "a_mug_with_a_very_long_name_that_somebody_gave_it_because_names_may_be_long"
_RUN = {
    "task": "set_table",
    "subtask": None,
    "policy": "expert",
    "episodes": 8,
    "worlds": 4,
    "seed": 0,
}
_LONG_RUN = {
    "policy": f"/home/somebody/checkpoints/{LONG}/student.safetensors",
    "env.observations.cameras.of_the_robot.names": "fetch_head fetch_hand",
    "target": LONG,
    "policy_sha256": "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08",
    "command": f"mjhab eval --policy {LONG} --task set_table --subtask pick --episodes 8",
}
_TRAINING = {
    "algorithm": "dagger",
    "seed": 0,
    "also": [],
    "scene": {
        "task": "set_table",
        "subtask": "pick",
        "target": LONG,
        "split": "train",
        "assets": f"/data/{LONG}",
    },
    "config": {
        "student": {
            "preset": "small",
            "inputs": {"image_size": 64, "depth_range_m": [0.01, 3.0]},
            "ensemble_members_with_their_own_backbones": 3,
        },
        "learning_rate_schedule_of_the_backbone": "cosine over all rounds of the collection",
    },
}
_SUMMARY = {
    "preset": "small",
    "split": None,
    "success_once": None,
    "interval": None,
    "success_at_end": None,
    "episodes": 0,
    "seconds": 61.0,
    "steps": 0,
    "samples": 0,
    "demonstrations": 0,
    "rounds": 0,
}


def episodes(count: int, **options: Any) -> list[EpisodeRecord]:
    """Finished episodes of scripted worlds."""
    env = FakeEnv(4, quality=0.9, taint_chance=0.5, **options)
    return rollout(env, RandomPolicy(0), range(count), seed=0)


def pages(folder: Path) -> dict[str, str]:
    """HTML by name of the page; ``folder`` is for the files that they are made of."""
    chain = episodes(8)
    return {
        "run": render_report(chain, _RUN, 20.0),
        "run_long_names": render_report(_renamed(chain), {**_RUN, **_LONG_RUN}, 20.0),
        "run_films": render_report(chain[:3], _RUN, 20.0, _film(folder)),
        "run_none": render_report([], _RUN, 0.0),
        "compared": _compared(chain, _film(folder)),
        "training": _training(folder / "training", full=True),
        "training_none": _training(folder / "training_none", full=False),
        "data": _data(folder / "data", images=True),
        "data_without_images": _data(folder / "data_plain", images=False),
        "labels": _labels(),
        "experts": _experts(12),
        "experts_none": _experts(0),
        "reward": _reward(40),
        "reward_none": _reward(0),
        "interact": _interact(),
        "reproduce": _reproduce(),
    }


def _compared(chain: list[EpisodeRecord], film: Any) -> str:
    lost = [dataclasses.replace(record, success_once=False) for record in chain]
    films = {record.index: film(record.index) for record in chain[:2]}
    runs = [
        ComparedRun("a", _RUN, chain, films),
        ComparedRun(LONG, {**_RUN, **_LONG_RUN}, lost, films),
    ]
    return render_comparison(runs, pairs_of(runs), ["A caution."])


def _renamed(records: list[EpisodeRecord]) -> list[EpisodeRecord]:
    return [
        dataclasses.replace(
            each,
            home=f"{LONG}_home",
            subtasks=tuple(
                dataclasses.replace(s, target=LONG, label=f"{LONG}_failure")
                for s in each.subtasks
            ),
        )
        for each in records
    ]


def _film(folder: Path) -> Any:
    path = folder / "film.mp4"
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = FilmWriter(path, 10)
    for k in range(6):
        frame = np.zeros((96, 128, 3), np.uint8)
        frame[:, 20 * k : 20 * k + 20] = (200, 120, 40)
        writer.add(frame)
    writer.close()
    return lambda index: path


def _training(folder: Path, *, full: bool) -> str:
    place = cast(TrainingFolder, SimpleNamespace(path=folder, config=_TRAINING))
    if not full:
        return render_training_report(place, [], [], _SUMMARY)
    rows: list[dict[str, Any]] = [
        {"samples": 900 * k, "seconds": 12.0 * k, "loss": 1.0 / k} for k in range(1, 30)
    ]
    rows += [
        {
            "samples": 9000 * k,
            "seconds": 120.0 * k,
            "success_once": 0.2 * k,
            "round": k,
            "split": "train",
            "episodes": 20 * k,
            "collection_success": 0.9,
            "collection_seconds": 40.0,
        }
        for k in range(1, 4)
    ]
    summary = {
        **_SUMMARY,
        "split": "val",
        "success_once": 0.5,
        "interval": (0.3, 0.7),
        "success_at_end": 0.4,
        "episodes": 8,
        "steps": 1200,
        "samples": 27000,
        "demonstrations": 60,
        "rounds": 3,
    }
    return render_training_report(place, rows, episodes(8), summary)


def _data(folder: Path, *, images: bool) -> str:
    folder.mkdir(parents=True, exist_ok=True)
    env = DataEnv(subtask="pick", images=images)
    record(folder / "a.h5", range(6), env, images=ImageFormat() if images else None)
    return render_data_report(folder, FilmWriter)


def _labels() -> str:
    """All labels of all subtasks in one chart: the largest legend."""
    counts = {name: Counter(SUBTASKS[name].labels) for name in SUBTASKS}
    section = Section("Labels", "All of them.", chart="labels-plot")
    return render_sections("Labels", [section], {"labels-plot": labels_figure(counts)})


def _experts(rows: int) -> str:
    empty = RowResult(**_RESULT)
    measured = [
        dataclasses.replace(
            empty,
            subtask=("pick", "place", "open")[k % 3],
            target=f"{LONG}_{k}",
            pack=("builtin", "replica_cad")[k % 2],
            episodes=20,
            successes=18,
            success_once=0.9,
            interval=(0.7, 0.97),
            success_at_end=0.85,
            gentle=0.8,
            gentle_peak=0.9,
        )
        for k in range(rows)
    ]
    if rows:
        chain = dataclasses.replace(
            measured[0],
            subtask="chain",
            target="",
            navigate="teleport",
            progressive=(0.9, 0.8, 0.7),
        )
        measured.append(chain)
    config = {
        "split": "val",
        "seed": 0,
        "spawn_rule": "front_box",
        "env": {},
        "profile": "mjhab",
    }
    return render_experts(measured or [empty], [], config)


_RESULT: dict[str, Any] = {
    field.name: None if field.default is dataclasses.MISSING else field.default
    for field in dataclasses.fields(RowResult)
} | {
    "pack": "builtin",
    "task": "set_table",
    "subtask": "pick",
    "target": "024_bowl",
    "navigate": "",
    "split": "val",
    "episodes": 0,
    "wanted": 20,
    "homes": 0,
    "successes": 0,
    "interval": (0.0, 1.0),
    "tainted": 0,
    "labels": {},
    "failures": {},
    "progressive": (),
    "error": "",
}


def _reward(count: int) -> str:
    rng = np.random.default_rng(0)
    curves = [(k % 3 > 0, np.sort(rng.random(200))) for k in range(count)]
    section = Section("pick", "Rewards.", chart="reward-pick")
    plots = {"reward-pick": reward_figure(curves)}
    return render_sections("Dense reward of the expert", [section], plots)


def _interact() -> str:
    point = {
        "sps_mean": 900.0,
        "sps_ci95": 20.0,
        "reset_and_step_sps": 700.0,
        "physics_ms": 10.0,
        "render_ms": 5.0,
        "device_mb": None,
        "rss_mb": 900.0,
        "tainted_worlds": 0,
    }
    found = {
        "points": [
            {**point, "worlds": worlds, "rss_mb": 500.0 + worlds} for worlds in (16, 1024)
        ],
        "steps": 100,
        "seeds": 3,
        "home": "apt_0",
        "render": True,
        "backend": "cpu",
        "device": "Some Processor With A Long Name @ 2.50 GHz",
    }
    pictures = {
        "rgb": np.zeros((2, 128, 128, 3), np.uint8),
        "depth": np.ones((2, 128, 128), np.float32),
    }
    return interact_page(found, pictures)


def _reproduce() -> str:
    result = {
        "row": f"set_table/pick/{LONG}",
        "rules": "as_published",
        "success_once": 0.7,
        "low": 0.6,
        "high": 0.8,
        "success_at_end": 0.6,
        "episodes": 100,
        "demonstrations": 1000,
        "samples": 100000,
        "cpu_minutes": 120.0,
        "paper": {},
        "paper_says": "a sentence of the paper that is rather long, as such sentences are",
    }
    config = {"what": "table1", "column": "bc", "preset": "small", "split": "val"}
    config |= {"assets": "builtin"}
    return reproduce_page([result], config)
