"""What functions of recorded episodes, such as `mjhab.replay`, and their commands are asked for."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self, cast

from mjhab.config.env_spec import EnvSpec, env_options
from mjhab.core.errors import (
    UsageError,
    fault,
    missing_field,
    unknown_name,
    wrong_value,
)
from mjhab.core.files.reading import read_json_object
from mjhab.core.typed.bounds import Bound, Output
from mjhab.core.typed.flags import Flag
from mjhab.core.typed.options import take_options
from mjhab.tasks.subtasks.registry import SUBTASKS

if TYPE_CHECKING:
    from mjhab.data.select.query import Filter

PlacesLike = str | PathLike[str] | Sequence[str | PathLike[str]]
"""A shard, a folder of shards, or several of them."""
MAX_QUALITY = 51
"""Largest constant rate factor of x264, for the smallest files."""


CONVERTED = ("pd_joint_pos", "pd_ee_delta_pose", "pd_ee_pose", "pd_joint_delta_pos")
"""Control modes that recorded actions can be converted to."""


def check_mode(mode: str) -> None:
    """Refuse a control mode that actions cannot be converted to; "" is that of the recording.

    Raises:
        UsageError: names those that there are.
    """
    if mode not in ("", *CONVERTED):
        raise unknown_name("control mode of converted actions", mode, CONVERTED)


@dataclass(frozen=True, kw_only=True)
class RecordedSpec:
    """Recorded episodes, and what to do with them."""

    places: Annotated[tuple[Path, ...], Flag(metavar="FILE|FOLDER ...", positional=True)]
    """Shards (*.h5) or folders of shards."""

    @classmethod
    def of(cls, places: PlacesLike, **options: Any) -> Self:
        """Make a specification of options.

        Args:
            places: a shard, a folder of shards, or a sequence of them.
            **options: the other fields, by name.

        Raises:
            UsageError: an option is unknown or invalid; see the class.
            TypeError: an option without default is missing.
        """
        known = {option.name for option in dataclasses.fields(cls)}
        for name in options:
            if name not in known:
                raise unknown_name("option", name, known)
        if isinstance(places, str | PathLike):
            places = (places,)
        # Its fields are checked, and made paths, by the class.
        return cls(places=cast(Any, places), **options)

    def __post_init__(self) -> None:
        take_options(self)


@dataclass(frozen=True, kw_only=True)
class SelectedSpec(RecordedSpec):
    """Recorded episodes that pass a filter, and what to do with them."""

    where: Annotated[str | None, Flag(metavar="FILTER", shown="default: all")] = None
    """Only these episodes, as in `mjhab data query`."""
    preset: Annotated[str | None, Flag(metavar="NAME", shown="default: none")] = None
    """A filter with a name, see `mjhab data fields`; with --where, both must hold."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.filter()

    def filter(self) -> Filter | None:
        """The filter of ``where`` and ``preset``; None takes every episode.

        Raises:
            UsageError: the text is invalid or the preset unknown.
        """
        # Here: the help of a command does not wait for h5py.
        from mjhab.data.select.query import read_filter

        return read_filter(self.where, self.preset)


@dataclass(frozen=True, kw_only=True)
class ExportSpec(SelectedSpec):
    """Recorded episodes to write in the format of another tool.

    Raises:
        UsageError: an option is invalid.
    """

    out: Annotated[Path, Flag(metavar="FOLDER"), Output()]
    """The folder to write; it is written atomically."""
    until: Annotated[
        str, Flag(metavar="end|success|success+N", shown="default: all of it")
    ] = ""
    """How much of an episode: success+N ends it N control steps after its first success."""
    points: Annotated[int, Bound(most=100_000)] = 0
    """Number of points of a cloud with colours in the frame of the base, made of the colour and depth images; 0 for
    none."""
    overwrite: bool = False
    """Replace an existing export in the folder."""
    resume: bool = False
    """Continue an interrupted export; options and episodes must be the same."""

    def __post_init__(self) -> None:
        from mjhab.data.select.until import Until

        super().__post_init__()
        Until.parse(self.until)


@dataclass(frozen=True, kw_only=True)
class LerobotSpec(ExportSpec):
    """Write recorded episodes as a LeRobot data set: parquet, mp4 and meta.

    `mjhab export lerobot runs/pick --preset pick_paper --out exported/pick`

    Colour images become videos, depth images [mm] and segmentation become columns. Needs the extra `data` (pyarrow).

    Raises:
        UsageError: an option is invalid.
    """

    version: Annotated[str, Flag(metavar="3.0|2.1")] = "3.0"
    """Version of the format."""
    rgb: bool = True
    """Colour images, as videos; --no-rgb leaves them out."""
    depth: bool = True
    """Depth images, which are by far the largest part, as columns; --no-depth leaves them out."""
    seg: bool = True
    """Segmentation, as columns; --no-seg leaves it out."""
    quality: Annotated[int, Bound(most=MAX_QUALITY)] = 18
    """Constant rate factor of videos: 0 (smallest loss) to 51 (smallest)."""
    colours: Annotated[str, Flag(metavar="film|png")] = "film"
    """How colour images are stored: in videos, whose colours have half the resolution, or one by one without loss, for
    small images."""
    state: Annotated[str, Flag(metavar="own|recorded")] = "own"
    """What observation.state holds: what the robot's own sensors tell, or all that was recorded, such as the 42 numbers
    of MS-HAB."""
    actions: Annotated[str, Flag(metavar="MODE", shown="default: as recorded")] = ""
    """Convert the actions to a control mode: pd_joint_pos (absolute joints), pd_ee_delta_pose or pd_ee_pose (end
    effector), or what was recorded in these modes to pd_joint_delta_pos. `mjhab replay --verify --actions MODE` tells
    whether converted actions succeed."""
    language: bool = False
    """Store skills and wordings in the column language_persistent, too; LeRobot before 0.6 cannot load such a set."""
    splits: Annotated[
        Path | None, Flag(metavar="splits.json", shown="default: all are train")
    ] = None
    """File of `mjhab dataset make` that names the homes of the split val; their episodes come last."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, valid in (("colours", ("film", "png")), ("state", ("own", "recorded"))):
            if getattr(self, name) not in valid:
                raise unknown_name(name, getattr(self, name), valid)
        check_mode(self.actions)
        self.held_out()

    def held_out(self) -> tuple[str, ...]:
        """Homes of the split val.

        Raises:
            UsageError: the file cannot be read, or names no homes.
        """
        if self.splits is None:
            return ()
        val = read_json_object(self.splits).get("val")
        homes = val.get("homes") if isinstance(val, Mapping) else None
        if not isinstance(homes, list) or not all(isinstance(one, str) for one in homes):
            raise fault(
                self.splits,
                'names no homes of the split val ({"val": {"homes": [...]}}).',
            )
        return tuple(homes)


@dataclass(frozen=True, kw_only=True)
class ManiskillSpec(ExportSpec):
    """Write recorded episodes in the format of MS-HAB's data set, one HDF5 file per task, subtask and target.

    `mjhab export maniskill runs/pick --preset pick_paper --out rearrange-dataset`

    Raises:
        UsageError: an option is invalid.
    """


@dataclass(frozen=True, kw_only=True)
class ReplaySpec(SelectedSpec, EnvSpec):
    """Simulate recorded actions again and compare every bit (--verify), or render recorded states (--render).

    `mjhab replay runs/pick --verify`

    `mjhab replay runs/pick --render rgbd --camera-size 256 --out pick_rgbd.h5`

    Raises:
        UsageError: an option is invalid, or options exclude each other.
    """

    WHAT: ClassVar[str] = "a replay"

    verify: bool = False
    """Simulate the actions on the CPU and compare positions and velocities of every step; fails unless all agree."""
    render: Annotated[
        str | None, Flag(metavar="depth|rgb|rgbd|seg|pointcloud", shown="default: none")
    ] = None
    """Render these images of every state into a new shard, without simulation; several joined by +."""
    actions: Annotated[str, Flag(metavar="MODE", shown="default: as recorded")] = ""
    """With --verify: convert the actions to another control mode, as `mjhab export lerobot --actions` does, and tell
    how many of the episodes that succeeded succeed with these, too."""
    out: Annotated[
        Path | None, Flag(metavar="FILE.h5", shown="default: none"), Output(".h5")
    ] = None
    """With --render: the shard to make or to continue."""
    cameras: Annotated[
        tuple[str, ...] | None, Flag(metavar="NAME ...", shown="default: all")
    ] = None
    """With --render: cameras of the robot, and follow, a camera behind the robot (colour only)."""
    rgb: Annotated[str, Flag(metavar="png|jpeg")] = "png"
    """With --render: format of colour images; png is lossless."""
    env: Annotated[
        Mapping[str, Any],
        env_options(
            "num_envs",
            "camera_size",
            "threads",
            "shader",
            "shading",
            docs={
                "num_envs": "Number of episodes simulated, or frames rendered, in parallel. Changes the speed, never "
                "the results.",
                "camera_size": "With --render: side of the images, or height and width [px].",
            },
            num_envs=8,
        ),
    ] = field(default_factory=dict)
    """Options of the environment, fields of `EnvConfig`; all others are those of the recorded run."""

    @classmethod
    def of(cls, places: PlacesLike, **options: Any) -> Self:
        """See `RecordedSpec.of`; environment options by their names, too, as in `EnvSpec.of`."""
        own = {option.name for option in dataclasses.fields(cls)}
        further = {name: options.pop(name) for name in {*options} - own}
        env = {**options.pop("env", {}), **further}
        return super().of(places, **options, env=env)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._take_env()
        if self.verify == (self.render is not None):
            raise UsageError(
                "say what to do, one of the two: --verify, or --render depth (or rgb, rgbd, ...)."
            )
        check_mode(self.actions)
        if self.actions and not self.verify:
            raise wrong_value("actions", self.actions, "left out without --verify")
        if self.render is not None:
            self._check_images(self.render)

    def _check_images(self, render: str) -> None:
        # Here: the help of a command waits neither for gymnasium nor for h5py.
        from mjhab.data.record.render import FOLLOW
        from mjhab.data.store.images import ImageFormat
        from mjhab.envs.observations.modes import image_size, mode_outputs

        if self.out is None:
            raise missing_field(
                "out", "render", "Give --out FILE.h5: the recorded shard is not changed."
            )
        mode_outputs(render)
        image_size(self.asked.camera_size)
        ImageFormat(self.rgb)
        if FOLLOW in (self.cameras or ()) and "rgb" not in render:
            raise UsageError(
                f"the camera '{FOLLOW}' gives colour only: add rgb to --render, as in --render rgb."
            )


@dataclass(frozen=True, kw_only=True)
class ChainStartsSpec(SelectedSpec):
    """Make start states of a subtask from recorded episodes: where the drive before it ended, with what was held.

    Of whole tasks: `mjhab spawns from runs/chains --subtask close --target kitchen_counter/drawer3 --out
    spawns/after_drives.npz`

    Where a policy was stuck: `mjhab spawns from runs/open --subtask open --where "label == 'slightly_open_failure'"
    --after 100 150 --out spawns/half_open.npz`

    Whole tasks are recorded by `mjhab generate --task set_table --navigate drive`. Use the starts with `mjhab eval
    --spawns FILE.npz` and `mjhab train ... --spawns FILE.npz`.

    Raises:
        UsageError: an option is invalid.
    """

    subtask: Annotated[str, Flag(metavar="NAME")]
    """The subtask that begins: pick, place, open, close or one of a plugin."""
    target: Annotated[str, Flag(metavar="NAME", shown="default: all of them")] = ""
    """Only its starts with this object type, object or link."""
    after: Annotated[tuple[int, ...], Flag(metavar="N ..."), Bound(0)] = (0,)
    """Take the states N control steps after the subtask began, of those that lasted longer and had not succeeded by
    then; robot and objects stand still at the start. Several numbers take several states. 0 takes those in which it
    began, of whole tasks alone."""
    out: Annotated[Path, Flag(metavar="FILE.npz"), Output()]
    """The file to write."""
    overwrite: bool = False
    """Replace the file."""

    def __post_init__(self) -> None:
        super().__post_init__()
        SUBTASKS.check(self.subtask)


@dataclass(frozen=True, kw_only=True)
class LabelSpec(RecordedSpec):
    """Recompute labels and events of recorded episodes from their signals, without simulation, and print changes.

    `mjhab label runs/pick`

    Raises:
        UsageError: an option is invalid.
    """

    write: bool = False
    """Write the new labels into the shards."""
