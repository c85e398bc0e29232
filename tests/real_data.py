"""Where tests find the real data sets: ReplicaCAD, YCB, episodes. They are never part of the repository."""

from __future__ import annotations

import os
from pathlib import Path

from tests.missing import missing

VARIABLE = "MJHAB_TEST_DATA"
DEFAULT = Path(__file__).parents[2] / "shared" / "data"


def real_data(*parts: str) -> Path:
    """Path of a file or folder of the real data, e.g. ``real_data("ycb")``.

    The data lie in ``$MJHAB_TEST_DATA``, or in ``../shared/data`` beside the repository. Without them a test is skipped
    on a user's machine and fails where ``CI`` is set: there nothing may go untested in silence.
    """
    path = Path(os.environ.get(VARIABLE) or DEFAULT).joinpath(*parts)
    if not path.exists():
        missing(
            f"real data {path} is absent; set {VARIABLE} to the folder that holds {parts[0]}"
        )
    return path
