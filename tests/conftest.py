"""Simulators that the tests of several files share: kernels load once. Every test resets them."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import pytest

from mjhab.episodes.grasps import carry_postures
from mjhab.layout.layout import Layout
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from tests.sim.warp.start import ROSTER, WORLDS
from tests.warp_device import TEST_DEVICE, read_on_host

if TEST_DEVICE != "cpu":
    read_on_host()


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect the tests without looking for garbage among them.

    Nothing of a million objects is any: each search takes 0.7 s, and 21 of them 5 of 20 s in every process of xdist.
    What was collected lives to the end and is left out of the later searches, too.
    """
    gc.disable()
    result = yield
    gc.freeze()
    gc.enable()
    return result


@pytest.fixture(scope="module")
def few_carry_postures() -> Iterator[None]:
    """Four arm postures with each held object instead of 32, which take 1.3 s per object and layout to be found."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(carry_postures, "MAX_ARMS", 4)
        yield


@pytest.fixture(scope="session")
def warp() -> ModuleType:
    """The module of the GPU simulator."""
    from mjhab.sim.warp import simulator as warp

    return warp


@pytest.fixture(scope="session")
def layout() -> Layout:
    """Can and box in the built-in homes."""
    return Layout(open_pack("builtin"), ROSTER)


@pytest.fixture(scope="session")
def cpu(layout: Layout) -> CpuSimulator:
    """The simulator to agree with."""
    return CpuSimulator(layout, WORLDS, 1)


@pytest.fixture(scope="session")
def shared(warp: ModuleType, layout: Layout) -> Any:
    """The GPU simulator on the device of the tests."""
    return warp.WarpSimulator(layout, WORLDS, TEST_DEVICE)
