"""The options of ``mjhab eval`` and ``mjhab demo``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class DemoOptions:
    """Run a demonstration: the expert sets the table in four furnished homes; films and report go to runs/demo.

    The same as `mjhab eval --task set_table --policy expert --episodes 4 --worlds 4 --seed 0 --films 4`. The first run
    compiles for about a minute; then it takes two minutes on two cores.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/demo")
    """Folder of the results; results of an earlier run are replaced."""
    json: bool = False
    """Print the summary as one line of JSON at the end, as eval does."""
