"""The compiled models of a layout's homes, with the servos of a simulator."""

from __future__ import annotations

import mujoco

from mjhab.core.errors import unknown_name
from mjhab.core.memory_cache import MemoryCache
from mjhab.layout.compile import compile_home, home_hash
from mjhab.layout.layout import Layout
from mjhab.robots.model import apply_drives
from mjhab.robots.parts import Drives


def model_bytes(model: mujoco.MjModel) -> int:
    """Memory of a compiled model [bytes]. Its Python wrapper takes about as much as the model: the heap grew by 13.9 MB
    for 20 models of 0.34 MB each."""
    return 2 * int(mujoco.mj_sizeModel(model))


_MODELS = MemoryCache("models", size=model_bytes)


class HomeModels:
    """A model per home, made when it is first asked for; simulators with the same layout and servos share it.

    Who wants to change a model makes a copy.

    Args:
        layout: what all homes share.
        drives: servos of the robot.
    """

    def __init__(self, layout: Layout, drives: Drives) -> None:
        self._layout = layout
        self._drives = drives
        self._homes = layout.pack.homes_by_name
        self._hashes: dict[str, str] = {}

    def __call__(self, home: str) -> mujoco.MjModel:
        """The compiled model of a home of the pack.

        Raises:
            UsageError: the pack has no such home.
        """
        if home not in self._hashes:
            if home not in self._homes:
                raise unknown_name("home", home, self._homes)
            self._hashes[home] = home_hash(self._layout, self._homes[home])
        return _MODELS.get((self._hashes[home], self._drives), lambda: self._make(home))

    def _make(self, home: str) -> mujoco.MjModel:
        model = compile_home(self._layout, self._homes[home])
        apply_drives(model, self._layout.robot, self._drives)
        return model
