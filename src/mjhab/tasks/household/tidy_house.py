"""TidyHouse: five objects from one open surface to another (habitat-lab hab/tidy_house.yaml)."""

from __future__ import annotations

from mjhab.tasks.household.spec import TargetRule, TaskSpec

NUM_TARGETS = 5
_ANYWHERE = ("open_surface",)

TIDY_HOUSE = TaskSpec(
    name="tidy_house",
    words=("tidy up the house", "tidy the house", "clean up the home"),
    # No object is named: habitat-lab draws the targets among all objects.
    targets=(TargetRule(start=_ANYWHERE, goal=_ANYWHERE),) * NUM_TARGETS,
    objects=("003_cracker_box", "005_tomato_soup_can", "024_bowl"),
)
