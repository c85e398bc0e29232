"""Materials of the Fetch robot's visual meshes."""

from __future__ import annotations

from mjhab.scenes.builtin.materials import Material

ROBOT_MATERIALS: dict[str, Material] = {
    "fetch_shell": Material((0.90, 0.91, 0.92), gloss=0.35),
    "fetch_blue": Material((0.10, 0.42, 0.66), gloss=0.35),
    "fetch_grey": Material((0.36, 0.37, 0.39), gloss=0.25),
    "fetch_dark": Material((0.13, 0.13, 0.14), gloss=0.15),
    "fetch_red": Material((0.78, 0.10, 0.09), gloss=0.4),
}
"""Materials named by ``visuals.robot_meshes``: white shells, blue joints, grey base and hand."""
