"""Run episodes of mjhab with the real vla-eval package: its runner, its specs. `make test-vla-eval` calls this."""

# The library lives in an environment of its own, see the Makefile.
# pyright: reportMissingImports=false
from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
from vla_eval.benchmarks.base import StepBenchmark
from vla_eval.registry import resolve_import_string
from vla_eval.runners.sync_runner import SyncEpisodeRunner
from vla_eval.specs import check_specs

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


def main() -> None:
    benchmark_class = resolve_import_string("mjhab.integrations.vla_eval:MjhabBenchmark")
    assert issubclass(benchmark_class, StepBenchmark)
    assert benchmark_class.configure_render("cpu") == {}
    benchmark = benchmark_class(rows=[ROW], camera_size=32)
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
    for index in range(2):
        numbered = {**task, "episode_idx": index}
        result = asyncio.run(
            runner.run_episode(benchmark, numbered, server, max_steps=STEPS)
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
