"""Take-over DAgger: the student starts an episode, the expert takes over, and the student learns from the expert.

Round 0 is plain imitation of the expert. In every later round the student acts for a random number of control steps,
at most `DaggerConfig.longest_prefix`. Then the expert plans from the state reached and finishes the episode; its part
is added to the demonstrations if the episode succeeds. Training continues with the same network, and a fixed fraction
of every batch comes from the newest round.

With a teacher, a policy, it is distillation: the teacher demonstrates in round 0; in later rounds the student acts in
whole episodes, and learns the action that the teacher names in every control step (`intervention.Relabelling`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from mjhab.core.errors import UsageError
from mjhab.data.select.query import Filter
from mjhab.evaluation.resolve import open_policy
from mjhab.learning.configs import DaggerConfig
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.policy_kind import CAMERA_SIZE_OPTION, joined
from mjhab.learning.runs.collection import Round
from mjhab.learning.runs.imitation import ImitationSession


class DaggerSession(ImitationSession):
    """A run of DAgger: imitation in rounds."""

    def views(self, layout: ObservationSpec) -> list[dict[str, Any]]:
        """See `ImitationSession.views`; what a teacher sees is observed, too.

        Raises:
            UsageError: the teacher needs another environment, or larger images.
        """
        return [_with_teacher(layout.env_options(), spec) for spec in self.spec.teachers]

    def round_in(self, wanted: Round, place: int) -> Round:
        """See `ImitationSession.round_in`."""
        teacher = self.spec.teachers[place]
        if not teacher:
            return wanted
        # Episodes end as in evaluation: nobody needs time after a take-over.
        return replace(wanted, teacher=teacher, style=(), longest=0, horizon=0)

    def load_round(self, number: int, where: Filter | None = None) -> None:
        """See `ImitationSession.load_round`: of a relabelled student also the episodes that failed.

        Of those in which the expert takes over, successes alone are kept when they are collected.
        """
        everything = Filter("true") if number and any(self.spec.teachers) else where
        super().load_round(number, everything)

    @property
    def dagger(self) -> DaggerConfig:
        """The rounds."""
        config = self.spec.config.dagger
        assert config is not None
        return config

    def learn(self) -> None:
        """Run the remaining rounds."""
        config = self.dagger
        self.restore_rounds()
        while self.state.round <= config.rounds:
            number = self.state.round
            # A resumed run has the round's demonstrations already.
            if len(self.sources) <= number:
                self.collect_round(number)
            updates = config.updates if number else self.config.updates
            self.train(updates, config.new_share)
            if self.spec.round_episodes:
                self.evaluate(self.spec.round_episodes)
            if number == config.rounds and not config.final_updates:
                return
            # Before the round is counted: a resumed run needs the student that begins it.
            self.save_policy(self.folder.round_student(number + 1))
            self.next_round()
        # The share that the newest data have by size: at the end all rounds count alike.
        self.train(config.final_updates, self.newest_share, cool_down=True)

    def restore_rounds(self) -> None:
        """Load the demonstrations of the finished rounds."""
        for number in range(self.state.round):
            if number == 0 and self.spec.data:
                self.take_demonstrations()
            else:
                self.load_round(number)

    def collect_round(self, number: int) -> None:
        """Load or collect the demonstrations of a round; round 0 takes the data of the specification, if any."""
        if not number:
            self.take_demonstrations()
            return
        config = self.dagger
        wanted = Round(
            number=number,
            episodes=config.episodes,
            longest=config.longest_prefix(number),
            student=self.folder.round_student(number),
            # Without a student prefix, in round 0, the task's own horizon is long enough.
            horizon=config.horizon,
            hold_steps=self.config.hold_steps,
            style=self.config.style,
        )
        self.collect(wanted)

    def summarize(self) -> dict[str, Any]:
        """See `Session.summarize`; a round after the last one makes the final updates."""
        return {
            **super().summarize(),
            "rounds": min(self.state.round, self.dagger.rounds),
        }


def _with_teacher(view: dict[str, Any], teacher: str) -> dict[str, Any]:
    """Observation options ``view`` of a student with what a teaching policy needs, "" for the expert.

    Raises:
        UsageError: the teacher needs another environment, or larger images than the student learns from.
    """
    if not teacher:
        return view
    needed = open_policy(teacher).facts.env_options
    both = joined(teacher, [("the student", view), (teacher, needed)])
    if (
        CAMERA_SIZE_OPTION in view
        and both[CAMERA_SIZE_OPTION] != view[CAMERA_SIZE_OPTION]
    ):
        raise UsageError(
            f"the teacher {teacher} sees images of {both[CAMERA_SIZE_OPTION]} px, the student of "
            f"{view[CAMERA_SIZE_OPTION]} px: give --set inputs.image_size={both[CAMERA_SIZE_OPTION]}."
        )
    return both
