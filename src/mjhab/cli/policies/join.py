"""``mjhab policy join``: several trained policies as one that reads the sentence."""

from __future__ import annotations

from mjhab.cli.output import report
from mjhab.learning.assigned.spec import PolicyJoinSpec
from mjhab.learning.require import require_learn


def run_join(spec: PolicyJoinSpec, json: bool) -> int:
    """Join policies; returns 0."""
    require_learn()
    # Here: it needs torch.
    from mjhab.learning.assigned.join import join

    done = join(spec)
    told = {**vars(done), "file": str(done.file), "unread": list(done.unread)}
    known = ", ".join(f"{name} ({count})" for name, count in done.requests.items())
    unread = (
        f" {len(done.unread)} sentences are taken for another." if done.unread else ""
    )
    report(
        json,
        told,
        f"{done.file} ({done.bytes:,} bytes): {done.members} policies; requests (sentences): {known}.{unread}",
    )
    return 0
