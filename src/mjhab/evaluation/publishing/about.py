"""What is in a data set, as JSON data: the record that its card is made of."""

from __future__ import annotations

import dataclasses
import datetime
import shlex
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.core.files.checksums import KEY, list_files
from mjhab.core.machine import cores
from mjhab.core.timing import STEP_SECONDS
from mjhab.core.typed.flags import flag_of
from mjhab.data.export.columns import action_columns, state_columns
from mjhab.data.select.describing import state_names, subtask_words
from mjhab.data.select.facts import target_of
from mjhab.data.select.own_state import base_velocity, tells_base_velocity
from mjhab.data.store.places import episodes, has_shards
from mjhab.data.store.reading import RecordedEpisode
from mjhab.evaluation.publishing.spec import DEMONSTRATIONS, DatasetSpec

ABOUT = "dataset.json"
MAKING = "making.json"
"""What a set is made with, from its begin on."""
SPLITS_FILE = "splits.json"
FORMAT = "mjhab-dataset"
SUBSETS: dict[str, str] = {"failures": "not success", "recoveries": "success"}
"""Filters of the subsets of what is no demonstration."""
_GB = 1e9
_BASE_VELOCITY = ("base_vel.forward", "base_vel.left", "base_vel.yaw")
_EXAMPLES = 12
"""Number of sentences that a card shows."""


class _ColumnRanges:
    """Mean, spread and range of the columns of a dataset, over all rows of all episodes."""

    def __init__(self) -> None:
        self._count = 0
        self._sums: Any = 0.0
        self._squares: Any = 0.0
        self._least: Any = np.inf
        self._most: Any = -np.inf

    def add(self, rows: np.ndarray) -> None:
        """Add rows (n, D)."""
        # Sums of squares over millions of rows lose their digits in float32.
        values = rows.astype(np.float64)
        self._count += len(values)
        self._sums = self._sums + values.sum(axis=0)
        self._squares = self._squares + (values**2).sum(axis=0)
        self._least = np.minimum(self._least, values.min(axis=0))
        self._most = np.maximum(self._most, values.max(axis=0))

    def of_columns(self) -> list[dict[str, float]]:
        """Of every column."""
        mean = self._sums / self._count
        # Rounding may leave a little less than 0 of a constant column.
        std = np.sqrt(np.maximum(self._squares / self._count - mean**2, 0.0))
        told = {"mean": mean, "std": std, "min": self._least, "max": self._most}
        return [
            {name: round(float(values[k]), 6) for name, values in told.items()}
            for k in range(len(mean))
        ]


class _Contents:
    """What is counted while the episodes of a set are read."""

    def __init__(self) -> None:
        self.targets: dict[str, Counter[str]] = defaultdict(Counter)
        self.skills: dict[str, list[int]] = defaultdict(list)
        self.sentences: Counter[str] = Counter()
        self.wordings: set[str] = set()
        self.actions = _ColumnRanges()
        self.state = _ColumnRanges()
        self.base_velocity = _ColumnRanges()
        self.labels: Counter[str] = Counter()
        self.first: RecordedEpisode | None = None
        self.licences: dict[str, None] = {}

    def add(self, episode: RecordedEpisode, target: str, subset: str) -> None:
        """Count an episode; only demonstrations have a part in the statistics."""
        counts = self.targets[target]
        counts[subset] += 1
        self.licences[episode.run.licence] = None
        if subset != "episodes":
            return
        self.first = self.first or episode
        counts["frames"] += episode.steps
        record = episode.record
        self.labels.update(entry.label or "" for entry in record.subtasks)
        self.sentences.update(subtask_words(record))
        told = episode.annotations
        for sentences in told.wordings:
            self.wordings.update(sentences)
        for each in told.skills:
            self.skills[each.skill].append(each.end - each.start)
        self.actions.add(episode.array("actions"))
        self.state.add(episode.array("obs/state"))
        if tells_base_velocity(episode):
            self.base_velocity.add(base_velocity(episode))


def describe(
    spec: DatasetSpec, splits: Mapping[str, Any], clock: Mapping[str, Any]
) -> dict[str, Any]:
    """Describe a set whose episodes and splits are written.

    Args:
        spec: what was asked for.
        splits: content of SPLITS_FILE.
        clock: hours and CPU hours that it has taken.
    """
    found = _Contents()
    for episode, target, subset in _episodes(spec):
        found.add(episode, target, subset)
    # The record cannot hold its own hash, and the configuration changes when the set is extended.
    files = list_files(spec.out, frozenset({ABOUT, MAKING}))
    size = int(np.sum([each["bytes"] for each in files.values()]))
    totals = Counter[str]()
    for counts in found.targets.values():
        totals.update(counts)
    # The counter holds frames beside episodes.
    tried = totals.total() - totals["frames"]
    per_thousand = 1000 / max(tried, 1)
    about = {
        "format": FORMAT,
        "version": 1,
        "name": spec.track,
        "made": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "command": command_of(spec),
        **_origin(spec, found),
        "episodes": totals["episodes"],
        "frames": totals["frames"],
        "hz": round(1 / STEP_SECONDS),
        "gb": round(size / _GB, 3),
        "hours": round(clock["hours"], 3),
        "cpu_hours": round(clock["cpu_hours"], 3),
        "cores": cores(),
        "per_1000_episodes": {
            "cpu_hours": round(clock["cpu_hours"] * per_thousand, 2),
            "gb": round(size / _GB * per_thousand, 2),
        },
        "per_target": {
            name: _counts(each) for name, each in sorted(found.targets.items())
        },
        "subsets": {
            DEMONSTRATIONS: (
                spec.keep
                or "as in the paper's data: presets pick_paper, place_paper, open_paper, close_paper"
            )
            + ("; no mishap on purpose" if spec.recoveries else ""),
            **SUBSETS,
        },
        "splits": {name: each for name, each in splits.items() if name != "by"},
        "labels": dict(found.labels.most_common()),
        "skills": {
            skill: {
                "segments": len(lengths),
                "steps": int(np.sum(lengths)),
                "median_steps": float(np.median(lengths)),
            }
            for skill, lengths in sorted(found.skills.items())
        },
        "sentences": {
            "distinct": len(found.sentences),
            "wordings": len(found.wordings),
            "examples": [text for text, _ in found.sentences.most_common(_EXAMPLES)],
        },
        **_columns(found),
        KEY: files,
    }
    return about


def _episodes(spec: DatasetSpec) -> Iterator[tuple[RecordedEpisode, str, str]]:
    """The episodes of all rows, with the target that they count for, and their subset."""
    for row in spec.chosen().values():
        places = {"episodes": spec.folder(row)}
        places |= {name: spec.out / name / f"{row.name}.h5" for name in SUBSETS}
        for subset, place in places.items():
            for episode in (
                episodes(place) if place.is_file() or has_shards(place) else ()
            ):
                target = "" if row.target else f".{target_of(episode.record)}"
                yield episode, f"{row.name}{target}", subset


def _counts(found: Counter[str]) -> dict[str, int]:
    return {key: found[key] for key in ("episodes", "frames", *SUBSETS)}


def _origin(spec: DatasetSpec, found: _Contents) -> dict[str, Any]:
    """Who recorded it, where, and with what."""
    first = found.first
    if first is None:
        return {"licence": ""}
    run = first.run
    env = run.config.get("env", {})
    return {
        "mjhab": run.versions.get("mjhab", ""),
        "versions": dict(run.versions),
        "commit": run.commit,
        "robot": run.robot,
        "control_mode": env.get("control_mode", ""),
        "profile": env.get("profile", ""),
        "assets": Path(str(_place(spec.asked.assets))).name,
        "stage": run.layout.get("stage", ""),
        "licence": "; ".join(found.licences),
        "policy": run.policy,
        "style": list(spec.style),
        "until": spec.until,
        "seed": spec.asked.seed,
    }


def _columns(found: _Contents) -> dict[str, Any]:
    first = found.first
    if first is None:
        return {"actions": [], "state": [], "base_velocity": [], "cameras": {}}
    actions = action_columns(first.run)
    state = state_columns(state_names(first.columns("obs/state"), first.run.layout))
    return {
        "actions": _joined(actions, found.actions.of_columns()),
        "state": _joined(state, found.state.of_columns()),
        "base_velocity": _joined(
            state_columns(_BASE_VELOCITY), found.base_velocity.of_columns()
        )
        if tells_base_velocity(first)
        else [],
        "images": [f"{camera}/{output}" for camera, output in first.images],
        "cameras": dict(first.run.layout.get("cameras", {})),
    }


def _joined(
    columns: list[dict[str, Any]], numbers: list[dict[str, float]]
) -> list[dict[str, Any]]:
    return [{**column, **told} for column, told in zip(columns, numbers, strict=True)]


def _place(assets: Any) -> Any:
    return assets.get("place", "") if isinstance(assets, Mapping) else assets


def command_of(spec: DatasetSpec) -> str:
    """The command line that makes the same set; of folders of assets it names the last part alone."""
    words = ["mjhab", "dataset", "make", spec.track]
    for option in dataclasses.fields(spec):
        value = getattr(spec, option.name)
        if (
            option.name in ("track", "env", "out", "workers", "ray")
            # The command should show what was chosen.
            or value == option.default
        ):
            continue
        words += _option(option.name.replace("_", "-"), value)
    for name, value in spec.env.items():
        if name in ("num_envs", "threads"):
            continue
        if name == "assets":
            given = dict(value) if isinstance(value, Mapping) else {"place": value}
            words += _option("assets", Path(str(given.pop("place"))).name)
            for key, one in given.items():
                words += _option(key.replace("_", "-"), one)
            continue
        flag = flag_of(EnvConfig, name).name or name
        words += _option(flag.replace("_", "-"), value)
    return shlex.join([*words, "--out", spec.out.name])


def _option(name: str, value: Any) -> list[str]:
    if value is True:
        return [f"--{name}"]
    if value is False:
        return [f"--no-{name}"]
    many = value if isinstance(value, list | tuple) else [value]
    return [f"--{name}", *map(str, many)]
