"""The device that the tests of the backend warp run on: Warp's CPU device, or the one named by MJHAB_TEST_DEVICE."""

from __future__ import annotations

import os
import sys
from typing import Any

import numpy as np

TEST_DEVICE = os.environ.get("MJHAB_TEST_DEVICE", "cpu")


def read_on_host() -> None:
    """Let tests read tensors of a GPU as arrays, as they do on Warp's CPU device; the package itself may not."""
    import torch

    plain = {name: getattr(torch.Tensor, name) for name in ("numpy", "__array__")}

    def reader(name: str) -> Any:
        def read(self: Any, *args: Any, **options: Any) -> Any:
            asker = sys._getframe(1).f_globals.get("__name__", "")
            here = self if asker.startswith("mjhab.") else self.detach().cpu()
            options.pop("copy", None)  # numpy asks; torch's __array__ does not know it
            return plain[name](here, *args, **options)

        return read

    for name in plain:
        setattr(torch.Tensor, name, reader(name))


def check_repeated(ours: Any, theirs: Any, what: str = "") -> None:
    """Check that the same work, done twice, has the same result (arrays): every bit on Warp's CPU device.

    A GPU adds in changing order (atomics). After two control steps 1e-11 in positions and 4e-7 in the accelerations of
    the warm start were seen there.
    """
    if TEST_DEVICE == "cpu":
        np.testing.assert_array_equal(ours, theirs, err_msg=what)
        return
    wanted = np.asarray(theirs, float)
    scale = max(1.0, float(np.abs(wanted).max(initial=0.0)))
    np.testing.assert_allclose(
        np.asarray(ours, float), wanted, rtol=1e-3, atol=1e-4 * scale, err_msg=what
    )
