"""ReplicaCAD as a source of packs: resolution of paths to the data set and to scenes of it."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from mjhab.core.errors import fault
from mjhab.scenes.pack_source import PackRequest, PackSource
from mjhab.scenes.replica_cad.files import SCENE_SUFFIX, is_replica_cad
from mjhab.scenes.replica_cad.stage_choice import StageRequest, can_stand_in
from mjhab.scenes.spec import OWN_STAGE, STAND_IN, Pack

_SUBFOLDER = "replica_cad"
"""Folder of the data set in the folder of all data sets (`mjhab assets where`)."""


def locate(place: str) -> tuple[Path, tuple[str, ...]] | None:
    """Resolve a path to a data set folder and names of scenes.

    Args:
        place: the data set, the folder that holds it as ``replica_cad``, a ``*.scene_instance.json`` of it, or one of
            the two folders followed by names or patterns of scenes, separated by commas: ``replica_cad/apt_0,apt_1``.

    Returns:
        The folder and the names, () for none; None if the path is none of these.
    """
    path = Path(place)
    # The file of one scene: its data set is the folder two levels above "configs/scenes".
    if place.endswith(SCENE_SUFFIX) and path.is_file():
        return path.resolve().parents[2], (path.name.removesuffix(SCENE_SUFFIX),)
    folder = _data_set(path)
    if folder is not None:
        return folder, ()
    # A name that does not exist in a data set is one of its scenes, or several with commas.
    folder = None if path.exists() else _data_set(path.parent)
    return (folder, tuple(path.name.split(","))) if folder is not None else None


def _data_set(folder: Path) -> Path | None:
    """The folder itself, or the one in it, if that looks like the data set."""
    return next((f for f in (folder, folder / _SUBFOLDER) if is_replica_cad(f)), None)


def _open(request: PackRequest) -> Pack:
    found = locate(request.place)
    if found is None:
        raise fault(request.place, "no ReplicaCAD data set.")
    folder, scenes = found
    stage = StageRequest(
        request.stage, Path(request.stage_mesh) if request.stage_mesh else None
    )
    return _read(folder.resolve(), (*scenes, *request.scenes), stage, request.articulate)


def _complete(request: PackRequest, recorded: bool) -> PackRequest:
    """The request with the stage it takes if it names none, see `PackRequest.stage`."""
    found = locate(request.place)
    if request.stage or found is None:
        return request
    folder, scenes = found
    # What was recorded without a stage had the walls of its own, and must replay with them.
    fits = not (recorded or request.stage_mesh)
    fits = fits and can_stand_in(folder, (*scenes, *request.scenes))
    return replace(request, stage=STAND_IN if fits else OWN_STAGE)


@lru_cache(maxsize=4)
def _read(
    folder: Path,
    scenes: tuple[str, ...],
    stage: StageRequest,
    articulate: tuple[str, ...],
) -> Pack:
    # On use: the reader takes long to import, and most runs have built-in homes.
    from mjhab.scenes.replica_cad.reader import open_replica_cad

    return open_replica_cad(folder, scenes, stage, articulate)


SOURCE = PackSource(
    "replica_cad",
    _open,
    lambda place: locate(place) is not None,
    frozenset({"articulate", "stage", "stage_mesh", "scenes"}),
    _complete,
)
