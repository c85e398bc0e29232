"""Perturbations: what a `Perturbation` is, their registry, and which of them an environment is asked for.

One axis (camera, light, language, ...) has five levels. What it changes in an episode is drawn from (seed, index, axis,
level) alone, by streams of its own: everything that is not perturbed stays as it is without, bit by bit.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from mjhab.core.errors import MjhabError, UsageError, about, fault, wrong_value
from mjhab.core.names import check_name
from mjhab.core.registration.plugins import raised_text
from mjhab.core.registration.registry import Registry, check_item
from mjhab.core.seeding import EpisodeId, stream
from mjhab.robots.robot import Robot

LEVELS = 5
"""Levels of every axis, 1 to 5; 0 is the episode without the perturbation."""
MAX_DRAWS = 20
"""So often a change of a start that is impossible is drawn anew; then the start stays as it is."""
# A sign is read, too, so that the message about the level names what was given.
_ENTRY = re.compile(r"\s*([^:,\s]+)\s*:\s*(-?\d+)\s*")
ALL = "all"
"""In place of the names of all axes."""
AXES = ("camera", "light", "colours", "layout", "start", "language", "noise")
"""Names of the axes of mjhab itself."""


@dataclass(frozen=True)
class Quantity:
    """One number of an axis.

    Attributes:
        unit: such as "m", "deg", "px"; "" for counts and shares.
        levels: its value at levels 1 to 5.
        meaning: what it is, a phrase.
    """

    unit: str
    levels: tuple[float, ...]
    meaning: str


@dataclass(frozen=True)
class Drawn(EpisodeId):
    """What one axis does in one episode.

    Attributes:
        axis: name of the perturbation.
        level: 1 to 5.
        amounts: the numbers of the level, by name of the quantity.
        values: what `Perturbation.draw` drew of them, plain data.
    """

    axis: str
    level: int
    amounts: Mapping[str, float]
    values: Mapping[str, Any] = field(default_factory=dict)

    def stream(self, *keys: int | str) -> np.random.Generator:
        """A stream of random numbers of this axis and level in this episode; other keys, other numbers."""
        # The level is a key, so that the levels of one episode are drawn independently of each other.
        return stream(self.seed, "perturbation", self.axis, self.level, self.index, *keys)


@dataclass(frozen=True, eq=False)
class MountChange:
    """How a camera of the robot differs from where it should be.

    Attributes:
        shift: (3,) change of its position in its own axes (x right, y up, z backwards) [m].
        turn: (3,) rotation vector in its own axes [rad].
        widen: factor of the tangent of half its field of view.
    """

    shift: np.ndarray
    turn: np.ndarray
    widen: float


@dataclass(frozen=True, eq=False)
class ActionFrame:
    """What the entries of an action are.

    Attributes:
        half: (A,) half the range of every entry.
        gripper: number of the gripper's entry.
        base: numbers of the entries of the base.
    """

    half: np.ndarray
    gripper: int
    base: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class PictureFrame:
    """How and when C images were taken.

    Attributes:
        step: control steps since the start of the episode.
        mat: (C, 3, 3) orientations of the cameras, world frame; columns x right, y up, z backwards.
        focal: (C,) focal lengths [px].
    """

    step: int
    mat: np.ndarray
    focal: np.ndarray


class StartScene(Protocol):
    """The start of an episode, for perturbations of it."""

    @property
    def robot(self) -> Robot:
        """The robot."""
        ...

    def moved(self, base: np.ndarray, arm: np.ndarray) -> np.ndarray | None:
        """The start with the robot elsewhere; None if that is impossible.

        Args:
            base: (3,) change of its x, y [m], world, and yaw [rad].
            arm: (A,) changes of the arm's joints [m or rad].
        """
        ...


class ObjectScene(Protocol):
    """Where the objects of an episode are, for perturbations of it."""

    @property
    def distractors(self) -> Sequence[int]:
        """Slots of the objects that are no target of the episode."""
        ...

    def beside_target(
        self, slots: Sequence[int], gap: float, random: np.random.Generator
    ) -> np.ndarray | None:
        """Poses (N, 7) of all objects with some of them beside the target; None if they have no room there.

        Args:
            slots: those that are put there.
            gap: least gap [m] to the target and between each other.
            random: draws the places.
        """
        ...


class Perturbation:
    """An axis of perturbations; a subclass sets the attributes and overrides what it changes.

    Every hook gets the `Drawn` of the episode, whose `Drawn.stream` is its only source of randomness. None of them is
    called where the axis is not asked for.
    """

    name: str = ""
    """Name of the axis."""
    about: str = ""
    """What it changes, a phrase."""
    quantities: Mapping[str, Quantity] = {}
    """Its numbers, by name."""
    on_device: bool = False
    """Whether backend warp has it: it changes starts or sentences alone, which the host makes."""
    needs: tuple[str, ...] = ()
    """Images that are drawn for `picture` besides those that are observed: "depth", "seg"."""
    images: tuple[str, ...] = ("rgb", "depth", "seg", "target_depth")
    """Images that `picture` changes."""

    def draw(self, drawn: Drawn, robot: Robot) -> Mapping[str, Any]:
        """Plain data that is drawn once for an episode and recorded with it."""
        return {}

    def furniture(self, drawn: Drawn) -> float:
        """The largest distance [m] by which chairs and other loose furniture are moved; of the level alone."""
        raise NotImplementedError

    def objects(
        self, drawn: Drawn, scene: ObjectScene, attempt: int
    ) -> tuple[np.ndarray, Mapping[str, Any]] | None:
        """Poses (N, 7) of the objects, and what is recorded of it; None if this attempt is impossible."""
        raise NotImplementedError

    def start(
        self, drawn: Drawn, scene: StartScene, attempt: int
    ) -> tuple[np.ndarray, Mapping[str, Any]] | None:
        """State (nq,) in which the episode starts, and what is recorded of it; None if this attempt is impossible."""
        raise NotImplementedError

    def sentence(self, drawn: Drawn, text: str, number: int) -> str:
        """An instruction in other words; ``number``: its place among those of the episode."""
        raise NotImplementedError

    def mount(self, drawn: Drawn, camera: str) -> MountChange:
        """How a camera of the robot differs from where it should be; observed parameters do not tell."""
        raise NotImplementedError

    def looks(self, drawn: Drawn, image: np.ndarray) -> np.ndarray:
        """The material (M,) that each of the M of the scene is drawn as in the whole episode, by the rasterizer.

        ``image``: (M,) bool, materials with an image that fits the mesh which it was made for.
        """
        raise NotImplementedError

    def picture(
        self, drawn: Drawn, images: Mapping[str, np.ndarray], frame: PictureFrame
    ) -> None:
        """Change the images of a control step in place.

        Args:
            drawn: of the episode.
            images: of C cameras: "rgb" (C, h, w, 3) uint8, "depth" (C, h, w) float32 [m], 0 where nothing is hit,
                "seg" (C, h, w) int32, "target_depth" (C, h, w) uint8; those that are there.
            frame: how and when they were taken.
        """
        raise NotImplementedError

    def delay(self, drawn: Drawn) -> int:
        """Control steps by which actions come late."""
        raise NotImplementedError

    def act(
        self, drawn: Drawn, action: np.ndarray, frame: ActionFrame, step: int
    ) -> np.ndarray:
        """The action (A,) float32 that is executed in place of ``action``."""
        raise NotImplementedError

    def reaches(self, images: Collection[str], reads_instruction: bool) -> bool:
        """Whether it may change what a policy does.

        Args:
            images: those that the policy sees, or that what it sees is made of.
            reads_instruction: whether it may read instructions.
        """
        seen = {
            "sentence": reads_instruction,
            "mount": bool(images),
            "looks": "rgb" in images,
            "picture": bool({*images} & {*self.images}),
        }
        return any(seen.get(hook, True) for hook in self.hooks)

    def amounts(self, level: int) -> dict[str, float]:
        """Its numbers at a level, by name of the quantity."""
        return {
            name: quantity.levels[level - 1] for name, quantity in self.quantities.items()
        }

    @cached_property
    def hooks(self) -> frozenset[str]:
        """Names of the hooks that it overrides."""
        return frozenset(
            name
            for name in HOOKS
            if getattr(type(self), name) is not getattr(Perturbation, name)
        )


HOOKS = (
    "furniture",
    "objects",
    "start",
    "sentence",
    "mount",
    "looks",
    "picture",
    "delay",
    "act",
)
"""Methods of a `Perturbation` that change something."""

PERTURBATIONS: Registry[Perturbation] = Registry(
    "axis of perturbation",
    {name: f"mjhab.envs.perturbations.{name}:{name.upper()}" for name in AXES},
)
"""All axes, those of mjhab itself first."""


def register_perturbation(perturbation: Perturbation) -> Perturbation:
    """Make an axis known to ``mjhab.make(perturb="NAME:3")`` and to all commands; return it.

    Raises:
        UsageError: it is no `Perturbation`, its name is taken, or a quantity has other than five numbers.
    """
    check_item("register_perturbation", perturbation, Perturbation)
    where = f"perturbation {perturbation.name!r}"
    check_name("name of the axis of perturbation", perturbation.name)
    for name, quantity in perturbation.quantities.items():
        if len(quantity.levels) != LEVELS:
            raise wrong_value(
                f"levels of {name}", quantity.levels, f"{LEVELS} numbers", where=where
            )
    # It would be recorded with every episode and change none of them.
    if not perturbation.hooks:
        raise fault(where, f"changes nothing: override one of {', '.join(HOOKS)}.")
    return PERTURBATIONS.add(perturbation.name, perturbation)


def parse_axes(asked: str | Mapping[str, Any], option: str = "perturb") -> dict[str, int]:
    """Axes and their levels of a text such as "camera:3,light:2", or of a mapping, in the order of the registry.

    ``ALL`` alone names every axis: "all:2".

    Raises:
        UsageError: there is no such axis or level, or an axis is named twice.
    """
    found: dict[str, int] = {}
    entries = _entries(asked, option)
    # Alone only: beside other axes it would be unclear which level those have.
    if [axis for axis, _ in entries] == [ALL]:
        entries = [(axis, entries[0][1]) for axis in PERTURBATIONS]
    for axis, level in entries:
        # First the name alone is looked at: for a misspelt axis the list of axes helps more than the form.
        with about(option, UsageError):
            PERTURBATIONS.check(axis)
        if (
            isinstance(level, bool)
            or not isinstance(level, int)
            or not 1 <= level <= LEVELS
        ):
            raise wrong_value(f"level of {axis}", level, f"1 to {LEVELS}", where=option)
        if axis in found:
            raise UsageError(f"{option} names {axis!r} twice.", option=option, given=axis)
        found[axis] = level
    # In one order, whatever the order of the words: it is part of records and of hashes.
    return {axis: found[axis] for axis in PERTURBATIONS if axis in found}


def _entries(asked: str | Mapping[str, Any], option: str) -> list[tuple[str, Any]]:
    if isinstance(asked, Mapping):
        return list(asked.items())
    found: list[tuple[str, Any]] = []
    for part in filter(None, (part.strip() for part in asked.split(","))):
        entry = _ENTRY.fullmatch(part)
        if entry is None:
            with about(option, UsageError):
                PERTURBATIONS.check(part.partition(":")[0].strip())
            raise wrong_value(
                option,
                asked,
                f"AXIS:LEVEL,... with levels 1 to {LEVELS}, such as camera:3,light:2",
            )
        found.append((entry[1], int(entry[2])))
    return found


def axes_text(axes: Mapping[str, int]) -> str:
    """The text that `parse_axes` reads: "camera:3,light:2"."""
    return ",".join(f"{axis}:{level}" for axis, level in axes.items())


@dataclass(frozen=True)
class PerturbationPlan:
    """Which axes an environment perturbs.

    Attributes:
        fixed: axes at one level in every episode.
        random: axes whose level is drawn for every episode, from 0 (without it) to the one that is named.
    """

    fixed: Mapping[str, int]
    random: Mapping[str, int]

    def __bool__(self) -> bool:
        return bool(self.fixed or self.random)

    @property
    def axes(self) -> tuple[Perturbation, ...]:
        """All of them, in the order of the registry."""
        return tuple(
            PERTURBATIONS[axis]
            for axis in PERTURBATIONS
            if axis in self.fixed or axis in self.random
        )

    def drawn(self, seed: int, index: int, robot: Robot) -> tuple[Drawn, ...]:
        """What the axes do in the episode (seed, index); an axis whose level is 0 there is left out.

        Raises:
            UsageError: a plugin's perturbation raises, or draws what is no plain data.
        """
        found = []
        for axis in self.axes:
            level = self._level(axis.name, seed, index)
            if level:
                amounts = axis.amounts(level)
                bare = Drawn(seed, index, axis.name, level, amounts)
                values = called(axis.name, "draw", bare, robot)
                # A copy: a plugin may keep the mapping that it returned, and change it.
                found.append(Drawn(seed, index, axis.name, level, amounts, dict(values)))
        return tuple(found)

    def shifts(self) -> tuple[float, ...]:
        """The distances [m] by which furniture may be moved, of all levels that an episode can have."""
        found = set()
        for axis in self.axes:
            if "furniture" not in axis.hooks:
                continue
            highest = self.fixed.get(axis.name, self.random.get(axis.name, 0))
            # Level 0 moves nothing and needs no pack of its own.
            lowest = highest if axis.name in self.fixed else 1
            for level in range(lowest, highest + 1):
                # Any seed and index do: the hook depends on the level alone.
                bare = Drawn(0, 0, axis.name, level, axis.amounts(level))
                found.add(float(called(axis.name, "furniture", bare)))
        return tuple(sorted(found))

    def _level(self, axis: str, seed: int, index: int) -> int:
        if axis in self.fixed:
            return self.fixed[axis]
        # Apart from the streams of the axes, so that a drawn level gives what the same fixed level gives.
        random = stream(seed, "perturbation level", axis, index)
        return int(random.integers(self.random[axis] + 1))

    def check_device(self) -> None:
        """Refuse what backend warp does not have.

        Raises:
            UsageError: names the axes.
        """
        lacking = [axis.name for axis in self.axes if not axis.on_device]
        if lacking:
            has = [name for name in PERTURBATIONS if PERTURBATIONS[name].on_device]
            raise UsageError(
                f"backend 'warp' does not perturb {', '.join(lacking)}, only {', '.join(has)}; take backend 'cpu'.",
                option="perturb",
                given=lacking,
                expected=tuple(has),
            )


def called(axis: str, hook: str, *args: Any) -> Any:
    """What a hook of an axis returns.

    Raises:
        UsageError: it raises; the message names the axis and the plugin that has registered it.
    """
    try:
        return getattr(PERTURBATIONS[axis], hook)(*args)
    # Errors that already say what to do keep their words.
    except MjhabError:
        raise
    # A plugin is code of others, which raises whatever it likes.
    except Exception as error:
        raise UsageError(
            f"{PERTURBATIONS.described(axis)}: {hook} raised {raised_text(error)}.",
            option="perturb",
            given=axis,
        ) from error


def described(
    drawn: Sequence[Drawn], more: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """What is recorded of an episode, by axis: the level, what was drawn, and ``more`` that came of it."""
    return {
        one.axis: {"level": one.level, **one.values, **more.get(one.axis, {})}
        for one in drawn
    }
