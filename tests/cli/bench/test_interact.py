"""The Interact benchmark on the CPU backend: its scene, its recorded actions, its numbers and files."""

from __future__ import annotations

import csv
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import interact_recipe
from mjhab.bench.environments.memory_sampler import MemorySampler
from mjhab.bench.interact import run as bench
from mjhab.bench.interact.scene import (
    OBJECTS,
    STEPS,
    STIFF_BODY_MODE,
    InteractScene,
    interact_actions,
    interact_scene,
)
from mjhab.cli.main import main
from mjhab.core.errors import UsageError
from mjhab.reports.interact import interact_figure
from mjhab.robots.controllers import make_controller
from mjhab.scenes.packs import open_pack
from tests.refusals import command, refused


@pytest.fixture(scope="module")
def scene() -> InteractScene:
    return interact_scene()


def test_the_recorded_actions_move_all_five_objects(scene: InteractScene) -> None:
    run = bench.InteractBench(scene, "cpu", 2, render=False, threads=1)
    touched = np.zeros(len(OBJECTS), bool)
    for number in range(STEPS):
        run.step(number)
        touched |= run.sim.state().touch[0, : len(OBJECTS)]
    assert run.moved() == list(OBJECTS)
    assert touched.all()
    assert run.tainted() == 0
    # Worlds are alike to the bit.
    np.testing.assert_array_equal(run.sim.qpos[0], run.sim.qpos[1])
    # Nothing fell to the floor: the objects are pushed about on the table.
    assert (run.sim.state().object_pose[0, :, 2] > 0.7).all()


def test_the_recipe_makes_the_actions_in_the_repository(scene: InteractScene) -> None:
    made = interact_recipe.record(scene)
    np.testing.assert_array_equal(made, interact_actions(scene)[:, :7])


def test_start_is_that_of_the_paper_before_a_surface(scene: InteractScene) -> None:
    actions = interact_actions(scene)
    assert actions.shape == (200, 13) and actions.dtype == np.float32
    assert (
        np.abs(actions[:, :7]).max() <= 1.0
        and not actions[:, 7].any()
        and not actions[:, 11:].any()
    )
    np.testing.assert_allclose(actions[:, 8:11], [[0.0, 0.562, 0.15]] * 200, atol=1e-6)
    home = scene.layout.pack.homes[0]
    assert (
        len(scene.layout.pack.homes) == 1 and len(home.props) == 1 and home.articulations
    )


def test_commands_are_those_of_the_controller(scene: InteractScene) -> None:
    actions = interact_actions(scene)[:20]
    offset, moves = bench.affine_commands(actions)
    controller = make_controller(STIFF_BODY_MODE, 1)
    rng = np.random.default_rng(0)
    for row, action in zip(offset, actions, strict=True):
        q = rng.uniform(-1.0, 1.0, (1, 15))
        np.testing.assert_allclose(
            row + moves * q[0], controller.command(action[None], q)[0], atol=1e-12
        )


def test_a_surface_that_is_missing_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    from mjhab.bench.interact import scene as module

    pack = open_pack("builtin")
    monkeypatch.setattr(
        module, "open_pack", lambda _: dataclasses.replace(pack, homes=pack.homes[:2])
    )
    monkeypatch.setattr(module, "HALF_WIDTH", 5.0)
    with refused(said="no home of builtin has a table or counter"):
        interact_scene()


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "interact"
    args = "bench interact --backend cpu --worlds 1 2 --seeds 2 --steps 4".split()
    assert main([*args, "--threads", "1", "--out", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {"sps_mean", "sps_ci95", "device_mb", "rss_mb", "worlds", "device"} <= set(
        found
    )
    assert (
        found["device"] == "cpu" and found["device_mb"] is None and found["rss_mb"] > 50
    )
    assert [point["worlds"] for point in found["points"]] == [1, 2]
    assert found["sps_mean"] == max(point["sps_mean"] for point in found["points"])
    assert json.loads((out / "interact.json").read_text()) == found
    rows = list(csv.DictReader((out / "interact.csv").open()))
    assert [(row["worlds"], row["seed"]) for row in rows] == [
        ("1", "1"),
        ("1", "2"),
        ("2", "1"),
        ("2", "2"),
    ]
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "4299.18" in page and "Habitat 2.0" in page and 'alt="head and hand' in page
    assert all(
        point["physics_ms"] > 0.0 and point["render_ms"] > 0.0
        for point in found["points"]
    )
    assert main([*args, "--no-render", "--threads", "1", "--out", str(out)]) == 0
    assert "no cameras" in capsys.readouterr().out
    assert 'alt="head and hand' not in (out / "report.html").read_text(encoding="utf-8")
    assert (
        json.loads((out / "interact.json").read_text())["points"][0]["render_ms"] is None
    )


@pytest.mark.parametrize(
    ("option", "given"), [("backend", "gpu"), ("worlds", 0), ("seeds", 0), ("steps", 201)]
)
def test_bad_arguments(option: str, given: object, tmp_path: Path) -> None:
    with refused(option, given):
        command("bench", "interact", "--out", tmp_path, f"--{option}", given)


def test_pictures_are_drawn_in_every_step_unless_told_not_to(
    scene: InteractScene,
) -> None:
    run = bench.InteractBench(scene, "cpu", 1, render=True, threads=1)
    drawn: list[Any] = []
    draw = run._draw
    assert draw is not None

    def note() -> Any:
        drawn.append(draw())
        return drawn[-1]

    run._draw = note
    run.step(0)
    run.step(1)
    assert len(drawn) == 2
    assert drawn[0]["rgb"].shape == (1, 2, 128, 128, 3) and drawn[0]["depth"].shape == (
        1,
        2,
        128,
        128,
    )
    # The head camera sees the table before it.
    assert 0.3 < np.median(drawn[0]["depth"][0, 0, 96:, 40:88]) < 2.0
    assert bench.InteractBench(scene, "cpu", 1, render=False, threads=1)._draw is None


def test_worlds_that_do_not_fit_are_refused_before_they_are_made(
    scene: InteractScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a GPU with 24 GB, as far as a machine without one can tell."""
    device: Any = type(
        "Device", (), {"is_cuda": True, "__str__": lambda self: "cuda:0"}
    )()
    probe: Any = type(sys)("mjhab.sim.warp.device")
    probe.open_device = lambda name: device
    probe.free_mb = lambda _: 24_000.0
    monkeypatch.setitem(sys.modules, "mjhab.sim.warp.device", probe)
    opened: list[int] = []

    def opens(backend: str, layout: Any, worlds: int, **_: Any) -> Any:
        opened.append(worlds)
        raise UsageError("no further")

    monkeypatch.setattr(bench, "open_simulator", opens)
    with refused(
        said=("100000 worlds need about", "are free on cuda:0", "--worlds", "num_envs=")
    ):
        bench.InteractBench(scene, "warp", 100_000, render=True)
    assert not opened
    for backend, worlds in (("warp", 8192), ("cpu", 100_000)):
        with refused(said="no further"):
            bench.InteractBench(scene, backend, worlds, render=True)
    assert opened == [8192, 100_000]


def test_confidence_interval_is_that_of_student() -> None:
    runs = [
        {
            "worlds": 4,
            "sps": sps,
            "reset_and_step_sps": 9.0,
            "device_mb": None,
            "rss_mb": 7.0 + sps,
        }
        for sps in (10.0, 12.0, 14.0)
    ]
    found = bench.summarize(runs)
    assert found["sps_mean"] == 12.0
    assert found["sps_ci95"] == pytest.approx(4.3027 * 2.0 / np.sqrt(3), abs=0.01)
    assert found["rss_mb"] == 21.0 and found["device_mb"] is None
    assert bench.summarize(runs[:1])["sps_ci95"] is None


def test_memory_is_sampled_while_the_work_runs() -> None:
    level = {"rss": 1.0}
    with MemorySampler(
        lambda: level["rss"], lambda: 2 * level["rss"], interval=0.005
    ) as memory:
        level["rss"] = 50.0
        time.sleep(0.1)
        level["rss"] = 3.0
    assert memory.peak_rss_mb == 50.0 and memory.peak_device_mb == 100.0
    assert memory.samples > 4
    with MemorySampler(lambda: 1.0, lambda: None) as memory:
        pass
    assert memory.peak_device_mb is None and memory.samples == 2


def test_plot_takes_the_memory_of_the_gpu_where_there_is_one() -> None:
    point = {
        "worlds": 8,
        "sps_mean": 100.0,
        "sps_ci95": None,
        "rss_mb": 1024.0,
        "device_mb": 2048.0,
    }
    found = {"points": [point], "backend": "warp", "device": "cuda:0"}
    ours, maniskill, habitat = interact_figure(found)["data"]
    assert ours["x"] == [2.0] and ours["y"] == [100.0]
    assert (maniskill["x"], maniskill["y"], maniskill["error_y"]["array"]) == (
        [15.35],
        [4299.18],
        [26.36],
    )
    assert (habitat["x"], habitat["y"], habitat["error_y"]["array"]) == (
        [22.6],
        [1397.65],
        [11.02],
    )
    point["device_mb"] = None
    assert interact_figure(found)["data"][0]["x"] == [1.0]
