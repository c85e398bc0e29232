"""Memory of the GPU simulator: no copies in a step, buffers that hold, captured work that allocates nothing.

Every trap test fails when its cure in ``sim/warp*.py`` is taken out.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from mjhab.layout.home_models import HomeModels
from mjhab.layout.layout import Layout
from mjhab.robots.parts import Drives
from mjhab.sim.mujoco.cpu import CpuSimulator
from tests.missing import need_warp
from tests.refusals import refused
from tests.sim.warp.start import (
    WORLDS,
    bits_of,
    hold,
    homes_of,
    starts,
)
from tests.warp_device import TEST_DEVICE

need_warp()


def test_a_step_copies_nothing_to_the_host(
    shared, cpu: CpuSimulator, layout: Layout, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch
    import warp as wp

    qpos = starts(cpu)
    shared.reset(range(WORLDS), homes_of(layout), qpos)
    ctrl = torch.as_tensor(np.stack([hold(cpu, q) for q in qpos]), dtype=torch.float32)

    def forbidden(*_: object, **__: object) -> None:
        raise AssertionError("copied to the host")

    with monkeypatch.context() as patch:
        for kind, names in (
            (torch.Tensor, ("cpu", "numpy", "item", "tolist", "__array__")),
            (wp.array, ("numpy",)),
        ):
            for name in names:
                patch.setattr(kind, name, forbidden)
        shared.step(ctrl)
        state = shared.state()
        taint = shared.taint()
    assert not taint.any()
    for view, owner in (
        (state.object_pose, shared.engine.data.qpos),
        (state.body_pos, shared.engine.data.xpos),
    ):
        assert owner.ptr <= view.data_ptr() < owner.ptr + owner.capacity


def test_buffer_sizes_are_measured_once_and_hold_the_stress(
    warp: ModuleType,
    cpu: CpuSimulator,
    layout: Layout,
    monkeypatch: pytest.MonkeyPatch,
    shared,
) -> None:
    from mjhab.sim.warp import sizes as warp_sizes

    monkeypatch.setattr(warp_sizes, "measure_demand", None)
    sizes = warp_sizes.buffer_sizes(
        layout, cpu.model, cpu.addresses, WORLDS, shared.device
    )
    assert sizes == shared.engine.sizes
    many = warp_sizes.buffer_sizes(
        layout, cpu.model, cpu.addresses, 100 * WORLDS, shared.device
    )
    assert (
        sizes.contacts < many.contacts < 100 * sizes.contacts and many.rows == sizes.rows
    )
    home = layout.pack.homes[0]
    run = warp_sizes.stress(layout, home, cpu.model(home.name), cpu.addresses, 70)
    assert run.rows <= sizes.rows and len(run.states) < WORLDS
    qpos = np.stack([*(qpos for qpos, _ in run.states), starts(cpu)[0]])
    shared.reset(range(WORLDS), [home.name] * WORLDS, qpos)
    shared.step(np.zeros((WORLDS, 15)))
    assert not {"contact_overflow", "constraint_overflow", "nan"} & set().union(
        *bits_of(shared.taint())
    )


def test_buffer_sizes_are_measured_for_every_kind_of_servos(
    warp: ModuleType,
    cpu: CpuSimulator,
    layout: Layout,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    from mjhab.sim.warp import sizes as warp_sizes

    measured: list[Any] = []

    def measure(layout: Layout, model: Any, *_: object) -> Any:
        measured.append(model)
        return warp_sizes.BufferUsage(
            contacts=1, mean_contacts=1.0, ccd=1, mean_ccd=1.0, rows=1, awake=1
        )

    monkeypatch.setattr(warp_sizes, "measure_demand", measure)
    monkeypatch.setattr(warp_sizes, "cache_dir", lambda: tmp_path)
    by_speed = HomeModels(layout, Drives(velocity=layout.robot.group("arm")))
    for model in (cpu.model, by_speed, cpu.model, by_speed):
        warp_sizes.buffer_sizes(layout, model, cpu.addresses, WORLDS, cast(Any, None))
    assert measured == [cpu.model, by_speed]


def host_block(size: int, **_: object) -> Any:
    """Memory on the host in place of memory on a GPU."""
    block = np.zeros(size, np.uint8)
    return SimpleNamespace(ptr=block.ctypes.data, block=block)


def nullcontext_of(*_: object) -> AbstractContextManager[None]:
    return nullcontext()


def test_trap_captured_work_takes_the_memory_of_its_first_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The body of a conditional graph must hold no allocation, and the engine allocates wherever it computes.
    from mjhab.sim.warp import graphs as warp_graphs

    monkeypatch.setattr(warp_graphs.wp, "ScopedAllocator", nullcontext_of)
    arena = warp_graphs._Arena(cast(Any, SimpleNamespace(is_cuda=True)))
    monkeypatch.setattr(warp_graphs.wp, "empty", host_block)
    first = [arena.allocate(size) for size in (64, 64, 128)]
    assert len(set(first)) == 3
    for address, size in zip(first, (64, 64, 128), strict=True):
        arena.deallocate(address, size)

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("memory is allocated while work is captured")

    monkeypatch.setattr(warp_graphs.wp, "empty", refuse)
    with arena.closed():
        assert sorted(arena.allocate(size) for size in (128, 64, 64)) == sorted(first)
        # A block that a graph allocates is its own, but the arena would lend it to other graphs.
        with pytest.raises(
            RuntimeError, match="takes 64 bytes that its first run did not take"
        ):
            arena.allocate(64)


def test_captured_work_needs_no_memory_but_that_of_its_first_run(
    warp: ModuleType, layout: Layout, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A GPU would refuse more. Warp's CPU device keeps what it captures until the end of a capture, which CUDA does not:
    # so the work is done where it would be captured.
    from mjhab.sim.warp import graphs as warp_graphs

    asked: list[int] = []
    closed = warp_graphs._Arena.closed

    @contextmanager
    def watched(arena: Any) -> Iterator[None]:
        before = len(arena._kept)
        with closed(arena):
            yield
        asked.append(len(arena._kept) - before)

    monkeypatch.setattr(warp_graphs._Arena, "closed", watched)
    monkeypatch.setattr(
        warp_graphs.wp,
        "ScopedCapture",
        lambda device: nullcontext(SimpleNamespace(graph=None)),
    )
    sim = warp.WarpSimulator(
        layout, 2, TEST_DEVICE, sizes=warp.BufferSizes(contacts=512, ccd=256, rows=512)
    )
    home = layout.pack.homes[0].name
    qpos = sim.qpos.clone()
    sim.step(sim.engine.ctrl_t.clone())
    sim.mend_broken()
    rows, ctrl, rings = sim.start_rows([home] * 2, qpos.numpy())
    sim.reset_masked(rows.new_tensor([1, 0]).bool(), rows, qpos, ctrl, rings)
    # Refresh, step, mend, renew: under a condition that does not hold, the latter two are captured without a first run.
    assert asked == [0, 0, 0, 0] and len(sim.engine.graphs._arena._kept) > 10


def test_the_broad_phase_is_one_that_can_stand_under_a_condition(
    warp: ModuleType, layout: Layout, monkeypatch: pytest.MonkeyPatch
) -> None:
    # For large models the engine would take one that sorts with memory of its own.
    import mujoco_warp

    put = mujoco_warp.put_model

    def put_large(*args: Any, **options: Any) -> Any:
        model = put(*args, **options)
        model.opt.broadphase = mujoco_warp.BroadphaseType.SAP_TILE
        return model

    monkeypatch.setattr(mujoco_warp, "put_model", put_large)
    sim = warp.WarpSimulator(
        layout, 1, TEST_DEVICE, sizes=warp.BufferSizes(contacts=512, ccd=256, rows=512)
    )
    assert sim.engine.model.opt.broadphase == mujoco_warp.BroadphaseType.NXN


def test_work_is_captured_once_replayed_and_captured_anew_when_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from mjhab.sim.warp import graphs as warp_graphs

    log: list[str] = []

    class Capture:
        def __init__(self, device: object) -> None:
            self.graph = f"graph {len(log)}"

        def __enter__(self) -> Capture:
            log.append("capture")
            return self

        def __exit__(self, *error: object) -> None:
            log.append("end")

    def launch(graph: str, stream: str) -> None:
        log.append(f"{graph} on {stream}")

    torch_works_on = ["stream 0"]
    monkeypatch.setattr(warp_graphs.wp, "ScopedCapture", Capture)
    monkeypatch.setattr(warp_graphs.wp, "capture_launch", launch)
    monkeypatch.setattr(warp_graphs.wp, "Stream", lambda device: "own stream")
    for name in ("ScopedAllocator", "ScopedDevice", "ScopedStream"):
        monkeypatch.setattr(warp_graphs.wp, name, nullcontext_of)
    monkeypatch.setattr(
        warp_graphs.wp, "synchronize_device", lambda device: log.append("wait")
    )
    monkeypatch.setattr(warp_graphs, "torch_stream", lambda device: torch_works_on[0])
    graphs = warp_graphs.Graphs(cast(Any, SimpleNamespace(is_cuda=True)))
    for _ in range(3):
        graphs.run("step", lambda: log.append("work"))
    # Capturing is on a stream of its own, so torch and it wait for each other; a launch is where torch works.
    first = ["wait", "work", "capture", "work", "end", "wait"]
    assert log == [*first, "graph 2 on stream 0", "graph 2 on stream 0"]
    torch_works_on[0] = "stream 7"
    graphs.run("step", lambda: log.append("work"))
    assert log[-1] == "graph 2 on stream 7"
    del log[:]
    graphs.forget()
    graphs.run("step", lambda: log.append("work"))
    assert log == first


def test_without_the_engine_the_error_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delitem(sys.modules, "mjhab.sim.warp.simulator", raising=False)
    monkeypatch.setitem(sys.modules, "warp", None)
    with refused("backend 'warp'"):
        importlib.import_module("mjhab.sim.warp.simulator")


def test_too_many_worlds_for_the_memory(
    warp: ModuleType, layout: Layout, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise RuntimeError("Failed to allocate 123 bytes on device 'cuda:0'")

    monkeypatch.setattr(warp, "Engine", full)
    sizes = warp.BufferSizes(contacts=64, ccd=64, rows=64)
    with refused(said=f"6 worlds do not fit into the memory of {TEST_DEVICE}; try 3 "):
        warp.WarpSimulator(layout, 6, TEST_DEVICE, sizes=sizes)


def test_bad_arguments(warp: ModuleType, layout: Layout) -> None:
    with refused("num_worlds", 0, expected="at least 1"):
        warp.WarpSimulator(layout, 0, TEST_DEVICE)
    with refused("device", "cpu:3", expected="cpu"):
        warp.WarpSimulator(layout, 1, "cpu:3")
    sizes = warp.BufferSizes(contacts=64, ccd=64, rows=64)
    with refused("home", "builtin_m0_0", expected="builtin_m0_00"):
        warp.WarpSimulator(layout, 1, TEST_DEVICE, sizes=sizes).model("builtin_m0_0")
