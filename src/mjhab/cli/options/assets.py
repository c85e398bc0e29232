"""The options of ``mjhab assets``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.cli.options.common import MaybeName, Sub

DataSet = Annotated[
    tyro.conf.Positional[str], tyro.conf.arg(metavar="replica_cad|ycb|hab_episodes")
]


@dataclass(frozen=True)
class AssetsListOptions:
    """List the public data sets that mjhab reads, their licences, and which are installed."""

    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class AssetsFetchOptions:
    """Download a public data set and install it; none is needed for the built-in homes.

    For instance: `mjhab assets fetch replica_cad --accept-licence`

    An interrupted download continues with the same command. HF_ENDPOINT names a mirror of the hub; http_proxy,
    https_proxy and no_proxy are honoured. Without a network: zip the folder that `mjhab assets where` names on another
    machine, and give the file to --offline.
    """

    name: DataSet
    """The data set."""
    offline: Annotated[Path | None, tyro.conf.arg(metavar="BUNDLE")] = None
    """Install from this zip or tar archive; nothing is downloaded."""
    accept_licence: bool = False
    """Accept the licence of the data set, which differs from that of mjhab, without being asked."""
    overwrite: bool = False
    """Replace an installed data set."""
    repo: MaybeName = None
    """Another repository of the hub with the same files."""
    revision: MaybeName = None
    """Another branch, tag or commit of the repository."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class AssetsVerifyOptions:
    """Compare the files of an installed data set with the hashes recorded when it was installed.

    A folder that was not installed by mjhab has no record: its hashes are recorded now and used from then on.
    """

    name: DataSet
    """The data set."""
    json: bool = False
    """Print one line of JSON instead of tables."""


@dataclass(frozen=True)
class AssetsWhereOptions:
    """Print the folder of a data set, or the folder of all data sets, which MJHAB_ASSETS sets."""

    name: Annotated[
        tyro.conf.Positional[str], tyro.conf.arg(metavar="replica_cad|ycb|hab_episodes")
    ] = ""
    """The data set; the folder of all of them if absent, which --assets takes."""
    json: bool = False
    """Print one line of JSON."""


@dataclass(frozen=True)
class AssetsCommand:
    """List, install, verify and locate public data sets."""

    command: (
        Annotated[AssetsListOptions, Sub("list")]
        | Annotated[AssetsFetchOptions, Sub("fetch")]
        | Annotated[AssetsVerifyOptions, Sub("verify")]
        | Annotated[AssetsWhereOptions, Sub("where")]
    )
