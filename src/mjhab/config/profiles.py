"""Profiles: named sets of option values, so that an environment is that of one publication as a whole.

"mjhab" is the default: it gives the options their usual values and binds none of them. "ms_hab" is the environment in
which the MS-HAB paper trained and evaluated; its values may not be contradicted, so that a result under its name is
comparable with the paper's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from mjhab.core.conventions.names import OBJECT_AXES, SCAN_AXES, UNWRAPPED, WRAPPED
from mjhab.core.errors import unknown_name

DEFAULT_PROFILE = "mjhab"
SPAWN_RULES = ("front_box", "published")
"""Where the robot starts and with which arm, see `Profile.spawn_rule`."""
OF_PAPER = 0
"""Horizon that stands for those of the `SubtaskSpec`: 200 control steps, Navigate 500, or 1,000 in training."""


FREE_OPTIONS = ("horizon", "frame_stack")
"""Options that a binding profile leaves free: the original itself evaluates and trains with several values of them
(200 control steps of its evaluations, one frame of behaviour cloning, two of its diffusion policy)."""


@dataclass(frozen=True)
class Profile:
    """Values of the options of `config.EnvConfig` that have the same names.

    name: what ``profile`` is set to. binding: an option that is given with another value is an error, but for
    FREE_OPTIONS.
    stillness: see `TaskConfig.stillness`.
    spawn_rule: "front_box": Pick and Place at a link begin in the area in front of it, Place with the arm at rest;
        "published": anywhere within 2 m, Place with the arm of a successful Pick, see `starts` and `carry_postures`.
    stationary: parts of the robot that do not follow their actions (mshab/envs/wrappers/action.py: the head).
    force_limits: whether the limits on the cumulative force are in force; they are those of the paper.
    reward_formula, reward_normaliser: see `tasks.scoring.RewardOptions`.
    cameras: whose images are observed, in this order; None for all of the robot's.
    frame_stack: frames that `wrappers.FrameStack` stacks.
    handle_points: "ours" or "published": which points observations and rewards take for handles.
    object_axes, joint_angles: how observations tell poses of objects and angles of joints, see
        `core.conventions`.
    joint_dynamics: "ours" or "published": damping, friction, stops and range of the joints of furniture, see
        `layout.joints`. The default profile has ours: those of drawers and doors that stay where they are left, where
        the published numbers are one placeholder for all joints; and what was recorded before there was a choice.
    horizon, train_horizon: control steps of a subtask that is evaluated, and that is trained; Navigate has those of
        the paper in both.
    """

    name: str
    binding: bool
    stillness: str
    spawn_rule: str
    stationary: tuple[str, ...]
    force_limits: bool
    reward_formula: str
    reward_normaliser: str
    cameras: tuple[str, ...] | None
    frame_stack: int
    handle_points: str
    object_axes: str
    joint_angles: str
    joint_dynamics: str
    horizon: int
    train_horizon: int

    def options(self, subtask: str, *, trains: bool) -> dict[str, Any]:
        """Values of the options that depend on a profile; ``cameras`` only where it names some.

        Args:
            subtask: the one done alone, "" for a whole chain.
            trains: for an environment of `make_train`.
        """
        apart = ("name", "binding", "horizon", "train_horizon")
        values = {
            field.name: getattr(self, field.name)
            for field in fields(self)
            if field.name not in apart
        }
        # None is no list of cameras: `EnvConfig` then takes those of the robot.
        if values["cameras"] is None:
            del values["cameras"]
        # One number for all kinds would be Navigate's, too, which has more time.
        # Here: the command line names profiles in its help, which waits for no numpy.
        from mjhab.tasks.subtasks.registry import SUBTASKS

        alone = bool(subtask) and not SUBTASKS[subtask].navigates
        horizon = self.train_horizon if trains else self.horizon
        return {**values, "horizon": horizon if alone else OF_PAPER}


MJHAB = Profile(
    name=DEFAULT_PROFILE,
    binding=False,
    stillness="absolute",
    spawn_rule="front_box",
    stationary=(),
    force_limits=True,
    reward_formula="bounded",
    reward_normaliser="attainable",
    cameras=None,
    frame_stack=1,
    handle_points="ours",
    object_axes=OBJECT_AXES,
    joint_angles=WRAPPED,
    joint_dynamics="ours",
    horizon=OF_PAPER,
    train_horizon=OF_PAPER,
)
MS_HAB = Profile(
    name="ms_hab",
    binding=True,
    stillness="published",
    spawn_rule="published",
    stationary=("head",),
    force_limits=True,
    reward_formula="published",
    reward_normaliser="published",
    cameras=None,
    frame_stack=3,
    handle_points="published",
    object_axes=SCAN_AXES,
    joint_angles=UNWRAPPED,
    joint_dynamics="published",
    horizon=200,
    train_horizon=100,
)
PROFILES: dict[str, Profile] = {profile.name: profile for profile in (MJHAB, MS_HAB)}


def profile_named(name: str) -> Profile:
    """The profile of a name.

    Raises:
        UsageError: there is none; the message lists the names.
    """
    if name not in PROFILES:
        raise unknown_name("profile", name, PROFILES)
    return PROFILES[name]


def unbound(options: Mapping[str, Any], subtask: str, *, trains: bool) -> dict[str, Any]:
    """Environment options with the values of their profile as single options, so that others may differ from it.

    A binding profile allows no other value, so the profile of the result is the default one. The environment still
    counts as one of the profile where it differs in the horizon only, see `learning.observation.spec.profile_of`.

    Args:
        options: environment options. subtask: "" for a whole task. trains: for an environment of training.
    """
    values = profile_named(options.get("profile", DEFAULT_PROFILE)).options(
        subtask, trains=trains
    )
    return {**values, **options, "profile": DEFAULT_PROFILE}
