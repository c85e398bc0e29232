"""Tables on the device of the model fields in which homes differ: one row per home, copied to worlds at reset."""

from __future__ import annotations

import dataclasses

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp

from mjhab.sim.warp.kernels import copy_rows, keep_rows

HOME_FIELDS = (
    "body_pos",
    "body_quat",
    "geom_pos",
    "geom_quat",
    "geom_size",
    "geom_aabb",
    "geom_rbound",
    "jnt_range",
)
"""Fields of a compiled model in which the homes of a layout may differ."""
STATIC_POSES = ("geom_xpos", "geom_xmat")
"""World poses of geoms. The engine computes those of static geoms once, from its base model, for all worlds."""
_ROUNDING = 1e-6


class HomeTables:
    """Tables of HOME_FIELDS and STATIC_POSES with one row per home used so far, and their copies in the worlds.

    Args:
        base: host model that ``model`` was made from.
        model: device model; has one row per world of each of HOME_FIELDS.
        data: device data of W worlds.
        capacity: largest number of homes.

    Attributes:
        rows: (W,) int32 on the device: table row of the home that each world is in.
    """

    def __init__(
        self, base: mujoco.MjModel, model: mjw.Model, data: mjw.Data, capacity: int
    ) -> None:
        self._base = base
        views = {name: wp.to_torch(getattr(model, name)) for name in HOME_FIELDS}
        views |= {name: wp.to_torch(getattr(data, name)) for name in STATIC_POSES}
        self._worlds: dict[str, torch.Tensor] = views
        self._rows = wp.zeros(data.nworld, dtype=wp.int32)
        self.rows = wp.to_torch(self._rows)
        self._tables = {
            name: torch.zeros(
                # All rows at once: a table that grows would move, and captured graphs hold its address.
                (capacity, *view.shape[1:]),
                dtype=view.dtype,
                device=view.device,
            )
            for name, view in views.items()
        }
        # The same memory flattened to 2-D, for the kernel that copies rows under a mask.
        self._flat = [
            (wp.from_torch(self._tables[name].flatten(1)), wp.from_torch(view.flatten(1)))
            for name, view in views.items()
        ]
        self._index: dict[str, int] = {}
        self._shared = _shared_fields(base)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the homes used so far, in the order of their rows."""
        return tuple(self._index)

    def row(self, home: str, model: mujoco.MjModel) -> int:
        """Return the table row of a home; uploads its ``model`` on the first call.

        Raises:
            ValueError: the model differs from the base model in more than HOME_FIELDS.
        """
        if home not in self._index:
            # Otherwise a world would silently run with the values of another home.
            self._require_same(home, model)
            row = len(self._index)
            for name, values in _home_values(model).items():
                table = self._tables[name]
                table[row] = (
                    torch.as_tensor(values, dtype=table.dtype)
                    .reshape(table.shape[1:])
                    .to(table.device)
                )
            self._index[home] = row
        return self._index[home]

    def put(self, worlds: torch.Tensor, rows: torch.Tensor) -> None:
        """Put ``worlds`` (n,) into the homes of table ``rows`` (n,); both int64 on the device."""
        self.rows[worlds] = rows.to(self.rows.dtype)
        for name, view in self._worlds.items():
            view[worlds] = self._tables[name][rows]

    def put_masked(self, fresh: wp.array, rows: wp.array) -> None:
        """Put the worlds of mask ``fresh`` (W,) bool into homes ``rows`` (W,) int32; part of a captured graph."""
        wp.launch(keep_rows, dim=rows.shape, inputs=[fresh, rows], outputs=[self._rows])
        for table, world in self._flat:
            wp.launch(
                copy_rows, dim=world.shape, inputs=[fresh, rows, table], outputs=[world]
            )

    def _require_same(self, home: str, model: mujoco.MjModel) -> None:
        for name in self._shared:
            ours = getattr(self._base, name)
            theirs = getattr(model, name)
            same = np.shape(ours) == np.shape(theirs)
            # Not exactly: derived fields differ in their last bits between homes.
            if not same or not np.allclose(ours, theirs, rtol=_ROUNDING, atol=_ROUNDING):
                raise ValueError(
                    f"home {home!r} differs from its layout in {name}, which all worlds of a batch share"
                )


def _shared_fields(base: mujoco.MjModel) -> list[str]:
    """Return the names of the MjModel fields that the device model stores once for all worlds."""
    names = {field.name for field in dataclasses.fields(mjw.Model)} - set(HOME_FIELDS)
    return [
        name
        for name in sorted(names)
        if isinstance(getattr(base, name, None), (np.ndarray, int))
    ]


def _home_values(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    data = mujoco.MjData(model)
    # The engine never computes static poses anew, so that C MuJoCo does it once per home.
    mujoco.mj_kinematics(model, data)
    values = {name: np.asarray(getattr(model, name)) for name in HOME_FIELDS}
    return values | {name: np.asarray(getattr(data, name)) for name in STATIC_POSES}
