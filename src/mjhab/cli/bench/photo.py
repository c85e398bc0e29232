"""``mjhab bench photo``: the paper's ray-traced benchmark."""

from __future__ import annotations

from mjhab.bench.interact.photo import measure_photo, write_results
from mjhab.bench.specs import PhotoSpec
from mjhab.cli.output import Listing, report
from mjhab.core.files.outputs import check_folder

_HEADS = {
    "samples": "samples",
    "sps_mean": "SPS",
    "sps_ci95": "± 95 %",
    "reset_and_step_sps": "with reset",
    "cpu_ms": "core ms/step",
    "rss_mb": "RSS MB",
}


def bench_photo(spec: PhotoSpec, json: bool) -> int:
    """Print and write the results of `measure_photo`."""
    check_folder(spec.out)
    found, pictures = measure_photo(spec)
    write_results(spec.out, found, pictures)
    rows = [[point[key] for key in _HEADS] for point in found["points"]]
    title = f"Path-traced pictures of {found['camera']}, {found['variant']}"
    plot = f"Plot of speed over samples: {spec.out / 'report.html'}"
    report(json, found, Listing(title, tuple(_HEADS.values()), rows), plot)
    return 0
