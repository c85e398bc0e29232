"""Backends by name, memory estimates, warmup, and the measures of the parity report; no Warp needed."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mjhab.cli import bench_parity, estimate, gpu_report, warmup
from mjhab.cli.gpu_options import BenchParityOptions
from mjhab.cli.main import main
from mjhab.cli.options import DoctorOptions
from mjhab.core.errors import UsageError
from mjhab.scenes.layout import Layout
from mjhab.scenes.packs import open_pack
from mjhab.sim import backends
from mjhab.sim.cpu import CpuSimulator


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> dict[str, bool]:
    """Which modules of the extra are there; tests change it."""
    here: dict[str, bool] = dict.fromkeys(backends.GPU_MODULES, True)
    monkeypatch.setattr(backends, "_installed", here.__getitem__)
    return here


def test_auto_is_warp_where_the_extra_finds_a_device(
    installed: dict[str, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    devices: list[str] = ["cuda:0"]
    monkeypatch.setattr(backends, "cuda_devices", lambda: devices)
    assert backends.resolve("auto") == "warp"
    devices.clear()
    assert backends.resolve("auto") == "cpu"
    assert backends.resolve("warp") == "warp" and backends.resolve("cpu") == "cpu"
    installed["torch"] = False
    devices.append("cuda:0")
    assert backends.resolve("auto") == "cpu"
    with pytest.raises(UsageError, match=r"needs torch, not installed here; pip install 'mjhab\[gpu\]'"):
        backends.resolve("warp")
    with pytest.raises(UsageError, match=r"unknown backend 'wrap'.*warp"):
        backends.resolve("wrap")


def test_the_cpu_backend_imports_neither_warp_nor_torch() -> None:
    code = (
        "import sys; from mjhab.sim.backends import resolve\n"
        "resolve('cpu')\n"
        "sys.exit(bool({'warp', 'torch', 'mujoco_warp'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0


def test_the_cpu_simulator_is_opened_by_name() -> None:
    pack = open_pack("builtin")
    layout = Layout(dataclasses.replace(pack, homes=pack.homes[:1]), ())
    sim = backends.open_simulator("cpu", layout, 2, threads=1)
    assert isinstance(sim, CpuSimulator) and (sim.num_worlds, sim.num_threads) == (2, 1)


# -- estimate --------------------------------------------------------------------------------------------------------


def test_estimate_grows_with_worlds_and_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate, "available_mb", lambda: 20_000.0)
    monkeypatch.setattr(estimate, "gpu_free_mb", lambda: 8_000.0)
    state = estimate.estimate_rows(DoctorOptions(num_envs=100))
    images = estimate.estimate_rows(DoctorOptions(num_envs=100, obs="rgbd"))
    large = estimate.estimate_rows(DoctorOptions(num_envs=100, obs="rgbd", camera_size=256))
    for a, b, c in zip(state, images, large, strict=True):
        assert a["memory_mb"] < b["memory_mb"] < c["memory_mb"]
        assert c["world_mb"] - a["world_mb"] == pytest.approx(4 * (b["world_mb"] - a["world_mb"]), rel=0.05)
        assert a["most"] > b["most"] > c["most"] and a["fits"]
    # The number named fits, one more does not.
    need = estimate.needs(DoctorOptions(obs="rgbd"))[1]
    assert need.most is not None
    assert need.total_mb(need.most) <= 8_000.0 < need.total_mb(need.most + 1)


def test_estimate_command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate, "available_mb", lambda: 3_000.0)
    monkeypatch.setattr(estimate, "gpu_free_mb", lambda: None)
    args = ["doctor", "--estimate", "--obs", "rgbd"]
    assert main([*args, "--num-envs", "64", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    cpu, warp = found["backends"]
    assert (cpu["backend"], cpu["fits"], warp["backend"], warp["fits"]) == ("cpu", True, "warp", None)
    assert main([*args, "--num-envs", "4096"]) == 2
    out = capsys.readouterr()
    assert "4096 worlds do not fit: backend cpu needs" in out.err and f"at most --num-envs {cpu['most']}" in out.err
    # Where the GPU has room, it is fine that this machine has not.
    monkeypatch.setattr(estimate, "gpu_free_mb", lambda: 80_000.0)
    assert main([*args, "--num-envs", "4096"]) == 0
    assert main([*args, "--num-envs", "0"]) == 2
    assert main(["doctor", "--estimate", "--obs", "rgbx"]) == 2
    assert "unknown observation mode 'rgbx'" in capsys.readouterr().err


# -- warmup ----------------------------------------------------------------------------------------------------------


def test_warmup_says_what_it_compiles(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    from mjhab.scenes import packs

    pack = packs.open_pack("builtin")
    monkeypatch.setattr(packs, "open_pack", lambda _: dataclasses.replace(pack, homes=pack.homes[:2]))
    assert main(["warmup", "--backend", "cpu", "--json"]) == 0
    out = capsys.readouterr()
    assert list(json.loads(out.out)["seconds"]) == ["2 homes", "rasterizer"]
    assert out.err.splitlines()[-2:] == ["mjhab: compiling: 2 homes ...", "mjhab: compiling: rasterizer ..."]
    assert main(["warmup", "--task", "dishes"]) == 2
    assert warmup.WORLDS > 0


# -- parity ----------------------------------------------------------------------------------------------------------


def state_like(**changed: Any) -> Any:
    rows = {
        "robot_q": np.zeros((2, 15)), "link_q": np.zeros((2, 0)),
        "object_pose": np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (2, 3, 1)),
    }  # fmt: skip
    return type("State", (), rows | changed)


def test_difference_is_per_kind_and_world() -> None:
    pose = state_like().object_pose.copy()
    pose[1, 2] = [0.3, 0.4, 0.0, np.cos(0.1), np.sin(0.1), 0.0, 0.0]
    robot = np.zeros((2, 15))
    robot[0, 4] = -0.25
    found = bench_parity.difference(state_like(), state_like(object_pose=pose, robot_q=robot))
    np.testing.assert_allclose(found["objects"], [0.0, 0.5])
    np.testing.assert_allclose(found["turns"], [0.0, 0.2], atol=1e-7)
    np.testing.assert_allclose(found["robot"], [0.25, 0.0])
    np.testing.assert_allclose(found["links"], [0.0, 0.0])
    # q and -q are one orientation.
    flipped = state_like().object_pose * np.array([1, 1, 1, -1, -1, -1, -1])
    assert not bench_parity.difference(state_like(), state_like(object_pose=flipped))["turns"].any()


def test_share_of_nothing_is_none() -> None:
    assert bench_parity.share([]) is None
    assert bench_parity.share(np.array([True, False, True])) == 0.6667


def test_agreement_is_per_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three of four outcomes alike, half of the labels, one mean reward of four."""
    outcomes = {"cpu": [True, True, False, True], "warp": [True, True, False, False]}
    labels = {"cpu": ["a", "b", "c", "d"], "warp": ["a", "b", "x", "y"]}
    rewards = {"cpu": [0.5, 0.5, 0.5, 0.5], "warp": [0.51, 0.6, 0.2, 0.9]}
    sides = iter(("cpu", "warp"))

    def run(env: Any, policy: Any, episodes: range, seed: int, sinks: list[Any]) -> list[Any]:
        side = next(sides)
        assert env.on_warp == (side == "warp")
        found = []
        for index in episodes:
            row = np.array([True, False])
            step = SimpleNamespace(active=row, reward=np.array([rewards[side][index], 9.0]))
            sinks[0].on_step(env, step)
            record = SimpleNamespace(
                index=index, steps=1, success_once=outcomes[side][index],
                subtasks=[SimpleNamespace(label=labels[side][index])],
            )  # fmt: skip
            sinks[0].on_episode_end(env, 0, record)
            found.append(record)
        return found

    monkeypatch.setattr(bench_parity, "rollout", run)
    monkeypatch.setattr("mjhab.experts.make_expert", lambda env: None)
    monkeypatch.setattr(
        bench_parity, "make_env", lambda options, worlds: SimpleNamespace(num_envs=worlds, on_warp=False)
    )
    monkeypatch.setattr(bench_parity, "use_warp", lambda env, device: setattr(env, "on_warp", True))
    found = bench_parity.closed_loop(BenchParityOptions(worlds=2, episodes=4), "cpu")
    assert found == {
        "success": 0.75, "label": 0.5, "reward": 0.25, "success_rate_cpu": 0.75, "success_rate_warp": 0.5
    }  # fmt: skip


def test_parity_refuses_what_has_no_expert(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "parity", "--subtask", "navigate"]) == 2
    assert "--subtask must be pick, place, open or close" in capsys.readouterr().err


# -- report ----------------------------------------------------------------------------------------------------------


def test_report_says_that_there_was_no_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_room(plan: Any) -> Any:
        raise UsageError("no room")

    monkeypatch.setattr(gpu_report, "resolve", lambda name: name)
    monkeypatch.setattr(gpu_report, "cuda_devices", list)
    monkeypatch.setattr(gpu_report, "gpu_name", lambda: None)
    monkeypatch.setattr(gpu_report, "measure_interact", no_room)
    monkeypatch.setattr(gpu_report, "measure_parity", lambda options: {"worlds": options.worlds})
    gpu_report.main(tmp_path)
    found = {path.stem: json.loads(path.read_text()) for path in tmp_path.iterdir()}
    assert set(found) == {"gpu-interact", "gpu-memory", "gpu-parity"}
    for content in found.values():
        assert content["machine"]["gpu"] is None and content["note"] == gpu_report.NO_GPU
    assert all(point["error"] == "no room" for point in found["gpu-interact"]["points"])
    assert found["gpu-parity"]["worlds"] == 2
    assert len(found["gpu-memory"]["estimates"]) == 4
