"""Where the robot and the furniture of recorded episodes stand, which their states do not hold."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping

from mjhab.core.errors import UsageError, warn_once
from mjhab.data.export.maniskill_states import JointNote, Root
from mjhab.data.store.episode_data import RunInfo
from mjhab.robots.registry import robot_named
from mjhab.scenes.packs import open_pack

_UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def roots_of(run: RunInfo, home: str) -> Mapping[str, Root]:
    """The articulations of a home by name; without furniture, and told once, where its asset pack is not there."""
    try:
        height = robot_named(run.robot).base_height
        base = {run.robot: Root((0.0, 0.0, height, *_UPRIGHT))}
    # A robot of a plugin that is not installed here; the objects are worth exporting all the same.
    except UsageError:
        base = {}
    # The options of the run tell more than its place: they may choose another stage.
    assets = run.config.get("env", {}).get("assets", run.assets)
    # As text, because a cache needs a key that can be hashed.
    return {**base, **_furniture(json.dumps(assets), home)}


@functools.lru_cache(maxsize=256)
def _furniture(assets: str, home: str) -> Mapping[str, Root]:
    try:
        pack = open_pack(json.loads(assets))
        placed = pack.homes_by_name[home].articulations
    except (UsageError, KeyError) as error:
        warn_once(f"Furniture of {home} is left out of env_states: {error}")
        return {}
    found = {}
    for placement in placed:
        template = pack.articulations[placement.template]
        joints = {
            link.name: JointNote(-1.0 if link.mirrored else 1.0, *link.range)
            for link in template.links
        }
        found[template.name] = Root((*placement.pos, *placement.rotation), joints)
    return found
