"""A plugin that adds a pack of two homes from files: the cottage (JSON) and the hut (Python).

MJHAB_PLUGINS=examples/home/village.py mjhab homes list --assets village
"""

from __future__ import annotations

from pathlib import Path

import mjhab
from mjhab.scenes.spec import Pack

FOLDER = Path(__file__).parent


def open_village(request: mjhab.PackRequest) -> Pack:
    """The pack, the same object at every call: layouts and maps are kept per pack object."""
    if not _village:
        files = (FOLDER / "cottage.json", FOLDER / "hut.py")
        _village.append(mjhab.home_pack(*files, name="village"))
    return _village[0]


_village: list[Pack] = []
mjhab.register_pack(mjhab.PackSource("village", open_village))
