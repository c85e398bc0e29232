"""Backends by name, memory estimates, warmup, and the measures of the parity report; no Warp needed."""

from __future__ import annotations

import dataclasses
import errno
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mjhab
from benchmarks import gpu_report
from benchmarks.parity import run as bench_parity
from benchmarks.parity.__main__ import main as parity_main
from benchmarks.parity.episodes import KINDS, Leg, Log, difference
from mjhab.cli.machine import warmup
from mjhab.cli.main import main
from mjhab.core import libraries
from mjhab.core.errors import UsageError
from mjhab.envs import estimate
from mjhab.envs.parts import memory
from mjhab.layout.layout import Layout
from mjhab.scenes.packs import open_pack
from mjhab.sim import backends
from mjhab.sim.mujoco.cpu import CpuSimulator
from tests.refusals import refused


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> dict[str, bool]:
    """Which modules of the extra are there; tests change it."""
    here: dict[str, bool] = dict.fromkeys(backends.GPU_MODULES, True)
    monkeypatch.setattr(libraries, "_is_installed", here.__getitem__)
    monkeypatch.setattr(backends, "check_imports", lambda names, extra: None)
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
    with refused(
        "backend 'warp'",
        said=("needs torch, which is not installed", "pip install", "[gpu]'"),
    ):
        backends.resolve("warp")
    with refused("backend", "wrap", expected="warp"):
        backends.resolve("wrap")


def test_the_cpu_backend_imports_neither_warp_nor_torch() -> None:
    code = (
        "import sys; from mjhab.sim.backends import resolve\n"
        "resolve('cpu')\n"
        "sys.exit(bool({'warp', 'torch', 'mujoco_warp'} & set(sys.modules)))"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode
        == 0
    )


def test_the_cpu_simulator_is_opened_by_name() -> None:
    pack = open_pack("builtin")
    layout = Layout(dataclasses.replace(pack, homes=pack.homes[:1]), ())
    sim = backends.open_simulator("cpu", layout, 2, threads=1)
    assert isinstance(sim, CpuSimulator) and (sim.num_worlds, sim.num_threads) == (2, 1)


# -- estimate --------------------------------------------------------------------------------------------------------


def test_estimate_grows_with_worlds_and_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate, "available_mb", lambda: 20_000.0)
    monkeypatch.setattr(estimate, "gpu_free_mb", lambda: 8_000.0)
    state = estimate.estimate_rows(100)
    images = estimate.estimate_rows(100, "rgbd")
    large = estimate.estimate_rows(100, "rgbd", 256)
    for a, b, c in zip(state, images, large, strict=True):
        assert a["memory_mb"] < b["memory_mb"] < c["memory_mb"]
        assert c["world_mb"] - a["world_mb"] == pytest.approx(
            4 * (b["world_mb"] - a["world_mb"]), rel=0.05
        )
        assert a["most"] > b["most"] > c["most"] and a["fits"]
    # The number named fits, one more does not.
    memory = estimate.world_memory("rgbd")[1]
    assert memory.most is not None
    assert (
        memory.need.total_mb(memory.most)
        <= 8_000.0
        < memory.need.total_mb(memory.most + 1)
    )


def test_estimate_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimate, "available_mb", lambda: 3_000.0)
    monkeypatch.setattr(estimate, "gpu_free_mb", lambda: None)
    args = ["doctor", "--estimate", "--obs", "rgbd"]
    assert main([*args, "--worlds", "64", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    cpu, warp = found["backends"]
    assert (cpu["backend"], cpu["fits"], warp["backend"], warp["fits"]) == (
        "cpu",
        True,
        "warp",
        None,
    )
    assert main([*args, "--worlds", "4096"]) == 2
    out = capsys.readouterr()
    assert (
        "4096 worlds do not fit: backend cpu needs" in out.err
        and f"at most --worlds {cpu['most']}" in out.err
    )
    # Where the GPU has room, it is fine that this machine has not.
    monkeypatch.setattr(estimate, "gpu_free_mb", lambda: 80_000.0)
    assert main([*args, "--worlds", "4096"]) == 0
    assert main([*args, "--worlds", "0"]) == 2
    assert main(["doctor", "--estimate", "--obs", "rgbx"]) == 2
    assert "unknown observation mode 'rgbx'" in capsys.readouterr().err


def test_worlds_that_do_not_fit_the_device_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The number that the message names fits."""
    device: Any = type(
        "Device", (), {"is_cuda": True, "__str__": lambda self: "cuda:0"}
    )()
    probe: Any = type(sys)("mjhab.sim.warp.device")
    probe.open_device = lambda name: device
    probe.free_mb = lambda opened: 6_000.0
    monkeypatch.setitem(sys.modules, "mjhab.sim.warp.device", probe)
    with refused(
        said=("4096 worlds need about", "MB, but 6,000 MB are free on cuda:0")
    ) as told:
        memory.check_device_memory(4096, memory.WorldPictures("rgbd", 128))
    most = int(str(told.value).rpartition("num_envs=")[2].rstrip("."))
    memory.check_device_memory(most, memory.WorldPictures("rgbd", 128))
    with refused(said=f"num_envs={most}"):
        memory.check_device_memory(most + 1, memory.WorldPictures("rgbd", 128))
    # Larger pictures leave room for fewer; one camera takes half of two.
    with pytest.raises(UsageError):
        memory.check_device_memory(most, memory.WorldPictures("rgbd", (256, 128)))
    memory.check_device_memory(most, memory.WorldPictures("rgbd", (256, 128), cameras=1))
    probe.free_mb = lambda opened: 10.0
    with refused(said="Not even one fits"):
        memory.check_device_memory(1)
    # On Warp's CPU device the memory of this machine counts.
    device.is_cuda = False
    monkeypatch.setattr(memory, "available_mb", lambda: 20.0)
    with refused(said="20 MB are free"):
        memory.check_device_memory(1, device="cpu")


# -- warmup ----------------------------------------------------------------------------------------------------------


def test_warmup_says_what_it_compiles(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from mjhab.scenes import packs

    pack = packs.open_pack("builtin")
    monkeypatch.setattr(
        packs, "open_pack", lambda _: dataclasses.replace(pack, homes=pack.homes[:2])
    )
    assert main(["warmup", "--backend", "cpu", "--json"]) == 0
    out = capsys.readouterr()
    parts = ["2 homes", "rasterizer", "planning of the experts"]
    assert list(json.loads(out.out)["seconds"]) == parts
    said = [
        line for line in out.err.splitlines() if line.startswith("mjhab: compiling: ")
    ]
    assert said == [f"mjhab: compiling: {part} ..." for part in parts]
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
    found = difference(state_like(), state_like(object_pose=pose, robot_q=robot))
    np.testing.assert_allclose(found["objects"], [0.0, 0.5])
    np.testing.assert_allclose(found["turns"], [0.0, 0.2], atol=1e-7)
    np.testing.assert_allclose(found["robot"], [0.25, 0.0])
    np.testing.assert_allclose(found["links"], [0.0, 0.0])
    # q and -q are one orientation.
    flipped = state_like().object_pose * np.array([1, 1, 1, -1, -1, -1, -1])
    assert not difference(state_like(), state_like(object_pose=flipped))["turns"].any()


def test_share_of_nothing_is_none() -> None:
    assert bench_parity.share([]) is None
    assert bench_parity.share(np.array([True, False, True])) == 0.6667


def record_equal(index: int, **changed: Any) -> dict[str, Any]:
    """A row of `run_equal` in which everything agrees."""
    plain = {
        "index": index,
        "steps": 4,
        "success": [True, True],
        "label": ["a", "a"],
        "reward": [0.5, 0.5],
        "close": 4,
        "taint": [0, 0],
        "drift": {},
    }
    return plain | changed


def test_agreement_is_per_episode() -> None:
    rows = [
        record_equal(0),
        record_equal(
            1,
            success=[True, False],
            label=["b", None],
            reward=[0.5, 0.4],
            close=1,
            taint=[0, 4],
        ),
        record_equal(2, success=[False, False], label=[None, None], reward=[0.5, 0.51]),
        record_equal(3, label=["c", "d"], reward=[0.2, 0.9], close=0),
    ]
    assert bench_parity.equal_shares(rows) == {
        "episodes": 4,
        "steps": 16,
        "success": 0.75,
        "label": 0.3333,
        "reward": 0.5625,
        "mean_reward": 0.5,
        "success_cpu": 0.75,
        "success_warp": 0.5,
        "tainted": 1,
    }
    own = [
        {"success": True, "label": "a", "reward": 0.51, "taint": []},
        {"success": True, "label": "b", "reward": 0.6, "taint": ["nan"]},
    ]
    assert bench_parity.own_shares(list(zip(rows, own, strict=False))) == {
        "episodes": 2,
        "success": 1.0,
        "label": 1.0,
        "reward": 0.5,
        "success_cpu": 1.0,
        "success_warp": 1.0,
        "tainted": 1,
    }


def test_divergence_is_the_worst_and_the_median_world() -> None:
    drift = [
        {str(step): dict.fromkeys(KINDS, x * step) for step in (1, 10)}
        for x in (1.0, 2.0, 9.0)
    ]
    drift[2] |= {"100": dict.fromkeys(KINDS, 7.0)}  # only one world got so far
    found = bench_parity.divergence(
        [record_equal(i, drift=rows) for i, rows in enumerate(drift)]
    )
    assert found["steps"] == [1, 10]
    assert found["qpos_max"]["robot"] == [9.0, 90.0] and found["qpos_median"][
        "links"
    ] == [
        2.0,
        20.0,
    ]


def test_the_log_lets_a_killed_run_go_on(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "log.jsonl"
    leg = Leg("set_table", "open")
    log = Log(path)
    for index in (2, 0):
        log.add(leg, "equal", index, {"steps": index + 5})
    log.add(Leg("set_table", "close"), "equal", 1, {"steps": 9})
    with path.open("a") as file:
        file.write('{"acting": "equal", "task": "set_ta')  # killed while it wrote
    again = Log(path)
    assert again.missing(leg, "equal", range(4)) == [1, 3] and again.missing(
        leg, "own", [0]
    ) == [0]
    assert [row["steps"] for row in again.of(leg, "equal")] == [5, 7]
    assert [row["steps"] for row in again.of(leg, "equal", [2])] == [7]
    again.add(leg, "equal", 1, {"steps": 6})
    assert Log(path).missing(leg, "equal", range(4)) == [3]
    path.write_text("steps,success\n")
    with refused(said="is no log of"):
        Log(path)


def test_episodes_of_another_device_are_run_on_this_one_too(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    Log(path).add(Leg("set_table", "open", device="cpu"), "own", 0, {"steps": 5})
    other = Leg("set_table", "open", device="cuda:0")
    log = Log(path)
    assert log.missing(other, "own", [0]) == [0] and log.of(other, "own") == []
    # A log of an older version tells no device.
    path.write_text(path.read_text().replace('"device": "cpu", ', ""))
    assert Log(path).missing(other, "own", [0]) == [0]


def test_a_log_that_cannot_be_written_anew_stays_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "log.jsonl"
    Log(path).add(Leg("set_table", "open"), "equal", 0, {"steps": 5})
    before = path.read_text()

    def full(self: Path, text: str, encoding: str) -> None:
        with self.open("w") as file:
            file.write(text[: len(text) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="No space"):
        Log(path)
    assert path.read_text() == before


def test_only_what_the_log_lacks_is_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[tuple[str, str, int]] = []

    def run(name: str) -> Any:
        def work(leg: Leg, episodes: list[int], done: Any) -> None:
            for index in episodes:
                ran.append((name, leg.subtask, index))
                done(
                    index,
                    record_equal(index)
                    | (
                        {}
                        if name == "equal"
                        else {"success": True, "label": "a", "reward": 0.5, "taint": []}
                    ),
                )

        return work

    monkeypatch.setattr(bench_parity, "run_equal", run("equal"))
    monkeypatch.setattr(bench_parity, "run_own", run("own"))
    legs = [Leg("set_table", name) for name in ("open", "close")]
    log = Log(tmp_path / "log")
    log.add(legs[0], "equal", 0, record_equal(0))
    bench_parity.run_episodes(legs, 3, log)  # 2 of each: 3 do not divide
    assert ran == [
        ("equal", "open", 1),
        ("equal", "close", 0),
        ("equal", "close", 1),
        ("own", "open", 0),
        ("own", "open", 1),
        ("own", "close", 0),
        ("own", "close", 1),
    ]
    found = bench_parity.shares(log, "own", legs, bench_parity.own_shares)
    assert (
        list(found) == ["set_table open", "set_table close", "all"]
        and found["all"]["episodes"] == 4
    )


def test_parity_knows_which_subtasks_there_are(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert bench_parity.pairs("set_table", "pick") == [("set_table", "pick")]
    every = bench_parity.pairs("all", "all")
    assert (
        len(every) == 11
        and ("tidy_house", "navigate") in every
        and ("tidy_house", "open") not in every
    )
    assert bench_parity.pairs("all", "open") == [("set_table", "open")]
    for wrong, said in (
        (
            ["--task", "tidy_house", "--subtask", "open"],
            "has no subtask 'open'; it has pick, place, navigate",
        ),
        (["--task", "dishes"], "unknown task 'dishes'"),
        (["--subtask", "pik"], "unknown subtask 'pik'"),
    ):
        with pytest.raises(UsageError, match=said):
            bench_parity.pairs(**{"task": "set_table", "subtask": "pick"} | _named(wrong))
    assert parity_main(["--worlds", "0"]) == 2
    assert "worlds must be at least 1" in capsys.readouterr().err


def _named(args: list[str]) -> dict[str, str]:
    return {
        name.removeprefix("--"): value
        for name, value in zip(args[::2], args[1::2], strict=True)
    }


# -- report ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def quick_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every measure at once; Interact finds no room."""

    def no_room(plan: Any) -> Any:
        raise UsageError("no room")

    # A collection of this process's garbage takes seconds, and there is one after each measure.
    monkeypatch.setattr(gpu_report, "gc", SimpleNamespace(collect=int))
    monkeypatch.setattr(gpu_report, "resolve", lambda name: name)
    monkeypatch.setattr(gpu_report, "cuda_devices", list)
    monkeypatch.setattr(gpu_report, "gpu_name", lambda: None)
    monkeypatch.setattr(gpu_report, "measure_interact", no_room)
    monkeypatch.setattr(
        gpu_report, "measure_parity", lambda options: {"episodes": options.episodes}
    )
    monkeypatch.setattr(
        gpu_report,
        "picture_stages",
        lambda worlds, size, device: {"size": size, "device": device},
    )
    monkeypatch.setattr(gpu_report, "sleep_cost", lambda leg, steps: [leg.task, steps])
    monkeypatch.setattr(
        gpu_report.bench_env,
        "measure",
        lambda plan: {"points": [{"worlds": plan.worlds[0]}]},
    )


def read_all(folder: Path) -> dict[str, Any]:
    return {path.stem: json.loads(path.read_text()) for path in folder.iterdir()}


@pytest.mark.usefixtures("quick_report")
def test_report_says_that_there_was_no_gpu(tmp_path: Path) -> None:
    gpu_report.report(tmp_path)
    found = read_all(tmp_path)
    assert set(found) == {
        f"gpu-{name}"
        for name in ("memory", "interact", "env", "pictures", "sleep", "parity-quick")
    }
    for content in found.values():
        assert content["machine"]["gpu"] is None and content["note"] == gpu_report.NO_GPU
    points = found["gpu-interact"]["points"]
    assert len(points) == 6 and all(point["error"] == "no room" for point in points)
    assert found["gpu-parity-quick"]["episodes"] == 2
    assert [point["worlds"] for point in found["gpu-env"]["points"]] == [2, 16]
    pictures = found["gpu-pictures"]["points"]
    assert [(point["size"], point["device"]) for point in pictures] == [
        (64, "cpu"),
        (128, "cpu"),
    ]
    assert len(found["gpu-memory"]["estimates"]) == 4 and found["gpu-sleep"]["rows"] == [
        "tidy_house",
        60,
    ]


@pytest.mark.usefixtures("quick_report")
def test_report_on_a_gpu_measures_large_batches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpu_report, "cuda_devices", lambda: ["cuda:0"])
    gpu_report.report(tmp_path)
    found = read_all(tmp_path)
    assert set(found) == {
        f"gpu-{name}"
        for name in ("memory", "interact", "env", "pictures", "sleep", "parity")
    }
    parity = found["gpu-parity"]
    assert parity.pop("machine") and parity.pop("date")
    assert parity == {
        "version": mjhab.__version__,
        "command": "python -m benchmarks.gpu_report docs/results parity",
        "note": None,
        "what": "parity",
        "episodes": 200,
    }
    assert [point["what"] for point in found["gpu-env"]["points"]] == [
        *(
            f"PickSubtaskTrain-v1 warp, {count} worlds"
            for count in (256, 512, 1024, 2048, 4096)
        ),
        *(f"TidyHouse-v1 warp, {count} worlds" for count in (256, 1024)),
        "PickSubtaskTrain-v1 cpu, 16 worlds",
    ]
    assert [point["what"] for point in found["gpu-interact"]["points"]] == [
        f"interact {backend}, {count} worlds, {pictures}"
        for backend, counts in (("warp", (64, 256, 1024, 4096, 8192)), ("cpu", (1, 16)))
        for pictures in ("no cameras", "RGB-D")
        for count in counts
    ]


@pytest.mark.usefixtures("quick_report")
def test_report_goes_on_where_the_device_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(plan: Any) -> Any:
        raise RuntimeError("Graph launch error: CUDA error 700")

    monkeypatch.setattr(gpu_report, "measure_interact", fails)
    gpu_report.report(tmp_path, ["interact", "env"])
    found = read_all(tmp_path)
    assert {point["error"] for point in found["gpu-interact"]["points"]} == {
        "RuntimeError: Graph launch error: CUDA error 700"
    }
    assert "in fails" in capsys.readouterr().err and len(found["gpu-env"]["points"]) == 2


@pytest.mark.usefixtures("quick_report")
def test_report_measures_what_is_named(tmp_path: Path) -> None:
    gpu_report.report(tmp_path, ["parity"])
    assert read_all(tmp_path)["gpu-parity"]["episodes"] == 200
    with refused("measure", "party", expected="parity"):
        gpu_report.report(tmp_path, ["party"])
