"""JSON files with arrays in them, under the names of ``mani_skill.utils.io_utils``."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch


class CustomJsonEncoder(json.JSONEncoder):
    """Writes arrays and tensors as lists, their numbers as numbers, paths as texts."""

    def default(self, o: Any) -> Any:
        """What ``json`` does not know itself."""
        if isinstance(o, torch.Tensor):
            return o.tolist()
        if isinstance(o, np.ndarray | np.generic):
            return o.tolist()
        if isinstance(o, Path):
            return str(o)
        return super().default(o)


def load_json(filename: str | Path) -> Any:
    """Read a JSON file, ``.gz`` or plain."""
    path = Path(filename)
    opened = gzip.open if path.suffix == ".gz" else open
    with opened(path, "rt", encoding="utf-8") as file:
        return json.load(file)


def dump_json(
    filename: str | Path, obj: Any, encoder_cls: Any = CustomJsonEncoder, **options: Any
) -> None:
    """Write a JSON file, ``.gz`` or plain."""
    path = Path(filename)
    opened = gzip.open if path.suffix == ".gz" else open
    with opened(path, "wt", encoding="utf-8") as file:
        file.write(json.dumps(obj, cls=encoder_cls, **options))
