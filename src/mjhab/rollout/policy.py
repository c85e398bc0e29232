"""What acts: the Policy protocol and the two policies that need no knowledge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from mjhab.core.action_notes import ActionNotes
from mjhab.core.seeding import stream

ACTION_SIZE = 13
"""Width of an action of the default robot: arm 7, gripper 1, body (head 2, torso 1) 3, base 2."""


class RolloutEnv(Protocol):
    """What the rollout loop needs of a vector environment of W worlds; those of `mjhab.make` have it."""

    num_envs: int
    metadata: dict[str, Any]
    """``metadata["autoreset_mode"]`` is Gymnasium's, and must be DISABLED."""

    @property
    def taint_names(self) -> Sequence[str]:
        """Names of the bits of ``info["taint"]``."""
        ...

    def reset(self, *, seed: int, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Begin episodes. options: "episode" (n,) indices for the n worlds of "reset_mask" (W,) bool."""
        ...

    def step(self, actions: np.ndarray, /) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take one control step with actions (W, A)."""
        ...

    def render_worlds(
        self, worlds: Sequence[int], /, width: int = 480, height: int = 360
    ) -> np.ndarray:
        """Human views (n, H, W, 3) uint8 of n worlds."""
        ...

    def state_digest(self, world: int, /) -> str:
        """Hash of the state of one world."""
        ...

    def close(self) -> None:
        """Free what is held."""
        ...


class Policy(Protocol):
    """Maps observations of W worlds to actions.

    A policy may keep state per world; ``reset`` tells it which worlds begin a new episode. What it does in an episode
    must depend on that episode only (``info["episode_spec"][w]``), never on the world it runs in or on its neighbours.
    """

    @property
    def name(self) -> str:
        """Short name for reports."""
        ...

    def reset(self, mask: np.ndarray) -> None:
        """Forget the worlds in ``mask`` (W,) bool; called after their reset and before the next ``act``."""
        ...

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Return actions (W, A) float32 in [-1, 1] for the observations and info of the last reset or step."""
        ...


@runtime_checkable
class Annotated(Protocol):
    """A policy that tells what it intended and who acted. Of any other, the actions are the intended ones, its own."""

    def notes(self) -> ActionNotes:
        """Notes about the actions that the last ``act`` returned."""
        ...


@runtime_checkable
class Selective(Protocol):
    """A policy that can leave out worlds in which others act, because it works long for every world."""

    def act_in(self, obs: Any, info: Mapping[str, Any], mask: np.ndarray) -> np.ndarray:
        """Like `Policy.act`; actions (W, A) of which only those in the worlds of ``mask`` (W,) bool count."""
        ...


@runtime_checkable
class Correctable(Protocol):
    """A policy that can be told that other actions are executed than those it returned: it sees its previous action."""

    def replace_action(self, actions: np.ndarray, replan: bool = False) -> None:
        """Tell that ``actions`` (W, A) are executed instead of those that ``act`` returned last.

        ``replan``: what was planned for the next steps led from those, and is dropped.
        """
        ...


@runtime_checkable
class Styled(Protocol):
    """A policy that can be asked to act in one way or another."""

    def style(self, world: int) -> Mapping[str, Any]:
        """How it acts in the running episode of a world, as plain data for its record; empty if nothing was asked."""
        ...


@runtime_checkable
class Fallible(Protocol):
    """A policy that can fail in one episode and go on in the others, for instance one that is asked over a network."""

    def fault(self, world: int) -> str:
        """Why the episode in a world cannot go on, one line of text; "" if it can. Asked after every ``act``."""
        ...


@runtime_checkable
class Timed(Protocol):
    """A policy that measures how long it takes to get actions."""

    @property
    def latency_ms(self) -> Sequence[float]:
        """Duration of every request for actions so far [ms]."""
        ...


@runtime_checkable
class Paced(Protocol):
    """A policy for which the world may not wait."""

    @property
    def late_steps(self) -> int | None:
        """Control steps so far in which it had no action ready; None where the world waits for it."""
        ...


@runtime_checkable
class Chunked(Protocol):
    """A policy that plans the next actions at once."""

    def plan(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Actions (W, H, A) float32 for this control step and the next ones, in place of `Policy.act`."""
        ...


@runtime_checkable
class Clipped(Protocol):
    """A policy that counts the values of its actions that are out of range, which the environment clips."""

    @property
    def out_of_range(self) -> Mapping[str, int]:
        """How many values of its actions were clipped so far, by entry of the action; only those that were."""
        ...


@runtime_checkable
class Composed(Protocol):
    """A policy that lets others act."""

    @property
    def acting_policies(self) -> Sequence[Policy]:
        """All that may act."""
        ...


class ZeroPolicy:
    """Stands still: the all-zero action keeps every joint target and lets the gripper half open.

    Args:
        width: of an action (A).
    """

    name = "zero"

    def __init__(self, width: int = ACTION_SIZE) -> None:
        self._width = width
        self._worlds = 0

    def reset(self, mask: np.ndarray) -> None:
        """Learn the number of worlds from ``mask`` (W,) bool."""
        self._worlds = len(mask)

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Return zeros (W, A) float32."""
        return np.zeros((self._worlds, self._width), np.float32)


class RandomPolicy:
    """Uniform actions, one random stream per episode: the same episode gets the same actions in any world.

    Args:
        seed: of the streams. width: of an action (A).
    """

    name = "random"

    def __init__(self, seed: int, width: int = ACTION_SIZE) -> None:
        self._seed = seed
        self._width = width
        self._streams: list[np.random.Generator | None] = []

    def reset(self, mask: np.ndarray) -> None:
        """Drop the streams of the worlds in ``mask`` (W,) bool; ``act`` opens those of their new episodes."""
        if len(self._streams) != len(mask):
            self._streams = [None] * len(mask)
        for w in np.flatnonzero(mask):
            # Opened in `act`, which knows the episode.
            self._streams[w] = None

    def act(self, obs: Any, info: Mapping[str, Any]) -> np.ndarray:
        """Return actions (W, A) float32, uniform in [-1, 1]."""
        actions = np.empty((len(self._streams), self._width), np.float32)
        for w, episode in enumerate(info["episode_spec"]):
            generator = self._streams[w]
            if generator is None:
                generator = stream(
                    # By the episode and not by the world, so that it is the same with any number of worlds.
                    self._seed,
                    "policy",
                    "random",
                    int((episode or {}).get("index", 0)),
                )
                self._streams[w] = generator
            actions[w] = generator.uniform(-1.0, 1.0, self._width)
        return actions
