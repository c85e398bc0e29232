"""What a viewer asks of the place its episodes come from: running worlds, or shards."""

from __future__ import annotations

from typing import Protocol

from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.viewer.drawn.plan_marks import PlanMarks
from mjhab.viewer.sources.pace import Pace
from mjhab.viewer.sources.track import Track


class Source(Protocol):
    """Episodes to show. Only running worlds can be driven by hand or given another policy."""

    @property
    def is_live(self) -> bool:
        """Whether its episodes go on while they are shown."""
        ...

    @property
    def pace(self) -> Pace:
        """How fast time passes; of running worlds also whether it does."""
        ...

    @property
    def choices(self) -> tuple[str, ...]:
        """Names of what can be watched."""
        ...

    @property
    def choice(self) -> str:
        """The name, of ``choices``, of what is watched; "" while nothing is."""
        ...

    @property
    def policies(self) -> tuple[str, ...]:
        """Specifications of the policies that can be chosen; empty where nothing acts."""
        ...

    @property
    def sim(self) -> CpuSimulator:
        """Has the homes that the track is in."""
        ...

    @property
    def track(self) -> Track | None:
        """The episode that is watched; None while there is none yet."""
        ...

    @property
    def problem(self) -> str:
        """What went wrong, in words; empty while all is well."""
        ...

    @property
    def hand_drives(self) -> bool:
        """Whether a person drives the watched world."""
        ...

    @property
    def recording(self) -> str:
        """What becomes of the episode that runs, in words; empty if it is not kept."""
        ...

    def plan_at(self, step: int) -> PlanMarks | None:
        """What the expert plans in a state of the track, if it was asked for and is known."""
        ...

    def start(self) -> None:
        """Begin."""
        ...

    def close(self) -> None:
        """End; what is recorded is closed."""
        ...

    def choose(self, choice: str) -> None:
        """Watch something else."""
        ...

    def set_policy(self, spec: str) -> None:
        """Let another policy act."""
        ...

    def restart(self) -> None:
        """Begin the watched episode again; a recorded one is shown from its first state."""
        ...

    def next_episode(self) -> None:
        """Go to the next episode."""
        ...

    def show_expert_plan(self, shown: bool) -> None:
        """Ask for `plan_at`, or not any more."""
        ...

    def set_hand(self, driving: bool) -> None:
        """Let a person drive the watched world, or give it back to the policy."""
        ...

    def hear_hand(self, message: str) -> None:
        """Take a message of `hand.js`."""
        ...

    def hand_gone(self) -> None:
        """No page is open any more that could send such messages."""
        ...

    def finish_episode(self) -> None:
        """End the watched episode now, and keep it."""
        ...
