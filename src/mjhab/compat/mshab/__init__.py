"""What scripts of MS-HAB import, answered by mjhab.

``import mjhab.compat.mshab`` registers MS-HAB's ids with Gymnasium; ``gymnasium.make("PickSubtaskTrain-v0", ...)``
then gives our worlds under its arguments, observations, and `info`. ``python -m mjhab.compat.mshab SCRIPT.py``
runs a script that imports ``mshab`` and ``mani_skill`` (`answers`).
"""

from mjhab.compat.mshab.ids import register_ids

register_ids()
