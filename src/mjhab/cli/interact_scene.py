"""What ``mjhab bench interact`` simulates: a home with its stage and articulations, one surface, five objects, one robot
before it, and 200 recorded actions that sweep the arm through the objects. All worlds are alike.

After the paper's benchmark (mshab/envs/interact.py, MS-HAB paper Sec. 4): stage, articulations and YCB objects without
the other furniture; the robot faces 90 degrees there, and the surface here. The original's action file cannot be
published with this package, so the actions are our own; ``python -m mjhab.cli.interact_recipe`` makes them again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files

import numpy as np

from mjhab.core.errors import UsageError
from mjhab.scenes.fetch import FETCH_JOINTS
from mjhab.scenes.freespace import free_map
from mjhab.scenes.layout import Layout, compile_order_qpos0, yaw_quat
from mjhab.scenes.packs import open_pack
from mjhab.scenes.receptacles import PlacedReceptacle, placed_receptacles
from mjhab.scenes.spec import Home, Pack
