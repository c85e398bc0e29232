"""Push, a subtask that mjhab does not have: push an object across a table into a zone.

    MJHAB_PLUGINS=examples/push mjhab envs list
    MJHAB_PLUGINS=examples/push mjhab eval --task push_objects --subtask push --episodes 4

`subtask` says what Push is, `start` how it begins, `expert` how it is done, `task` which household task has it.
"""

from mjhab import register_subtask, register_task

from .subtask import PUSH
from .task import PUSH_OBJECTS

register_subtask(PUSH)
register_task(PUSH_OBJECTS)
