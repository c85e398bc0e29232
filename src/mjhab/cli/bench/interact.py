"""``mjhab bench interact``: the paper's Interact benchmark on either backend."""

from __future__ import annotations

from mjhab.bench.interact.run import IMAGE_SIDE_PX, measure_interact, write_results
from mjhab.bench.specs import InteractSpec
from mjhab.cli.output import Listing, report
from mjhab.core.files.outputs import check_folder

_HEADS = {
    "worlds": "worlds",
    "sps_mean": "SPS",
    "sps_ci95": "± 95 %",
    "physics_ms": "phys",
    "render_ms": "render",
    "device_mb": "GPU MB",
    "rss_mb": "RSS MB",
    "moved": "moved",
    "tainted_worlds": "taint",
}


def bench_interact(spec: InteractSpec, json: bool) -> int:
    """Print and write the results of `measure_interact`."""
    check_folder(spec.out)
    found, runs, pictures = measure_interact(spec)
    write_results(spec.out, found, runs, pictures)
    kind = (
        "no cameras" if spec.no_render else f"2 x {IMAGE_SIDE_PX} x {IMAGE_SIDE_PX} RGB-D"
    )
    rows = [
        [len(p[k]) if k == "moved" else p[k] for k in _HEADS] for p in found["points"]
    ]
    title = f"Interact, {found['backend']} on {found['device']}, {kind}; stages in ms"
    plot = f"Plot of speed over memory: {spec.out / 'report.html'}"
    report(json, found, Listing(title, tuple(_HEADS.values()), rows), plot)
    return 0
