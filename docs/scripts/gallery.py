"""Make gallery and film of the path tracer: ``python docs/scripts/gallery.py --assets FOLDER [--into docs/media]``.

On the left what the rasterizer draws, on the right the path tracer from the same place. Single pictures are kept in
``--scratch`` and not drawn again.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import mjhab
from mjhab.cli.main import main as command
from mjhab.evaluation.evaluate import run_evaluation
from mjhab.evaluation.shots.shoot import Studio
from mjhab.evaluation.shots.spec import ShotSpec
from mjhab.evaluation.shots.takes import open_take
from mjhab.evaluation.specs import EvalSpec
from mjhab.render.pictures.captions import with_words
from mjhab.rollout.sinks import Sink, StepView

LIGHTS = ("midday", "midday", "evening", "evening")
BUILTIN = ("builtin_m0_00", "builtin_m1_02", "builtin_m2_05", "builtin_m3_04")
REPLICA_CAD = (
    "v3_sc1_staging_03",
    "v3_sc0_staging_12",
    "v3_sc3_staging_08",
    "v3_sc2_staging_16",
)
TASKS = {"set_table": 330, "prepare_groceries": 250, "tidy_house": 120}
"""Control step in which the expert is seen, by whole task."""
SUBTASKS = {"pick": 60, "place": 70, "open": 70, "close": 40}
"""The same by subtask of SetTable."""
SIZE = (480, 300)
"""Width and height of a picture [px]."""
SAMPLES = "8"
QUALITY = 72
FRAMES = 124
FILM_SIZE = (480, 270)
FILM_SAMPLES = 2
FILM_QUALITY = 50


class _SeenError(Exception):
    """The picture is taken: the rollout ends."""


class _Snapshot(Sink[Any]):
    """Draws one control step with both shaders."""

    def __init__(self, step: int, paths: Sequence[Path]) -> None:
        self._step = step
        self._paths = paths

    def on_step(self, env: Any, step: StepView) -> None:
        if step.steps[0] < self._step:
            return
        renderer = env.observer.renderer
        tracer = renderer.tracer
        for path, used in zip(self._paths, (None, tracer), strict=True):
            renderer.tracer = used
            frame = env.render_worlds([0], width=SIZE[0], height=SIZE[1])[0]
            Image.fromarray(frame).save(path)
        raise _SeenError


def expert_pair(scratch: Path, step: int, **options: Any) -> np.ndarray:
    """Both pictures of a control step of the expert, side by side."""
    name = "_".join(options.values())
    paths = [scratch / f"{name}_{shader}.png" for shader in ("raster", "path")]
    if not all(path.exists() for path in paths):
        spec = EvalSpec.of(
            policy="expert",
            **options,
            episodes=1,
            num_envs=1,
            films=0,
            shader="path",
            shading={"samples": int(SAMPLES)},
            out=scratch / name,
            overwrite=True,
        )
        with contextlib.suppress(_SeenError):
            run_evaluation(spec, [_Snapshot(step, paths)])
    return _beside(paths)


def home_pair(scratch: Path, home: str, light: str, assets: Sequence[str]) -> np.ndarray:
    """Both pictures of a home, side by side."""
    paths = [scratch / f"{home}_{shader}.png" for shader in ("raster", "path")]
    traced = ("--shading.light", light, "--shading.samples", SAMPLES)
    for path, shader, options in zip(
        paths, ("raster", "path"), ((), traced), strict=True
    ):
        if not path.exists():
            size = ("--width", str(SIZE[0]), "--height", str(SIZE[1]))
            asked = ["homes", "render", home, "--view", "inside", *size, *assets]
            if command([*asked, "--shader", shader, *options, "--out", str(path)]):
                raise SystemExit(f"{home} was not drawn.")
    return _beside(paths)


def film(scratch: Path, path: Path) -> None:
    """An animation of a whole SetTable by the path tracer, with the camera and the sentences of films."""
    shard = scratch / "set_table"
    if not shard.exists():
        mjhab.generate("expert", task="set_table", episodes=1, out=shard)
    spec = ShotSpec.of(
        place=shard, env={"shader": "path", "shading": {"samples": FILM_SAMPLES}}
    )
    take = open_take(spec)
    try:
        frames = [
            Image.fromarray(with_words(image, take.sentences[step]))
            for step, image, _ in Studio(spec, take).stills(0, FRAMES, FILM_SIZE)
        ]
    finally:
        take.env.close()
    more = {"save_all": True, "append_images": frames[1:], "duration": 100, "loop": 0}
    frames[0].save(path, quality=FILM_QUALITY, method=6, **more)
    print(f"{path}: {path.stat().st_size / 1e3:,.0f} kB")


def _beside(paths: Sequence[Path]) -> np.ndarray:
    return np.concatenate(
        [np.asarray(Image.open(path).convert("RGB")) for path in paths], axis=1
    )


def _save(rows: Sequence[np.ndarray], path: Path) -> None:
    Image.fromarray(np.concatenate(rows)).save(path, quality=QUALITY, method=6)
    print(f"{path}: {path.stat().st_size / 1e3:,.0f} kB")


def main(arguments: Sequence[str] | None = None) -> None:
    """Make everything in the folder ``--into``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--assets", required=True, help="folder of ReplicaCAD")
    parser.add_argument("--into", type=Path, default=Path("docs/media"))
    parser.add_argument("--scratch", type=Path, default=Path("runs/gallery"))
    asked = parser.parse_args(arguments)
    scratch = asked.scratch
    scratch.mkdir(parents=True, exist_ok=True)
    for name, homes, assets in (
        ("builtin", BUILTIN, ()),
        ("replica_cad", REPLICA_CAD, ("--assets", asked.assets)),
    ):
        rows = [
            home_pair(scratch, home, light, assets)
            for home, light in zip(homes, LIGHTS, strict=True)
        ]
        _save(rows, asked.into / f"gallery_{name}.webp")
    subtasks = [
        expert_pair(scratch, step, task="set_table", subtask=subtask)
        for subtask, step in SUBTASKS.items()
    ]
    _save(subtasks, asked.into / "gallery_subtasks.webp")
    tasks = [expert_pair(scratch, step, task=task) for task, step in TASKS.items()]
    _save(tasks, asked.into / "gallery_tasks.webp")
    film(scratch, asked.into / "set_table_path.webp")


if __name__ == "__main__":
    main()
