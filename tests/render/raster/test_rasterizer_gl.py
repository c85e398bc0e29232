"""The rasterizer against MuJoCo's own OpenGL renderer, on machines that have one.

Where none works the test warns (``no OpenGL here``) and checks only that the probe says so: there
``test_rasterizer_rays.py`` and ``test_rasterizer_golden.py`` are the oracles. Where one works its name is printed and
stored as the property ``opengl`` of the test suite.
"""

from __future__ import annotations

import os
import subprocess
import sys
import warnings

import numpy as np

from mjhab.render.build_scene import SceneBuilder
from mjhab.render.cameras import Cameras, look_at
from mjhab.render.gl_probe import GL_BACKENDS, renderer_probe
from mjhab.render.raster.rasterizer import Rasterizer
from mjhab.scenes.spec import Geom

SIZE = (160, 120)
FOVY = 1.1
BOXES = [
    Geom("box", (3.0, 3.0, 0.05), (0.0, 0.0, -0.05)),
    Geom("box", (0.4, 0.2, 0.3), (0.3, 0.2, 0.4), (0.9, 0.1, 0.3, 0.2)),
    Geom("box", (0.1, 0.6, 0.1), (-0.5, -0.1, 0.3), (0.8, -0.3, 0.1, 0.5)),
    Geom("box", (0.05, 3.0, 1.0), (-2.0, 0.0, 1.0)),
]
EYE = np.array([1.6, -1.2, 1.4])
TARGET = np.array([0.0, 0.0, 0.3])
_SCRIPT = """
import sys
import mujoco
import numpy as np
model = mujoco.MjModel.from_xml_string(sys.argv[1])
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, int(sys.argv[3]), int(sys.argv[2])) as renderer:
    renderer.enable_depth_rendering()
    renderer.update_scene(data, "eye")
    depth = renderer.render().copy()
    renderer.disable_depth_rendering()
    renderer.enable_segmentation_rendering()
    renderer.update_scene(data, "eye")
    np.savez(sys.argv[4], depth=depth, seg=renderer.render()[..., 0] + 1)
"""


def scene_xml() -> str:
    """BOXES and the camera as MJCF, near plane at 0.01 m."""
    mat = look_at(EYE, TARGET)
    axes = " ".join(f"{x:.12g}" for x in (*mat[:, 0], *mat[:, 1]))
    geoms = "".join(
        f'<geom type="box" size="{" ".join(map(str, g.size))}" pos="{" ".join(map(str, g.pos))}" '
        f'quat="{" ".join(map(str, g.quat))}"/>'
        for g in BOXES
    )
    return (
        f'<mujoco><statistic extent="1"/><visual><map znear="0.01" zfar="50"/></visual><worldbody>{geoms}'
        f'<camera name="eye" pos="{" ".join(map(str, EYE))}" xyaxes="{axes}" fovy="{np.degrees(FOVY)}"/>'
        "</worldbody></mujoco>"
    )


def away_from_edges(seg: np.ndarray) -> np.ndarray:
    """Pixels (h, w) whose four neighbours see the same."""
    inner = np.ones(seg.shape, bool)
    for axis in (0, 1):
        change = np.diff(seg, axis=axis) != 0
        for pad in ((0, 1), (1, 0)):
            pads = [(0, 0), (0, 0)]
            pads[axis] = pad
            inner &= ~np.pad(change, pads)
    return inner


def test_depth_and_seg_agree_with_mujoco_where_opengl_works(
    tmp_path, record_testsuite_property
):
    probe = renderer_probe()
    backend = next((name for name in GL_BACKENDS if probe[name]), "rasterizer")
    record_testsuite_property("opengl", backend if backend in GL_BACKENDS else "none")
    print(f"OpenGL: compared with {backend}")
    if backend not in GL_BACKENDS:
        warnings.warn(
            "no OpenGL here: the rasterizer was not compared with mujoco.Renderer",
            stacklevel=1,
        )
        assert backend == "rasterizer" and not any(
            renderer_probe()[name] for name in GL_BACKENDS
        )
        return
    file = tmp_path / "gl.npz"
    subprocess.run(
        [sys.executable, "-c", _SCRIPT, scene_xml(), *map(str, SIZE), str(file)],
        env={**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend},
        check=True,
        capture_output=True,
        timeout=60,
    )
    builder = SceneBuilder(1)
    for k, geom in enumerate(BOXES):
        quat = np.array(geom.quat) / np.linalg.norm(geom.quat)
        builder.add_world_geom(Geom("box", geom.size, geom.pos, tuple(quat)), seg=str(k))
    eye = EYE[None, None]
    mat = look_at(EYE, TARGET)[None, None]
    own = Rasterizer(builder.build(), 1).render(
        np.zeros(1, int),
        np.zeros((1, 1, 3)),
        np.eye(3)[None, None],
        Cameras(eye, mat, FOVY, *SIZE),
    )
    with np.load(file) as gl:
        alike = own["seg"][0, 0] == gl["seg"]
        # OpenGL snaps corners to a 256th of a pixel: at edges the two may differ.
        assert alike[away_from_edges(gl["seg"])].mean() >= 0.999 and alike.mean() > 0.99
        hit = alike & (gl["seg"] > 0)
        error = np.abs(own["depth"][0, 0] - gl["depth"])[hit]
        assert np.median(error) < 1e-4 and np.quantile(error, 0.99) < 2e-3
