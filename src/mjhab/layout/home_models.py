"""The compiled models of a layout's homes, with the servos of a simulator."""

from __future__ import annotations

import mujoco

from mjhab.core.errors import unknown_name
from mjhab.layout.compile import compile_home
from mjhab.layout.layout import Layout
from mjhab.robots.model import apply_drives
from mjhab.robots.parts import Drives


class HomeModels:
    """A model per home, made when it is first asked for and kept from then on.

    Every instance has models of its own: the servos of another simulator's are not touched.

    Args:
        layout: what all homes share.
        drives: servos of the robot.
    """

    def __init__(self, layout: Layout, drives: Drives) -> None:
        self._layout = layout
        self._drives = drives
        self._homes = layout.pack.homes_by_name
        self._models: dict[str, mujoco.MjModel] = {}

    def __call__(self, home: str) -> mujoco.MjModel:
        """The compiled model of a home of the pack.

        Raises:
            UsageError: the pack has no such home.
        """
        if home not in self._models:
            if home not in self._homes:
                raise unknown_name("home", home, self._homes)
            model = compile_home(self._layout, self._homes[home])
            apply_drives(model, self._layout.robot, self._drives)
            self._models[home] = model
        return self._models[home]
