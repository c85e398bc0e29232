"""``mjhab assets``: list, install, verify and locate public data sets."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from mjhab.assets.install import fetch, install_bundle, read_record, verify
from mjhab.assets.sources import SOURCES, Source, hub_endpoint, source_named
from mjhab.cli.output import Listing, report
from mjhab.core.errors import UsageError
from mjhab.core.files.cache import assets_dir
from mjhab.core.progress import say
from mjhab.core.typed.flags import Flag
from mjhab.core.typed.options import take_options

DataSet = Annotated[str, Flag(metavar="replica_cad|ycb|hab_episodes", positional=True)]


@dataclass(frozen=True)
class AssetsListSpec:
    """List the public data sets that mjhab reads, their licences, and which are installed."""


@dataclass(frozen=True)
class AssetsFetchSpec:
    """Download a public data set and install it; none is needed for the built-in homes.

    For instance: `mjhab assets fetch replica_cad --accept-licence`

    An interrupted download continues with the same command. HF_ENDPOINT names a mirror of the hub; http_proxy,
    https_proxy and no_proxy are honoured. Without a network: zip the folder that `mjhab assets where` names on another
    machine, and give the file to --offline.
    """

    name: DataSet
    """The data set."""
    offline: Annotated[Path | None, Flag(metavar="BUNDLE", shown="default: none")] = None
    """Install from this zip or tar archive; nothing is downloaded."""
    accept_licence: bool = False
    """Accept the licence of the data set, which differs from that of mjhab, without being asked."""
    overwrite: bool = False
    """Replace an installed data set."""
    repo: Annotated[str, Flag(shown="default: that of the data set")] = ""
    """Another repository of the hub with the same files."""
    revision: Annotated[str, Flag(shown="default: that of the data set")] = ""
    """Another branch, tag or commit of the repository."""

    def __post_init__(self) -> None:
        take_options(self)


@dataclass(frozen=True)
class AssetsVerifySpec:
    """Compare the files of an installed data set with the hashes recorded when it was installed.

    A folder that was not installed by mjhab has no record: its hashes are recorded now and used from then on.
    """

    name: DataSet
    """The data set."""

    def __post_init__(self) -> None:
        take_options(self)


@dataclass(frozen=True)
class AssetsWhereSpec:
    """Print the folder of a data set, or the folder of all data sets, which MJHAB_ASSETS sets."""

    name: DataSet = ""
    """The data set; the folder of all of them if absent, which --assets takes."""

    def __post_init__(self) -> None:
        take_options(self)


def list_assets(spec: AssetsListSpec, json: bool) -> int:
    """Print all installable data sets."""
    rows: list[dict[str, Any]] = [
        {
            "name": source.name,
            "title": source.title,
            "repo": source.repo,
            "revision": source.revision,
            "licence": source.licence,
            "terms": source.terms,
            "installed": (assets_dir() / source.name).is_dir(),
        }
        for source in SOURCES.values()
    ]
    shown = [
        (row["name"], row["title"], row["licence"], "yes" if row["installed"] else "no")
        for row in rows
    ]
    columns = ("name", "what", "licence", "installed")
    table = Listing(f"data sets, in {assets_dir()}", columns, shown)
    report(json, {"folder": str(assets_dir()), "assets": rows}, table)
    return 0


def fetch_assets(spec: AssetsFetchSpec, json: bool) -> int:
    """Install one data set, from the hub or from an archive."""
    source = source_named(spec.name)
    source = replace(
        source,
        repo=spec.repo or source.repo,
        revision=spec.revision or source.revision,
    )
    _agree(source, spec.accept_licence)
    if spec.offline is not None:
        folder = install_bundle(source, spec.offline, assets_dir(), spec.overwrite)
    else:
        say(
            f"{source.name} from {hub_endpoint()}/datasets/{source.repo} ({source.revision})"
        )
        folder = fetch(source, assets_dir(), spec.overwrite)
    record = read_record(folder) or {"files": {}}
    size = sum(row["size"] for row in record["files"].values())
    files = len(record["files"])
    facts = {"name": source.name, "folder": str(folder), "files": files, "bytes": size}
    report(json, facts, f"{source.name}: {files} files, {size / 1e6:.1f} MB in {folder}")
    return 0


def _agree(source: Source, accepted: bool) -> None:
    """Show the licence of a data set and, in a terminal, ask whether the user accepts it.

    Raises:
        UsageError: the licence is not accepted.
    """
    say(f"{source.title}\nLicence: {source.licence}\nTerms: {source.terms}")
    if accepted:
        return
    if not sys.stdin.isatty():
        # Nobody can answer: a script must say so itself.
        raise UsageError(
            f"{source.name} has its own licence (above); add --accept-licence to accept it."
        )
    print("Do you accept these terms? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise UsageError(
            f"the terms of {source.name} were not accepted; nothing was installed."
        )


def verify_assets(spec: AssetsVerifySpec, json: bool) -> int:
    """Check one installed data set; returns 1 if files are missing or changed."""
    folder = assets_dir() / source_named(spec.name).name
    found = verify(folder)
    good = not (found.missing or found.changed)
    facts = {
        "name": spec.name,
        "folder": str(folder),
        "ok": good,
        "files": found.files,
        "missing": list(found.missing),
        "changed": list(found.changed),
        "first_use": found.first_use,
    }
    problems = [(path, "missing") for path in found.missing]
    problems += [(path, "changed") for path in found.changed]
    parts: tuple[Listing | str, ...] = (
        f"{folder}: {found.files} files are as installed.",
    )
    if problems:
        title = f"{folder}: {len(problems)} of {found.files} files are not as installed"
        advice = f"`mjhab assets fetch {spec.name} --overwrite` installs them again."
        parts = (Listing(title, ("file", "is"), problems), advice)
    elif found.first_use:
        parts = (
            f"{folder}: it had no record; the hashes of its {found.files} files are recorded now.",
        )
    report(json, facts, *parts)
    return 0 if good else 1


def where(spec: AssetsWhereSpec, json: bool) -> int:
    """Print the folder of a data set, or of all data sets."""
    folder = assets_dir() / source_named(spec.name).name if spec.name else assets_dir()
    report(json, {"folder": str(folder), "installed": folder.is_dir()}, str(folder))
    return 0
