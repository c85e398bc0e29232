"""A plugin that adds a mug to the objects of mjhab.

MJHAB_PLUGINS=examples/mug/mug.py mjhab eval --task tidy_house --subtask pick --target mug ...
"""

from __future__ import annotations

from pathlib import Path

import mjhab

MUG = mjhab.object_from_glb("mug", Path(__file__).with_name("mug.glb"), mass=0.25)
mjhab.register_object(MUG)
