"""examples/mug: a plugin's object is held in simulation, and the scripted expert picks it."""

from __future__ import annotations

import dataclasses
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import mjhab
from mjhab.config.env import EnvConfig
from mjhab.config.thresholds import task_config
from mjhab.core.registration.plugins import load_plugin
from mjhab.episodes.grasps.stable import MAX_GRASPS, StableGrasps
from mjhab.layout.layout import Layout
from mjhab.robots.fetch.robot import ROBOT
from mjhab.scenes.formats.gltf import read_glb
from mjhab.scenes.objects import OBJECTS
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.scratch import Scratch

FOLDER = Path(__file__).parents[2] / "examples" / "mug"


@pytest.fixture(autouse=True)
def mug() -> Iterator[None]:
    assert not load_plugin(FOLDER / "mug.py").error
    yield
    OBJECTS.remove("mug")


def test_the_file_is_what_its_script_makes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = runpy.run_path(str(FOLDER / "make_mug.py"))
    monkeypatch.setitem(script["main"].__globals__, "OUT", tmp_path / "mug.glb")
    monkeypatch.setattr(sys, "argv", ["make_mug.py"])
    script["main"]()
    made = read_glb(tmp_path / "mug.glb")
    kept = read_glb(FOLDER / "mug.glb")
    assert [part.mesh for part in made] == [part.mesh for part in kept]
    for a, b in zip(made, kept, strict=True):
        np.testing.assert_allclose(a.vertices, b.vertices, atol=1e-6)


def test_many_different_grasps_hold_in_simulation() -> None:
    pack = dataclasses.replace(open_pack(), homes=open_pack().homes[:1])
    sim = CpuSimulator(Layout(pack, ("mug",)), 1, 1)
    held = StableGrasps(sim, task_config(EnvConfig(), ROBOT), Scratch(sim)).found("mug")
    assert len(held) == MAX_GRASPS
    fingers = np.array([grasp.fingers for grasp in held])
    # By the wall or the handle, and around the body.
    assert fingers.min() < 0.008


def test_the_expert_picks_it(tmp_path: Path) -> None:
    run = mjhab.evaluate(
        "expert",
        task="tidy_house",
        subtask="pick",
        target="mug",
        home="builtin_m0_00",
        episodes=4,
        worlds=4,
        films=0,
        out=tmp_path,
    )
    assert run.summary["success_once"] >= 0.5
    (record, *_) = (tmp_path / "episodes.jsonl").read_text().splitlines()
    assert "mug_:0000" in record
