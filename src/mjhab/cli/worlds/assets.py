"""``mjhab assets``: list, install, verify and locate public data sets."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

from mjhab.assets.install import fetch, install_bundle, read_record, verify
from mjhab.assets.sources import SOURCES, Source, hub_endpoint, source_named
from mjhab.cli.options.assets import (
    AssetsFetchOptions,
    AssetsListOptions,
    AssetsVerifyOptions,
    AssetsWhereOptions,
)
from mjhab.cli.output import print_json, print_table
from mjhab.core.errors import UsageError
from mjhab.core.files.cache import assets_dir


def run_assets(
    options: AssetsListOptions
    | AssetsFetchOptions
    | AssetsVerifyOptions
    | AssetsWhereOptions,
) -> int:
    """Run one of the four commands and return the exit code."""
    if isinstance(options, AssetsListOptions):
        return list_assets(options)
    if isinstance(options, AssetsFetchOptions):
        return fetch_assets(options)
    if isinstance(options, AssetsVerifyOptions):
        return verify_assets(options)
    return where(options)


def list_assets(options: AssetsListOptions) -> int:
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
    if options.json:
        print_json({"folder": str(assets_dir()), "assets": rows})
        return 0
    shown = [
        (row["name"], row["title"], row["licence"], "yes" if row["installed"] else "no")
        for row in rows
    ]
    print_table(
        f"data sets, in {assets_dir()}", ("name", "what", "licence", "installed"), shown
    )
    return 0


def fetch_assets(options: AssetsFetchOptions) -> int:
    """Install one data set, from the hub or from an archive."""
    source = source_named(options.name)
    source = replace(
        source,
        repo=options.repo or source.repo,
        revision=options.revision or source.revision,
    )
    _agree(source, options.accept_licence)
    if options.offline is not None:
        folder = install_bundle(source, options.offline, assets_dir(), options.overwrite)
    else:
        print(
            f"{source.name} from {hub_endpoint()}/datasets/{source.repo} ({source.revision})",
            file=sys.stderr,
        )
        folder = fetch(source, assets_dir(), options.overwrite)
    record = read_record(folder) or {"files": {}}
    size = sum(row["size"] for row in record["files"].values())
    if options.json:
        print_json(
            {
                "name": source.name,
                "folder": str(folder),
                "files": len(record["files"]),
                "bytes": size,
            }
        )
    else:
        print(
            f"{source.name}: {len(record['files'])} files, {size / 1e6:.1f} MB in {folder}"
        )
    return 0


def _agree(source: Source, accepted: bool) -> None:
    """Show the licence of a data set and, in a terminal, ask whether the user accepts it.

    Raises:
        UsageError: the licence is not accepted.
    """
    print(
        f"{source.title}\nLicence: {source.licence}\nTerms: {source.terms}",
        file=sys.stderr,
    )
    if accepted:
        return
    if not sys.stdin.isatty():
        raise UsageError(
            f"{source.name} has its own licence (above); add --accept-licence to accept it."
        )
    print("Do you accept these terms? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise UsageError(
            f"the terms of {source.name} were not accepted; nothing was installed."
        )


def verify_assets(options: AssetsVerifyOptions) -> int:
    """Check one installed data set; returns 1 if files are missing or changed."""
    folder = assets_dir() / source_named(options.name).name
    found = verify(folder)
    good = not (found.missing or found.changed)
    if options.json:
        print_json(
            {
                "name": options.name,
                "folder": str(folder),
                "ok": good,
                "files": found.files,
                "missing": list(found.missing),
                "changed": list(found.changed),
                "first_use": found.first_use,
            }
        )
        return 0 if good else 1
    problems = [(path, "missing") for path in found.missing] + [
        (path, "changed") for path in found.changed
    ]
    if problems:
        print_table(
            f"{folder}: {len(problems)} of {found.files} files are not as installed",
            ("file", "is"),
            problems,
        )
        print(f"`mjhab assets fetch {options.name} --overwrite` installs them again.")
    elif found.first_use:
        print(
            f"{folder}: it had no record; the hashes of its {found.files} files are recorded now."
        )
    else:
        print(f"{folder}: {found.files} files are as installed.")
    return 0 if good else 1


def where(options: AssetsWhereOptions) -> int:
    """Print the folder of a data set, or of all data sets."""
    folder = (
        assets_dir() / source_named(options.name).name if options.name else assets_dir()
    )
    if options.json:
        print_json({"folder": str(folder), "installed": folder.is_dir()})
    else:
        print(folder)
    return 0
