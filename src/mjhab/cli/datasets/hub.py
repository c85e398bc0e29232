"""``mjhab dataset push|pull`` and ``mjhab policy push|pull``: data sets and policies to and from the hub."""

from __future__ import annotations

import tempfile
from pathlib import Path

from mjhab.cli.exits import stopped
from mjhab.cli.output import report
from mjhab.core.files.interrupts import sigterm_interrupts
from mjhab.evaluation.publishing.hub import Pushed, pull, push_dataset, push_folder
from mjhab.evaluation.publishing.spec import DatasetPushSpec, PolicyPushSpec, PullSpec


def run_push(spec: DatasetPushSpec, json: bool) -> int:
    """Upload a data set; returns 0."""
    return _tell(push_dataset(spec), json)


def run_policy_push(spec: PolicyPushSpec, json: bool) -> int:
    """Upload a policy; returns 0."""
    # Here: pulling needs no torch.
    from mjhab.learning.publishing import gather

    with tempfile.TemporaryDirectory(prefix="mjhab-policy-") as folder:
        gather(spec.policy, Path(folder), spec.licence)
        return _tell(push_folder(Path(folder), spec.repo, "model", spec.private), json)


def _tell(done: Pushed, json: bool) -> int:
    report(json, vars(done), f"{done.files} files, {done.bytes:,} bytes: {done.address}")
    return 0


def run_pull(spec: PullSpec, json: bool) -> int:
    """Download a data set or an export; returns 0, or 130 after Ctrl-C or SIGTERM."""
    return _pull(spec, "dataset", json)


def run_policy_pull(spec: PullSpec, json: bool) -> int:
    """Download a policy; returns 0, or 130 after Ctrl-C or SIGTERM."""
    return _pull(spec, "model", json)


def _pull(spec: PullSpec, kind: str, json: bool) -> int:
    try:
        with sigterm_interrupts():
            done = pull(spec, kind)
    except KeyboardInterrupt:
        # Pulling goes on by itself, so no --resume is named.
        return stopped(f"finished files are kept in {spec.out}", again="")
    facts = {"path": str(done.path), "commit": done.commit, "files": done.files}
    report(json, facts, f"{done.files} files of commit {done.commit[:8]}: {done.path}")
    return 0
