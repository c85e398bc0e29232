"""Run episodes of mjhab with the real vla-eval package: its runner, its specs. `make test-vla-eval` calls this."""

# The library lives in an environment of its own, see the Makefile.
# pyright: reportMissingImports=false
from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from vla_eval import benchmarks
from vla_eval.benchmarks.base import StepBenchmark
from vla_eval.config import EvalConfig
from vla_eval.registry import resolve_import_string
from vla_eval.runners.sync_runner import SyncEpisodeRunner
from vla_eval.specs import check_specs

UPSTREAM = Path(__file__).parents[2] / "docs" / "upstream" / "vla_eval"
STEPS = 6
ROW = "set_table.close.kitchen_counter-drawer3"


class Still:
    """Stands where vla-eval has its connection to a model server, and sends zeros."""

    def __init__(self) -> None:
        self.seen: list[dict[str, Any]] = []
        self.ended: list[dict[str, Any]] = []

    async def start_episode(self, payload: dict[str, Any]) -> None:
        self.task = payload["task"]

    async def act(self, obs: dict[str, Any]) -> dict[str, Any]:
        self.seen.append(obs)
        return {"actions": np.zeros(9, np.float32)}

    async def end_episode(self, result: dict[str, Any]) -> None:
        self.ended.append(result)


def configurations() -> dict[str, EvalConfig]:
    """The configurations of `UPSTREAM`, whose class is then found as in a harness that has it."""
    benchmarks.__path__.append(str(UPSTREAM / "src" / "vla_eval" / "benchmarks"))
    found = {}
    for path in (UPSTREAM / "configs").rglob("*.yaml"):
        (entry,) = yaml.safe_load(path.read_text(encoding="utf-8"))["benchmarks"]
        found[path.stem] = EvalConfig.from_dict(entry)
    return found


def main() -> None:
    configs = configurations()
    for name, config in configs.items():
        made = resolve_import_string(config.benchmark)(**config.params)
        most = made.get_metadata()["max_episodes_per_task"]
        assert config.episodes_per_task <= most, (name, most)
        assert len(made.get_tasks()) == {"eval": 11, "ms_hab_7": 7, "smoke_test": 1}[name]
    smoke = configs["smoke_test"]
    benchmark_class = resolve_import_string(smoke.benchmark)
    assert issubclass(benchmark_class, StepBenchmark)
    assert benchmark_class.configure_render("cpu") == {}
    benchmark = benchmark_class(**smoke.params)
    (task,) = benchmark.get_tasks()
    assert task["name"] == ROW
    spec = benchmark.get_action_spec()
    seen_spec = benchmark.get_observation_spec()
    assert check_specs(spec, spec, seen_spec, seen_spec) == []
    assert (
        benchmark.get_hold_action(None)["actions"].shape
        == (spec["actions"].dims,)
        == (9,)
    )
    server = Still()
    runner = SyncEpisodeRunner()
    for index in range(smoke.episodes_per_task):
        numbered = {**task, "episode_idx": index}
        result = asyncio.run(
            runner.run_episode(benchmark, numbered, server, max_steps=smoke.max_steps)
        )
        assert set(result["metrics"]) == set(benchmark.get_metric_keys())
        assert result["steps"] == STEPS and result["metrics"]["success"] is False
    first, second = server.seen[0], server.seen[STEPS]
    assert (
        first["images"]["head"].shape == (32, 32, 3) and first["images"]["head"].std() > 0
    )
    assert (
        first["states"].shape == (42,) and "top right drawer" in first["task_description"]
    )
    assert not np.array_equal(first["states"], second["states"])
    benchmark.cleanup()
    print("vla-eval runs mjhab: 2 episodes")


if __name__ == "__main__":
    main()
