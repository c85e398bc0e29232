"""Generate episodes of household tasks; (task, split, seed, index) determine an episode on a layout.

The `TaskSpec` of a task defines where objects start and where their goals are, by furniture roles (`scenes.roles`).
A home without room for the objects is skipped: the next one of the list takes its place (`EpisodeMaker.make`).
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import numpy as np

from mjhab.core.arithmetic.digest import arithmetic_digest
from mjhab.core.errors import UsageError, fault, unknown_name, warn_once
from mjhab.core.files.cache import cache_dir, read_cached
from mjhab.core.names import below
from mjhab.core.registration.plugins import source_digest
from mjhab.core.seeding import stream
from mjhab.episodes.episode import Episode, read_episode, write_episode
from mjhab.episodes.homes import homes_named, homes_of, require_furniture
from mjhab.episodes.placement import Draw, Placer
from mjhab.layout.compile import home_hash
from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import (
    placed_receptacles,
)
from mjhab.layout.standing import standing_on
from mjhab.scenes.roles import link_with_role, roles_of
from mjhab.scenes.spec import Home
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import settle
from mjhab.tasks.household.registry import TASKS

MAX_DRIFT = 0.02
"""A draw is rejected if an object moves farther than this [m] while it settles."""
MAX_SPEED = 0.05
"""A draw is rejected if an object is faster than this [m/s or rad/s] after settling."""
MOST_DRAWS = 200
"""A home is given up after so many draws of an episode."""
_MOST_NAMED = 4
"""So many homes a message names; of others it tells the number."""
_VERSION = 3


class EpisodeMaker:
    """Generates the episodes of one task on one layout, and caches them on disk.

    Args:
        sim: CPU simulator of the layout; its compiled models are used to settle objects.
        task: name of the household task.
        split: split of homes to draw from.
        home: name of a home, or a pattern such as ``v3_sc0_staging_0?``: episode i is in home i modulo the number of
            homes that fit; "" to draw a home of ``split`` per episode. If it has no room, the next one is taken.
        target: object type that must be among the targets; "" for any.

    Raises:
        UsageError: there is no such task or home, a home lacks furniture of the task, or the roster an object.
    """

    def __init__(
        self, sim: CpuSimulator, task: str, split: str, home: str = "", target: str = ""
    ) -> None:
        self.sim = sim
        self.task = task
        self.spec = TASKS[task]
        self.split = split
        self.target = target
        self.layout: Layout = sim.layout
        self.homes = (
            homes_named(self.layout.pack, home)
            if home
            else homes_of(self.layout.pack, split)
        )
        # Homes that are named are visited one after the other, so that each of them occurs.
        self._in_turn = bool(home)
        require_furniture(self.layout.pack, self.homes, task)
        self._require_objects()
        self._placer = Placer(self.layout, self.spec, target)

    def _require_objects(self) -> None:
        """Check that the roster has the objects that the target rules of the task name.

        Raises:
            UsageError: it lacks one; the message names the rule.
        """
        roster = self.layout.roster
        for k, rule in enumerate(self.spec.targets):
            if rule.object and rule.object not in roster:
                raise fault(
                    TASKS.described(self.task),
                    f"targets[{k}]: {unknown_name('object', rule.object, set(roster))} Name it in "
                    "TaskSpec.objects, too.",
                )

    def episode(self, seed: int, index: int) -> Episode:
        """Return the episode of (seed, index), from the cache if it was made before.

        Raises:
            UsageError: no home has room, see `make`.
        """
        path = self._path(seed, index)
        found = read_cached(
            path, lambda file: read_episode(file, self.task, self.split, seed, index)
        )
        if found is None:
            # The number of draws is not kept: it is of interest only while files are made.
            found, _ = self.make(seed, index)
            write_episode(path, found)
        # Said for cached episodes, too: else only the first run would tell.
        for home in found.skipped_homes:
            self._tell_skipped(home)
        return found

    def make(self, seed: int, index: int) -> tuple[Episode, int]:
        """Generate the episode of (seed, index) without the cache; also return the number of rejected draws.

        If ``MOST_DRAWS`` draws in its home find no room, the homes after it in the list are tried in turn, so that the
        home is a function of (seed, index) and the list, not of the episodes made before.

        Raises:
            UsageError: no draw of ``MOST_DRAWS`` in any of the homes found room for all objects and came to rest.
        """
        skipped: list[str] = []
        for home in self._homes_for(seed, index):
            for attempt in range(MOST_DRAWS):
                episode = self._draw(seed, index, attempt, home)
                if episode is not None:
                    rejected = len(skipped) * MOST_DRAWS + attempt
                    accepted = dataclasses.replace(episode, skipped_homes=tuple(skipped))
                    return accepted, rejected
            skipped.append(home.name)
            if len(skipped) < len(self.homes):
                self._tell_skipped(home.name)
        raise self._no_room(skipped, seed, index)

    def _tell_skipped(self, home: str) -> None:
        warn_once(
            f"home {home!r} has no room for episodes of {self.task}: they take place in the next home of the list."
        )

    def _no_room(self, homes: list[str], seed: int, index: int) -> UsageError:
        if len(homes) == 1:
            which = f"home {homes[0]!r} has no"
            mend = "Choose other homes, or give this one"
        else:
            more = len(homes) - _MOST_NAMED
            named = ", ".join(homes[:_MOST_NAMED]) + (f", and {more} more" * (more > 0))
            which = f"none of the {len(homes)} homes ({named}) has"
            mend = "Choose other homes, or give one of these"
        return UsageError(
            f"{which} room for {self.task} episode {index} of seed {seed}: in {MOST_DRAWS} draws the "
            f"{self.layout.num_objects} objects found no places, or did not come to rest there. {mend} more "
            "furniture, or pieces of it the roles that the task needs."
        )

    def _draw(self, seed: int, index: int, attempt: int, home: Home) -> Episode | None:
        # The home does not depend on the attempt, so that homes in which draws often fail are as frequent as others.
        rng = stream(seed, "episode", self.task, self.split, index, attempt)
        receptacles = placed_receptacles(self.layout, home)
        roles = roles_of(self.layout.pack, home)
        # A copy, as objects are placed into it; those of no use stay parked.
        poses = self.layout.parked_poses.copy()
        standing = standing_on(self.layout, home)
        draw = Draw(home, roles, receptacles, {}, poses, standing)
        targets = self._placer.place_targets(rng, draw)
        if targets is None or not self._placer.place_clutter(rng, draw, targets):
            return None
        # The initial state belongs to the model, which all draws share.
        qpos = self.sim.model(home.name).qpos0.copy()
        a = self.sim.addresses
        qpos[a.object_q[:, None] + np.arange(7)] = draw.pose
        for role, position in self.spec.openings:
            link = link_with_role(roles, role)
            qpos[a.link_q[self.layout.link_ids.index(link)]] = position
        settled, speed = settle(self.sim.model(home.name), a, qpos)
        pose = settled[a.object_q[:, None] + np.arange(7)]
        if (
            speed > MAX_SPEED
            # Still objects may have fallen from where they were placed.
            or np.linalg.norm(pose[:, :3] - draw.pose[:, :3], axis=1).max() > MAX_DRIFT
        ):
            return None
        return Episode(
            seed,
            index,
            self.task,
            self.split,
            home.name,
            pose,
            settled[a.link_q],
            targets,
        )

    def _homes_for(self, seed: int, index: int) -> Iterator[Home]:
        """Yield the home of an episode, then the others in the order of the list, from there on and round it."""
        count = len(self.homes)
        if self._in_turn:
            first = index
        else:
            rng = stream(seed, "home", self.task, self.split, index)
            first = int(rng.integers(count))
        # Round the list and not at random, so that a neighbour takes over whatever the stream gives.
        return (self.homes[(first + k) % count] for k in range(count))

    # -- cache -----------------------------------------------------------------------------------------------------

    @cached_property
    def digest(self) -> str:
        """Hash of what an episode depends on besides (task, split, seed, index): homes, objects and compiling code,
        roles of the furniture, rules of the task."""
        # The homes are in the digest themselves: of the hash only what all of them share is needed.
        shared = home_hash(self.layout, self.homes[0])
        roles = self.layout.pack.roles
        # What a chain makes of a target is not part of the episode.
        rules = [dataclasses.replace(rule, chain=None) for rule in self.spec.targets]
        spec = self.spec
        drawn = (rules, spec.openings, spec.shelf_region, spec.shelf_clutter)
        parts: tuple[object, ...] = (
            _VERSION,
            shared,
            self.homes,
            self._in_turn,
            roles,
            drawn,
        )
        # A plugin can change the rules of its task while the code of mjhab stays the same.
        own = source_digest(TASKS.source(self.task))
        return hashlib.sha256(repr((*parts, own) if own else parts).encode()).hexdigest()[
            :16
        ]

    def _path(self, seed: int, index: int) -> Path:
        scene = f"{self.task}-{self.target}" if self.target else self.task
        # Versions that did not keep clear of what stands in a home left other episodes of such homes in the cache.
        home = next(self._homes_for(seed, index))
        kept = "-clear" if standing_on(self.layout, home) else ""
        name = f"{scene}-{self.split}-{seed}-{index}{kept}.json"
        # Objects are settled by simulation, whose last bits depend on the machine.
        folder = f"{self.digest}-{arithmetic_digest().hex()[:8]}"
        return below(cache_dir() / "episodes" / folder, name)
