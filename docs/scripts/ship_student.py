"""Put a trained student into the package: ``python docs/scripts/ship_student.py RUN/student.safetensors``.

The file is named after what the student was trained for; large weights are stored as 8-bit integers.
"""

from __future__ import annotations

import sys
from pathlib import Path

from mjhab.learning.checkpoint import load_checkpoint, save_compact
from mjhab.learning.shipped_kind import FOLDER, SUFFIX, file_name

if __name__ == "__main__":
    for source in map(Path, sys.argv[1:]):
        scene = load_checkpoint(source).about["scene"]
        target = FOLDER / (file_name(scene["task"], scene["subtask"], scene["target"]) + SUFFIX)
        save_compact(source, target)
        print(f"{target}: {target.stat().st_size / 1e6:.1f} MB")
