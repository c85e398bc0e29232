"""Perturbations of what robots see and do in W worlds on the host."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjhab.config.perturbing import (
    PERTURBATIONS,
    ActionFrame,
    Drawn,
    MountChange,
    PerturbationPlan,
    PictureFrame,
    called,
)
from mjhab.core.errors import fault
from mjhab.core.rotations import mat_from_rotation_vector
from mjhab.robots.controllers.controller import Controller
from mjhab.robots.robot import Robot
from mjhab.tasks.instructions import Instructions

if TYPE_CHECKING:
    from mjhab.render.home_scene import ViewChange
    from mjhab.render.render_scene import RenderScene


MOST_KEPT = 4096
"""Episodes whose mounts and materials are kept in memory; each takes 0.3 to 2 KiB."""


class PerturbedMoment(NamedTuple):
    """When an image is taken: what is drawn for its episode, and control steps since its start."""

    drawn: tuple[Drawn, ...]
    step: int


class Perturber:
    """What the axes of a plan do to the images and actions of W worlds.

    Args:
        plan: the axes.
        robot: the robot.
        controller: tells what the entries of actions are.
        num_worlds: W.
    """

    def __init__(
        self,
        plan: PerturbationPlan,
        robot: Robot,
        controller: Controller,
        num_worlds: int,
    ) -> None:
        self.plan = plan
        self._robot = robot
        hooks = {hook for axis in plan.axes for hook in axis.hooks}
        self.sees = bool(hooks & {"mount", "looks", "picture"})
        """Whether images are perturbed."""
        self.acts = bool(hooks & {"delay", "act"})
        """Whether actions are perturbed."""
        self.needs = frozenset(name for axis in plan.axes for name in axis.needs)
        """Images that are drawn to change others."""
        self._frame = ActionFrame(
            0.5 * (controller.high - controller.low),
            controller.gripper,
            tuple(controller.base_columns),
        )
        self._moments = [PerturbedMoment((), 0) for _ in range(num_worlds)]
        self._late: list[list[np.ndarray]] = [[] for _ in range(num_worlds)]
        """Actions of every world that are not executed yet."""
        self._kept: dict[tuple[object, ...], Any] = {}
        """Mounts and looks by episode."""

    def begin(self, world: int, seed: int, index: int) -> None:
        """Draw what is perturbed in the episode that a world begins."""
        self._moments[world] = self.moment(seed, index, 0)
        self._late[world] = []

    def moment(self, seed: int, index: int, step: int) -> PerturbedMoment:
        """A moment of the episode (seed, index)."""
        return PerturbedMoment(self.plan.drawn(seed, index, self._robot), step)

    def moments(self) -> list[PerturbedMoment]:
        """(W,) the present moments."""
        return list(self._moments)

    def step(self, actions: np.ndarray, still: np.ndarray) -> np.ndarray:
        """The actions (W, A) that are executed in place of ``actions`` in the next control step.

        ``still``: (W, A) actions that hold the pose; they are executed while the first ones are late.
        """
        executed = actions.copy()
        for world, moment in enumerate(self._moments):
            if self.acts and moment.drawn:
                executed[world] = self._act(world, moment, actions[world], still[world])
            # In every world, also without noise of actions: images depend on the step.
            self._moments[world] = moment._replace(step=moment.step + 1)
        return executed

    def _act(
        self, world: int, moment: PerturbedMoment, action: np.ndarray, still: np.ndarray
    ) -> np.ndarray:
        delays = [called(d.axis, "delay", d) for d in _with(moment.drawn, "delay")]
        # A copy: the caller may write into its array before the action is executed.
        waiting = [*self._late[world], action.copy()]
        # Until as many have come as the delay is long, the robot holds its pose.
        late = len(waiting) > sum(int(delay) for delay in delays)
        now = waiting.pop(0) if late else still
        self._late[world] = waiting
        for drawn in _with(moment.drawn, "act"):
            found = called(drawn.axis, "act", drawn, now, self._frame, moment.step)
            now = np.asarray(found, np.float32)
            # A plugin's slip would else show as a broken simulation.
            if now.shape != action.shape or not np.isfinite(now).all():
                raise fault(
                    PERTURBATIONS.described(drawn.axis),
                    f"act must return {len(action)} finite numbers, got {now.shape}.",
                )
        return now

    # -- images ----------------------------------------------------------------------------------------------------

    def views(
        self,
        moments: Sequence[PerturbedMoment],
        cameras: Sequence[str],
        scene: RenderScene | None,
    ) -> ViewChange:
        """How the views of n worlds differ from what they should be; ``scene``: None where no colours are drawn."""
        from mjhab.render.home_scene import (
            CameraChange,
            ViewChange,
        )  # loads numba and trimesh

        mounts = looks = None
        axes = [_with(moment.drawn, "mount") for moment in moments]
        if any(axes):
            found = [self._mount(drawn, tuple(cameras)) for drawn in axes]
            mounts = CameraChange(*(np.stack(rows) for rows in zip(*found, strict=True)))
        axes = [_with(moment.drawn, "looks") for moment in moments]
        if scene is not None and any(axes):
            # Images of meshes fit theirs alone; patterns fit anything.
            image = (scene.mat_texture >= 0) & ~scene.mat_pattern
            looks = np.stack([self._looks(drawn, image) for drawn in axes])
        return ViewChange(mounts, looks)

    def _looks(self, drawn: Sequence[Drawn], image: np.ndarray) -> np.ndarray:
        """(M,) int32 materials that those of the scene are drawn as; the same in a whole episode."""
        key = ("looks", *_episode(drawn))
        if key not in self._kept:
            looks = np.arange(len(image), dtype=np.int32)
            for one in drawn:
                found = np.asarray(called(one.axis, "looks", one, image))
                if found.shape != looks.shape or not set(found.tolist()) <= {
                    *range(len(looks))
                }:
                    raise fault(
                        PERTURBATIONS.described(one.axis),
                        f"looks must return {len(looks)} numbers from 0 to {len(looks) - 1}.",
                    )
                # One axis after the other, each on what the last one chose.
                looks = found[looks].astype(np.int32)
            self._keep(key, looks)
        return self._kept[key]

    def _mount(
        self, drawn: Sequence[Drawn], cameras: tuple[str, ...]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Shift (C, 3), turn (C, 3, 3) and width (C,) of the cameras of a world; the same in a whole episode."""
        key = (cameras, *_episode(drawn))
        if key not in self._kept:
            shift = np.zeros((len(cameras), 3))
            turn = np.tile(np.eye(3), (len(cameras), 1, 1))
            widen = np.ones(len(cameras))
            for c, camera in enumerate(cameras):
                for one in drawn:
                    change: MountChange = called(one.axis, "mount", one, camera)
                    # In the axes that earlier changes have turned.
                    shift[c] += turn[c] @ change.shift
                    turn[c] = turn[c] @ mat_from_rotation_vector(change.turn[None])[0]
                    widen[c] *= change.widen
            self._keep(key, (shift, turn, widen))
        return self._kept[key]

    def _keep(self, key: tuple[object, ...], found: Any) -> None:
        """Keep what an axis gives once for an episode, whose images all need it."""
        # All at once: a long run comes back to none of them.
        if len(self._kept) > MOST_KEPT:
            self._kept.clear()
        self._kept[key] = found

    def pictures(
        self,
        moments: Sequence[PerturbedMoment],
        images: Mapping[str, np.ndarray],
        mat: np.ndarray,
        focal: np.ndarray,
    ) -> None:
        """Change the images (n, C, ...) of n worlds in place.

        Args:
            moments: (n,) when they were taken.
            images: by output.
            mat: (n, C, 3, 3) orientations of the cameras.
            focal: (n, C) focal lengths [px].
        """
        for w, moment in enumerate(moments):
            own = {name: rows[w] for name, rows in images.items()}
            self.picture(moment, own, mat[w], focal[w])

    def picture(
        self,
        moment: PerturbedMoment,
        images: Mapping[str, np.ndarray],
        mat: np.ndarray,
        focal: np.ndarray,
    ) -> None:
        """Change the images (C, ...) of one world in place, see `pictures`."""
        frame = PictureFrame(moment.step, mat, focal)
        for one in _with(moment.drawn, "picture"):
            called(one.axis, "picture", one, images, frame)

    # -- states ----------------------------------------------------------------------------------------------------

    def get_state(self, world: int) -> dict[str, Any]:
        """Steps since the start of a world's episode, and the actions that are late."""
        late = [action.tolist() for action in self._late[world]]
        return {"step": self._moments[world].step, "late": late}

    def set_state(self, world: int, state: Mapping[str, Any]) -> None:
        """Restore a world from `get_state`; `begin` has been called for its episode."""
        self._moments[world] = self._moments[world]._replace(step=int(state["step"]))
        self._late[world] = [np.array(each, np.float32) for each in state["late"]]


def _episode(drawn: Sequence[Drawn]) -> list[tuple[str, int, int, int]]:
    """What everything that is drawn depends on."""
    return [(one.axis, one.level, one.seed, one.index) for one in drawn]


def _with(drawn: Sequence[Drawn], hook: str) -> list[Drawn]:
    """Those whose axis has a hook."""
    return [one for one in drawn if hook in PERTURBATIONS[one.axis].hooks]


def in_other_words(drawn: Sequence[Drawn], said: Instructions) -> Instructions:
    """The sentences of an episode as its axes say them.

    Raises:
        UsageError: an axis raises, or says nothing or more than one line.
    """
    for one in _with(drawn, "sentence"):
        # A subtask alone is told by one sentence, in `task` and in `subtasks`.
        words = {
            text: _sentence(one, text, number)
            for number, text in enumerate(dict.fromkeys((said.task, *said.subtasks)))
        }
        subtasks = tuple(words[text] for text in said.subtasks)
        said = Instructions(words[said.task], subtasks)
    return said


def _sentence(drawn: Drawn, text: str, number: int) -> str:
    found = called(drawn.axis, "sentence", drawn, text, number)
    if not isinstance(found, str) or not found.isprintable() or bool(found) != bool(text):
        raise fault(
            PERTURBATIONS.described(drawn.axis),
            f"sentence must return one line of text, got {found!r}.",
        )
    return found
