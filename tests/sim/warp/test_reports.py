"""Parity report and Interact benchmark with the warp backend, on Warp's CPU device with few worlds."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import sleep as gpu_sleep
from benchmarks.parity import episodes as parity_episodes
from benchmarks.parity import run as bench_parity
from benchmarks.parity.episodes import KINDS, Leg, Log, run_equal, run_own
from mjhab.bench.environments import env as bench_env
from mjhab.bench.environments.stages import STEP_STAGES
from mjhab.bench.interact import run as bench_interact
from mjhab.bench.interact.scene import InteractScene, interact_scene
from mjhab.bench.specs import EnvBenchSpec
from mjhab.cli.machine import warmup
from mjhab.rollout.loop import rollout
from mjhab.scenes import packs
from mjhab.sim.backends import check_device, open_simulator
from mjhab.sim.warp.host_twin import HostTwin
from tests.missing import need_warp
from tests.warp_device import TEST_DEVICE

need_warp()

from mjhab.envs.device import pool  # noqa: E402
from mjhab.envs.device.env import DeviceEnv  # noqa: E402


@pytest.fixture(scope="module")
def scene() -> InteractScene:
    return interact_scene()


@pytest.fixture(autouse=True)
def fixed_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Buffers by hand: measuring them belongs to test_warp.py."""
    from mjhab.sim.warp import simulator as warp

    sizes = warp.BufferSizes(contacts=600, ccd=400, rows=1000)
    monkeypatch.setattr(warp, "buffer_sizes", lambda *_: sizes)


def test_interact_runs_on_warp_as_on_the_cpu(scene: InteractScene) -> None:
    runs = [
        bench_interact.InteractBench(
            scene, backend, 2, render=False, device="cpu", threads=1
        )
        for backend in ("warp", "cpu")
    ]
    for run in runs:
        for number in range(6):
            run.step(number)
        run.sync()
    warp, cpu = (np.asarray(run.sim.state().robot_q, float) for run in runs)
    start = scene.robot
    assert np.abs(cpu[0] - start).max() > 0.05
    np.testing.assert_allclose(warp, cpu, atol=1e-4)
    assert [run.tainted() for run in runs] == [0, 0]
    assert runs[0].device_used_mb() is None and runs[0].moved() == []


def test_interact_draws_the_same_on_both_backends(scene: InteractScene) -> None:
    found = []
    for backend in ("warp", "cpu"):
        run = bench_interact.InteractBench(
            scene, backend, 2, render=True, device="cpu", threads=1
        )
        times, views = bench_interact.stage_times(run, 2)
        assert min(times["physics_ms"] or 0.0, times["render_ms"] or 0.0) > 0.0
        found.append(views)
    warp, cpu = found
    assert warp["rgb"].shape == (2, 128, 128, 3) and warp["depth"].shape == (2, 128, 128)
    assert np.median(np.abs(warp["depth"] - cpu["depth"])) < 1e-3
    assert np.abs(warp["rgb"].astype(float) - cpu["rgb"]).mean() < 2.0


def test_parity_of_an_environment(tmp_path: Path) -> None:
    options = bench_parity.ParitySpec(
        worlds=1,
        steps=2,
        grasp_seconds=0.0,
        device="cpu",
        threads=1,
        log=tmp_path / "log",
    )
    found = bench_parity.measure_parity(options)
    assert found["steps"] == [1] and set(found["qpos_max"]) == set(KINDS)
    assert 0.0 < found["qpos_max"]["robot"][0] < 1e-4
    assert found["qpos_max"]["objects"][0] < 1e-3 and found["qpos_max"]["links"][0] < 1e-5
    assert found["agree"] == {"success": 1.0, "label": None, "reward": 1.0}
    assert found["grasps"] == [] and found["device"] == "cpu" and found["worlds"] == 1
    assert found["episodes_equal"] == found["episodes_own"] == {}
    (row,) = Log(options.log).rows.values()
    assert (row["acting"], row["steps"], row["taint"]) == ("drift2", 2, [0, 0])


def test_the_twin_gets_the_same_actions_and_resets() -> None:
    """Two episodes one after the other in one world, cut short: the second begins alike on both, too."""
    rows: dict[int, dict[str, Any]] = {}
    run_equal(
        Leg("set_table", "close", threads=1, worlds=1),
        [3, 5],
        rows.__setitem__,
        max_steps=2,
    )
    assert set(rows) == {3, 5}
    for row in rows.values():
        assert row["steps"] == row["close"] == 2 and row["label"] == [None, None]
        assert (
            0.0 < row["drift"]["1"]["robot"] < 1e-4
            and row["drift"]["1"]["objects"] < 1e-3
        )
    assert rows[3]["reward"] != rows[5]["reward"]


def test_the_expert_acts_on_warp_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[HostTwin] = []
    make = Leg.make_twin
    monkeypatch.setattr(
        Leg, "make_twin", lambda leg: (env := make(leg), made.append(env.sim))[0]
    )
    monkeypatch.setattr(
        parity_episodes, "rollout", functools.partial(rollout, max_steps=2)
    )
    rows: dict[int, dict[str, Any]] = {}
    run_own(Leg("set_table", "close", threads=1, worlds=1), [3], rows.__setitem__)
    assert (
        isinstance(made[0], HostTwin) and rows[3]["steps"] == 2 and rows[3]["taint"] == []
    )
    assert rows[3]["success"] is False and 0.0 < rows[3]["reward"] < 1.0


def test_a_device_env_is_timed_stage_by_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "LEAST", 2)
    options = EnvBenchSpec.of(
        id="mjhab/CloseSubtaskTrain-v1",
        obs="depth",
        reward="dense",
        backend="warp",
        device="cpu",
        worlds=(2,),
        steps=2,
        rounds=1,
        camera_size=16,
    )
    found = bench_env.measure(options)
    (point,) = found["points"]
    assert (found["backend"], point["worlds"], point["device"], point["tainted"]) == (
        "warp",
        2,
        "cpu",
        0,
    )
    assert (
        list(point["stages"]) == list(STEP_STAGES) and min(point["stages"].values()) > 0.0
    )
    assert (
        point["env_sps"] > 0.0 and point["engine_sps"] > 0.0 and point["reset_ms"] > 0.0
    )
    assert point["device_mb"] is None and point["rss_mb"] > 100.0


def test_sleep_saves_and_hardly_changes() -> None:
    rows = gpu_sleep.sleep_cost(Leg("set_table", "pick", threads=1, worlds=1), 3)
    assert [(row["engine"], row["sleep"]) for row in rows] == [
        (e, s) for e in ("C", "warp") for s in (True, False)
    ]
    for asleep, awake in (rows[:2], rows[2:]):
        assert asleep["awake_dofs"] < 0.2 * awake["awake_dofs"] <= 0.2 * awake["nv"]
        assert (
            awake["difference"]["robot"] < 1e-5
            and 0.0 < awake["difference"]["objects"] < 1e-3
        )
    assert [row["tainted"] for row in rows] == [0, 0, 0, 0]


def test_warmup_compiles_all_of_a_device_env(monkeypatch: pytest.MonkeyPatch) -> None:
    pack = packs.open_pack("builtin")
    monkeypatch.setattr(
        packs, "open_pack", lambda _: dataclasses.replace(pack, homes=pack.homes[:2])
    )
    stepped: list[int] = []
    step = DeviceEnv.step
    monkeypatch.setattr(
        DeviceEnv,
        "step",
        lambda env, actions: stepped.append(env.num_envs) or step(env, actions),
    )
    seconds = warmup.warmup(warmup.WarmupSpec.of(task="set_table", device="cpu"), "warp")
    parts = ["2 homes", "rasterizer", "planning of the experts", "MuJoCo Warp"]
    assert list(seconds) == parts and stepped == [warmup.WORLDS]


def test_grasps_hold_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks.parity import grasp as parity_grasp

    opened: list[tuple[str, str]] = []

    def on_a_machine_with_a_gpu(
        name: str, *args: Any, device: str, **options: Any
    ) -> Any:
        check_device(name, device)
        opened.append((name, device))
        there = TEST_DEVICE if name == "warp" else ""
        return open_simulator(name, *args, device=there, **options)

    monkeypatch.setattr(parity_grasp, "BENCH_OBJECTS", ("005_tomato_soup_can",))
    monkeypatch.setattr(parity_grasp, "open_simulator", on_a_machine_with_a_gpu)
    (row,) = parity_grasp.grasp_parity(0.2, "cuda:0", 1, 0)
    assert opened == [("cpu", ""), ("warp", "cuda:0")]
    assert row["object"] == "005_tomato_soup_can"
    for backend in ("cpu", "warp"):
        assert not row[backend]["dropped"] and 0.0 < row[backend]["slip_mm"] < 10.0
    assert row["warp"]["slip_mm"] == pytest.approx(row["cpu"]["slip_mm"], abs=0.5)
