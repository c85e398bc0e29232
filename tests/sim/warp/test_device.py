"""The device of the warp backend: what is refused and why, free memory, and the line that tells of kernels compiled."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import pytest

from tests.missing import need_warp
from tests.refusals import refused

need_warp()

import torch  # noqa: E402
import warp as wp  # noqa: E402

from mjhab.sim.warp import builds as warp_builds  # noqa: E402
from mjhab.sim.warp import device as warp_device  # noqa: E402


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """A machine as Warp would tell it; tests change it."""
    told: dict[str, Any] = {"driver": (12, 4), "there": True, "graphs": True}
    device = SimpleNamespace(is_cuda=True, free_memory=3 * 2**30)
    monkeypatch.setattr(wp, "get_cuda_driver_version", lambda: told["driver"])
    monkeypatch.setattr(wp, "is_cuda_available", lambda: told["there"])
    monkeypatch.setattr(wp, "is_conditional_graph_supported", lambda: told["graphs"])
    monkeypatch.setattr(
        wp, "get_devices", lambda: ["cpu", "cuda:0"] if told["there"] else ["cpu"]
    )
    monkeypatch.setattr(
        wp,
        "get_device",
        lambda name: (
            device if name.startswith("cuda") else SimpleNamespace(is_cuda=False)
        ),
    )
    return told


def test_the_first_cuda_device_is_taken(cuda: dict[str, Any]) -> None:
    device = warp_device.open_device("")
    assert device.is_cuda and warp_device.free_mb(device) == 3072.0
    assert not warp_device.open_device("cpu").is_cuda
    with refused("device", "cuda:1", expected="cuda:0"):
        warp_device.open_device("cuda:1")


@pytest.mark.parametrize(
    ("machine", "name", "fields"),
    [
        ({"driver": None, "there": False}, "", dict(said="found no CUDA device")),
        (
            {"driver": (12, 2), "there": True},
            "",
            dict(said="driver for CUDA 12.4 or newer, this one is for 12.2; update"),
        ),
        ({"driver": (11, 0), "there": False}, "", dict(said="this one is for 11.0")),
        (
            {"driver": (11, 0), "there": False},
            "cuda:0",
            dict(said="this one is for 11.0"),
        ),
        (
            {"graphs": False},
            "cuda:0",
            dict(said="a Warp that was built with CUDA 12.4 or newer"),
        ),
    ],
)
def test_machines_that_cannot_are_told_why(
    cuda: dict[str, Any], machine: dict[str, Any], name: str, fields: dict[str, Any]
) -> None:
    cuda |= machine
    with refused(**fields) as told:
        warp_device.open_device(name)
    assert "\n" not in str(told.value)
    assert not warp_device.open_device("cpu").is_cuda  # which needs no driver


def test_a_full_device_is_told_in_one_line() -> None:
    device: Any = "cuda:0"
    for told in (
        "Failed to allocate 123 bytes on device 'cuda:0'",
        "CUDA out of memory. Tried to allocate 2 GiB",
    ):
        with (
            refused(said="4096 worlds do not fit into the memory of cuda:0; try 2048"),
            warp_device.room_for(4096, device),
        ):
            raise RuntimeError(told)
    with refused(said="1 worlds do not fit"), warp_device.room_for(1, device):
        raise RuntimeError("CUDA error 2: out of memory")
    for other in (
        "something else",
        "CUDA error 700: an illegal memory access was encountered",
    ):
        with pytest.raises(RuntimeError, match=other), warp_device.room_for(4096, device):
            raise RuntimeError(other)


def test_warp_works_on_the_stream_of_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """As far as a machine without CUDA can show it: the current stream of the right device, one object for each."""
    asked: list[int] = []

    def current(ordinal: int) -> SimpleNamespace:
        asked.append(ordinal)
        return SimpleNamespace(cuda_stream=ordinal * 100)

    monkeypatch.setattr(torch.cuda, "current_stream", current)
    monkeypatch.setattr(
        wp, "stream_from_torch", lambda stream: SimpleNamespace(handle=stream.cuda_stream)
    )
    monkeypatch.setattr(warp_device, "_STREAMS", {})
    one = SimpleNamespace(ordinal=1)
    two = SimpleNamespace(ordinal=2)
    first: Any = warp_device.torch_stream(one)  # type: ignore[arg-type]
    other: Any = warp_device.torch_stream(two)  # type: ignore[arg-type]
    assert (first.handle, other.handle) == (100, 200) and asked == [1, 2]
    assert warp_device.torch_stream(one) is first  # type: ignore[arg-type]


# -- kernels that are compiled ---------------------------------------------------------------------------------------


def watched(clock: list[float]) -> tuple[warp_builds.BuildProgress, Any]:
    """A progress, and a compiler of 20 s that it tells of."""
    progress = warp_builds.BuildProgress(lambda: clock[0])

    def compiler(path: str) -> str:
        clock[0] += 20.0
        return path.upper()

    return progress, progress.watch(compiler, lambda path: path)


def test_a_log_gets_a_line_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    clock = [0.0]
    progress, compiler = watched(clock)
    assert (
        compiler("/cache/wp_mujoco_warp._src.solver_1a2b3c4d.cu")
        == "/CACHE/WP_MUJOCO_WARP._SRC.SOLVER_1A2B3C4D.CU"
    )
    compiler("/cache/wp_mjhab.sim.warp.kernels_1a2b3c4d.cpp")
    clock[0] = (
        21.0 + warp_builds.LINE_EVERY - 20.0
    )  # the third comes too early for a line
    compiler("/cache/wp_other_1a2b3c4d.cpp")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2 and (progress.count, progress.seconds) == (3, 60.0)
    assert (
        "module 1 (mujoco_warp._src.solver), 0 s so far. Some minutes the first time"
        in lines[0]
    )
    assert "module 2 (mjhab.sim.warp.kernels), 20 s so far" in lines[1]


def test_a_terminal_gets_one_line_that_goes_away(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, compiler = watched([0.0])
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    for _ in range(2):
        compiler("/cache/wp_solver_1a2b3c4d.cu")
    told = capsys.readouterr().err
    assert (
        "\n" not in told
        and told.endswith("\r\033[K")
        and told.count("module 2 (solver)") == 1
    )


def test_what_warp_compiles_is_told(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the real compiler: opening a device is enough, and what the cache holds is not compiled again."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    warp_device.open_device("cpu")
    progress = warp_builds.announce_builds()
    before = progress.count
    values = wp.zeros(3, dtype=float, device="cpu")
    for _ in range(2):
        wp.launch(_count_up, dim=3, inputs=[values], device="cpu")
    assert values.numpy().tolist() == [2.0, 2.0, 2.0]
    assert progress.count == before + 1 and progress.seconds > 0.0


@wp.kernel
def _count_up(values: wp.array(dtype=float)):  # type: ignore[valid-type]
    values[wp.tid()] += 1.0
