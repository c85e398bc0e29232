"""Dense rewards as tables of terms: the terms, the quantities that they read, and shared functions for raw values.

A term is ``scale`` times a raw value between 0 and 1, given while its condition ``when`` holds. Terms, scales and
shapes are those of mshab/envs/{pick,place,open,close,navigate}.py, with Euclidean distances and absolute speeds.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.arrays import Array, constant, namespace, pile
from mjhab.core.errors import unknown_name, wrong_value
from mjhab.core.joints import BASE_X, BASE_YAW
from mjhab.tasks.posture import off_rest
from mjhab.tasks.signals import Signals, WorldState
from mjhab.tasks.thresholds import TaskConfig

ALWAYS = "always"
"""Condition of terms that are added in every step."""
FREE_FORCE = 0.2
"""Scaled contact force below which the force term is 0."""
HAND_FORCE_PER_NEWTON = 0.001
"""Scale of contact forces in Pick and Place [1/N]; with FREE_FORCE, forces below 200 N are free."""
IDEAL_SPEED = {"hinge": 2.0, "slide": 1.0}
"""Largest joint speed without penalty by type of joint: doors [rad/s], drawers [m/s]."""
CLOSED_NEAR_M = 0.3
"""Largest distance between tool centre and handle at which a closing link counts as closed by the hand [m]."""
READABLE = ("object_vel", "joint", "nav_distance")
"""Fields of `RewardView` that are computed only for tables that name them in ``RewardTable.reads``; zero for others."""


@dataclass(frozen=True)
class RewardView:
    """Inputs of a dense reward: W worlds after a control step, active subtask. World frame, SI units."""

    world: WorldState
    signals: Signals
    tcp_vel: Array
    """(W, 3) velocity of the tool centre [m/s]."""
    object_pos: Array
    """(W, 3) position of the subtask's object."""
    object_vel: Array
    """(W, 6) linear [m/s] and angular [rad/s] velocity of the object; zero unless the table reads "object_vel"."""
    goal_pos: Array
    """(W, 3) goal of the object, or goal of the base in Navigate."""
    torso_up: Array
    """(W,) height of the torso as a share of its travel."""
    handle_distance: Array
    """(W,) distance from the tool centre to the handle [m]; zero unless the table reads "joint", as are the next two
    and closed_near."""
    joint_qd: Array
    """(W,) velocity of the link's joint [m/s or rad/s]."""
    joint_ideal: Array
    """(W,) largest speed of the joint without penalty [m/s or rad/s]."""
    open_frac: Array
    """(W,) part of its range at which the link counts as open."""
    nav_distance: Array
    """(W,) length of the way to the navigation goal around obstacles [m]; zero unless the table reads
    "nav_distance"."""
    closed_near: Array
    """(W,) bool: the link has been closed while the tool centre was near its handle, see `closed_near`."""


@dataclass(frozen=True)
class Term:
    """One row of a reward table."""

    name: str
    scale: float
    when: str
    """Name of the condition under which the term is added; the raw function of the table computes it."""
    about: str
    """Description: the rewarded behaviour, and the formula of the raw value if it is not 1."""


RawFunction = Callable[
    [RewardView, TaskConfig], tuple[dict[str, Array], dict[str, Array]]
]
"""(view, config) to the conditions, name to (W,) bool, and the raw values, name to (W,) in [0, 1]; a term without a
raw value is worth 1 while its condition holds."""


@dataclass(frozen=True)
class RewardTable:
    """The dense reward of one kind of subtask.

    Raises:
        UsageError: ``reads`` names something other than READABLE.
    """

    terms: tuple[Term, ...]
    cases: tuple[tuple[str, ...], ...]
    """Sets of conditions that can hold at the same time, besides ALWAYS; one set per stage of the subtask."""
    raw: RawFunction
    published: float | None = None
    """Normaliser of the published code; None if it lacks the subtask."""
    reads: tuple[str, ...] = ()
    """Names from READABLE that the raw function needs."""
    raw_published: RawFunction | None = None
    """Conditions and raw values of the published code; None if they do not differ from ``raw``."""

    def __post_init__(self) -> None:
        for name in self.reads:
            if name not in READABLE:
                raise unknown_name("reading of a reward table", name, READABLE)

    @property
    def attainable(self) -> float:
        """Largest possible sum of the terms over ``cases``: raw values are 1, or 0 for terms with a negative scale."""
        return max(
            # Not ``sum``, whose last bit depends on the version of Python.
            ordered_sum(
                max(t.scale, 0.0) for t in self.terms if t.when in (ALWAYS, *case)
            )
            for case in self.cases
        )

    def in_formula(self, formula: str) -> RewardTable:
        """The table with the raw values of "bounded" or of "published", see `rewards.RewardOptions`."""
        if formula == "bounded" or self.raw_published is None:
            return self
        return dataclasses.replace(self, raw=self.raw_published)

    def scaled(self, kind: str, scales: Mapping[str, float]) -> RewardTable:
        """The table with other scales for some terms.

        Args:
            kind: name of the subtask, for messages.
            scales: new scale by name of the term.

        Raises:
            UsageError: no such term, or a scale that is not a finite number.
        """
        for name, scale in scales.items():
            if name not in {t.name for t in self.terms}:
                raise unknown_name(
                    f"reward term of {kind}", name, [t.name for t in self.terms]
                )
            if (
                isinstance(scale, bool)
                or not isinstance(scale, int | float)
                # Infinity would make every reward NaN.
                or not math.isfinite(scale)
            ):
                raise wrong_value(
                    f"the scale of reward term {kind}.{name}", scale, "a finite number"
                )
        terms = tuple(
            dataclasses.replace(t, scale=float(scales.get(t.name, t.scale)))
            for t in self.terms
        )
        return dataclasses.replace(self, terms=terms)


# -- raw measures ------------------------------------------------------------------------------------------------------


def near(
    sharpness: Mapping[str, float], distances: Mapping[str, Array]
) -> dict[str, Array]:
    """Compute ``1 - tanh(sharpness * distance)``, 1 at zero and falling to 0, for several terms in one call.

    Args:
        sharpness: factor by name; do not modify the dict later, because the array made from it is cached.
        distances: (W,) each, with the same names.

    Raises:
        UsageError: the names differ.
    """
    if sharpness.keys() != distances.keys():
        strange = ", ".join(sorted(sharpness.keys() ^ distances.keys()))
        raise wrong_value(
            "distances", strange, "names that sharpness has, too, and the other way round"
        )
    # One call of tanh for all terms: on small arrays the calls cost more than the arithmetic.
    rows = pile([distances[name] for name in sharpness])
    column = constant(tuple(sharpness.values()), rows)[:, None]
    return dict(zip(sharpness, 1 - namespace(rows).tanh(column * rows), strict=True))


def above_zero(x: Array) -> Array:
    """``max(x, 0)``."""
    return namespace(x).where(x > 0, x, 0.0)


def length(x: Array) -> Array:
    """Euclidean length (W,) of the rows of (W, n).

    The rows are made contiguous, so that the order of summation, and so the last bit, depends neither on the memory
    layout of ``x`` nor on the number of worlds.
    """
    xp = namespace(x)
    # Copies where rows are not contiguous, and else costs nothing.
    x = x.reshape(-1).reshape(x.shape)
    return xp.sqrt(xp.vecdot(x, x))


def force_excess(robot_force: Array, per_newton: float) -> Array:
    """Scaled excess of contact forces F (W,) [N], ``max(per_newton * F, 0.2) - 0.2``; the term is 1 - tanh(3 x)."""
    return above_zero(per_newton * robot_force - FREE_FORCE)


def posture_error(world: WorldState, config: TaskConfig) -> Array:
    """(W,) distance of torso, head and arm from rest, over all joints [m, rad], see `off_rest`."""
    return length(off_rest(world.robot_q, config))


def joint_speed(world: WorldState, config: TaskConfig) -> Array:
    """(W,) length of the joint velocities without the fingers [m/s, rad/s]."""
    return length(world.robot_qd[:, config.joints.body])


def torso_speed(world: WorldState, config: TaskConfig) -> Array:
    """(W,) speed of the torso, upwards [m/s]; 0 for a robot without one."""
    torso = config.joints.torso
    # Zeros of the same library, device and dtype.
    return world.robot_qd[:, BASE_X] * 0.0 if torso is None else world.robot_qd[:, torso]


def lengths(*vectors: Array) -> list[Array]:
    """Euclidean lengths (W,) of several (W, 3), by one call of each operation for all of them."""
    xp = namespace(vectors[0])
    return list(length(xp.concat(vectors)).reshape(len(vectors), -1))


def rest_distance(world: WorldState, config: TaskConfig) -> Array:
    """(W,) distance of the tcp from its rest position in front of the base [m]."""
    base = world.base_pose
    tcp = world.tcp_pos
    xp = namespace(base)
    rx, ry, rz = config.ee_rest_pos
    # Polar, with one cosine and one sine per world in place of four products.
    radius = math.hypot(rx, ry)
    heading = base[:, BASE_YAW] + math.atan2(ry, rx)
    dx = tcp[:, 0] - base[:, 0] - radius * xp.cos(heading)
    dy = tcp[:, 1] - base[:, 1] - radius * xp.sin(heading)
    dz = tcp[:, 2] - (config.base_height + rz)
    return xp.sqrt(dx * dx + dy * dy + dz * dz)


def share_left(gap: Array, whole: Array, *, bounded: bool = True) -> Array:
    """(W,) remaining share ``gap / whole`` of a motion, at least 0; 0 for motions without length.

    Args:
        gap: (W,) remaining distance.
        whole: (W,) whole distance.
        bounded: clip to 1; without it the share exceeds 1 where a joint is beyond its limit, as in the original.
    """
    xp = namespace(gap)
    # A joint without range would divide by zero.
    left = above_zero(gap) / xp.where(whole > 0, whole, 1.0)
    # Without the bound a joint beyond its start gives less than nothing, as in the published code.
    return xp.where(left < 1, left, 1.0) if bounded else left


def closed_near(before: Array, closed: Array, distance: Array) -> Array:
    """Whether the link is closed and the hand has been at the handle since it was: (W,) bool.

    Args:
        before: (W,) bool, the value one control step earlier; False at the start of a subtask.
        closed: (W,) bool, the link is closed now; a link that opens again loses the credit.
        distance: (W,) from the hand to the handle [m].
    """
    return closed & (before | (distance <= CLOSED_NEAR_M))
