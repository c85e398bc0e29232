"""Pictures of homes for people."""

from __future__ import annotations

import numpy as np

from mjhab.scenes.layout import Layout
from mjhab.scenes.spec import Pack
from mjhab.sim.cpu import CpuSimulator
from mjhab.sim.home_scene import HomeRenderer


def render_home(pack: Pack, home: str, view: str = "top", width: int = 960, height: int = 720) -> np.ndarray:
    """RGB (height, width, 3) of one home of a pack, without objects.

    Raises:
        UsageError: unknown home or view.
    """
    sim = CpuSimulator(Layout(pack, ()), 1, 1)
    return HomeRenderer(sim).home_view(home, view, width, height)
