"""``mjhab policy mean``: the mean of the weights of policies that began alike."""

from __future__ import annotations

from mjhab.cli.output import report
from mjhab.learning.assigned.spec import PolicyMeanSpec
from mjhab.learning.require import require_learn


def run_mean(spec: PolicyMeanSpec, json: bool) -> int:
    """Write the mean; returns 0."""
    require_learn()
    # Here: it needs torch.
    from mjhab.learning.assigned.mean import mean

    done = mean(spec)
    shares = ", ".join(f"{share:.3g}" for share in done.shares)
    report(
        json,
        {**vars(done), "file": str(done.file), "shares": list(done.shares)},
        f"{done.file} ({done.bytes:,} bytes): the mean of {len(done.shares)} policies, shares {shares}.",
    )
    return 0
