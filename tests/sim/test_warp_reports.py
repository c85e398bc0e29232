"""Parity report and Interact benchmark with the warp backend, on Warp's CPU device with few worlds."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import pytest

from mjhab.cli import bench_interact, bench_parity
from mjhab.cli.gpu_options import BenchParityOptions
from mjhab.cli.host_twin import HostTwin
from mjhab.cli.interact_scene import InteractScene, interact_scene

if not os.environ.get("CI"):
    # In CI the engine must be there: the tests then fail rather than pass unseen.
    pytest.importorskip("mujoco_warp", reason="the [gpu] extra is not installed")


@pytest.fixture(scope="module")
def scene() -> InteractScene:
    return interact_scene()


@pytest.fixture(autouse=True)
def fixed_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Buffers by hand: measuring them belongs to test_warp.py."""
    from mjhab.sim import warp

    sizes = warp.BufferSizes(contacts=600, ccd=400, rows=1000)
    monkeypatch.setattr(warp, "buffer_sizes", lambda *_: sizes)


def test_interact_runs_on_warp_as_on_the_cpu(scene: InteractScene) -> None:
    runs = [
        bench_interact.InteractBench(scene, backend, 2, render=False, device="cpu", threads=1)
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
        run = bench_interact.InteractBench(scene, backend, 2, render=True, device="cpu", threads=1)
        times, views = bench_interact.stage_times(run, 2)
        assert min(times["physics_ms"] or 0.0, times["render_ms"] or 0.0) > 0.0
        found.append(views)
    warp, cpu = found
    assert warp["rgb"].shape == (2, 128, 128, 3) and warp["depth"].shape == (2, 128, 128)
    assert np.median(np.abs(warp["depth"] - cpu["depth"])) < 1e-3
    assert np.abs(warp["rgb"].astype(float) - cpu["rgb"]).mean() < 2.0


def test_parity_of_an_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    monkeypatch.setattr(bench_parity, "use_warp", lambda env, device: (use_warp(env, device), made.append(env)))
    options = BenchParityOptions(worlds=1, steps=2, grasp_seconds=0.0, device="cpu", threads=1)
    found = bench_parity.measure_parity(options)
    assert isinstance(made[0].sim, HostTwin)
    assert found["steps"] == [1] and set(found["qpos_max"]) == set(bench_parity.KINDS)
    assert 0.0 < found["qpos_max"]["robot"][0] < 1e-4
    assert found["qpos_max"]["objects"][0] < 1e-3 and found["qpos_max"]["links"][0] < 1e-5
    assert found["agree"] == {"success": 1.0, "label": None, "reward": 1.0}
    assert found["grasps"] == [] and found["device"] == "cpu"


use_warp = bench_parity.use_warp


def test_grasps_hold_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    from mjhab.cli import parity_grasp

    monkeypatch.setattr(parity_grasp, "BENCH_OBJECTS", ("005_tomato_soup_can",))
    (row,) = parity_grasp.grasp_parity(0.2, "cpu", 1, 0)
    assert row["object"] == "005_tomato_soup_can"
    for backend in ("cpu", "warp"):
        assert not row[backend]["dropped"] and 0.0 < row[backend]["slip_mm"] < 10.0
    assert row["warp"]["slip_mm"] == pytest.approx(row["cpu"]["slip_mm"], abs=0.5)
