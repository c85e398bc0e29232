"""What a pretrained backbone costs on the CPU: ``python -m benchmarks.backbone FILE.onnx``."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from benchmarks.command import run_command
from mjhab.cli.output import listing_of, report
from mjhab.learning.observation.backbone import Backbone


@dataclass(frozen=True)
class BackboneCostSpec:
    """Measure the CPU time of an image for networks of `--set inputs.backbone=FILE`, from images of each size.

    `python -m benchmarks.backbone dinov2.onnx --sizes 128 224`
    """

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """The networks."""
    sizes: tuple[int, ...] = (128, 224)
    """Sides of the images [px]; they are resized to that of the network."""
    images: int = 16
    """Images of each size."""
    json: bool = False
    """Print one line of JSON instead of a table."""


def measure(spec: BackboneCostSpec) -> list[dict[str, Any]]:
    """One row per file and size: features, MB of the file, CPU time of an image [ms]."""
    rows = []
    for file in spec.files:
        backbone = Backbone(file)
        for size in spec.sizes:
            shape = (spec.images, size, size, 3)
            images = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
            # Time of the process, because the network spreads over cores.
            begun = time.process_time()
            backbone.features(images)
            cpu = time.process_time() - begun
            rows.append(
                {
                    "network": file.stem,
                    "image": size,
                    "input": backbone.spec.size,
                    "features": backbone.spec.features,
                    "mb": round(file.stat().st_size / 1e6, 1),
                    "cpu_ms": round(1000 * cpu / spec.images, 1),
                }
            )
    return rows


def _work(spec: BackboneCostSpec) -> int:
    rows = measure(spec)
    report(spec.json, {"rows": rows}, listing_of("Backbones", rows))
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    least = {"sizes": 1, "images": 1}
    return run_command("backbone", BackboneCostSpec, _work, words, minima=least)


if __name__ == "__main__":
    sys.exit(main())
