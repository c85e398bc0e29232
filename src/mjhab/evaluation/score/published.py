"""Published success rates on the subtasks of track ms_hab_7, for the table of its scores."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """A published mean success rate over the seven subtasks [%], and where it stands."""

    policy: str
    mean: float
    source: str


PUBLISHED_RESULTS: dict[str, tuple[Published, ...]] = {
    "ms_hab_7": (
        Published("RDT", 42.9, "in the table of AC-DiT *"),
        Published("AC-DiT, 1.2 B parameters", 55.6, "arXiv 2507.01961 *"),
        Published("AnchorVLA, 0.73 B", 64.0, "arXiv 2604.01567 *"),
        Published("MobileWAM, 6.5 B", 73.0, "arXiv 2608.04657 *"),
        Published("SG-VLA, another mix of all three tasks", 73.0, "arXiv 2603.22760 *"),
        Published("GeoHAT", 79.3, "arXiv 2606.13394, abstract"),
    ),
}
"""By track, lowest first. An asterisk marks numbers that were taken from notes on a paper and not from the paper."""
WHAT_DIFFERS: dict[str, str] = {
    "ms_hab_7": "What differs between these scores and the published numbers: the physics (MuJoCo here, PhysX there); "
    "the homes (here built-in ones, or ReplicaCAD with the walls that the heading names, of which stand-in ones are "
    "fitted from another mesh; there ReplicaCAD with its own walls); the demonstrations (here of a scripted expert; "
    "there 1,000 per subtask by RL policies); what policies see (here what each was trained with, and the expert the "
    "simulator's state; there RGB or RGB-D images, joints and a sentence); the episodes (here fixed, 100 for each of 3 "
    "seeds, their actions replayed; there 100 x 3 of their own). *score* counts what succeeds before the limit on the "
    "force is exceeded, as the environment defines success, *goes on* what succeeds in any step, whatever the force: "
    "publications seldom say which of these they count. An asterisk marks numbers from notes on a paper, not from it."
}
"""By track, what to know before numbers are compared."""
