"""Sizes of the engine's buffers, measured once per layout in rollouts with random commands in its homes."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp

from mjhab.core.errors import unknown_name, wrong_value
from mjhab.core.files.cache import cache_dir, read_cached, write_cached
from mjhab.core.joints import BASE
from mjhab.core.seeding import stream
from mjhab.layout.addresses import Addresses
from mjhab.layout.compile import home_hash
from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import placed_receptacles
from mjhab.scenes.spec import Home
from mjhab.sim.mujoco.settle import settle
from mjhab.sim.warp.buffers import BufferSizes
from mjhab.sim.warp.engine import Engine

MARGIN = 1.25
"""Factor on the largest demand measured in the stress rollouts."""
STRESS_HOMES = 4
"""Homes in which stress rollouts run."""
ROUNDS = 6
"""Stress rollouts per home."""
STRESS_STEPS = 600
"""Substeps [10 ms] of a stress rollout."""
HOLD_STEPS = 40
"""Substeps [10 ms] for which a random command is held."""
HEAPS = 6
"""Receptacles that hold all objects of a rollout: denser than in any task, so that the robot makes many contacts."""
LEAST = BufferSizes(contacts=24, ccd=16, rows=256, awake=64)
"""Least sizes per world: enough for the robot and eight moving objects."""
CROWD = 256
"""Extra contacts for the whole batch, so that one world with many contacts does not use up those of the others."""
PLACES = 30
"""Random base poses tried; the robot starts a rollout in the one with the fewest contacts."""
REACH = (0.6, 1.0)
"""Range of the distance [m] of these base poses from a random object."""
TOP_SPEED = 1.5
"""Largest command of velocity servos [m/s or rad/s], and of position servos of joints without limits [rad]."""
WORST_STATES = 1
"""States with the most contacts of each rollout whose demand is measured on the device."""
OTHER_STATES = 1
"""Random states of each rollout whose demand is measured on the device."""
SLEEP_STEPS = 30
"""Substeps [10 ms] simulated before the first command, in which C MuJoCo puts trees at rest to sleep."""
AWAKE_STEP = 16
"""The engine solves dense blocks of this many dofs; `BufferSizes.awake` is a multiple of it."""
_CCD_TRIES = (16, 32, 64, 96, 128, 192, 256, 512, 1024)
_GENEROUS = BufferSizes(contacts=4096, ccd=1024, rows=2048)
_FORMAT = "mjhab-warp-sizes-1"


@dataclass(frozen=True)
class BufferUsage:
    """Measured demand of one world on each of `BufferSizes`: the largest, and for shared buffers also the mean."""

    contacts: int
    mean_contacts: float
    ccd: int
    mean_ccd: float
    rows: int
    awake: int

    def sizes(self, num_worlds: int, nv: int) -> BufferSizes:
        """Return the buffer sizes for a batch.

        Contacts and ccd are shared by all worlds, so that the batch needs less than the largest demand of every world.

        Args:
            num_worlds: size of the batch.
            nv: dofs of the model, the limit of ``awake``.
        """

        def shared(worst: int, mean: float) -> int:
            # The standard error of the mean over the worlds, twice, for demands between 0 and the worst.
            spread = 2.0 * math.sqrt(worst * mean / num_worlds)
            return math.ceil(
                # One world at its worst and the others at their mean.
                MARGIN * (worst + (num_worlds - 1) * min(worst, mean + spread))
            )

        contacts = CROWD + max(
            LEAST.contacts * num_worlds, shared(self.contacts, self.mean_contacts)
        )
        ccd = min(
            contacts, CROWD + max(LEAST.ccd * num_worlds, shared(self.ccd, self.mean_ccd))
        )
        rows = max(LEAST.rows, math.ceil(MARGIN * self.rows))
        awake = max(
            LEAST.awake or 0, AWAKE_STEP * math.ceil(MARGIN * self.awake / AWAKE_STEP)
        )
        return BufferSizes(contacts, ccd, rows, min(nv, awake))


@dataclass(frozen=True, eq=False)
class StressRollout:
    """Result of a stress rollout.

    Attributes:
        states: (qpos (nq,), tree_asleep (ntree,)) of the states to measure on the device.
        rows: largest number of constraint rows of any substep.
        awake: largest number of awake dofs of any substep.
    """

    states: list[tuple[np.ndarray, np.ndarray]]
    rows: int
    awake: int


def buffer_sizes(
    layout: Layout,
    model: Callable[[str], mujoco.MjModel],
    a: Addresses,
    num_worlds: int,
    device: wp.Device,
) -> BufferSizes:
    """Return the buffer sizes for a batch of worlds of a layout; measured demands are cached on disk.

    Args:
        layout: the layout.
        model: returns the compiled model of a home by name, with the servos that the worlds have.
        a: addresses of the layout.
        num_worlds: size of the batch.
        device: Warp device to measure on.
    """
    homes = layout.pack.homes
    chosen = [
        homes[i]
        # Spread over the list, whose neighbours are variants of one plan of a home.
        for i in sorted({round(x) for x in np.linspace(0, len(homes) - 1, STRESS_HOMES)})
    ]
    digest = hashlib.sha256(
        # With this file, whose rollouts decide the numbers.
        repr((_FORMAT, mjw.__version__)).encode() + Path(__file__).read_bytes()
    )
    for home in chosen:
        digest.update(home_hash(layout, home).encode())
    # Servos decide how hard the robot pushes; the hash of a home has those of the robot, not of the control mode.
    first = model(homes[0].name)
    for servos in (first.actuator_gainprm, first.actuator_biasprm, first.jnt_actfrcrange):
        digest.update(servos.tobytes())
    path = cache_dir() / "warp" / f"sizes-{digest.hexdigest()[:24]}.json"
    demand = read_cached(path, _load)
    if demand is None:
        demand = measure_demand(layout, model, a, chosen, device)
        text = json.dumps(dataclasses.asdict(demand))
        write_cached(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    return demand.sizes(num_worlds, first.nv)


def _load(path: Path) -> BufferUsage:
    return BufferUsage(**json.loads(path.read_text(encoding="utf-8")))


def changed_sizes(sizes: BufferSizes, changes: Mapping[str, int]) -> BufferSizes:
    """Return ``sizes`` with the fields of ``changes`` replaced.

    Raises:
        UsageError: there is no such field, or a value is not an integer of at least 1.
    """
    names = [field.name for field in dataclasses.fields(BufferSizes)]
    for name, value in changes.items():
        if name not in names:
            raise unknown_name("buffer", name, names)
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise wrong_value(f"buffer {name!r}", value, "a whole number of at least 1")
    return dataclasses.replace(sizes, **changes)


def measure_demand(
    layout: Layout,
    model: Callable[[str], mujoco.MjModel],
    a: Addresses,
    homes: list[Home],
    device: wp.Device,
) -> BufferUsage:
    """Run stress rollouts in ``homes`` on C MuJoCo, and measure the demand of states of them on the device."""
    engine = Engine(model(homes[0].name), a, 1, len(homes), _GENEROUS, device)
    turns = [home for home in homes for _ in range(ROUNDS)]
    runs = [
        stress(layout, home, model(home.name), a, index)
        for index, home in enumerate(turns)
    ]
    needs = np.array(
        [
            _measure(engine, engine.homes.row(home.name, model(home.name)), *state)
            for home, run in zip(turns, runs, strict=True)
            for state in run.states
        ]
    )
    contacts, ccd, rows = needs.T
    # Both engines: C MuJoCo counts in every step, the device only in some.
    most_rows = max(int(rows.max()), *(run.rows for run in runs))
    return BufferUsage(
        int(contacts.max()),
        float(contacts.mean()),
        int(ccd.max()),
        float(ccd.mean()),
        most_rows,
        max(run.awake for run in runs),
    )


def stress(
    layout: Layout, home: Home, model: mujoco.MjModel, a: Addresses, index: int
) -> StressRollout:
    """Simulate random commands at full speed near objects on the receptacles of a home; ``index`` seeds the draws."""
    # A fixed seed: equal layouts get equal buffers.
    rng = stream(0, "warp stress", index)
    data = mujoco.MjData(model)
    data.qpos[:] = settle(model, a, _strew(layout, home, model, a, rng))[0]
    _stand_free(data, model, a, rng)
    low, high = model.jnt_range[model.actuator_trnid[:, 0]].T
    # A servo without position gain takes a speed.
    is_speed = (model.actuator_biasprm[:, 1] == 0.0) | (high <= low)
    low = np.where(is_speed, -TOP_SPEED, low)
    high = np.where(is_speed, TOP_SPEED, high)
    mujoco.mj_step(model, data, SLEEP_STEPS)
    counts = []
    states = []
    rows = 0
    awake = 0
    for step in range(STRESS_STEPS):
        # Held for a while, so that the robot gets up speed and runs into things.
        if step % HOLD_STEPS == 0:
            data.ctrl[:] = rng.uniform(low, high)
        mujoco.mj_step(model, data)
        counts.append(data.ncon)
        states.append((data.qpos.copy(), data.tree_asleep.copy()))
        rows = max(rows, data.nefc)
        awake = max(awake, data.nv_awake)
    # Stable, so that ties give the same states on every machine.
    order = np.argsort(counts, kind="stable")[-WORST_STATES:].tolist()
    order += rng.choice(STRESS_STEPS, OTHER_STATES, replace=False).tolist()
    return StressRollout([states[i] for i in order], rows, awake)


def _strew(
    layout: Layout,
    home: Home,
    model: mujoco.MjModel,
    a: Addresses,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return a state (nq,) with every object 2 cm above a random point of one of HEAPS open receptacles."""
    qpos = model.qpos0.copy()
    surfaces = [
        r for r in placed_receptacles(layout, home) if not r.link and r.kind == "open"
    ]
    surfaces = [surfaces[i] for i in rng.permutation(len(surfaces))[:HEAPS]]
    for slot in range(layout.num_objects if surfaces else 0):
        on = surfaces[rng.integers(len(surfaces))]
        place = on.point(*rng.uniform(-1.0, 1.0, 2) * on.half)
        start = a.object_q[slot]
        qpos[start : start + 3] = place + np.array(
            [0.0, 0.0, layout.objects[slot].half[2] + 0.02]
        )
    return qpos


def _stand_free(
    data: mujoco.MjData, model: mujoco.MjModel, a: Addresses, rng: np.random.Generator
) -> None:
    """Set the robot to the one of PLACES random base poses near objects in which it has the fewest contacts."""
    robot_tree = model.body_treeid[a.robot_body[a.robot.tcp]]
    data.qpos[a.robot_q] = a.robot.rest
    best = np.zeros(3)
    least = math.inf
    for _ in range(PLACES):
        yaw = rng.uniform(-np.pi, np.pi)
        distance = rng.uniform(*REACH)
        thing = (
            data.qpos[a.object_q[rng.integers(len(a.object_q))] :][:2]
            if len(a.object_q)
            else np.zeros(2)
        )
        place = np.array(
            [*(thing - distance * np.array([np.cos(yaw), np.sin(yaw)])), yaw]
        )
        data.qpos[a.robot_q[BASE]] = place
        mujoco.mj_forward(model, data)
        touching = (
            (model.body_treeid[model.geom_bodyid[data.contact.geom]] == robot_tree)
            .any(axis=1)
            .sum()
        )
        # The first of equals, whatever follows.
        if touching < least:
            best = place
            least = touching
    data.qpos[a.robot_q[BASE]] = best


def _measure(
    engine: Engine, home_row: int, qpos: np.ndarray, asleep: np.ndarray
) -> tuple[int, int, int]:
    """Measure the demand of one state on the device.

    Args:
        engine: with a batch of one world.
        home_row: row of the home in the engine's tables.
        qpos: (nq,) state.
        asleep: (ntree,) its ``tree_asleep``.

    Returns:
        Contacts or candidate pairs, whichever are more; geom pairs in convex collision; constraint rows.
    """
    data = engine.data
    device = engine.qpos_t.device
    world = torch.zeros(1, dtype=torch.int64, device=device)
    row = torch.as_tensor([home_row], device=device)
    contacts = rows = 0
    # The engine does not count pairs in convex collision, but reports when they exceed ``naccdmax``.
    for allowed in _CCD_TRIES:
        data.naccdmax = allowed
        # The captured graph holds the old size.
        engine.graphs.forget()
        engine.clear(world, row, torch.as_tensor(asleep[None], device=device))
        engine.qpos_t[world] = torch.as_tensor(qpos).to(engine.qpos_t)
        engine.clear_flags(world)
        engine.refresh(world)
        contacts = max(int(data.nacon.numpy()[0]), int(engine.pairs_peak.numpy()[0]))
        rows = int(data.nefc.numpy()[0])
        if not int(data.overflow.numpy()[0]) & int(mjw.OverflowType.CCD):
            return contacts, allowed, rows
    # Even the largest was too small; the margin and the overflow bit remain.
    return contacts, _CCD_TRIES[-1], rows
