"""Convert mjhab's episodes to the HAB format."""

from __future__ import annotations

import numpy as np

from mjhab.core.names import copy_name
from mjhab.episodes.episode import Episode
from mjhab.episodes.hab.format import (
    OBJECT_SUFFIX,
    SCENE_SUFFIX,
    HabEpisode,
    Marker,
    pose_to_hab,
)
from mjhab.episodes.hab.format import Receptacle as NumberedLink
from mjhab.episodes.hab.reader import FIXED_LINKS, PREFIX, link_names, receptacle_at
from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import PlacedReceptacle, placed_receptacles
from mjhab.scenes.spec import Home
from mjhab.tasks.household.set_table import FRIDGE_DOOR

_REPLICA_CAD = "replica_cad"
_MARKERS = {
    "kitchen_counter/drawer1_top": "cab_push_point_7",
    "kitchen_counter/drawer2_top": "cab_push_point_6",
    "kitchen_counter/drawer3": "cab_push_point_5",
    "kitchen_counter/drawer4": "cab_push_point_4",
    FRIDGE_DOOR: "fridge_push_point",
}
"""HAB's marker name of the handle by link id."""


def to_hab(layout: Layout, home: Home, episode: Episode) -> HabEpisode:
    """Return an episode in the HAB format; root links have number 0, ``info`` has task, split, seed and index."""
    places = placed_receptacles(layout, home)
    at = {
        name: receptacle_at(layout, places, name, pose)
        for name, pose in zip(layout.object_names, episode.object_pose, strict=True)
    }
    kinds = dict(zip(layout.object_names, layout.objects, strict=True))
    goals = {t.obj: np.array([*t.goal_pos, 1.0, 0.0, 0.0, 0.0]) for t in episode.targets}
    there = {
        name: receptacle_at(layout, places, name, pose) for name, pose in goals.items()
    }
    names = [t.obj for t in episode.targets]
    return HabEpisode(
        episode_id=str(episode.index),
        scene_id=f"data/{layout.pack.name}/configs/scenes/{home.name}{SCENE_SUFFIX}",
        rigid_objs=tuple(
            (
                f"{kind}{OBJECT_SUFFIX}",
                pose_to_hab(pose, layout.pack.objects[kind].scan_yaw),
            )
            for kind, pose, used in zip(
                layout.roster,
                episode.object_pose,
                layout.used_slots(episode.object_pose),
                strict=True,
            )
            # Parked objects wait outside of the home and are not part of the episode.
            if used
        ),
        targets={
            name: pose_to_hab(pose, kinds[name].scan_yaw) for name, pose in goals.items()
        },
        ao_states=_ao_states(layout, episode.link_q),
        markers=_markers(layout),
        target_receptacles=tuple(_numbered(layout, at[name]) for name in names),
        goal_receptacles=tuple(_numbered(layout, there[name]) for name in names),
        name_to_receptacle={
            name: f"{_handle(layout, p)}|{p.name}"
            for name, p in at.items()
            if p is not None
        },
        info={
            "object_labels": {name: f"any_targets|{k}" for k, name in enumerate(names)},
            "task": episode.task,
            "split": episode.split,
            "seed": episode.seed,
            "index": episode.index,
        },
        rest={
            "scene_dataset_config": f"data/{layout.pack.name}/{_dataset_config(layout)}",
            "additional_obj_config_paths": ["data/objects/ycb/configs/"],
            "start_position": [0, 0, 0],
            "start_rotation": [0, 0, 0, 1],
        },
    )


def _dataset_config(layout: Layout) -> str:
    return f"{'replicaCAD' if layout.pack.name == _REPLICA_CAD else layout.pack.name}.scene_dataset_config.json"


def _ao_states(layout: Layout, link_q: np.ndarray) -> dict[str, dict[str, float]]:
    """Return the positions of joints that are open by more than 1 mm or 1 mrad (settling moves closed ones by less)."""
    out: dict[str, dict[str, float]] = {}
    for ref, position in zip(layout.links, link_q.tolist(), strict=True):
        if abs(position) > 1e-3:
            number = link_names(layout, ref.articulation).index(ref.link.name)
            # The sign is that of the original's joint.
            stated = -position if ref.link.mirrored else position
            out.setdefault(copy_name(ref.articulation, 0), {})[str(number)] = round(
                stated, 6
            )
    return out


def _markers(layout: Layout) -> tuple[Marker, ...]:
    """Return HAB's markers at the grasp points of mjhab's handles [m], in link frames with +y up."""
    found = []
    for ref in layout.links:
        if ref.id in _MARKERS:
            x, y, z = ref.link.handle.pos
            found.append(
                Marker(
                    _MARKERS[ref.id],
                    copy_name(ref.articulation, 0),
                    ref.link.name,
                    # The +y up frame of the format: a quarter turn about x.
                    (round(x, 6), round(z, 6), round(-y, 6)),
                )
            )
    return tuple(found)


def _handle(layout: Layout, place: PlacedReceptacle) -> str:
    thing = place.id.split("/")[0]
    if thing == place.template:
        return copy_name(thing, 0)
    # Only names of that pack were shortened.
    prefix = PREFIX if layout.pack.name == _REPLICA_CAD else ""
    return copy_name(f"{prefix}{place.template}", int(thing.rsplit("_", 1)[1]))


def _numbered(layout: Layout, place: PlacedReceptacle | None) -> NumberedLink:
    if place is None:
        return ("", None)
    if place.id.split("/")[0] == place.template:
        # What stands on the furniture itself is on its body, which is a link of its own in the format.
        link = place.link.split("/")[1] if place.link else FIXED_LINKS[1]
        return (_handle(layout, place), link_names(layout, place.template).index(link))
    return (_handle(layout, place), None)
