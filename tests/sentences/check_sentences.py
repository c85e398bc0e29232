"""Read the instructions of many episodes back, and hold them against the state of the simulator.

    make test-sentences EPISODES=1000
    python check_sentences.py EPISODES OUT.json PACK[,PACK...] [TASK,TASK...]

Of every episode the sentences of the whole chain are checked and those of one subtask alone, the kinds in turn; the
splits are in turn, too. PACK: "builtin" or the folder of a pack. Exits with 1 if a sentence is false, fits several
things or cannot be read.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mjhab.config.env import EnvConfig
from mjhab.config.thresholds import task_config
from mjhab.core.registration.plugins import load_plugins
from mjhab.envs.parts.reporting import describe_episode
from mjhab.episodes.episode import Episode
from mjhab.episodes.narration import InstructionGenerator
from mjhab.episodes.source import EpisodeSource, open_setting
from mjhab.robots.registry import robot_named
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.household.registry import TASKS
from tests.sentences.reader import Findings, Reader, check_episode

SPLITS = ("train", "val", "test")
HOUSEHOLD = ("tidy_house", "prepare_groceries", "set_table")
MOST_EXAMPLES = 20


class Checker:
    """Checks the sentences of the episodes of one task and pack."""

    def __init__(self, task: str, assets: str) -> None:
        self._task = task
        config = EnvConfig(task=task, assets=assets, num_envs=1)
        setting = open_setting(config)
        self.sim = CpuSimulator(setting.layout, 1, 1)
        self.narrator = InstructionGenerator(setting.layout)
        kinds = ("", *TASKS[task].subtasks)
        homes = setting.layout.pack.homes
        self._splits = [split for split in SPLITS if any(h.split == split for h in homes)]
        self._sources = {
            (kind, split): self._opened(
                dataclasses.replace(config, subtask=kind, split=split)
            )
            for kind in kinds
            for split in self._splits
        }
        self._kinds = kinds[1:]

    def _opened(self, config: EnvConfig) -> tuple[EnvConfig, EpisodeSource]:
        return config, EpisodeSource(
            self.sim, config, task_config(config, robot_named(config.robot))
        )

    def check(self, seed: int, index: int) -> dict[str, Findings]:
        """Findings of an episode: of the whole chain, and of one subtask alone, by its kind."""
        count = len(self._splits)
        split = self._splits[index % count]
        kind = self._kinds[index // count % len(self._kinds)]
        found: dict[str, Findings] = {}
        for which in ("", kind):
            config, source = self.source(which, split)
            episode = source.episode(seed, index)
            found[which or "chain"] = self._read(config, source, episode)
        return found

    def source(self, kind: str, split: str) -> tuple[EnvConfig, EpisodeSource]:
        """Configuration and episodes of chains (kind "") or of one kind of subtask, in the homes of a split."""
        return self._sources[kind, split]

    def _read(
        self, config: EnvConfig, source: EpisodeSource, episode: Episode
    ) -> Findings:
        start = source.start(episode)
        told = describe_episode(episode, start.plan, config, self.narrator)
        model = self.sim.model(start.home)
        reader = Reader(source.layout, model, start.qpos, start.home)
        return check_episode(reader, start.plan, dict(told), TASKS[self._task].words)


def rows(
    episodes: int, assets: str, tasks: tuple[str, ...], seed: int = 0
) -> Iterator[dict[str, Any]]:
    """A row of counts per task and kind of a pack, every hundred episodes and at the end."""
    for task in tasks:
        checker = Checker(task, assets)
        counts: dict[str, Counter[str]] = {}
        examples: list[str] = []
        closest: dict[str, float] = {}
        began = time.perf_counter()
        for index in range(episodes):
            for kind, found in checker.check(seed, index).items():
                counts.setdefault(kind, Counter()).update(found.counts)
                counts[kind]["episodes"] += 1
                closest[kind] = min(closest.get(kind, 99.0), found.closest)
                for text in found.examples:
                    examples.append(f"{index}: {text}")
                    print(f"{task} {index}: {text}", flush=True)
            if (index + 1) % 100 == 0:
                seconds = time.perf_counter() - began
                print(
                    f"{assets} {task} {index + 1}: {seconds:.0f} s {_sum(counts)}",
                    flush=True,
                )
        yield {
            "pack": Path(assets).name,
            "task": task,
            "counts": {kind: dict(count) for kind, count in counts.items()},
            "closest_m": {k: round(v, 3) for k, v in closest.items()},
            "examples": examples[:MOST_EXAMPLES],
        }


def _sum(counts: Mapping[str, Counter[str]]) -> dict[str, int]:
    total: Counter[str] = Counter()
    for count in counts.values():
        total.update(count)
    return dict(total)


def wrong(row: Mapping[str, Any]) -> int:
    """Number of sentences of a row that are not right."""
    return sum(
        number
        for count in row["counts"].values()
        for outcome, number in count.items()
        if outcome not in ("true", "episodes")
    )


def main(arguments: list[str]) -> int:
    """The command."""
    episodes, out, packs, *named = arguments
    tasks = tuple(named[0].split(",")) if named else HOUSEHOLD
    load_plugins()
    found = []
    for assets in packs.split(","):
        for row in rows(int(episodes), assets, tasks):
            found.append(row)
            print(json.dumps(row), flush=True)
            Path(out).parent.mkdir(parents=True, exist_ok=True)
            Path(out).write_text(json.dumps(found, indent=1), encoding="utf-8")
    return int(any(wrong(row) for row in found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
