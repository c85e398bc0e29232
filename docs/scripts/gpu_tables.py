"""Tables of the backend warp from docs/results/gpu-*.json, which ``make gpu-report`` writes."""

from __future__ import annotations

from collections.abc import Iterable

from result_files import Row, percent, read, source, table

PICTURES = {True: "2 x 128 x 128 RGB-D", False: "no"}


def h200_interact() -> str:
    """Interact with 64 to 8,192 worlds."""
    rows = read("gpu-h200")["interact"]
    return _interact(rows, "GPU memory, all processes", "device_mb") + source("gpu-h200")


def host_interact() -> str:
    """Interact on Warp's CPU device and on the backend cpu."""
    rows = read("gpu-interact")["points"]
    return _interact(rows, "process", "rss_mb") + source("gpu-interact")


def _interact(rows: Iterable[Row], memory: str, key: str) -> str:
    head = ("backend", "pictures", "worlds", "control steps/s")
    lines = []
    for row in rows:
        speed = f"{row['sps_mean']:,.0f}"
        if row["sps_ci95"] is not None:
            speed += f" ± {row['sps_ci95']:,.0f}"
        drawn = row["render_ms"] is not None
        times = [f"{row['physics_ms']:.1f}", f"{row['render_ms']:.1f}" if drawn else "-"]
        line = [row.get("backend", "warp"), PICTURES[drawn], f"{row['worlds']:,}", speed]
        lines.append([*line, ", ".join(times), f"{row[key] / 1000:.1f} GB"])
    return table((*head, "physics, pictures [ms per step of all worlds]", memory), lines)


def h200_env() -> str:
    """Training environments with depth."""
    return _env(read("gpu-h200")["env"]) + source("gpu-h200")


def host_env() -> str:
    """The same without a GPU."""
    return _env(read("gpu-env")["points"]) + source("gpu-env")


def _env(rows: Iterable[Row]) -> str:
    lines = []
    for row in rows:
        milliseconds = {
            name: 1000 * seconds / row["profiled_steps"]
            for name, seconds in row["stages"].items()
        }
        stages = ", ".join(f"{name} {each:.1f}" for name, each in milliseconds.items())
        speeds = [f"{row[name]:,.0f}" for name in ("env_sps", "engine_sps")]
        lines.append([row["what"], f"{row['worlds']:,}", *speeds, stages])
    head = ("environment", "worlds", "control steps/s", "bare engine")
    return table((*head, "stages of a step of all worlds [ms]"), lines)


def pictures() -> str:
    """Stages of the pictures on a GPU."""
    lines = []
    for row in read("gpu-pictures")["points"]:
        stages = ", ".join(
            f"{name} {each:.1f}" for name, each in row["stages_ms"].items()
        )
        counts = [f"{row['worlds']:,}", f"{row['images']:,}", stages]
        lines.append([f"{row['size']} px", *counts, f"{row['images_per_s']:,}"])
    head = ("images", "worlds", "images per step", "stages [ms]", "images/s")
    return table(head, lines) + source("gpu-pictures")


def sleep() -> str:
    """What sleeping costs and changes."""
    lines = []
    for row in read("gpu-sleep")["rows"]:
        off = row["difference"]
        names = ("robot", "objects", "turns")
        cells = ["-" if row["sleep"] else f"{off[name]:.0e}" for name in names]
        line = [row["engine"], "asleep" if row["sleep"] else "awake", f"{row['ms']:.1f}"]
        lines.append([*line, f"{row['awake_dofs']} of {row['nv']}", *cells])
    head = ("engine", "still things", "step of all worlds [ms]", "most dofs awake")
    off = ("robot [rad or m]", "objects [m]", "turns [rad]")
    return table((*head, *off), lines) + source("gpu-sleep")


def parity_divergence() -> str:
    """Largest and median difference of both backends under the same actions."""
    return _divergence(read("gpu-parity"))


def h200_divergence() -> str:
    """The same on a GPU."""
    return _divergence(read("gpu-h200")["parity"])


def _divergence(found: Row) -> str:
    lines = []
    for name, most in found["qpos_max"].items():
        pairs = zip(most, found["qpos_median"][name], strict=True)
        lines.append([name, *(f"{large:.1e} ({middle:.0e})" for large, middle in pairs)])
    return table(("after control steps", *map(str, found["steps"])), lines)


def parity_episodes() -> str:
    """Agreement of whole episodes of the expert under the same actions."""
    lines = []
    for name, row in read("gpu-parity")["episodes_equal"].items():
        shares = [percent(row[key], 1) for key in ("success", "label", "reward")]
        rates = [percent(row[f"success_{backend}"], 1) for backend in ("cpu", "warp")]
        counts = [str(row["episodes"]), f"{row['steps']:,}"]
        lines.append([name.replace("_", " "), *counts, *shares, " / ".join(rates)])
    head = ("subtask", "episodes", "steps", "success agrees %", "label agrees %")
    told = ("reward within 0.02 %", "success cpu / warp %")
    return table((*head, *told), lines) + source("gpu-parity")


TABLES = {
    "gpu_h200_interact": h200_interact,
    "gpu_h200_env": h200_env,
    "gpu_h200_divergence": h200_divergence,
    "gpu_pictures": pictures,
    "gpu_host_interact": host_interact,
    "gpu_host_env": host_env,
    "gpu_sleep": sleep,
    "gpu_parity_divergence": parity_divergence,
    "gpu_parity_episodes": parity_episodes,
}
