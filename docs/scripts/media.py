"""Make the pictures and short films of README and documentation: ``python docs/scripts/media.py [--into docs/media]``.

Homes, films and camera images come from mjhab itself, with fixed seeds; minutes on two cores.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from PIL import Image

import mjhab
from mjhab.cli.main import main as command

HOMES = ("builtin_m0_00", "builtin_m1_02", "builtin_m2_05", "builtin_m3_04")
PICTURE = (640, 400)
"""Width and height of a picture of a home [px]."""
FILM = (480, 270)
"""Width and height of a film [px]."""
SPEED_UP = 3
"""Films show every third frame in the time of one."""
QUALITY = 70
CAMERA_SIZE = 256
NEAR_TO_FAR_M = 3.0
"""Depth that is drawn black [m]."""


def make_homes(into: Path, scratch: Path) -> None:
    """homes.webp: two by two built-in homes, each from a corner of a room."""
    drawn = [_home(home, scratch) for home in HOMES]
    rows = [np.concatenate(drawn[at : at + 2], axis=1) for at in (0, 2)]
    Image.fromarray(np.concatenate(rows)).save(into / "homes.webp", quality=QUALITY)


def _home(home: str, scratch: Path) -> np.ndarray:
    path = scratch / f"{home}.png"
    size = ("--width", str(PICTURE[0]), "--height", str(PICTURE[1]))
    shown = ("--view", "inside", *size)
    _run("homes", "render", home, *shown, "--out", str(path))
    return np.asarray(Image.open(path).convert("RGB"))


def make_films(into: Path, scratch: Path) -> None:
    """expert.webp: the expert sets the table. student.webp: a learned policy shuts a drawer."""
    for name, options in {
        "expert": ("--task", "set_table", "--policy", "expert", "--episodes", "1"),
        "student": (
            "--task", "set_table", "--subtask", "close", "--target", "kitchen_counter/drawer3",
            "--policy", "learned", "--split", "val", "--episodes", "1",
        ),
    }.items():  # fmt: skip
        out = scratch / name
        _run("eval", *options, "--seed", "0", "--films", "1", "--out", str(out))
        (film,) = out.rglob("*.mp4")
        _animate(film, into / f"{name}.webp")


def make_cameras(into: Path) -> None:
    """cameras.webp: what the two cameras of the robot see in a Pick: colours, depth, segments."""
    env = mjhab.make(
        task="set_table",
        subtask="pick",
        obs_mode="rgbd+seg",
        camera_size=CAMERA_SIZE,
        num_envs=1,
    )
    obs, _ = env.reset(seed=0)
    rows = []
    for name in sorted((key for key in obs if key.endswith("/rgb")), reverse=True):
        camera = name.removesuffix("/rgb")
        rgb = obs[name][0]
        depth = obs[f"{camera}/depth"][0, ..., 0].astype(float) / 1000.0
        grey = np.where(
            depth > 0.0, 255.0 * np.clip(1.0 - depth / NEAR_TO_FAR_M, 0.0, 1.0), 0.0
        )
        palette = np.random.default_rng(1).integers(40, 255, (4096, 3))
        segments = palette[obs[f"{camera}/seg"][0, ..., 0] % len(palette)]
        grey = np.repeat(grey[..., None], 3, axis=2)
        rows.append(
            np.concatenate(
                [rgb, grey.astype(np.uint8), segments.astype(np.uint8)], axis=1
            )
        )
    env.close()
    Image.fromarray(np.concatenate(rows)).save(into / "cameras.webp", quality=QUALITY)


def _animate(film: Path, path: Path) -> None:
    frames = [Image.fromarray(frame).resize(FILM) for frame in iio.imiter(film)][
        ::SPEED_UP
    ]
    seconds = 1.0 / iio.immeta(film)["fps"]
    frames[0].save(
        path,
        save_all=True,
        append_images=frames[1:],
        duration=round(1000 * seconds),
        loop=0,
        quality=QUALITY,
        method=4,
    )


def _run(*arguments: str) -> None:
    if command(list(arguments)):
        raise SystemExit(f"mjhab {' '.join(arguments)} failed.")


def main(arguments: Sequence[str] | None = None) -> None:
    """Make everything in the folder ``--into``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--into", type=Path, default=Path("docs/media"))
    into = parser.parse_args(arguments).into
    into.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        make_homes(into, Path(scratch))
        make_cameras(into)
        make_films(into, Path(scratch))
    for path in sorted(into.iterdir()):
        print(f"{path}: {path.stat().st_size / 1e3:,.0f} kB")


if __name__ == "__main__":
    main()
