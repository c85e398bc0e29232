"""What light does with the surfaces of a home: Mitsuba's BSDFs of the looks that the rasterizer draws."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjhab.render.models import Look, srgb_bytes
from mjhab.scenes.shapes.colors import srgb_to_linear

DULL = 0.12
"""Looks of less gloss have no highlight at all, which is faster."""
FEW_SAMPLES = 4
DULL_OF_FEW = 0.45
"""The same in pictures of so few paths per pixel, whose noise hides the sheen of satin fronts: 30 of 175 ms of a core
at 128 x 128 pixels and 4 paths."""

METALLIC = 0.6
"""Of metal. What it reflects is lit by few reflections: with 1 sinks and handles are black at midday."""


def surface(mi: Any, look: Look, samples: int) -> dict[str, Any]:
    """The BSDF of a look in pictures of so many paths per pixel, a dictionary of Mitsuba; visible from both sides."""
    color = _color(mi, look)
    dull = DULL if samples > FEW_SAMPLES else DULL_OF_FEW
    if look.gloss < dull and look.kind != "metal":
        inner = {"type": "diffuse", "reflectance": color}
    else:
        inner = {
            "type": "principled",
            "base_color": color,
            "roughness": _roughness(look.gloss),
            "metallic": METALLIC if look.kind == "metal" else 0.0,
            "specular": 0.5,
        }
    # Meshes of files are seen from behind as well.
    return {"type": "twosided", "inner": inner}


def _roughness(gloss: float) -> float:
    """Roughness 0 to 1 of a gloss: 0.75 of gloss 0.1 (satin paint), 0.3 of gloss 0.8 (glass, enamel)."""
    return max(0.82 - 0.65 * gloss, 0.15)


def _color(mi: Any, look: Look) -> dict[str, Any]:
    if look.texture is None:
        return {"type": "rgb", "value": look.color.tolist()}
    texture = look.texture
    if not (look.color == 1.0).all():
        texture = _tinted(texture, look.color)
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(texture)),
        # Textures are sRGB, which Mitsuba is to convert.
        "raw": False,
        "filter_type": "bilinear",
    }


def _tinted(texture: np.ndarray, color: np.ndarray) -> np.ndarray:
    """A texture (h, w, 3) uint8 sRGB multiplied with a linear colour (3,)."""
    return srgb_bytes(srgb_to_linear(texture / 255.0) * color)
