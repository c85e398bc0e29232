"""Which walls the homes of ReplicaCAD get: those of their own stages, of a file, of a stand-in, or none."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.errors import UsageError, fault
from mjhab.scenes.replica_cad.files import (
    NAVMESHES,
    SCENE_SUFFIX,
    file_in,
    load_json,
    numbers,
    rotation,
    template,
)
from mjhab.scenes.replica_cad.files import field as entry
from mjhab.scenes.replica_cad.stage import Extent, stage_shape
from mjhab.scenes.spec import NO_STAGE, OTHER_STAGE, OWN_STAGE, STAND_IN, Geom

Shape = tuple[tuple[Geom, ...], Extent]
"""Wall boxes of a stage, and x_min, y_min, x_max, y_max [m] of its floor."""
STAND_IN_FILE = Path("stages") / "frl_apartment_stage_simple.glb"
"""The mesh that stands in unless the user names another, in the folder of the data set (`stand_in`)."""


def can_stand_in(folder: Path, scenes: Iterable[str] = ()) -> bool:
    """Whether a data set has what a stand-in for missing stages needs: its mesh, and the scenes' navigation meshes.

    Args:
        folder: of the data set.
        scenes: names or patterns of scenes besides the staged ones.
    """
    if not (folder / STAND_IN_FILE).is_file():
        return False
    # Staged scenes always, as they tell where the walls of the stand-in are cut.
    patterns = ("v3_sc?_staging_*", *scenes)
    found = (
        f
        for p in patterns
        for f in sorted(folder.glob(f"configs/scenes/{p}{SCENE_SUFFIX}"))
    )
    names = (file.name.removesuffix(SCENE_SUFFIX) for file in found)
    return all((folder / NAVMESHES / f"{name}.navmesh").is_file() for name in names)


@dataclass(frozen=True)
class StageRequest:
    """Which stages to use: ``stage`` and ``mesh`` as `PackRequest.stage` and ``stage_mesh``, None for no mesh.

    Raises:
        UsageError: the mesh does not exist.
    """

    stage: str = OWN_STAGE
    mesh: Path | None = None

    def __post_init__(self) -> None:
        if self.mesh is not None and not self.mesh.is_file():
            raise fault(self.mesh, "this stage mesh does not exist.")


@dataclass(eq=False)
class Stages:
    """Walls and floor extents of scenes; every mesh is read once.

    Attributes:
        folder: of the data set.
        request: which stages to use.
        missing: stage meshes that scenes name and that do not exist.
        used: kinds of `spec.STAGES` that scenes got.
    """

    folder: Path
    request: StageRequest
    missing: list[Path] = field(default_factory=list)
    used: set[str] = field(default_factory=set)
    _shapes: dict[tuple[Any, ...], Shape] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """One of `spec.STAGES`: what the scenes got; that of scenes whose own is missing, if there are any."""
        kinds = (STAND_IN, NO_STAGE, OTHER_STAGE, OWN_STAGE)
        # The kind that differs most from the published homes names the pack.
        return next(kind for kind in kinds if kind in self.used)

    def shape(
        self, path: Path, body: dict[str, Any], group: tuple[str, ...]
    ) -> Shape | None:
        """Return walls and floor extent of a scene; None for none.

        Args:
            path, body: file of the scene and its content.
            group: names of the scenes that a stand-in is fitted to.

        Raises:
            UsageError: a file is missing or broken, or the stand-in has another frame.
        """
        record = entry(path, body, "stage_instance")
        kind, file = self._choose(path, record)
        self.used.add(kind)
        if kind == STAND_IN:
            # One stand-in for the whole group: all staged scenes have the same stage.
            return self._once((STAND_IN, *group), lambda: self._stand_in(group))
        if file is None:
            return None
        shift = np.zeros(3)
        if "translation" in record:
            shift = numbers(path, record, "translation", 3, "stage_instance")
        turn = rotation(path, record, "stage_instance")
        key = (file, *shift.tolist(), *turn.ravel().tolist())
        return self._once(key, lambda: stage_shape(file, turn, shift))

    def _choose(self, path: Path, record: Any) -> tuple[str, Path | None]:
        """Kind of the stage of a scene, one of `spec.STAGES`, and its mesh if it is used as it is."""
        asked = self.request.stage
        if asked == NO_STAGE:
            return NO_STAGE, None
        if asked == OWN_STAGE and self.request.mesh is not None:
            return OTHER_STAGE, self.request.mesh
        own = self._own(path, record)
        if own.is_file():
            return OWN_STAGE, own
        if own not in self.missing:
            self.missing.append(own)
        return (STAND_IN if asked == STAND_IN else NO_STAGE), None

    def consequence(self) -> str:
        """What follows from the stages that are missing, for a warning."""
        if self.request.stage == STAND_IN:
            return f"{self._mesh.name} stands in, fitted to the navigation meshes (stage: stand-in)"
        fitted = ", --stage stand-in walls of a like mesh" if self._mesh.is_file() else ""
        return f"homes have a floor but no walls (--stage-mesh FILE gives another stage{fitted})"

    @property
    def _mesh(self) -> Path:
        return self.request.mesh or self.folder / STAND_IN_FILE

    def _own(self, path: Path, record: Any) -> Path:
        """The mesh of the stage that a scene names."""
        name = template(path, record, "stage_instance").rsplit("/", 1)[-1]
        config = self.folder / "configs" / "stages" / f"{name}.stage_config.json"
        return file_in(config, load_json(config), "render_asset")

    def _stand_in(self, group: tuple[str, ...]) -> Shape:
        # On use: most data sets have their stages.
        from mjhab.scenes.replica_cad.stand_in import stand_in

        if not self._mesh.is_file():
            raise UsageError(
                f"stage 'stand-in' needs {self._mesh}, which is missing: give a mesh in the frame of the scenes with "
                "--stage-mesh, or leave out the option."
            )
        return stand_in(self._mesh, self.folder, group)

    def _once(self, key: tuple[Any, ...], make: Callable[[], Shape]) -> Shape:
        if key not in self._shapes:
            self._shapes[key] = make()
        return self._shapes[key]
