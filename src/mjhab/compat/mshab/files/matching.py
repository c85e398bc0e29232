"""Find the subtasks of task plans in the chains of mjhab, and names of objects and links in those of a layout."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjhab.compat.mshab.files.plans import MsHabTaskPlan
from mjhab.compat.mshab.files.subtasks import (
    ArticulationConfig,
    CloseSubtask,
    MsHabSubtask,
    NavigateSubtask,
    OpenSubtask,
    PickSubtask,
    PlaceSubtask,
)
from mjhab.core.errors import wrong_value
from mjhab.core.names import copy_name
from mjhab.data.imports.ms_hab_layout import object_id
from mjhab.episodes.hab.reader import FIXED_LINKS, link_names
from mjhab.layout.layout import Layout
from mjhab.scenes.spec import PUBLISHED_POINTS, Vec3
from mjhab.tasks.plan import Subtask, Target, TaskPlan
from mjhab.tasks.subtasks.registry import spec_of

SCENE_SUFFIX = ".scene_instance.json"
_FAR_M = 0.5
"""A navigation leads to an object if the goal of the plan is not farther than this from where it starts [m]."""


def object_name(obj_id: str | None) -> str:
    """Name of an object in a layout: ``024_bowl_:0000`` for ``024_bowl-0``; "" for none.

    Raises:
        FieldError: it is no kind and number.
    """
    if not obj_id:
        return ""
    # Kinds can hold a dash themselves, as 072-a_toy_airplane does.
    kind, dash, number = obj_id.rpartition("-")
    if not dash or not kind or not number.isdecimal():
        raise wrong_value("obj_id", obj_id, "kind and number of an object: '024_bowl-0'")
    return copy_name(kind, int(number))


def furniture_of(config: ArticulationConfig) -> str:
    """Piece of furniture of a layout that a drawer or door of a plan belongs to."""
    return config.articulation_type or config.articulation_id.rpartition("-")[0]


def articulation_of(subtask: MsHabSubtask) -> ArticulationConfig | None:
    """The drawer or door that a subtask of a plan is about, if it is about one."""
    if isinstance(subtask, ArticulationConfig):
        return subtask
    return getattr(subtask, "articulation_config", None)


def link_of(layout: Layout, config: ArticulationConfig) -> str:
    """Id of the link of a layout that a plan numbers.

    Raises:
        FieldError: the layout has no such furniture, or no moving link of this number.
    """
    furniture = furniture_of(config)
    names = link_names(layout, furniture)
    number = config.articulation_handle_link_idx
    if not len(FIXED_LINKS) <= number < len(names):
        has = ", ".join(layout.link_ids)
        raise wrong_value(
            "articulation_handle_link_idx",
            number,
            f"the number of a moving link of {furniture!r}; this pack has {has}",
        )
    return f"{furniture}/{names[number]}"


def articulation_config(layout: Layout, link: str) -> ArticulationConfig:
    """The drawer or door of a layout as plans name it; the root has number 0, joints are numbered without it."""
    furniture, name = link.split("/")
    number = link_names(layout, furniture).index(name)
    return ArticulationConfig(
        furniture, f"{furniture}-0", number, number - len(FIXED_LINKS)
    )


def handle_point(layout: Layout, link: str) -> list[float]:
    """Handle of a link in plans: in the link's frame, with +y up [m]."""
    handle = layout.links[layout.link_ids.index(link)].link.handle
    x, y, z = handle.point(PUBLISHED_POINTS)
    return [x, z, -y]


def position_in(chain: TaskPlan, layout: Layout, subtask: MsHabSubtask) -> int:
    """Position in the chain of an episode of a subtask of a plan.

    Raises:
        FieldError: the chain has no such subtask.
    """
    found = [
        i
        for i, own in enumerate(chain.subtasks)
        if own.name == subtask.type and _is(chain, i, layout, subtask)
    ]
    if not found:
        about = _described(subtask)
        alike = [own.target for own in chain.subtasks if own.name == subtask.type]
        has = ", ".join(alike) or "none"
        raise wrong_value(subtask.type, about, f"one of the episode's: {has}")
    if isinstance(subtask, NavigateSubtask) and subtask.goal_pos is not None:
        # A task drives to some places more than once; the goals tell the drives apart.
        return min(found, key=lambda i: _distance(chain.subtasks[i].goal_pos, subtask))
    return found[0]


def _described(subtask: MsHabSubtask) -> str:
    facts: dict[str, Any] = dataclasses.asdict(subtask)
    named = ("obj_id", "articulation_id", "goal_pos", "articulation_handle_link_idx")
    return ", ".join(f"{name} {facts[name]}" for name in named if facts.get(name))


def _is(chain: TaskPlan, i: int, layout: Layout, subtask: MsHabSubtask) -> bool:
    """Whether the subtask at position ``i`` of a chain, of the same kind, is that of a plan."""
    own = chain.subtasks[i]
    if isinstance(subtask, PickSubtask | PlaceSubtask):
        return own.obj == object_name(subtask.obj_id)
    if isinstance(subtask, OpenSubtask | CloseSubtask):
        return own.link == link_of(layout, subtask)
    assert isinstance(subtask, NavigateSubtask)
    if subtask.obj_id:
        return own.must_hold and own.obj == object_name(subtask.obj_id)
    config = subtask.articulation_config
    if subtask.goal_pos is not None or config is None:
        return not own.must_hold and _distance(own.goal_pos, subtask) < _FAR_M
    following = spec_of(chain.subtasks[i + 1].kind)
    leads = following.closes_link if subtask.remove_obj_id else following.opens_link
    return leads and own.link == link_of(layout, config)


def _distance(own: Vec3, subtask: NavigateSubtask) -> float:
    if subtask.goal_pos is None:
        return 0.0
    return float(np.linalg.norm(np.subtract(own, subtask.goal_pos)))


def is_whole(chain: TaskPlan, plan: MsHabTaskPlan) -> bool:
    """Whether a plan has the kinds of subtasks of a chain, and their objects."""
    kinds = [own.name for own in chain.subtasks]
    if [subtask.type for subtask in plan.subtasks] != kinds:
        return False
    return all(
        object_name(subtask.obj_id) == own.obj
        for own, subtask in zip(chain.subtasks, plan.subtasks, strict=True)
        if isinstance(subtask, PickSubtask | PlaceSubtask)
    )


def with_goals(
    targets: Sequence[Target], chain: TaskPlan, found: Sequence[tuple[int, MsHabSubtask]]
) -> tuple[Target, ...]:
    """Targets with the goals that plans give: of Place, and of Navigate.

    Args:
        targets: of the episode.
        chain: the chain made of them.
        found: position in the chain and subtask of the plan.

    Raises:
        FieldError: a goal is no point.
    """
    goals: dict[str, dict[str, Vec3]] = {}
    for position, subtask in found:
        given = getattr(subtask, "goal_pos", None)
        own = chain.subtasks[position]
        if given is None:
            continue
        if isinstance(subtask, PlaceSubtask) or own.must_hold:
            goals.setdefault(own.obj, {})["goal_pos"] = _point(given)
        else:
            goals.setdefault(own.toward, {})["start_pos"] = _point(given)
    return tuple(
        dataclasses.replace(target, **goals.get(target.obj, {})) for target in targets
    )


def _point(given: Any) -> Vec3:
    array = np.asarray(given, np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise wrong_value("goal_pos", given, "three numbers [m]")
    x, y, z = array.tolist()
    return (x, y, z)


def home_of(build_config_name: str | None) -> str:
    """Name of the home of a plan: without the suffix of scene files."""
    # Plans that were written on Windows have its separators.
    name = (build_config_name or "").replace("\\", "/").rpartition("/")[2]
    return name.removesuffix(SCENE_SUFFIX)


def subtask_in_files(
    layout: Layout, chain: TaskPlan, position: int
) -> MsHabSubtask | None:
    """The subtask at a position of a chain as plans write it; None if MS-HAB has no plan of it.

    Those are Navigates in tasks that open links to the object inside.
    """
    own = chain.subtasks[position]
    config = articulation_config(layout, own.link) if own.link else None
    obj = object_id(own.obj) if own.obj else ""
    point = list(own.goal_pos)
    kind = own.name
    if kind == "pick":
        return PickSubtask(obj, config)
    if kind == "place":
        return PlaceSubtask(obj, None, point, articulation_config=config)
    if kind == "navigate":
        return _navigate(layout, chain, position, config)
    if kind not in ("open", "close") or config is None:
        return None
    place = dataclasses.asdict(config)
    place["articulation_relative_handle_pos"] = handle_point(layout, own.link)
    if kind == "open":
        return OpenSubtask(**place, obj_id=obj)
    return CloseSubtask(**place, remove_obj_id=_behind(chain, own))


def _navigate(
    layout: Layout, chain: TaskPlan, position: int, config: ArticulationConfig | None
) -> NavigateSubtask | None:
    own = chain.subtasks[position]
    point = list(own.goal_pos)
    opened = [s.link for s in chain.subtasks[:position] if spec_of(s.kind).opens_link]
    closed = [s.link for s in chain.subtasks[:position] if spec_of(s.kind).closes_link]
    is_open = len(opened) > len(closed)
    before = [
        list(s.goal_pos)
        for s in chain.subtasks[:position]
        if spec_of(s.kind).navigates or spec_of(s.kind).brings_to_goal
    ]
    earlier = before[-1] if before else None
    if own.must_hold:
        link = opened[-1] if is_open else own.link
        held = articulation_config(layout, link) if link else None
        return NavigateSubtask(object_id(own.obj), point, earlier, held)
    following = chain.subtasks[position + 1]
    spec = spec_of(following.kind)
    if spec.opens_link:
        return NavigateSubtask(articulation_config=config)
    if spec.closes_link:
        removed = _behind(chain, following)
        return NavigateSubtask(articulation_config=config, remove_obj_id=removed)
    return None if is_open else NavigateSubtask(None, point, earlier, config)


def _behind(chain: TaskPlan, closing: Subtask) -> str | None:
    """The object for which a link was opened that is then closed."""
    for own in chain.subtasks:
        if spec_of(own.kind).opens_link and own.link == closing.link and own.obj:
            return object_id(own.obj)
    return None
