"""What lies in the cache was computed by the arithmetic of this machine: another one has another key."""

from __future__ import annotations

import numpy as np
import pytest

from mjhab.core.arithmetic import digest as arithmetic
from mjhab.core.arithmetic.digest import arithmetic_digest
from mjhab.episodes import generator
from mjhab.episodes.generator import EpisodeMaker
from mjhab.episodes.grasps import stable
from mjhab.episodes.grasps.stable import StableGrasps
from mjhab.episodes.rosters import roster
from mjhab.layout import compile as compiling
from mjhab.layout.compile import home_hash, model_path
from mjhab.layout.layout import Layout
from mjhab.render import mesh_levels
from mjhab.robots.fetch.model import REST_QPOS
from mjhab.scenes.builtin import home_cache
from mjhab.scenes.packs import open_pack
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.scratch import Scratch
from tests.tasks.build import config_of

KEYED = (compiling, generator, stable, mesh_levels, home_cache)
"""Modules with results in the cache; experts.planning.link_motions and scenes.replica_cad.looks do it likewise."""
ELSEWHERE = b"the arithmetic of another machine"


def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in KEYED:
        monkeypatch.setattr(module, "arithmetic_digest", lambda: ELSEWHERE)


def test_models_of_another_arithmetic_have_other_files_but_the_same_home(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    layout = Layout(open_pack("builtin"), ())
    home = layout.pack.homes[0]
    here = model_path(layout, home), home_hash(layout, home)
    elsewhere(monkeypatch)
    assert model_path(layout, home) != here[0]
    assert home_hash(layout, home) == here[1]


def test_episodes_grasps_homes_and_meshes_have_other_files(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sim = CpuSimulator(Layout(open_pack("builtin"), roster("set_table")), 1, 1)
    here = keys(sim)
    assert keys(sim) == here
    elsewhere(monkeypatch)
    there = keys(sim)
    same = [name for name in here if there[name] == here[name]]
    assert same == ["episode files"], (
        "the name of an episode file travels, the rest does not"
    )


def keys(sim: CpuSimulator) -> dict[str, str]:
    maker = EpisodeMaker(sim, "set_table", "train")
    grasps = StableGrasps(sim, config_of(REST_QPOS), Scratch(sim))
    triangle = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
    return {
        "episode files": maker.digest,
        "episodes": str(maker._path(0, 0)),
        "grasps": str(grasps.folder),
        "homes": home_cache._code_digest().hex(),
        "meshes": mesh_levels._digest(triangle),
    }


def test_the_digest_sees_the_libraries_and_the_last_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fresh = arithmetic_digest.__wrapped__
    here = fresh()
    assert fresh() == here == arithmetic_digest()
    with monkeypatch.context() as other:
        other.setattr(arithmetic, "version", lambda name: "99.0")
        assert fresh() != here
    with monkeypatch.context() as other:
        exact = np.sin
        other.setattr(
            arithmetic.np, "sin", lambda x: np.nextafter(exact(x), 9.0, dtype=x.dtype)
        )
        assert fresh() != here
    with monkeypatch.context() as other:
        other.setattr(arithmetic.math, "exp", lambda x: 2.718281828459045**x)
        assert fresh() != here
