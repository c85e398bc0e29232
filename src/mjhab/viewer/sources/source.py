"""The interface between the viewer and the source of its episodes: running worlds, or shards."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.viewer.drawn.plan_marks import PlanMarks
from mjhab.viewer.sources.pace import RealTimeClock
from mjhab.viewer.sources.track import Track


class ViewSource(Protocol):
    """Source of episodes to show. Only running worlds can be teleoperated or given another policy."""

    @property
    def is_live(self) -> bool:
        """Whether its episodes are being simulated, rather than recorded."""
        ...

    @property
    def pace(self) -> RealTimeClock:
        """Speed of time; of running worlds also whether they are paused."""
        ...

    @property
    def choices(self) -> tuple[str, ...]:
        """Names of the worlds or recorded episodes that can be watched."""
        ...

    @property
    def choice(self) -> str:
        """Which of ``choices`` is watched; "" if none is."""
        ...

    @property
    def policies(self) -> tuple[str, ...]:
        """Specifications of the policies that can be chosen; empty for recorded episodes."""
        ...

    @property
    def sim(self) -> CpuSimulator:
        """Simulator whose layout has the home of ``track``."""
        ...

    @property
    def track(self) -> Track | None:
        """The episode that is watched; None while there is none yet."""
        ...

    @property
    def problem(self) -> str:
        """Message about a failure; "" if there is none."""
        ...

    @property
    def hand_drives(self) -> bool:
        """Whether the watched world is teleoperated."""
        ...

    @property
    def recording(self) -> str:
        """Message about where the running episode is recorded; "" if it is not."""
        ...

    def plan_at(self, step: int) -> PlanMarks | None:
        """Return the expert's plan in a state of the track; None if switched off, not yet computed, or missing."""
        ...

    def prepare(self) -> None:
        """Make what `start` needs, so that what cannot work is told before a page is served."""
        ...

    def start(self) -> None:
        """Start to run, or show the first episode."""
        ...

    def close(self) -> None:
        """Stop, and close environments and the shard that is written."""
        ...

    def choose(self, choice: str) -> None:
        """Watch another of ``choices``."""
        ...

    def set_policy(self, spec: str) -> None:
        """Let the policy with this specification act from the next step on."""
        ...

    def restart(self) -> None:
        """Run the watched episode again from its reset; show a recorded one from its first state."""
        ...

    def next_episode(self) -> None:
        """Go to the next episode."""
        ...

    def show_expert_plan(self, shown: bool) -> None:
        """Switch `plan_at` on or off."""
        ...

    def set_hand(self, driving: bool) -> None:
        """Start or stop the teleoperation of the watched world."""
        ...

    def hear_hand(self, message: str) -> None:
        """Take a message of `hand.js` about keys and gamepad."""
        ...

    @property
    def hand_pose(self) -> np.ndarray | None:
        """Pose (7,) that the gripper is to go to, in the frame of `Robot.arm_root`; None without teleoperation."""
        ...

    def aim_hand(self, pose: np.ndarray) -> None:
        """Let the gripper go to a pose (7,) in the frame of `Robot.arm_root`."""
        ...

    def grip(self) -> None:
        """Open or close the gripper that is teleoperated."""
        ...

    def hand_gone(self) -> None:
        """Note that the last page that could send such messages was closed."""
        ...

    def finish_episode(self) -> None:
        """Truncate the watched episode now and record it."""
        ...
