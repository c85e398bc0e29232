"""Options and types of options that several commands share; tyro turns the dataclasses into the command line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.config.profile_choice import ProfileChoice
from mjhab.config.profiles import DEFAULT_PROFILE

Sub = tyro.conf.subcommand
Number = Annotated[int, tyro.conf.arg(metavar="N")]
Name = Annotated[str, tyro.conf.arg(metavar="NAME")]
MaybeName = Annotated[str | None, tyro.conf.arg(metavar="NAME")]
PolicyName = Annotated[str, tyro.conf.arg(metavar="NAME|FILE.py:CLASS|ws://HOST:PORT")]
Numbers = Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")]
Backend = Annotated[str, tyro.conf.arg(metavar="auto|cpu|warp")]
Device = Annotated[str, tyro.conf.arg(metavar="DEVICE")]
Assets = Annotated[str, tyro.conf.arg(metavar="builtin|FOLDER")]
StageMesh = Annotated[Path | None, tyro.conf.arg(metavar="FILE.glb")]
Joints = Annotated[str | None, tyro.conf.arg(metavar="NAME,NAME")]


@dataclass(frozen=True, kw_only=True)
class MemoryOptions:
    """The option of long-running commands; `cli.main.run` applies it."""

    cache_mb: Annotated[float | None, tyro.conf.arg(metavar="MB")] = None
    """Limit of the cache of homes, maps and episodes in memory [MB]; $MJHAB_CACHE_MB, else 512, if absent. Changes the
    speed, never the results."""


@dataclass(frozen=True, kw_only=True)
class ProfileOptions(ProfileChoice):
    """Options of all commands that build environments for policies."""

    profile: Annotated[str, tyro.conf.arg(metavar="mjhab|ms_hab")] = DEFAULT_PROFILE
    """Values of many options at once: ms_hab is the environment of the MS-HAB paper (see docs/environments.md)."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """The robot (see: mjhab robots list); the default one if absent."""
    starts: Annotated[str | None, tyro.conf.arg(metavar="front_box|published")] = None
    """Start positions of Pick and Place at a drawer or fridge, and start posture of the arm in Place (spawn_rule of an
    environment); the profile's if absent."""
    stillness: Annotated[str | None, tyro.conf.arg(metavar="absolute|published")] = None
    """Whether a joint that moves backwards counts as moving (absolute) or as still; the profile's if absent."""
    joint_dynamics: Annotated[str | None, tyro.conf.arg(metavar="ours|published")] = None
    """Damping, friction, stops and range of doors and drawers: mjhab's, or those of their files; the profile's if
    absent."""


@dataclass(frozen=True, kw_only=True)
class PolicyProfileOptions(ProfileOptions):
    """`ProfileOptions` of commands whose policy or data may have a profile of their own."""

    profile: Annotated[str, tyro.conf.arg(metavar="mjhab|ms_hab")] = ""
    """Values of many options at once: ms_hab is the environment of the MS-HAB paper (see docs/environments.md). If
    absent, the one that the checkpoint or the data were made with, else mjhab."""
