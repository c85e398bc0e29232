"""Training for the paper's results about imitation: data sets that the variants of a row share, one policy for each."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from mjhab.learning.changes import with_changes
from mjhab.learning.configs import (
    BC,
    DIFFUSION,
    ImitationConfig,
    StudentConfig,
    preset_of,
)
from mjhab.paper.reproduce.rows import TableRow
from mjhab.paper.reproduce.spec import TRAINED_IN, TableSpec, env_of
from mjhab.paper.reproduce.variants import STYLES, Imitation

if TYPE_CHECKING:
    from mjhab.learning.runs.run import TrainingResult
    from mjhab.learning.runs.specs import ImitationSpec

DATA = "data"


def train_imitation(
    spec: TableSpec,
    row: TableRow,
    imitation: Imitation,
    folder: Path,
    run: Path,
    resume: bool,
) -> TrainingResult:
    """Train a policy of a row, or continue its training.

    Args:
        spec: the request.
        row: of Table 1.
        imitation: how it is trained.
        folder: of the row; the data sets lie in ``data`` below it.
        run: folder of the training run.
        resume: continue in it.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed while demonstrations were collected; they are kept.
    """
    from mjhab.learning.runs.specs import ImitationSpec
    from mjhab.learning.train import train_spec

    asked = ImitationSpec(
        out=run,
        preset=config_of(spec, imitation),
        env={**env_of(spec, row, row.target), "num_envs": spec.asked.num_envs},
        budget_minutes=spec.budget_minutes,
        eval_episodes=0,
        round_episodes=0,
        eval_split=TRAINED_IN,
        device=spec.device or "cpu",
        workers=spec.workers,
        resume=resume,
    )
    places = tuple(
        _collected(spec, asked, folder / DATA, name) for name in imitation.data
    )
    # With two data sets half of each, so that all variants learn from as many.
    half = f"success and index < {_episodes(spec) // 2}" if len(places) > 1 else None
    return train_spec(
        dataclasses.replace(
            asked, data=places, where=half, per_target=imitation.per_target
        )
    )


def config_of(spec: TableSpec, imitation: Imitation) -> ImitationConfig:
    """How a policy is trained; the diffusion policy sees images of the size of the request's preset."""
    chosen = preset_of(BC, spec.preset_name)
    if imitation.algorithm != BC:
        paper = preset_of(DIFFUSION).student
        inputs = dataclasses.replace(
            paper.inputs, image_size=chosen.student.inputs.image_size
        )
        student = dataclasses.replace(
            paper, inputs=inputs, updates=chosen.student.updates
        )
        chosen = ImitationConfig(student)
    updates = (f"updates={spec.updates}",) if spec.updates else ()
    return with_changes(chosen, (*imitation.changes, *updates))


def _episodes(spec: TableSpec) -> int:
    return spec.demos or preset_of(BC, spec.preset_name).student.demos


def _by_name(style: tuple[str, ...]) -> dict[str, str]:
    """The words NAME=VALUE of a style by name."""
    return {word.partition("=")[0]: word for word in style}


def _data_folder(config: StudentConfig, preset: StudentConfig, name: str) -> str:
    """Name of the folder of a data set; variants share it where they need the same images and the same ends."""
    parts = [name or "demonstrations"]
    if config.inputs.image_size != preset.inputs.image_size:
        parts.append(f"{config.inputs.image_size}px")
    if config.hold_steps != preset.hold_steps:
        parts.append("whole" if config.hold_steps < 0 else f"until_{config.hold_steps}")
    return "_".join(parts)


def _collected(spec: TableSpec, asked: ImitationSpec, out: Path, name: str) -> Path:
    """The folder of a data set for a training; collects what it lacks."""
    from mjhab.learning.runs.collection import Collector, Round
    from mjhab.learning.runs.request import layout_for

    preset = preset_of(BC, spec.preset_name).student
    inputs = dataclasses.replace(
        preset.inputs, image_size=asked.config.student.inputs.image_size
    )
    # The preset and not the variant: variants that differ elsewhere share these data.
    seen = ImitationConfig(dataclasses.replace(preset, inputs=inputs))
    layout = layout_for(dataclasses.replace(asked, preset=seen))
    changes = {**_by_name(preset.style), **_by_name(STYLES[name])}
    hold_steps = asked.config.student.hold_steps
    wanted = Round(
        0, _episodes(spec), hold_steps=hold_steps, style=tuple(changes.values())
    )
    folder = out / _data_folder(asked.config.student, preset, name)
    collector = Collector(asked.scene, layout.env_options(), asked.resources, asked.seed)
    collector.collect(wanted, folder)
    return folder
