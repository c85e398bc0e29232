"""Images of whole homes, for people."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mjhab.layout.layout import Layout
from mjhab.render.home_scene import HomeRenderer
from mjhab.scenes.shading import Shading
from mjhab.scenes.spec import Pack
from mjhab.sim.mujoco.cpu import CpuSimulator


def render_home(
    pack: Pack,
    home: str,
    view: str = "top",
    width: int = 960,
    height: int = 720,
    shading: Shading | None = None,
) -> np.ndarray:
    """Render one home of a pack, without objects.

    Args:
        pack: has the home.
        home: name of the home.
        view: one of `home_scene.VIEWS`.
        width, height: of the image [px].
        shading: options of the path tracer; None takes the rasterizer.

    Returns:
        (height, width, 3) uint8 sRGB.

    Raises:
        UsageError: unknown home or view, or there is no path tracer.
    """
    return next(render_homes(pack, [home], view, width, height, shading))


def render_homes(
    pack: Pack,
    homes: Sequence[str],
    view: str = "top",
    width: int = 960,
    height: int = 720,
    shading: Shading | None = None,
) -> Iterator[np.ndarray]:
    """Render several homes one after the other, building the scene once; arguments and errors as `render_home`."""
    renderer = HomeRenderer(CpuSimulator(Layout(pack, ()), 1, 1), shading=shading)
    return (renderer.home_view(home, view, width, height) for home in homes)
