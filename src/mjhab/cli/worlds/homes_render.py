"""``mjhab homes render``: an image of one home, or a sheet with all homes of a pack."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from mjhab.cli.output import report
from mjhab.cli.worlds.home_names import find_home, homes_of_split
from mjhab.config.env_spec import EnvSpec, env_options
from mjhab.core.errors import missing_field, wrong_value
from mjhab.core.files.cache import write_atomic
from mjhab.core.progress import progress_bar
from mjhab.core.typed.bounds import Bound, Output
from mjhab.core.typed.flags import Flag
from mjhab.evaluation.shots.spec import still_shading
from mjhab.scenes.free_camera import FOV_DEG, Place, free_camera
from mjhab.scenes.shading import Shading

PNG = ".png"
HTML = ".html"
ONE_SIZE = (1200, 900)
SHEET_SIZE = (400, 300)
"""Default width and height of a single image, and of each image on a sheet [px]."""


Side = Annotated[
    int | None, Flag(shown="default: 1200 x 900, with --all 400 x 300"), Bound(16, 8192)
]


@dataclass(frozen=True)
class HomesRenderSpec(EnvSpec):
    """Draw one home, or a sheet of all homes of a pack; needs no OpenGL.

    For instance: `mjhab homes render builtin_m0_00 --out home.png --view inside`

    All of them: `mjhab homes render --all --out homes.html`

    Raises:
        UsageError: an option is invalid, or options exclude each other.
    """

    name: Annotated[str, Flag(metavar="[HOME]", positional=True)] = ""
    """Name of the home (see: mjhab homes list)."""
    all: bool = False
    """Draw every home of the pack into one sheet; --width and --height are then those of one picture."""
    out: Annotated[Path, Flag(metavar="FILE.png"), Output()] = Path("home.png")
    """The PNG to write; with --all also an HTML page that needs no network."""
    view: Annotated[str, Flag(metavar="top|plan|inside")] = "top"
    """top (from above), plan (from straight above, without perspective) or inside (from a corner of a room)."""
    camera: Place = None
    """Where the camera stands, as x,y,z in the world [m]; with a minus at the front --camera=-1,2,1.5."""
    look_at: Place = None
    """What the camera looks at, as x,y,z [m]; with --camera."""
    fov: Annotated[float, Bound(1, 150)] = FOV_DEG
    """Vertical field of view of --camera [degrees]."""
    width: Side = None
    """Width of the picture [px]."""
    height: Side = None
    """Height of the picture [px]."""
    env: Annotated[
        Mapping[str, Any],
        env_options(
            *("assets", "split", "shader", "shading"), shown={"split": "default: all"}
        ),
    ] = field(default_factory=dict)
    """The asset pack, with ``all`` which of its homes, and how they are drawn; see `still_shading`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        free_camera(self.camera, self.look_at, self.fov)
        if self.camera is not None and self.look_at is None:
            raise missing_field(
                "look_at", advice="Say what the camera looks at: --look-at x,y,z"
            )
        if self.camera is not None and self.all:
            raise wrong_value("camera", self.camera, "left out with --all")
        _check_out(self.out, (PNG, HTML) if self.all else (PNG,))
        if self.all and self.name:
            raise wrong_value("name", self.name, "left out with --all")
        if not self.all and "split" in self.env:
            raise wrong_value(
                "split",
                self.env["split"],
                "left out without --all: one home is drawn by its name",
            )
        if not self.all and not self.name:
            raise missing_field(
                "name",
                advice="Name a home (see: mjhab homes list), or draw all of them with --all.",
            )

    @property
    def viewpoint(self) -> Any:
        """The name of a view, or the place of the camera."""
        from mjhab.render.pictures.viewpoint import Viewpoint

        free = free_camera(self.camera, self.look_at, self.fov)
        return self.view if free is None else Viewpoint(*free)

    @property
    def shading(self) -> Shading | None:
        """The options of the path tracer, None for the rasterizer."""
        return still_shading(self.asked)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        width, height = SHEET_SIZE if self.all else ONE_SIZE
        return self.width or width, self.height or height


def render(spec: HomesRenderSpec, json: bool) -> int:
    """Render one home or a sheet of homes."""
    return render_sheet(spec, json) if spec.all else render_one(spec, json)


def _check_out(out: Path, endings: tuple[str, ...]) -> None:
    if out.suffix.lower() not in endings:
        raise wrong_value(
            "out", str(out), f"a name that ends with {' or '.join(endings)}"
        )
    if out.is_dir():
        raise wrong_value("out", str(out), f"a {endings[0]} file, not a folder")


def render_one(spec: HomesRenderSpec, json: bool) -> int:
    """Draw one home into a PNG."""
    home = find_home(spec.asked.assets, spec.name)
    from PIL import Image

    from mjhab.render.pictures.home_views import render_homes
    from mjhab.scenes.packs import open_pack

    begun = time.perf_counter()
    pack: Any = open_pack(spec.asked.assets)
    image = next(
        iter(render_homes(pack, [home.name], spec.viewpoint, *spec.size, spec.shading))
    )
    seconds = round(time.perf_counter() - begun, 2)
    write_atomic(spec.out, Image.fromarray(image).save)
    height, width = image.shape[:2]
    facts = {
        "home": home.name,
        "view": spec.view,
        "width": width,
        "height": height,
        "file": str(spec.out),
        "seconds": seconds,
        "shader": spec.asked.shader,
        "samples": spec.shading.samples if spec.shading else None,
    }
    report(json, facts, f"drew {home.name} ({spec.view}) into {spec.out}")
    return 0


def render_sheet(spec: HomesRenderSpec, json: bool) -> int:
    """Draw all homes of a pack into one PNG or HTML page."""
    from mjhab.render.pictures.home_views import render_homes
    from mjhab.reports.contact_sheet import Tile, save_html, save_png
    from mjhab.scenes.packs import open_pack

    pack: Any = open_pack(spec.asked.assets)
    homes = homes_of_split(pack, spec.env.get("split"))
    tiles = []
    with progress_bar("drawing homes", len(homes)) as advance:
        names = [home.name for home in homes]
        images = render_homes(pack, names, spec.viewpoint, *spec.size, spec.shading)
        # Pictures come one by one, so that the bar moves and memory holds one home.
        for home, image in zip(homes, images, strict=True):
            tiles.append(
                Tile(home.name, f"{home.split}, layout {home.macro}", home.note, image)
            )
            advance()
    save = save_png if spec.out.suffix.lower() == PNG else save_html
    title = f"{len(tiles)} homes of {pack.name}"
    write_atomic(spec.out, lambda temporary: save(temporary, title, tiles))
    facts = {"homes": len(tiles), "view": spec.view, "out": str(spec.out)}
    report(json, facts, f"drew {len(tiles)} homes ({spec.view}) into {spec.out}")
    return 0
