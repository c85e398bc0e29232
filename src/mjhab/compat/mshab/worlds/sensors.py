"""Arguments about pictures: their size (``sensor_configs``) and how they are drawn (``shader_dir``)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mjhab.core.errors import unknown_name, wrong_value
from mjhab.core.typed.checks import check, check_one_of

FETCH_CAMERAS = ("fetch_head", "fetch_hand")
SHADERS = ("minimal", "default", "rt", "rt-fast", "rt-med")
"""Ways of drawing of ManiSkill."""
ENTRIES = ("width", "height", "shader_pack")
SIDE_PX = 128
"""Width and height of a picture that is not told another one."""


def is_ray_traced(name: Any) -> bool:
    """Whether a way of drawing of ManiSkill traces rays.

    Raises:
        UsageError: ManiSkill has no such way of drawing.
    """
    check_one_of("shader_dir", name, SHADERS)
    return name.startswith("rt")


def asked_pictures(configs: Any) -> tuple[tuple[int, int] | None, str | None]:
    """(height, width) [px] of all pictures, and the way of drawing, from ``sensor_configs``; None if it tells nothing.

    Raises:
        UsageError: an unknown camera or entry, or cameras of several sizes.
    """
    sizes = set()
    shader = None
    for config in _of_cameras(configs or {}):
        for name in config:
            if name not in ENTRIES:
                raise unknown_name("entry of sensor_configs", name, ENTRIES)
        shader = config.get("shader_pack", shader)
        size = (config.get("height", SIDE_PX), config.get("width", SIDE_PX))
        for side in size:
            check(isinstance(side, int), "size in sensor_configs", side, "a whole number")
        sizes.add(size)
    if len(sizes) > 1:
        raise wrong_value(
            "sensor_configs", configs, "one width and height for all cameras"
        )
    return (sizes.pop() if sizes else None), shader


def _of_cameras(value: Any) -> list[Mapping[str, Any]]:
    """Settings for all cameras, or those of single ones with what they leave to them."""
    check(
        isinstance(value, Mapping), "sensor_configs", value, "a mapping of width, height"
    )
    common = {k: v for k, v in value.items() if not isinstance(v, Mapping)}
    single = []
    for name, own in value.items():
        if isinstance(own, Mapping):
            check_one_of("camera in sensor_configs", name, FETCH_CAMERAS)
            single.append({**common, **own})
    return single or ([common] if common else [])
