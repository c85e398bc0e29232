"""What `mjhab.shot` and ``mjhab shot`` are asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, ClassVar

from mjhab.config.env import EnvConfig
from mjhab.config.env_spec import EnvSpec, env_options
from mjhab.core.errors import missing_field, unknown_name, wrong_value
from mjhab.core.typed.bounds import Bound, Output
from mjhab.core.typed.flags import Flag
from mjhab.robots.registry import ROBOTS
from mjhab.scenes.free_camera import FOV_DEG, Place, free_camera
from mjhab.scenes.shading import RASTER, Shading, shading_of

FILM = "film"
TOP = "top"
PLAN = "plan"
VIEWS = (FILM, TOP, PLAN)
"""Views that every robot has; the names of its cameras are views, too."""
PNG = ".png"
MP4 = ".mp4"
STILL_SAMPLES = 16
"""Paths per pixel of shader path where nothing is said."""
MOST_STEPS = 64
"""Largest number of pictures on a contact sheet."""


@dataclass(frozen=True)
class ShotSpec(EnvSpec):
    """Take a picture of an episode at one control step: recorded (`mjhab generate`), or of an evaluation.

    From where hand and target are seen best: `mjhab shot runs/pick --episode 3 --step 40 --out pick.png`

    From anywhere: `mjhab shot runs/pick --camera 3,2,1.6 --look-at 1,1,0.8 --fov 50`

    Several steps on one sheet: `mjhab shot runs/pick --sheet 9`

    A film around the target: `mjhab shot runs/pick --step 40 --turntable --out around.mp4`

    Episodes of an evaluation have no states: they run again, up to the step, by the policy that is named in the folder.

    Raises:
        UsageError: an option is invalid, or options exclude each other.
    """

    WHAT: ClassVar[str] = "a shot"

    place: Annotated[
        Path | PathLike[str] | str,
        Flag(metavar="RUN|SHARD", kind=Path, positional=True),
    ]
    """The folder of an evaluation, a shard (*.h5) or a folder of shards."""
    episode: Annotated[int, Bound(0)] = 0
    """Index of the episode."""
    step: Annotated[int | None, Flag(shown="default: the middle"), Bound(0)] = None
    """Control step; 0 is the start."""
    out: Annotated[
        Path | None,
        Flag(metavar="FILE", shown="default: shot.png, with --turntable shot.mp4"),
        Output(),
    ] = None
    """The PNG to write; with --turntable the MP4."""
    view: Annotated[str, Flag(metavar="film|top|plan|CAMERA")] = FILM
    """From where: film (hand and target in sight), top (the home from above), plan (without perspective), or a camera
    of the robot."""
    camera: Place = None
    """Where the camera stands, as x,y,z in the world [m]; with a minus at the front --camera=-1,2,1.5."""
    look_at: Place = None
    """What --camera looks at, as x,y,z [m]; without it, the hand."""
    fov: Annotated[float, Bound(1, 150)] = FOV_DEG
    """Vertical field of view of --camera [degrees]."""
    sheet: Annotated[int, Bound(0, MOST_STEPS)] = 0
    """A contact sheet of so many steps, from --step (else the start) to the end."""
    turntable: bool = False
    """A film around hand and target at the step."""
    caption: bool = False
    """Write the sentence of the subtask below the picture; contact sheets always do."""
    width: Annotated[int, Bound(16, 8192)] = 1280
    """Width of the picture, or of those on a sheet times their number per row [px]."""
    height: Annotated[int, Bound(16, 8192)] = 720
    """Height [px]."""
    env: Annotated[Mapping[str, Any], env_options("shader", "shading", "threads")] = (
        field(default_factory=dict)
    )
    """How it is drawn, fields of `EnvConfig`; shader path takes `STILL_SAMPLES` paths per pixel."""

    def __post_init__(self) -> None:
        super().__post_init__()
        # The class is frozen.
        object.__setattr__(self, "place", Path(self.place))
        cameras = sorted(
            {name for robot in ROBOTS.values() for name in robot.camera_names}
        )
        if self.view not in VIEWS and self.view not in cameras:
            raise unknown_name("view", self.view, (*VIEWS, *cameras))
        free = free_camera(self.camera, self.look_at, self.fov)
        if free is not None and self.view != FILM:
            raise wrong_value("view", self.view, "left out with --camera")
        if self.turntable:
            if self.sheet:
                raise wrong_value("sheet", self.sheet, "left out with --turntable")
            if free is not None or self.view != FILM:
                option = "camera" if free is not None else "view"
                given = self.camera if free is not None else self.view
                raise wrong_value(option, given, "left out with --turntable")
        ending = MP4 if self.turntable else PNG
        if self.out is not None and self.out.suffix.lower() != ending:
            raise wrong_value("out", str(self.out), f"a name that ends with {ending}")

    @property
    def file(self) -> Path:
        """Where the command writes."""
        return self.out or Path("shot.mp4" if self.turntable else "shot.png")

    @property
    def shading(self) -> Shading | None:
        """The options of the path tracer, None for the rasterizer."""
        return still_shading(self.asked)


def still_shading(asked: EnvConfig) -> Shading | None:
    """The options of the path tracer for a picture, None for the rasterizer."""
    if asked.shader == RASTER:
        return asked.path_shading
    return shading_of(asked.shader, {"samples": STILL_SAMPLES, **asked.shading})


def check_step(step: int, steps: int, episode: str) -> int:
    """A control step of an episode of ``steps`` control steps.

    Raises:
        UsageError: the episode has no such step.
    """
    if step > steps:
        raise wrong_value(
            "step", step, f"0 to {steps}, the last step of {episode}", where=""
        )
    return step


def no_episode(index: int, place: Path, known: list[int]) -> Exception:
    """The error for an index that no episode of a place has."""
    if not known:
        return missing_field("episode", place, "It has no finished episodes.")
    some = ", ".join(map(str, known[:8])) + (" ..." if len(known) > 8 else "")
    return wrong_value(
        "episode", index, f"the index of an episode there ({some})", where=place
    )
