"""Whether homes have room for the household tasks: one episode of each task is made in each home."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from mjhab.core.errors import UsageError
from mjhab.episodes.generator import EpisodeMaker
from mjhab.episodes.rosters import roster
from mjhab.layout.layout import Layout
from mjhab.scenes.spec import Home, Pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.household.registry import TASKS


def room_for_tasks(pack: Pack, homes: Sequence[Home]) -> Iterator[tuple[str, str, str]]:
    """Yield (task, home, why no episode of it can be made there), "" where one can, for all registered tasks.

    Tasks whose objects the pack lacks are left out. Episode 0 of seed 0 decides, as for ``mjhab eval``.
    """
    for task in TASKS:
        objects = roster(task)
        # Such a task cannot be asked for in this pack, whatever its rooms.
        if not set(objects) <= set(pack.objects):
            continue
        # One per task, since the objects are part of the compiled model.
        sim = CpuSimulator(Layout(pack, objects), 1, 1)
        for home in homes:
            yield task, home.name, _refusal(sim, task, home)


def _refusal(sim: CpuSimulator, task: str, home: Home) -> str:
    try:
        EpisodeMaker(sim, task, home.split, home=home.name).make(0, 0)
    except UsageError as error:
        return str(error)
    return ""
