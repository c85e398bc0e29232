"""How large the engine's buffers must be: measured once per layout by driving wildly through its homes."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp

from mjhab.core.cache import cache_dir, write_atomic
from mjhab.core.seeding import stream
from mjhab.scenes.compile import home_hash
from mjhab.scenes.layout import Addresses, Layout
from mjhab.scenes.receptacles import placed_receptacles
from mjhab.scenes.spec import Home
from mjhab.sim.warp_engine import BufferSizes, Engine

MARGIN = 1.5
"""Over the largest demand that the stress rollouts saw."""
STRESS_HOMES, STRESS_STEPS, HOLD_STEPS = 4, 300, 25
"""Homes driven through, substeps [10 ms] in each, and substeps that one random command lasts."""
TOP_SPEED = 1.5
"""Largest command [m/s or rad/s] of velocity servos, and angle [rad] of joints without limits."""
WORST_STATES, OTHER_STATES = 6, 6
"""Per home: states with most contacts, and random ones, whose demand is measured on the device."""
_GENEROUS = BufferSizes(contacts=4096, ccd=1024, rows=2048)
_CCD_TRIES = (8, 16, 24, 32, 48, 64, 96, 128, 192, 256, 512, 1024)
_FORMAT = "mjhab-warp-sizes-1"


@dataclass(frozen=True)
class Demand:
    """What one world may need: the worst that was seen, and the mean. See `BufferSizes`."""

    contacts: int
    mean_contacts: float
    ccd: int
    mean_ccd: float
    rows: int

    def sizes(self, num_worlds: int) -> BufferSizes:
        """Buffers for a batch: as contacts are shared, not every world needs the worst at once."""

        def shared(worst: int, mean: float) -> int:
            return math.ceil(MARGIN * (worst + (num_worlds - 1) * (mean + 2.0 * math.sqrt(worst * mean / num_worlds))))

        contacts = shared(self.contacts, self.mean_contacts)
        ccd = min(contacts, shared(self.ccd, self.mean_ccd))
        return BufferSizes(contacts, ccd, math.ceil(MARGIN * self.rows))


def buffer_sizes(
    layout: Layout, model: Callable[[str], mujoco.MjModel], a: Addresses, num_worlds: int, device: wp.Device
) -> BufferSizes:
    """Sizes for a batch of worlds of a layout, from the cache when they were measured before."""
    homes = layout.pack.homes
    chosen = [homes[i] for i in sorted({round(x) for x in np.linspace(0, len(homes) - 1, STRESS_HOMES)})]
    digest = hashlib.sha256(repr((_FORMAT, mjw.__version__, STRESS_STEPS, HOLD_STEPS)).encode())
    for home in chosen:
        digest.update(home_hash(layout, home).encode())
    path = cache_dir() / "warp" / f"sizes-{digest.hexdigest()[:24]}.json"
    if path.exists():
        return Demand(**json.loads(path.read_text(encoding="utf-8"))).sizes(num_worlds)
    demand = measure_demand(layout, model, a, chosen, device)
    text = json.dumps(dataclasses.asdict(demand))
    write_atomic(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    return demand.sizes(num_worlds)


def measure_demand(
    layout: Layout, model: Callable[[str], mujoco.MjModel], a: Addresses, homes: list[Home], device: wp.Device
) -> Demand:
    """Drive through some homes on C MuJoCo and measure chosen states of them on the device, one by one."""
    engine = Engine(model(homes[0].name), a, 1, len(homes), _GENEROUS, device)
    pairs, ccd, rows = [], [], []
    for index, home in enumerate(homes):
        states, most_rows = stress(layout, home, model(home.name), a, index)
        rows.append(most_rows)
        row = engine.homes.row(home.name, model(home.name))
        for qpos in states:
            need = _measure(engine, row, qpos)
            pairs.append(need[0])
            ccd.append(need[1])
            rows.append(need[2])
    return Demand(max(pairs), float(np.mean(pairs)), max(ccd), float(np.mean(ccd)), max(rows))


def stress(
    layout: Layout, home: Home, model: mujoco.MjModel, a: Addresses, index: int
) -> tuple[list[np.ndarray], int]:
    """Random commands at full speed among objects dropped on the receptacles of a home.

    Returns:
        States (nq,) with many contacts and random ones; the most constraint rows of any state.
    """
    rng = stream(0, "warp stress", index)
    data = mujoco.MjData(model)
    surfaces = [r for r in placed_receptacles(layout, home) if not r.link and r.kind == "open"]
    for slot in range(layout.num_objects if surfaces else 0):
        on = surfaces[rng.integers(len(surfaces))]
        place = on.point(*rng.uniform(-1.0, 1.0, 2) * on.half)
        start = a.object_q[slot]
        data.qpos[start : start + 3] = place + [0.0, 0.0, layout.objects[slot].half[2] + 0.02]
    counts, states, rows = [], [], 0
    low, high = model.jnt_range[model.actuator_trnid[:, 0]].T
    # A servo without stiffness is commanded a speed.
    is_speed = (model.actuator_biasprm[:, 1] == 0.0) | (high <= low)
    low, high = np.where(is_speed, -TOP_SPEED, low), np.where(is_speed, TOP_SPEED, high)
    for step in range(STRESS_STEPS):
        if step % HOLD_STEPS == 0:
            data.ctrl[:] = rng.uniform(low, high)
        mujoco.mj_step(model, data)
        counts.append(data.ncon)
        rows = max(rows, data.nefc)
        states.append(data.qpos.copy())
    order = np.argsort(counts, kind="stable")[-WORST_STATES:].tolist()
    order += rng.choice(STRESS_STEPS, OTHER_STATES, replace=False).tolist()
    return [states[i] for i in order], rows


def _measure(engine: Engine, home_row: int, qpos: np.ndarray) -> tuple[int, int, int]:
    """Demand of one state: contacts or candidate pairs, pairs in convex collision, constraint rows."""
    data, device = engine.data, engine.qpos_t.device
    world, row = torch.zeros(1, dtype=torch.int64, device=device), torch.as_tensor([home_row], device=device)
    contacts = rows = 0
    # The engine counts pairs in convex collision nowhere, but says when there are more than it may take.
    for allowed in _CCD_TRIES:
        data.naccdmax = allowed
        engine.clear(world, row)
        engine.qpos_t[world] = torch.as_tensor(qpos).to(engine.qpos_t)
        engine.clear_flags(world)
        engine.refresh(world)
        contacts = max(int(data.nacon.numpy()[0]), int(engine.pairs_peak.numpy()[0]))
        rows = int(data.nefc.numpy()[0])
        if not int(data.overflow.numpy()[0]) & int(mjw.OverflowType.CCD):
            return contacts, allowed, rows
    return contacts, _CCD_TRIES[-1], rows
