"""The public data sets that mjhab reads, and where they are.

Repositories, revisions and paths are those that habitat-sim's ``datasets_download.py`` (ReplicaCAD, YCB) and
ManiSkill's ``utils/assets/data.py`` (episodes) use. None of them publishes checksums we could pin: the hub tells the
hash of every file it serves, downloads are held to those, and what was installed is recorded and compared ever after.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from mjhab.core.errors import unknown_name, wrong_value

ENDPOINT = "https://huggingface.co"


@dataclass(frozen=True)
class Source:
    """One data set on the hub.

    ``archive``: the one file of the repository that is fetched and unpacked; "" takes the repository's files.
    ``picks``: (pattern, replacement) of the paths to keep and where they go; none keeps everything as it is.
    ``expects``: globs that must each match a file of the installed folder.
    """

    name: str
    title: str
    repo: str
    revision: str
    licence: str
    terms: str
    expects: tuple[str, ...]
    archive: str = ""
    picks: tuple[tuple[str, str], ...] = ()

    def place(self, path: str) -> str | None:
        """Where a file of the repository goes in the installed folder; None if it is not wanted."""
        if self.archive:
            return path if path == self.archive else None
        if not self.picks:
            return path
        found = ((re.fullmatch(pattern, path), to) for pattern, to in self.picks)
        return next((match.expand(to) for match, to in found if match), None)

    def complete(self, folder: Path) -> bool:
        """Whether a folder holds what the readers need."""
        return all(any(folder.glob(pattern)) for pattern in self.expects)


SOURCES: dict[str, Source] = {
    source.name: source
    for source in (
        Source(
            "replica_cad",
            "ReplicaCAD: 84 furnished apartments with a kitchen counter and a fridge that open",
            "ai-habitat/ReplicaCAD_dataset",
            "v1.6",
            "CC BY 4.0 by its card on the hub; copies elsewhere carry CC BY-NC 4.0 (non-commercial). "
            "Copyright Facebook, Inc. and its affiliates. Not the licence of mjhab.",
            "https://aihabitat.org/datasets/replica_cad/",
            (
                "configs/scenes/*.scene_instance.json",
                "configs/objects/*.object_config.json",
                "urdf/**/*.urdf",
            ),
        ),
        Source(
            "ycb",
            "YCB: scans of household objects",
            "ai-habitat/ycb",
            "v1.2",
            "CC BY 4.0 by its authors (Calli et al., the YCB Object and Model Set). Not the licence of mjhab.",
            "https://www.ycbbenchmarks.com/",
            ("*/textured.glb",),
            picks=(
                (r"meshes/([^/]+)/google_16k/(textured\.glb)", r"\1/\2"),
                (r"(?:.*/)?(LICENSE[^/]*)", r"\1"),
            ),
        ),
        Source(
            "hab_episodes",
            "Episodes of the Home Assistant Benchmark in ReplicaCAD",
            "haosulab/ReplicaCADRearrange",
            "main",
            "No licence is stated where the files lie; they derive from Habitat's rearrangement data sets, whose terms "
            "hold. Not the licence of mjhab.",
            "https://github.com/facebookresearch/habitat-lab/blob/main/DATASETS.md",
            ("**/*.json.gz",),
            archive="rearrange.zip",
        ),
    )
}


def source_named(name: str) -> Source:
    """The data set of that name.

    Raises:
        UsageError: there is none.
    """
    if name not in SOURCES:
        raise unknown_name("data set", name, SOURCES)
    return SOURCES[name]


def hub_endpoint() -> str:
    """Address of the hub: ``$HF_ENDPOINT`` (a mirror) or the hub itself, without a slash at the end.

    Raises:
        UsageError: the variable is not an http(s) address.
    """
    given = os.environ.get("HF_ENDPOINT", "").strip() or ENDPOINT
    parts = urlsplit(given)
    if parts.scheme not in ("http", "https") or not parts.netloc:
        raise wrong_value("HF_ENDPOINT", given, f"an address such as {ENDPOINT}")
    # Paths are appended with a slash of their own.
    return given.rstrip("/")


def licence_of(assets: str) -> str:
    """Terms of an asset pack that is one of the public data sets; "" for any other.

    Args:
        assets: "builtin", or the folder of a pack.
    """
    folder = Path(assets)
    parts = (folder, folder / "replica_cad", folder.parent, folder.parent / "replica_cad")
    if assets == "builtin" or not any(
        SOURCES["replica_cad"].complete(part) for part in parts
    ):
        return ""
    named = [SOURCES[name] for name in ("replica_cad", "ycb")]
    return "; ".join(
        f"{source.title.partition(':')[0]}: {source.licence}" for source in named
    )
