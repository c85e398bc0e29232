"""Test which renderers work on this machine; OpenGL in a subprocess, because a faulty driver may crash the process."""

from __future__ import annotations

import functools
import os
import subprocess
import sys

GL_BACKENDS = ("egl", "osmesa")
PROBE_SECONDS = 20.0
"""Time limit of the test of one GL backend [s]."""
_SCRIPT = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 3'/><geom type='box' size='1 1 .1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 32, 32) as renderer:
    renderer.update_scene(data)
    assert renderer.render().max() > 0
print("drawn")
"""


def _works(backend: str) -> bool:
    """Whether ``mujoco.Renderer`` renders a box with this GL backend within the time limit."""
    try:
        result = subprocess.run(
            # The backend is chosen at MuJoCo's first import, so that each needs a process.
            [sys.executable, "-c", _SCRIPT],
            env={**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend},
            capture_output=True,
            timeout=PROBE_SECONDS,
            check=False,
        )
    except (subprocess.TimeoutExpired, OSError):
        return False
    return b"drawn" in result.stdout


@functools.cache
def _probe() -> tuple[tuple[str, bool], ...]:
    return (
        ("rasterizer", True),
        *((backend, _works(backend)) for backend in GL_BACKENDS),
    )


def renderer_probe() -> dict[str, bool]:
    """Test whether each renderer works here: "rasterizer" (always True), "egl", "osmesa"; once per process."""
    return dict(_probe())
