"""Compiled models of a layout's homes with the servos of a control mode, cached in memory."""

from __future__ import annotations

import mujoco

from mjhab.core.errors import unknown_name
from mjhab.core.memory_cache import MemoryCache
from mjhab.layout.compile import compile_home, home_hash
from mjhab.layout.layout import Layout
from mjhab.robots.model import apply_drives
from mjhab.robots.parts import Drives


def model_bytes(model: mujoco.MjModel) -> int:
    """Return the memory of a compiled model [bytes].

    Twice MuJoCo's own size, because the Python wrapper takes as much again: 20 models of 0.34 MB took 13.9 MB.
    """
    return 2 * int(mujoco.mj_sizeModel(model))


_MODELS = MemoryCache("models", size=model_bytes)


class HomeModels:
    """Returns the compiled model of each home; compiles on the first call.

    Simulators with the same layout and servos share a model: copy it before changing it.

    Args:
        layout: names, order and sizes shared by all homes.
        drives: changes to the robot's servos.
    """

    def __init__(self, layout: Layout, drives: Drives) -> None:
        self._layout = layout
        self._drives = drives
        self._homes = layout.pack.homes_by_name
        self._hashes: dict[str, str] = {}

    def __call__(self, home: str) -> mujoco.MjModel:
        """Return the compiled model of a home of the pack, by name.

        Raises:
            UsageError: the pack has no such home.
        """
        if home not in self._hashes:
            if home not in self._homes:
                raise unknown_name("home", home, self._homes)
            self._hashes[home] = home_hash(self._layout, self._homes[home])
        # Stiff servos are not compiled, so that the hash of a home does not cover them.
        key = (self._hashes[home], self._drives, self._layout.robot.stiff_gains)
        return _MODELS.get(key, lambda: self._make(home))

    def _make(self, home: str) -> mujoco.MjModel:
        model = compile_home(self._layout, self._homes[home])
        apply_drives(model, self._layout.robot, self._drives)
        return model
