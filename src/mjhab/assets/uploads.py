"""Uploads to the hub: all files of a folder in one commit, so that a repository has the old set or the new one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from mjhab.assets.hub import TransferError, address_of, check_repository, patiently
from mjhab.assets.sources import hub_endpoint
from mjhab.core.errors import UsageError, fault, missing_field
from mjhab.core.version import __version__

_REFUSED = (401, 403)
"""HTTP states of a token that is not valid, or may not do this."""


def upload(
    name: str, kind: str, files: Mapping[str, Path], message: str, private: bool = False
) -> str:
    """Put files into a repository, which is made if it is not there; returns the address of the commit.

    Files that it has besides stay.

    Args:
        name: of the repository, "USER/NAME".
        kind: "dataset" or "model".
        files: the files by their path in the repository.
        message: of the commit.
        private: make a new repository private.

    Raises:
        UsageError: there is no token, it may not write there, or ``name`` is none of a repository.
        TransferError: the hub cannot be reached, or answers something else; the repository is as it was.
    """
    import huggingface_hub
    from huggingface_hub import CommitOperationAdd, HfApi
    from huggingface_hub.utils import disable_progress_bars, logging

    check_repository(name)
    # Asked for first: without one a GB would be prepared for nothing.
    token = huggingface_hub.get_token()
    if not token:
        raise missing_field(
            "token",
            "an upload",
            "Set HF_TOKEN to a token that may write, or log in once: hf auth login.",
        )
    logging.set_verbosity_error()
    disable_progress_bars()
    api = HfApi(hub_endpoint(), token, library_name="mjhab", library_version=__version__)
    where = address_of(name, kind)

    def commit() -> str:
        # None leaves an existing repository as it is.
        api.create_repo(name, repo_type=kind, private=private or None, exist_ok=True)
        added = [CommitOperationAdd(path, local) for path, local in files.items()]
        done = api.create_commit(name, added, commit_message=message, repo_type=kind)
        return str(done.commit_url)

    try:
        return patiently(commit, where)
    except TransferError as error:
        if error.status in _REFUSED:
            raise _may_not(where, error) from error
        raise


def _may_not(where: str, error: TransferError) -> UsageError:
    return fault(
        where,
        f"the token may not write there (the server says {error.status}); take one of its owner, or another name.",
    )
