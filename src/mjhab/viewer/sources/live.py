"""Running worlds as a source of the viewer: the rollout loop in its own thread, controlled by the page."""

from __future__ import annotations

import dataclasses
import queue
import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.action_notes import HUMAN
from mjhab.core.errors import MjhabError
from mjhab.core.progress import say
from mjhab.data.store.shard import ShardWriter
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.evaluation.evaluate import EvalSpec
from mjhab.evaluation.parts import describe_policy, env_options, make_env
from mjhab.experts.policy import ExpertPolicy
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink, StepView
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.viewer.drawn.plan_marks import PlanMarks
from mjhab.viewer.sources.hand import HandControl
from mjhab.viewer.sources.live_tracks import begin_tracks, extend_tracks
from mjhab.viewer.sources.pace import RealTimeClock
from mjhab.viewer.sources.plan_overlay import ExpertPlanOverlay
from mjhab.viewer.sources.switch import PolicySwitch
from mjhab.viewer.sources.takes import Cuttable, TakeRecorder
from mjhab.viewer.sources.track import Track

CUT_SECONDS = 10.0
"""Longest wait for the last episode to be recorded when the session is closed [s]."""
CLOSE_SECONDS = 30.0
"""Longest wait for the thread of the worlds to end [s]."""
# A rollout has an end, and a session nearly none.
EPISODES_AHEAD = 1000
"""Number of episodes of one rollout."""


class _Interrupt(Exception):
    """Ends a rollout because the session is closed or another rollout was requested."""


@dataclass(frozen=True)
class Wish:
    """A requested rollout. policy: a specification as for ``--policy``. first: index of the first world's episode."""

    policy: str
    first: int


class LiveSession:
    """Run episodes one after the other in a thread until `close`; a `source.Source`.

    Args:
        spec: worlds, task and policy, as for an evaluation; its ``out`` and ``episodes`` are not used.
        first: index of the first episode; with W worlds, W consecutive episodes run at a time.
        pace: timing of the control steps.
        policies: specifications of further policies that can be chosen.
        shard: file that finished episodes are recorded to; None records nothing.
        hold_at_end: pause when the episode of the watched world ends, so that its last state stays visible.

    Attributes:
        tracks: (W,) running episode of every world; None before its first state.
        problem: message about the last failure; "" if there is none.
        watched: index of the watched world.
        steps: number of control steps taken.
    """

    def __init__(
        self,
        spec: EvalSpec,
        first: int,
        pace: RealTimeClock,
        *,
        policies: Sequence[str] = (),
        shard: Path | None = None,
        hold_at_end: bool = True,
    ) -> None:
        assert isinstance(spec.policy, str)
        self.is_live = True
        self.choices = tuple(f"world {w}" for w in range(spec.asked.num_envs))
        self.policies = tuple(dict.fromkeys((spec.policy, "expert", HUMAN, *policies)))
        self.hand = HandControl()
        self.spec = spec
        self.pace = pace
        self.tracks: list[Track | None] = [None] * spec.asked.num_envs
        self.problem = ""
        self.watched = 0
        self.hold_at_end = hold_at_end
        self.env: SequentialTaskEnv | None = None
        self._cuttable: Cuttable | None = None
        self.switch: PolicySwitch | None = None
        self.steps = 0
        self._shard = shard
        self._writer: ShardWriter | None = None
        self._kept = 0
        self._wish = Wish(spec.policy, first)
        self._asked: Wish | None = self._wish
        self._options: dict[str, Any] = {}
        self._failed = False
        self._held = False
        self._correcting = False
        self._plan_wanted = False
        self._plan: ExpertPlanOverlay | None = None
        self._cut_done = threading.Event()
        self._jobs: queue.SimpleQueue[Callable[[LiveSession], object]] = (
            queue.SimpleQueue()
        )
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="worlds", daemon=True)

    # -- called by the page, on its threads -----------------------------------------------------------------------

    def prepare(self) -> None:
        """Make the first environment and policy and open the shard, so that what cannot work is told before `start`.

        Raises:
            UsageError: the options of the worlds or the policy cannot work, or the shard cannot be written.
            DamagedError: the file is no shard.
        """
        self._prepare(self._wish.policy)
        self._open_shard()

    def start(self) -> None:
        """Start the thread that runs the worlds."""
        self._thread.start()

    def close(self) -> None:
        """Stop the run; if episodes are recorded and a person acted in the watched one, truncate and record it."""
        runs = self.track is not None and not self.track.over and not self._failed
        if self._writer is not None and runs and self._human_acted(self.watched):
            self.finish_episode()
            # The last episode is written on the thread of the worlds.
            self._cut_done.wait(CUT_SECONDS)
        self._closing = True
        self.pace.wake()
        # Never started: nobody else would close the shard.
        if self._thread.ident is None:
            self._release()
        elif self._thread.is_alive():
            # A policy may be planning; the process must end all the same.
            self._thread.join(timeout=CLOSE_SECONDS)

    @property
    def sim(self) -> CpuSimulator:
        """The simulator of the worlds."""
        assert self.env is not None, "there are no worlds before there is a track"
        return self.env.sim

    @property
    def track(self) -> Track | None:
        """The running episode of the watched world."""
        return self.tracks[self.watched]

    @property
    def choice(self) -> str:
        """Name of the watched world."""
        return self.choices[self.watched]

    @property
    def expert_plan(self) -> PlanMarks | None:
        """The expert's plan in the newest state of the watched world; None unless it is switched on."""
        return self._plan.marks if self._plan is not None else None

    def plan_at(self, step: int) -> PlanMarks | None:
        """Return the expert's plan in the newest state, whatever ``step`` is."""
        return self.expert_plan

    @property
    def hand_drives(self) -> bool:
        """Whether the watched world is teleoperated."""
        return self.switch is not None and self.switch.hand_world == self.watched

    @property
    def recording(self) -> str:
        """Message about where the running episode is recorded; "" if it is not."""
        if self._shard is None:
            return ""
        who = HUMAN if self._human_acted(self.watched) else "policy"
        return f"{self._kept} episodes are in {self._shard.name}; this one goes there, too, as {who}'s"

    def choose(self, choice: str) -> None:
        """Watch the world with a name of ``choices``; teleoperation of the present one ends."""
        if self.hand_drives:
            self.set_hand(False)
        self.watched = self.choices.index(choice)
        self.do(lambda session: session.renew_plan())

    def set_policy(self, spec: str) -> None:
        """Let another policy act from the next step on.

        The episodes are restarted if it needs another configuration of the environment (for example its observations).
        """
        self.do(lambda session: session.change_policy(spec))

    def restart(self) -> None:
        """Start the watched episode again."""
        self.ask(first=self._first_for(self._index()))

    def next_episode(self) -> None:
        """Start the episode after the watched one."""
        self.ask(first=self._first_for(self._index() + 1))

    def show_expert_plan(self, shown: bool) -> None:
        """Switch ``expert_plan`` on or off."""
        self._plan_wanted = shown
        self.do(lambda session: session.renew_plan())

    def set_hand(self, driving: bool) -> None:
        """Start or stop the teleoperation of the watched world, before the next step."""
        self.do(lambda session: session.hand_over(driving))

    def hear_hand(self, message: str) -> None:
        """Take a message of `hand.js` about keys and gamepad."""
        self.hand.hear(message)
        self._follow_hold()

    @property
    def hand_pose(self) -> np.ndarray | None:
        """Pose (7,) that the gripper is to go to, in the frame of `Robot.arm_root`; None without teleoperation."""
        return self.hand.pose if self.hand_drives else None

    def aim_hand(self, pose: np.ndarray) -> None:
        """Let the gripper go to a pose (7,) in the frame of `Robot.arm_root`, if the watched world is teleoperated."""
        if self.hand_drives:
            self.hand.aim(pose)

    def grip(self) -> None:
        """Open or close the gripper, if the watched world is teleoperated."""
        if self.hand_drives:
            self.hand.toggle_gripper()

    def hand_gone(self) -> None:
        """Release all keys after the last page was closed, and pause if the watched world is teleoperated."""
        if self.hand_drives:
            self.pace.play(False)
        self.hand.let_go()
        self._follow_hold()

    def _follow_hold(self) -> None:
        """Take over or give back if the key that is held for it was pressed or released."""
        held = self.hand.holds
        if held != self._held:
            self._held = held
            self.do(lambda session: session.correct(held))

    def finish_episode(self) -> None:
        """Truncate the watched episode at the next control step, unless it has ended."""
        running = self.track is not None and not self.track.over
        if self._cuttable is not None and running:
            self._cut_done.clear()
            self._cuttable.cut[self.watched] = True
            if not self.pace.playing:
                # A paused world would never make the step in which the cut takes place.
                self.pace.step_once()

    def ask(self, *, policy: str | None = None, first: int | None = None) -> None:
        """Request a new rollout, with another policy or another index of the first episode; None keeps it."""
        now = self._asked or self._wish
        self._asked = Wish(
            now.policy if policy is None else policy,
            now.first if first is None else first,
        )
        # Who asks for something wants to see it.
        self.pace.play(True)

    def do(self, job: Callable[[LiveSession], object]) -> None:
        """Call a function between two control steps, on the thread of the worlds."""
        # The environment belongs to one thread.
        self._jobs.put(job)
        self.pace.wake()

    # -- called on the thread of the worlds -----------------------------------------------------------------------

    def change_policy(self, spec: str) -> None:
        """Do the work of `set_policy`."""
        if spec == HUMAN:
            self.hand_over(True)
            return
        if self.switch is not None:
            self.switch.give_back()
        full, options = self._needs(spec)
        # Other observations need another environment.
        if self.switch is None or self._failed or options != self._options:
            self.ask(policy=spec, first=self._first_for(self._index()))
            return
        self.switch.choose(full)
        self.problem = ""
        self._wish = dataclasses.replace(self._wish, policy=spec)

    def hand_over(self, driving: bool) -> None:
        """Do the work of `set_hand`."""
        if self.switch is None:
            return
        if driving:
            self.switch.take_over(self.hand, self.watched)
        else:
            self.switch.give_back()

    def correct(self, held: bool) -> None:
        """Let the person act while the key is held, unless the person drives anyway."""
        if held and not self.hand_drives:
            self._correcting = True
            self.hand_over(True)
        elif not held and self._correcting:
            self._correcting = False
            self.hand_over(False)

    def renew_plan(self) -> None:
        """Drop the expert's plan and, if switched on, compute that of the present state of the watched world."""
        if self._plan is not None:
            self._plan.forget()
        self.follow_plan()

    def follow_plan(self) -> None:
        """Update the expert's plan after a control step."""
        if self._plan is None or not self._plan_wanted:
            return
        assert self.switch is not None
        acting = self.switch.policy(self.switch.chosen)
        expert = (
            acting if isinstance(acting, ExpertPolicy) and not self.hand_drives else None
        )
        self._plan.note(self.watched, expert)

    def _run(self) -> None:
        try:
            while not self._closing:
                self._run_wish()
        finally:
            self._release()

    def _release(self) -> None:
        """Close the shard and the environment."""
        if self._writer is not None:
            self._writer.close()
        if self.env is not None:
            self.env.close()

    def _run_wish(self) -> None:
        """Run the requested rollout until another one is requested, the session is closed, or it fails."""
        try:
            if self._asked is None:
                # After a failure nothing runs until another rollout is requested.
                self.pace.wait(self._between)
                return
            self._wish = self._asked
            self._asked = None
            self._run_episodes(self._wish)
        except _Interrupt:
            return
        except Exception as error:
            self.tell_problem(_message_of(error))
            self._failed = True
            self.pace.play(False)

    def _run_episodes(self, wish: Wish) -> None:
        self._prepare(wish.policy)
        self.problem = ""
        self._failed = False
        assert self.switch is not None and self._cuttable is not None
        episodes = range(wish.first, wish.first + EPISODES_AHEAD)
        # The follower comes last, because it may wait at the end of an episode, which must be recorded by then.
        sinks = [*self._record(), _Follower(self)]
        rollout(
            self._cuttable.as_env(), self.switch, episodes, self.spec.asked.seed, sinks
        )

    def _needs(self, policy: str) -> tuple[str, dict[str, Any]]:
        """Specification of the policy to build, and the environment options that it needs; "human" builds "zero"."""
        base = "zero" if policy == HUMAN else policy
        spec = dataclasses.replace(self.spec, policy=base)
        return str(spec.policy), env_options(spec, describe_policy(spec.policy))

    def _prepare(self, policy: str) -> None:
        """Create the environment that the policy needs, unless the present one has its options; choose the policy."""
        full, options = self._needs(policy)
        if self.env is None or options != self._options:
            if self.env is not None:
                self.env.close()
            spec = dataclasses.replace(self.spec, episodes=self.spec.asked.num_envs)
            self.env = make_env(spec, options)
            self._cuttable = Cuttable(self.env)
            self._options = options
            self._plan = ExpertPlanOverlay(self.env)
            self.switch = PolicySwitch(self.env, self.spec.asked.seed)
        assert self.switch is not None
        self.switch.choose(full)
        if policy == HUMAN:
            self.switch.hand = self.hand
            self.switch.hand_world = self.watched

    def tell_problem(self, problem: str) -> None:
        """Show a failure in the page, and print it to stderr."""
        self.problem = problem
        say(f"mjhab: {problem}")

    def _record(self) -> list[Sink]:
        self._open_shard()
        if self._writer is None:
            return []
        assert self.env is not None
        facts = describe_policy(self._needs(self._wish.policy)[0])
        about = {"name": facts.name, **facts.identity}
        return [
            TakeRecorder(self._writer, self.env, about, self._writer.has),
            _StepCounter(self),
        ]

    def _open_shard(self) -> None:
        """Open the file that episodes are recorded to, if there is one."""
        if self._shard is not None and self._writer is None:
            self._writer = ShardWriter(self._shard)

    def note_kept(self) -> None:
        """Update the number of recorded episodes, after one was written."""
        self._kept = len(self._writer.names) if self._writer is not None else 0
        self._cut_done.set()

    def _human_acted(self, world: int) -> bool:
        track = self.tracks[world]
        return track is not None and any(
            moment.actor == HUMAN for moment in track.moments
        )

    def _index(self) -> int:
        """Index of the watched episode."""
        track = self.track
        return self._wish.first if track is None else track.index

    def _first_for(self, index: int) -> int:
        """Index of the first world's episode such that the watched world runs the episode ``index``."""
        return max(index - self.watched, 0)

    def _between(self) -> None:
        """Call the functions given to `do`; raise `_Interrupt` if the rollout is to end."""
        while not self._jobs.empty():
            job = self._jobs.get()
            try:
                job(self)
            except Exception as error:
                self.problem = _message_of(error)
        if self._closing or self._asked is not None:
            raise _Interrupt


class _StepCounter(Sink[RolloutEnv]):
    """Sink after the recorder that tells the session that an episode was written."""

    def __init__(self, session: LiveSession) -> None:
        self._session = session

    def on_episode_end(self, env: RolloutEnv, world: int, record: EpisodeRecord) -> None:
        self._session.note_kept()


class _Follower(Sink[SequentialTaskEnv]):
    """Sink that appends to the tracks of a session, and blocks until the next control step is due."""

    def __init__(self, session: LiveSession) -> None:
        self._session = session

    def on_reset(
        self, env: SequentialTaskEnv, info: Mapping[str, Any], mask: np.ndarray
    ) -> None:
        begin_tracks(self._session.tracks, env, info, mask)
        # The other worlds have waited for this control step already.
        if mask[self._session.watched]:
            self._wait()

    def on_step(self, env: SequentialTaskEnv, step: StepView) -> None:
        session = self._session
        extend_tracks(session.tracks, env, step)
        session.steps += 1
        session.follow_plan()
        # At its end `on_episode_end` waits, once the record is written.
        if not step.done[session.watched]:
            self._wait()

    def on_episode_end(
        self, env: SequentialTaskEnv, world: int, record: EpisodeRecord
    ) -> None:
        session = self._session
        track = session.tracks[world]
        if track is not None:
            track.over = "success" if record.success_once else "no success"
        if world == session.watched and record.error:
            session.tell_problem(record.error)
        if world == session.watched and session.hold_at_end:
            session.pace.play(False)
            self._wait()

    def _wait(self) -> None:
        self._session.pace.wait(self._session._between)


def _message_of(error: Exception) -> str:
    """Message about an error for the page: its text, with type, function and line if it is not one of ours."""
    if isinstance(error, MjhabError):
        return str(error)
    where = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({where.name}, line {where.lineno})"
