"""Styles of acting: scripts read the style from their view, and `ActionNoise` slows and disturbs their actions.

An intended action comes from the script; the executed action is the intended one with noise.

Numbers that name no source were chosen by hand on homes of the split train; they were not swept.
"""

from __future__ import annotations

import numpy as np

from mjhab.envs.parts.world_view import WorldView
from mjhab.envs.parts.worlds import PolicyWorlds
from mjhab.episodes.grasps.candidates import KINDS, Grasps
from mjhab.experts.arm import motion
from mjhab.experts.mishap import Mishap
from mjhab.robots.parts import ActionColumns
from mjhab.tasks.style import ANY, BURSTS, PLAIN, RULE, SMOOTH, VISIBLE, Style

NOISE_MEMORY = 0.86
"""Factor of the smooth noise from one control step to the next: its time constant is a third of a second."""
BURST_STEPS = (5, 30)
"""Least and largest duration of a burst of noise, and of the pause before it [control steps]."""
FULL_NOISE_ACTION = 0.25
"""Size of an action (of -1..1) above which noise has its full scale. For smaller actions it is reduced in proportion,
because success requires a robot that stands still, and the hand must be still while its fingers close."""


class StyledView(WorldView):
    """A view for a script that acts in a style.

    A slowed script acts as if its control steps were longer, so that the joint velocities it reads are divided by
    ``style.speed``.
    """

    def __init__(self, env: PolicyWorlds, world: int) -> None:
        super().__init__(env, world)
        self.style = PLAIN

    @property
    def qd(self) -> np.ndarray:
        """(J,) joint velocities [m/s, rad/s] divided by the speed of the style."""
        return super().qd / self.style.speed


def style_of(view: WorldView) -> Style:
    """Style of a view; `PLAIN` for a view without one."""
    return view.style if isinstance(view, StyledView) else PLAIN


def follows_rule(view: WorldView) -> bool:
    """Whether the style asks for a rule instead of a search, see `tasks.style.Style.plan`.

    What a script does by the rule depends on what a policy can observe: not on the time that is left, and hardly on
    where the robot starts.
    """
    return style_of(view).plan == RULE


def wait_for(view: WorldView, condition: motion.Until) -> motion.Until:
    """Condition that ends a wait early: ``condition`` if the style has visible waits, else `motion.never`.

    An imitating policy sees one state and cannot tell how long the expert has waited in it. With waits of a fixed
    duration most equal states are followed by more waiting, and the policy learns to wait for ever.
    """
    return condition if style_of(view).waits == VISIBLE else motion.never


def of_kind(grasps: Grasps, kind: str) -> Grasps:
    """Grasps with one approach direction: "top", "tilted", "side" or "any", see `candidates.KINDS`."""
    return (
        grasps
        if kind == ANY
        else grasps.take(np.flatnonzero(grasps.kind == KINDS.index(kind)))
    )


class ActionNoise:
    """Slows, disturbs and delays the actions of one episode.

    Args:
        style: how.
        columns: of the robot's actions.
        random: source of the noise, one stream per episode.
        begun: the episode has begun before: no standing still at the start.
    """

    def __init__(
        self,
        style: Style,
        columns: ActionColumns,
        random: np.random.Generator,
        *,
        begun: bool = False,
    ) -> None:
        self.style = style
        self._columns = columns
        self._base = [columns.base_forward, columns.base_yaw]
        self._random = random
        self._phase = 1.0
        self._mishap = Mishap(columns, random) if style.mishap else None
        self._noise = np.zeros(self._columns.dim)
        self._in_burst = False
        self._stretch = 0
        """Control steps left of the burst or pause."""
        self.holds = 0 if begun else style.hold
        """Control steps for which the robot still stands before it begins."""

    def due(self) -> bool:
        """Whether the script gives its next action in this control step; else the last action is repeated."""
        # A slowed script acts in a share of the control steps.
        self._phase += self.style.speed
        # Speeds such as 0.1 do not add up to 1 exactly: without the tolerance one step in ten would be lost.
        if self._phase < 2.0 - 1e-9:
            return False
        self._phase -= 1.0
        return True

    def wait(self, still: np.ndarray) -> np.ndarray:
        """The executed action (A,) of a control step before the beginning, where ``still`` (A,) is intended."""
        self.holds -= 1
        if not self.style.dither:
            return still
        scale = np.zeros(self._columns.dim)
        scale[self._columns.arm] = self.style.dither
        return self._disturbed(still, scale)

    def slow(self, action: np.ndarray) -> np.ndarray:
        """Intended action (A,) float32: the script's ``action`` (A,) times the speed, except for the gripper."""
        out = action * np.float32(self.style.speed)
        # The gripper's action is a position, not a speed: scaled, it would open or close half.
        out[self._columns.gripper] = action[self._columns.gripper]
        return out

    def disturb(self, intended: np.ndarray) -> np.ndarray:
        """Executed action (A,) float32: ``intended`` (A,) plus noise, except for the gripper; or that of a mishap."""
        executed = self._noisy(intended)
        return self._mishap.befall(intended, executed) if self._mishap else executed

    def _noisy(self, intended: np.ndarray) -> np.ndarray:
        style = self.style
        if not (style.noise or style.base_noise):
            return intended
        if style.noise_kind == BURSTS:
            return self._burst(intended)
        scale = np.zeros(self._columns.dim)
        # By the largest joint, because an arm that moves one joint is in motion as a whole.
        scale[self._columns.arm] = style.noise * min(
            1.0, float(np.abs(intended[self._columns.arm]).max()) / FULL_NOISE_ACTION
        )
        scale[self._base] = style.base_noise * min(
            1.0, float(np.abs(intended[self._base]).max()) / FULL_NOISE_ACTION
        )
        return self._disturbed(intended, scale)

    def _burst(self, intended: np.ndarray) -> np.ndarray:
        """Executed action (A,) with noise in bursts, also while the robot is at rest.

        Data with noise only during motions do not show how to return to rest. Success requires a robot that stands
        still, which it does in the pauses.
        """
        if self._stretch == 0:
            self._in_burst = not self._in_burst
            self._stretch = int(self._random.integers(BURST_STEPS[0], BURST_STEPS[1] + 1))
        self._stretch -= 1
        scale = np.zeros(self._columns.dim)
        if self._in_burst:
            scale[self._columns.arm] = self.style.noise
            scale[self._columns.body] = self.style.noise
            scale[self._base] = self.style.base_noise
        return self._disturbed(intended, scale)

    def _disturbed(self, action: np.ndarray, scale: np.ndarray) -> np.ndarray:
        fresh = self._random.standard_normal(self._columns.dim)
        if self.style.noise_kind == SMOOTH:
            self._noise = (
                # The factor of the fresh part keeps the variance at 1, so that the scale means the same for every kind
                # of noise.
                NOISE_MEMORY * self._noise + np.sqrt(1.0 - NOISE_MEMORY**2) * fresh
            )
        else:
            self._noise = fresh
        return np.clip(action + scale * self._noise, -1.0, 1.0).astype(np.float32)
