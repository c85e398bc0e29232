"""Which objects an environment has: one type per object slot."""

from __future__ import annotations

from mjhab.config.env import EnvConfig
from mjhab.scenes.builtin.objects import roster
from mjhab.scenes.spec import Pack


def object_roster(config: EnvConfig, pack: Pack) -> tuple[str, ...]:
    """Object type of every slot: those of the task, ``extra_objects``, and a target that is in neither.

    Args:
        config: names task, target and extra objects.
        pack: has the objects; a target that it does not have is no object (a link), and adds nothing.
    """
    found = (*roster(config.task), *config.extra_objects)
    target = config.target
    return (*found, target) if target in pack.objects and target not in found else found
