"""ObservationSpec of a student's inputs and outputs: named entries, which are compared with those of an environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from mjhab.config.profiles import DEFAULT_PROFILE, FREE_OPTIONS, PROFILES, profile_named
from mjhab.core.conventions.names import OBJECT_AXES, UNWRAPPED, Conventions
from mjhab.core.errors import UsageError, shown
from mjhab.core.typed.options import read_record
from mjhab.learning.configs import InputConfig
from mjhab.learning.observation.backbone import BackboneSpec, opened
from mjhab.learning.observation.parts import (
    Entry,
    conditioning_parts,
    image_channels,
    image_keys,
    image_outputs,
    parts_of,
    seen_keys,
    width_of,
)
from mjhab.robots.registry import DEFAULT_ROBOT, robot_named
from mjhab.tasks.subtasks.registry import SUBTASKS

if TYPE_CHECKING:
    from mjhab.envs.parts.worlds import PolicyWorlds

OLDER_KINDS = ("pick", "place", "navigate", "open", "close")
"""Kinds of subtasks in the one-hot condition of older checkpoints, which do not list their kinds."""
MAX_STATE_WIDTH = 10_000
MAX_ACTIONS = 1000
"""Limits of layouts that a file describes; a mobile manipulator has some 40 numbers and 13 actions."""


@dataclass(frozen=True)
class ObservationSpec:
    """Inputs and outputs of a student.

    inputs: which inputs it has. state: entries of the state vector, in order. actions: names of the dimensions of an
    action. targets, kinds: types of targets and kinds of subtasks in the one-hot condition. control: of the
    environment, see `control_of`. profile: of the environment, see `profile_of`; it is the default profile for
    evaluations of the student. robot: its name; "" in older checkpoints, of the default robot. object_axes,
    joint_angles: conventions of the observations that it was trained with, see `observation.state`; older checkpoints
    do not say, and are of the defaults here. backbone: the pretrained network whose file ``inputs``
    names; None without one.
    """

    inputs: InputConfig
    state: tuple[Entry, ...]
    actions: tuple[str, ...]
    targets: tuple[str, ...]
    control: tuple[str, ...]
    profile: str = DEFAULT_PROFILE
    kinds: tuple[str, ...] = OLDER_KINDS
    robot: str = ""
    object_axes: str = OBJECT_AXES
    joint_angles: str = UNWRAPPED
    backbone: BackboneSpec | None = None

    @property
    def conventions(self) -> Conventions:
        """Of the observations that it was trained with."""
        return Conventions(self.object_axes, self.joint_angles)

    def in_conventions(self, conventions: Conventions) -> ObservationSpec:
        """The same layout with observations of other conventions."""
        return replace(self, **asdict(conventions))

    @property
    def robot_name(self) -> str:
        """Name of the robot; older checkpoints, which name none, are of the default robot."""
        return self.robot or DEFAULT_ROBOT

    @property
    def entries(self) -> tuple[Entry, ...]:
        """All entries of the vector of one observation."""
        return tuple(
            entry for part in parts_of(self.inputs) for entry in part.entries(self)
        )

    @property
    def width(self) -> int:
        """Width of the vector of one observation."""
        return sum(width for _, width in self.entries)

    def without_images(self) -> ObservationSpec:
        """The same layout for a network that sees no images."""
        inputs = replace(self.inputs, cameras=(), image_size=0, backbone="")
        return replace(self, inputs=inputs, backbone=None)

    @property
    def state_width(self) -> int:
        """Width of the state vector."""
        return sum(width for _, width in self.state)

    @property
    def measured_width(self) -> int:
        """Width of the first sections of the vector, which are normalized; those that are told follow."""
        return self.width - self.conditioning_width

    @property
    def conditioning_width(self) -> int:
        """Width of what the student is told about the active subtask, see `parts.code_of`."""
        return sum(width_of(part, self) for part in conditioning_parts(self.inputs))

    @property
    def image_keys(self) -> tuple[str, ...]:
        """Keys of the images in the observation."""
        return image_keys(self.inputs)

    @property
    def image_channels(self) -> tuple[int, ...]:
        """Number of channels of each of these images."""
        return image_channels(self.inputs)

    def to_plain(self) -> dict[str, Any]:
        """The layout as JSON data, without the inputs, which are part of the student's config."""
        values = asdict(self)
        del values["inputs"]
        return values

    @classmethod
    def from_plain(
        cls, inputs: InputConfig, values: Mapping[str, Any]
    ) -> ObservationSpec:
        """Build from the dict of ``to_plain``, also after a round trip through JSON.

        Raises:
            ValueError: a field is missing, unknown or does not fit; the message names it.
        """
        layout: ObservationSpec = read_record(
            cls, {**values, "inputs": asdict(inputs)}, "layout"
        )
        widths = [width for _, width in layout.state]
        # A file from elsewhere could ask for a first layer of any size.
        if min(widths, default=1) < 1 or sum(widths) > MAX_STATE_WIDTH:
            raise ValueError(
                f"layout.state: widths {shown(widths)} are none of a state vector."
            )
        if not 1 <= len(layout.actions) <= MAX_ACTIONS:
            raise ValueError(f"layout.actions: {len(layout.actions)} names of actions.")
        if len(layout.control) < 2:
            raise ValueError("layout.control: expected control mode and kind of base.")
        return layout

    def check_env(self, env: PolicyWorlds, pool: int = 1) -> None:
        """Refuse an environment whose observations or actions differ from those that the student was trained with.

        Args:
            env: the environment.
            pool: how many times as wide and high its images are.

        Raises:
            UsageError: names the differing entries and the options of a matching environment.
        """
        # Other stationary joint groups than in training are allowed, like another profile: their actions are ignored.
        control = (*control_of(env)[:2], *self.control[2:])
        wrong = compare_specs(self, state_of(env), actions_of(env), control)
        size = (pool * self.inputs.image_size, pool * self.inputs.image_size)
        shapes = {entry.key: tuple(entry.shape) for entry in env.observer.table}
        for key in seen_keys(self.inputs):
            if key not in shapes:
                wrong.append(f"{key} is missing")
            elif shapes[key][:2] != size:
                wrong.append(
                    f"{key} is {shapes[key][1]}x{shapes[key][0]} px instead of {size[1]}x{size[0]}"
                )
        if wrong:
            raise UsageError(
                f"the checkpoint does not fit this environment: {'; '.join(wrong)}. It was trained with "
                f"{describe_options(self.env_options())}."
            )

    def pool_in(self, env: PolicyWorlds) -> int:
        """How many times as wide the images of an environment are as the student's; 1 where that is no whole number."""
        shapes = {entry.key: tuple(entry.shape) for entry in env.observer.table}
        for key in seen_keys(self.inputs):
            width = shapes[key][1] if key in shapes else 0
            # Pixels are averaged in whole blocks.
            if width and width % self.inputs.image_size == 0:
                return width // self.inputs.image_size
        return 1

    def env_options(self) -> dict[str, Any]:
        """Options of an environment with the observations, actions and profile that the student was trained with."""
        mode, base = self.control[:2]
        options: dict[str, Any] = {
            "profile": self.profile,
            "control_mode": mode,
            "base": base,
        }
        if self.robot:
            options["robot"] = self.robot
        # What the profile says already would be refused by one that is binding.
        if tuple(self.control[2:]) != profile_named(self.profile).stationary:
            options["stationary"] = tuple(self.control[2:])
        return options | image_options(self.inputs)


def inputs_of_robot(inputs: InputConfig, robot: str) -> InputConfig:
    """The inputs with the cameras of a robot in place of those that the presets name.

    Args:
        inputs: of a preset, or with cameras of the caller's choice, which stay.
        robot: its name; "" for the default robot, whose cameras the presets name.

    Raises:
        UsageError: there is no such robot.
    """
    # Cameras that somebody chose stay.
    if not robot or inputs.cameras != InputConfig.cameras:
        return inputs
    return replace(inputs, cameras=robot_named(robot).camera_names)


def image_options(inputs: InputConfig) -> dict[str, Any]:
    """Options of an environment with the images that a student sees."""
    if not inputs.cameras:
        return {}
    return {
        "obs_mode": "+".join(image_outputs(inputs)),
        "cameras": inputs.cameras,
        "camera_size": inputs.image_size,
    }


def described(inputs: InputConfig) -> BackboneSpec | None:
    """What a layout tells of the backbone of these inputs.

    Raises:
        UsageError: the file is no backbone, see `backbone.Backbone`.
    """
    return opened(inputs.backbone).spec if inputs.backbone else None


def observation_spec_of(
    env: PolicyWorlds, inputs: InputConfig, targets: Sequence[str]
) -> ObservationSpec:
    """ObservationSpec of a student that is trained in an environment."""
    profile = profile_of(vars(env.config))
    return ObservationSpec(
        inputs,
        state_of(env),
        actions_of(env),
        tuple(targets),
        control_of(env),
        profile,
        SUBTASKS.names(),
        env.config.robot,
        backbone=described(inputs),
    ).in_conventions(Conventions.of(vars(env.config)))


def state_of(env: PolicyWorlds) -> tuple[Entry, ...]:
    """Entries of an environment's state vector, in order."""
    entries: list[Entry] = []
    # The table goes on with images and other observations behind the state.
    left = env.single_observation_space["state"].shape[0]
    for row in env.observer.table:
        if left <= 0:
            break
        entries.append((row.key, row.shape[0]))
        left -= row.shape[0]
    return tuple(entries)


def actions_of(env: PolicyWorlds) -> tuple[str, ...]:
    """Names of the dimensions of an environment's actions."""
    return tuple(entry.name for entry in env.action_table)


def control_of(env: PolicyWorlds) -> tuple[str, ...]:
    """Control mode, kind of base and stationary joint groups of an environment, which define what its actions do."""
    return (env.config.control_mode, env.config.base, *env.config.stationary)


NEWER_OPTIONS = frozenset({"joint_dynamics"})
"""Options of profiles that older data and checkpoints do not tell."""


def profile_of(options: Mapping[str, Any]) -> str:
    """Name of the profile of an environment with these options of `EnvConfig`, also after a round trip through JSON.

    Options that match a binding profile in everything but what it leaves free belong to that profile: episodes of
    collection may be longer than those of an evaluation, see `collection.longer`. Axes of objects do not count: data
    of older versions have others, which `observation.state` converts. Options that are younger than the data
    (`NEWER_OPTIONS`) do not count where the data do not tell them: a profile is more than these.
    """
    options_in_force = {**asdict(Conventions.of(options)), **options}
    for profile in PROFILES.values():
        values = profile.options(str(options.get("subtask", "")), trains=False)
        apart = {*FREE_OPTIONS, "object_axes", *(NEWER_OPTIONS - options.keys())}
        values = {name: value for name, value in values.items() if name not in apart}
        if profile.binding and all(
            _plain(options_in_force.get(name)) == _plain(value)
            for name, value in values.items()
        ):
            return profile.name
    return str(options.get("profile", DEFAULT_PROFILE))


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def compare_specs(
    layout: ObservationSpec,
    state: Sequence[Entry],
    actions: Sequence[str],
    control: tuple[str, ...],
) -> list[str]:
    """Describe how state, actions and control differ from a layout; empty if they match."""
    wrong = compare_entries("state", layout.state, state)
    wrong += compare_entries(
        "action", [(name, 1) for name in layout.actions], [(name, 1) for name in actions]
    )
    if layout.control != control:
        wrong.append(
            f"control {', '.join(control)} instead of {', '.join(layout.control)}"
        )
    return wrong


def compare_entries(
    what: str, wanted: Sequence[Entry], found: Sequence[Entry]
) -> list[str]:
    """Describe how two lists of entries differ; empty if they match."""
    if tuple(wanted) == tuple(found):
        return []
    before = dict(wanted)
    now = dict(found)
    wrong = [f"{what} has no {name}" for name in before if name not in now]
    wrong += [
        f"{what} has {name}, which the student does not know"
        for name in now
        if name not in before
    ]
    wrong += [
        f"{what} {name} has {now[name]} numbers instead of {width}"
        for name, width in before.items()
        if name in now and now[name] != width
    ]
    return wrong or [f"the entries of {what} have another order: {', '.join(now)}"]


def describe_options(options: Mapping[str, Any]) -> str:
    """Options as "name=value, ..."."""
    return ", ".join(f"{name}={value!r}" for name, value in options.items())
