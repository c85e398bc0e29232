"""Cameras on Warp's CPU device: the same pictures as the CPU renderer's, and each trap of drawing many homes at once.

Every trap test fails when its cure in ``cameras.py``, ``scene.py`` or ``tracing.py`` of ``render/warp`` is taken out.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from torch import Tensor

from mjhab.layout.layout import Layout
from mjhab.render.home_scene import HomeRenderer
from mjhab.render.layout_scene import build_render_scene
from mjhab.robots.fetch.model import REST_QPOS
from mjhab.scenes.freespace import free_map
from mjhab.scenes.packs import open_pack
from mjhab.scenes.spec import PARKED, Home
from mjhab.sim.mujoco.cpu import CpuSimulator
from tests.missing import need_warp
from tests.real_data import real_data
from tests.refusals import refused
from tests.warp_device import TEST_DEVICE

need_warp()

CAMERAS = ("fetch_head", "fetch_hand")
OUTPUTS = ("rgb", "depth", "seg")
ROSTER = ("003_cracker_box", "005_tomato_soup_can")
BOX = 0
CAN = 1
SIZE = (56, 72)
WORLDS = 3
DEPTH_MEDIAN = 1e-3
DEPTH_P95 = 1e-3
SEGMENTS = 0.995
COLOR = 2.0
"""Tolerances: depth [m], share of equal segment ids, mean difference of colours [of 255]."""


@pytest.fixture(scope="module")
def warp() -> ModuleType:
    from mjhab.render.warp import cameras as warp_cameras

    return warp_cameras


def open_worlds(layout: Layout):
    from mjhab.sim.warp.buffers import BufferSizes
    from mjhab.sim.warp.simulator import WarpSimulator

    return WarpSimulator(
        layout, WORLDS, TEST_DEVICE, sizes=BufferSizes(contacts=4096, ccd=1024, rows=1024)
    )


class Pair:
    """A device simulator with cameras, and its twin on the CPU."""

    def __init__(
        self, warp: ModuleType, pack: str | dict[str, str], size: tuple[int, int] = SIZE
    ) -> None:
        self.layout = Layout(open_pack(pack), ROSTER)
        self.size = size
        self.sim, self.cpu = (
            open_worlds(self.layout),
            CpuSimulator(self.layout, WORLDS, 1),
        )
        self.cameras = warp.WarpCameras(self.sim, CAMERAS, size, OUTPUTS)
        self.renderer = HomeRenderer(self.cpu, 1)
        homes = self.layout.pack.homes
        self.homes = [homes[0].name, homes[len(homes) // 2].name, homes[-1].name]

    def home(self, name: str) -> Home:
        return next(home for home in self.layout.pack.homes if home.name == name)

    def start(self, name: str, place: int = 0, **joints: float) -> np.ndarray:
        """A state (nq,) with the robot on free floor, everything ajar, and the objects before the hand's camera."""
        fmap = free_map(self.home(name), self.layout.pack, cell=0.25)
        floor = fmap.to_xy(np.argwhere(fmap.navigable(0.35)))
        x, y = floor[len(floor) // 3 + 7 * place]
        yaw = 0.7 + 2.1 * place
        a = self.cpu.addresses
        qpos = self.cpu.model(name).qpos0.copy()
        qpos[a.robot_q] = REST_QPOS
        qpos[a.robot_q[:3]] = x, y, yaw
        qpos[a.link_q] = 0.15
        for slot, (ahead, left) in {BOX: (0.95, 0.0), CAN: (0.85, 0.2)}.items():
            first = a.object_q[slot]
            qpos[first : first + 2] = [
                x + ahead * np.cos(yaw) - left * np.sin(yaw),
                y + ahead * np.sin(yaw) + left * np.cos(yaw),
            ]
            qpos[first + 2] = 0.45
        return qpos

    def begin(self, homes: list[str], qpos: list[np.ndarray]) -> None:
        for sim in (self.sim, self.cpu):
            sim.reset(range(WORLDS), homes, np.stack(qpos))

    def drawn(self) -> dict[str, np.ndarray]:
        return {name: image.numpy().copy() for name, image in self.cameras.draw().items()}

    def expected(self, homes: list[str]) -> dict[str, np.ndarray]:
        return self.renderer.robot_views(
            self.cpu.state(), homes, self.size, OUTPUTS, CAMERAS
        )

    def check(self, homes: list[str]) -> None:
        """Both draw the same."""
        agree(self.drawn(), self.expected(homes))


def agree(got: dict[str, np.ndarray], want: dict[str, np.ndarray]) -> None:
    for world, camera in np.ndindex(*want["depth"].shape[:2]):
        off = np.abs(got["depth"][world, camera] - want["depth"][world, camera])
        assert np.median(off) < DEPTH_MEDIAN and np.quantile(off, 0.95) < DEPTH_P95
        assert (
            got["seg"][world, camera] == want["seg"][world, camera]
        ).mean() >= SEGMENTS
        colors = got["rgb"][world, camera].astype(float) - want["rgb"][world, camera]
        assert np.abs(colors).mean() < COLOR


@pytest.fixture(scope="module")
def pair(warp: ModuleType) -> Pair:
    return Pair(warp, "builtin")


def test_pictures_agree_with_the_cpu_renderer(pair: Pair) -> None:
    pair.begin(
        pair.homes, [pair.start(home, place) for place, home in enumerate(pair.homes)]
    )
    got = pair.drawn()
    agree(got, pair.expected(pair.homes))
    kinds = {"rgb": ((3,), np.uint8), "depth": ((), np.float32), "seg": ((), np.int32)}
    for name, (tail, dtype) in kinds.items():
        assert (
            got[name].shape == (WORLDS, len(CAMERAS), *SIZE, *tail)
            and got[name].dtype == dtype
        )
    assert pair.cameras.segmentation_names == pair.renderer.scene.seg_names
    # Something of everything is in view: else the test proves little.
    seen = {pair.cameras.segmentation_names[k] for k in np.unique(got["seg"])}
    assert {
        "floor",
        "wall",
        "003_cracker_box_:0000",
        "005_tomato_soup_can_:0000",
        "robot/gripper_link",
    } <= seen


def test_pictures_follow_the_worlds(pair: Pair) -> None:
    pair.begin(pair.homes, [pair.start(home, 1) for home in pair.homes])
    pair.drawn()
    ctrl = np.zeros((WORLDS, pair.cpu.model(pair.homes[0]).nu))
    for sim in (pair.sim, pair.cpu):
        for _ in range(2):
            sim.step(ctrl)
    pair.check(pair.homes)


def test_camera_poses_agree_with_the_cpu_renderer(pair: Pair) -> None:
    pair.begin(
        pair.homes, [pair.start(home, place) for place, home in enumerate(pair.homes)]
    )
    for got, want in zip(
        pair.cameras.poses(),
        pair.renderer.camera_poses(pair.cpu.state(), CAMERAS),
        strict=True,
    ):
        assert got.shape == want.shape
        np.testing.assert_allclose(got.numpy(), want, atol=1e-5)


def test_trap_static_poses_each_world_shows_its_own_home(pair: Pair) -> None:
    # The same robot in three homes, and in one of them twice.
    homes = [pair.homes[0], pair.homes[2], pair.homes[0]]
    qpos = pair.start(pair.homes[0])
    pair.begin(homes, [qpos] * WORLDS)
    got = pair.drawn()
    agree(got, pair.expected(homes))
    for image in got.values():
        np.testing.assert_array_equal(image[0], image[2])
        assert (image[0] != image[1]).mean() > 0.2


def test_trap_stale_trees_worlds_move_to_other_homes(
    pair: Pair, warp: ModuleType
) -> None:
    qpos = [pair.start(home, place) for place, home in enumerate(pair.homes)]
    pair.begin(pair.homes, qpos)
    pair.drawn()
    moved = pair.layout.pack.homes[len(pair.layout.pack.homes) // 3].name
    built = len(pair.cameras._scene._meshes)
    homes = [pair.homes[0], moved, pair.homes[2]]
    there = pair.start(moved)
    for sim in (pair.sim, pair.cpu):
        sim.reset([1], [moved], there[None])
    got = pair.drawn()
    agree(got, pair.expected(homes))
    # Its furniture was built now; nothing else was.
    assert len(pair.cameras._scene._meshes) == built + 1
    fresh = warp.WarpCameras(pair.sim, CAMERAS, SIZE, OUTPUTS).draw()
    for name, image in got.items():
        np.testing.assert_array_equal(image, fresh[name].numpy())
    # Back again, as the device environments do it: known homes need no work at all.
    rows, ctrl, rings = pair.sim.start_rows(pair.homes, np.stack(qpos))
    states = pair.sim.qpos.new_tensor(np.stack(qpos))
    pair.sim.reset_masked(rows.new_tensor([0, 1, 0]).bool(), rows, states, ctrl, rings)
    pair.cpu.reset([1], pair.homes[1:2], qpos[1][None])
    pair.check(pair.homes)
    assert len(pair.cameras._scene._meshes) == built + 1


def test_trap_depth_is_not_clamped_at_one_metre(pair: Pair) -> None:
    pair.begin(
        pair.homes, [pair.start(home, place) for place, home in enumerate(pair.homes)]
    )
    got = pair.drawn()["depth"]
    want = pair.expected(pair.homes)["depth"]
    far = want > 1.5
    assert far.mean() > 0.1 and want.max() > 2.5
    assert np.median(np.abs(got[far] - want[far])) < DEPTH_MEDIAN


def body_places(pair: Pair) -> Tensor:
    """(W, nbody, 3) positions of the bodies, the engine's own memory to write into: a GPU's ``numpy()`` is a copy."""
    import warp as wp

    return wp.to_torch(pair.sim.engine.data.xpos)


def test_trap_hidden_what_is_parked_is_not_drawn(pair: Pair) -> None:
    pair.begin(pair.homes, [pair.start(home) for home in pair.homes])
    a = pair.cpu.addresses
    pos = body_places(pair)
    robot = [
        pair.cpu.model(pair.homes[0]).body(name).id
        for name in ("base_link", "gripper_link", "head_tilt_link")
    ]
    assert (pos[:, robot, 2] > 0).all()
    # The whole scene of bodies sinks to where pieces of other homes are parked, in view of the cameras.
    below = pos.new_tensor([PARKED[0] - 2.0, PARKED[1], PARKED[2] - 0.6])
    before = pos.clone()
    sunk = below - before[:, robot[:1]]
    pos[:, 1:] = before[:, 1:] + sunk
    try:
        seg = pair.drawn()["seg"]
    finally:
        pos[:] = before
    assert not seg.any()
    # And an object alone, right before the hand.
    hand = robot[1]
    can = a.object_body[CAN]
    assert (
        pair.drawn()["seg"]
        == pair.cameras.segmentation_names.index("005_tomato_soup_can_:0000")
    ).any()
    pos[:, can, 2] = -26.0
    try:
        names = {
            pair.cameras.segmentation_names[k] for k in np.unique(pair.drawn()["seg"])
        }
    finally:
        pos[:] = before
    assert "005_tomato_soup_can_:0000" not in names and before[0, hand, 2] > 0


def test_trap_faces_seen_from_behind_hide_nothing(pair: Pair) -> None:
    # The hand is stuck in a wall of boxes beside a window: a ray meets the end of the box it starts in just where the
    # next one begins, from behind and from the front at once.
    home = pair.homes[0]
    pair.begin([home] * WORLDS, [pair.start(home)] * WORLDS)
    got = pair.drawn()["seg"][0, 1]
    want = pair.expected([home] * WORLDS)["seg"][0, 1]
    names = pair.cameras.segmentation_names
    wall = want == names.index("wall")
    assert wall.mean() > 0.1 and (got[wall] == want[wall]).mean() > 0.99
    assert names.index("background") in want


def test_a_world_that_diverged_gets_zeros_and_the_others_their_pictures(
    pair: Pair,
) -> None:
    pair.begin(pair.homes, [pair.start(home) for home in pair.homes])
    before = pair.drawn()
    pos = body_places(pair)
    kept = pos.clone()
    for bad in (np.nan, 1e6):
        pos[1, 5] = bad
        got = pair.drawn()
        for name, image in got.items():
            assert not image[1].any()
            np.testing.assert_array_equal(image[[0, 2]], before[name][[0, 2]])
    pos[:] = kept


def test_worlds_that_are_not_asked_for_keep_their_pixels(
    pair: Pair, warp: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, after = ([pair.start(home, place) for home in pair.homes] for place in (0, 1))
    pair.begin(pair.homes, after)
    want = pair.drawn()
    monkeypatch.setattr(
        warp, "WORLDS_AT_ONCE", 2
    )  # the world that is drawn lies in the first portion
    cameras = warp.WarpCameras(pair.sim, CAMERAS, SIZE, OUTPUTS)
    pair.begin(pair.homes, before)
    kept = {name: image.numpy().copy() for name, image in cameras.draw().items()}
    pair.begin(pair.homes, after)
    only = pair.sim.taint().new_tensor([0, 1, 0]).bool()
    for name, image in cameras.draw(only).items():
        np.testing.assert_array_equal(image[1], want[name][1])
        np.testing.assert_array_equal(image[[0, 2]], kept[name][[0, 2]])
        assert (kept[name] != want[name]).any(axis=tuple(range(1, kept[name].ndim))).all()
    for name, image in cameras.draw().items():
        np.testing.assert_array_equal(image, want[name])


def test_a_device_that_is_full_is_told(
    pair: Pair, warp: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise RuntimeError("Failed to allocate 123 bytes on device 'cuda:0'")

    cameras = warp.WarpCameras(pair.sim, CAMERAS, SIZE, OUTPUTS)
    monkeypatch.setattr(warp.WarpCameras, "_draw", full)
    with refused(said=f"3 worlds do not fit into the memory of {TEST_DEVICE}; try 1 "):
        cameras.draw()
    monkeypatch.setattr(warp.WarpCameras, "_make_images", full)
    with refused(said="3 worlds do not fit"):
        warp.WarpCameras(pair.sim, CAMERAS, SIZE, OUTPUTS)


def test_portions_and_single_outputs_change_no_pixel(
    pair: Pair, warp: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair.begin(pair.homes, [pair.start(home) for home in pair.homes])
    want = pair.drawn()
    monkeypatch.setattr(warp, "WORLDS_AT_ONCE", 2)
    for name in OUTPUTS:
        got = warp.WarpCameras(pair.sim, CAMERAS[1:], SIZE, (name,)).draw()
        assert set(got) == {name}
        np.testing.assert_array_equal(got[name].numpy(), want[name][:, 1:])


def test_patterns_are_seen(pair: Pair) -> None:
    # Boards of a wooden floor: light alone would leave it nearly even.
    pair.begin(pair.homes, [pair.start(home) for home in pair.homes])
    got = pair.drawn()
    want = pair.expected(pair.homes)
    floor = pair.cameras.segmentation_names.index("floor")
    alike(got, want, floor)


def test_pictures_on_real_furniture_and_objects_are_seen(warp: ModuleType) -> None:
    # Walls would shade the objects.
    pack = {"place": str(real_data("replica_cad")), "stage": "none"}
    pair = Pair(warp, pack, (96, 96))
    pair.begin(
        pair.homes, [pair.start(home, place) for place, home in enumerate(pair.homes)]
    )
    got = pair.drawn()
    want = pair.expected(pair.homes)
    agree(got, want)
    alike(
        got,
        want,
        pair.cameras.segmentation_names.index("003_cracker_box_:0000"),
        spread=20.0,
    )


def alike(
    got: dict[str, np.ndarray],
    want: dict[str, np.ndarray],
    segment: int,
    spread: float = 4.0,
) -> None:
    """The colours of a segment vary, and as those of the CPU renderer do."""
    both = (got["seg"] == segment) & (want["seg"] == segment)
    ours = got["rgb"][both].astype(float)
    theirs = want["rgb"][both].astype(float)
    assert both.sum() > 60 and ours.std(axis=0).min() > spread
    for channel in range(3):
        assert np.corrcoef(ours[:, channel], theirs[:, channel])[0, 1] > 0.97


def test_meshes_are_decimated_to_a_budget(pair: Pair) -> None:
    from mjhab.render.warp.scene import choose_levels, present

    scene = build_render_scene(pair.layout, pair.cpu.model(pair.homes[0]))
    moving = scene.instance_body > 0

    def most(level: np.ndarray) -> int:
        faces = scene.mesh_face_count[level]
        return int(
            max(
                (present(scene)[:, ~moving] * faces[~moving]).sum(axis=1).max(),
                faces[moving].sum(),
            )
        )

    fine = choose_levels(scene, detail=0.0)
    coarse = choose_levels(scene, detail=0.002, budget=14_000)
    assert (fine == scene.instance_mesh).all() and most(fine) > 18_000
    # Furniture of the built-in homes has one level, what moves has several: it can shrink, the furniture cannot.
    assert (
        scene.mesh_face_count[coarse[moving]].sum()
        < 0.7 * scene.mesh_face_count[fine[moving]].sum()
    )


@pytest.mark.parametrize(
    ("cameras", "outputs", "size", "told"),
    [
        (("fetch_hed",), ("rgb",), (8, 8), dict(option="camera", given="fetch_hed")),
        (CAMERAS, ("rgbd",), (8, 8), dict(option="output", given="rgbd")),
        ((), ("rgb",), (8, 8), dict(where="WarpCameras", said="no camera")),
        (CAMERAS, (), (8, 8), dict(where="WarpCameras", said="no output")),
        (CAMERAS, ("rgb",), (0, 8), dict(option="size", given=(0, 8))),
    ],
)
def test_wrong_requests_are_refused(
    pair: Pair, warp: ModuleType, cameras, outputs, size, told: dict[str, Any]
) -> None:
    with refused(**told):
        warp.WarpCameras(pair.sim, cameras, size, outputs)
