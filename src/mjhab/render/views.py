"""Pictures of homes for people."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mjhab.layout.layout import Layout
from mjhab.render.home_scene import HomeRenderer
from mjhab.scenes.spec import Pack
from mjhab.sim.mujoco.cpu import CpuSimulator


def render_home(
    pack: Pack, home: str, view: str = "top", width: int = 960, height: int = 720
) -> np.ndarray:
    """RGB (height, width, 3) of one home of a pack, without objects.

    Raises:
        UsageError: unknown home or view.
    """
    return next(render_homes(pack, [home], view, width, height))


def render_homes(
    pack: Pack, homes: Sequence[str], view: str = "top", width: int = 960, height: int = 720
) -> Iterator[np.ndarray]:
    """The same for several homes, one after the other; the scene is built once."""
    renderer = HomeRenderer(CpuSimulator(Layout(pack, ()), 1, 1))
    return (renderer.home_view(home, view, width, height) for home in homes)
