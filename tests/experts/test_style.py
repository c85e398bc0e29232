"""The expert's styles in real episodes: what was asked for is what happens, and nothing asked changes nothing."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

import mjhab.envs as envs
from mjhab.envs.parts.world_view import WorldView
from mjhab.experts import make_expert
from mjhab.experts.skills.pick_plans import plan_pick
from mjhab.experts.style import ActionNoise, StyledView
from mjhab.robots.fetch.robot import ROBOT
from mjhab.rollout.loop import rollout
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink, StepView
from mjhab.tasks.style import PLAIN, Style, Styles


@lru_cache
def records(
    subtask: str, *words: str, worlds: int = 4, episodes: tuple[int, ...] = (0, 1, 2, 3)
) -> list[EpisodeRecord]:
    env = envs.make(
        task="tidy_house",
        subtask=subtask,
        num_envs=worlds,
        split="train",
        autoreset="disabled",
        threads=1,
    )
    return rollout(env, make_expert(env, Styles.parse(words)), episodes, seed=0)


def labels(found: list[EpisodeRecord]) -> list[str | None]:
    return [record.subtasks[-1].label for record in found if record.success_once]


def success_step(record: EpisodeRecord) -> int:
    return min(step for step, name in record.events if name == "success")


def test_a_style_that_is_the_default_changes_no_bit_but_is_recorded():
    plain = records("place")
    asked = records("place", "speed=1")
    assert [r.final_state for r in plain] == [r.final_state for r in asked]
    assert [r.force for r in plain] == [r.force for r in asked]
    assert all("style" not in r.to_dict() for r in plain)
    assert all(r.to_dict()["style"]["speed"] == 1.0 for r in asked)


def test_styles_do_not_depend_on_the_worlds():
    words = ("speed=0.6..1.0", "noise=0.0..0.1", "hold=0..5", "dither=0.05")
    many = records("place", *words, episodes=(0, 1, 2))
    few = records("place", *words, worlds=2, episodes=(2, 0, 1))
    assert [r.style for r in many] == [r.style for r in few] and [
        r.final_state for r in many
    ] == [r.final_state for r in few]
    assert len({r.style["speed"] for r in many}) == 3


def test_a_mishap_opens_the_hand_and_is_not_intended():
    columns = ROBOT.action
    noise = ActionNoise(Style(mishap=1.0), columns, np.random.default_rng(0))
    closing = np.zeros(columns.dim, np.float32)
    closing[columns.gripper] = -1.0
    opened = 1.0 * closing
    opened[columns.gripper] = 1.0
    before = [noise.disturb(opened) for _ in range(20)]
    assert all(np.array_equal(each, opened) for each in before)
    executed = np.array([noise.disturb(closing) for _ in range(60)])
    hit = executed[:, columns.gripper] > 0
    assert (
        np.flatnonzero(hit)[0] >= 7
        and hit.sum() == 8
        and np.ptp(np.flatnonzero(hit)) == 7
    )
    assert np.abs(executed[hit][:, columns.arm]).max() > 0.05
    np.testing.assert_array_equal(executed[~hit], np.tile(closing, (52, 1)))


def test_a_chance_is_drawn_as_one_or_zero():
    styles = Styles.parse(("mishap=0.25",))
    drawn = [styles.draw(0, index).mishap for index in range(400)]
    assert set(drawn) == {0.0, 1.0} and 70 < sum(drawn) < 130
    assert styles.words == ["mishap=0.25"]


def test_after_a_mishap_the_expert_picks_up_again():
    struck = records("pick", "mishap=1", worlds=2, episodes=(0, 1))
    again = [
        record
        for record in struck
        if record.success_once and sum(name == "grasped" for _, name in record.events) > 1
    ]
    assert again and all(record.style["mishap"] == 1.0 for record in struck)
    assert "straightforward_success" not in labels(again)


def test_dropped_objects_are_labelled_so():
    placed = labels(records("place"))
    dropped = labels(records("place", "release=drop"))
    assert len(placed) >= 3 and len(dropped) >= 3
    assert (
        set(dropped) == {"dropped_to_goal_success"}
        and "dropped_to_goal_success" not in placed
    )


def test_slower_takes_longer_and_holding_still_delays():
    plain, slow, late = (
        records("pick", *words) for words in ((), ("speed=0.6",), ("hold=20",))
    )
    both = [
        (p, s)
        for p, s in zip(plain, slow, strict=True)
        if p.success_once and s.success_once
    ]
    assert len(both) >= 2 and all(
        success_step(s) > 1.2 * success_step(p) for p, s in both
    )
    begun = [
        (p.events[0][0], h.events[0][0])
        for p, h in zip(plain, late, strict=True)
        if p.events and h.events
    ]
    # Most of them: the arm settles while it waits, and another plan, quicker or slower, may come out.
    assert len(begun) >= 3 and np.median([held - first for first, held in begun]) > 15


def test_visible_waits_are_shorter_than_counted_ones():
    counted = records("place")
    visible = records("place", "waits=visible")
    both = [
        (c, v)
        for c, v in zip(counted, visible, strict=True)
        if c.success_once and v.success_once
    ]
    assert len(both) >= 3
    assert np.median([success_step(c) - success_step(v) for c, v in both]) >= 2


def one_world(task: str, subtask: str, target: str) -> Any:
    return envs.make(
        task=task,
        subtask=subtask,
        target=target,
        num_envs=1,
        autoreset="disabled",
        threads=1,
    )


def opening_steps(
    target: str, words: tuple[str, ...], steps: int
) -> Iterator[tuple[float, Any]]:
    """The expert opens a link: after every step its opening as a share of its range, and x, y, yaw of the base."""
    env = one_world("set_table", "open", target)
    expert = make_expert(env, Styles.parse(words))
    obs, info = env.reset(seed=0, options={"episode": [0]})
    expert.reset(np.ones(1, bool))
    view = env.view(0)
    link = view.home.links[target]
    for _ in range(steps):
        obs, _, _, _, info = env.step(expert.act(obs, info))
        yield view.link_q(link.id) / link.range[1], view.base


def widest_opening(*words: str) -> float:
    """Share of its range to which the expert opens the fridge, before it lets go."""
    return max(share for share, _ in opening_steps("fridge/top_door", words, 150))


def test_doors_are_opened_further_where_that_is_asked_for():
    plain = widest_opening()
    assert plain > 0.75 and widest_opening("open_further=0.08") > plain + 0.05


def room_behind(*words: str) -> float:
    """How far the base backs away from where it took the drawer's handle [m]; the drawer must open."""
    steps = list(opening_steps("kitchen_counter/drawer3", words, 200))
    assert steps[-1][0] > 0.9
    pulled = [base[:2] for share, base in steps if share > 0.02]
    return max(float(np.linalg.norm(at - pulled[0])) for at in pulled)


def test_a_drawer_that_the_arm_pulls_needs_less_room_behind_the_robot():
    assert room_behind("pull=arm") < room_behind() - 0.15


def test_noise_changes_what_happens_and_is_corrected():
    plain = records("pick")
    noisy = records("pick", "noise=0.1", "base_noise=0.1")
    assert all(p.final_state != n.final_state for p, n in zip(plain, noisy, strict=True))
    assert sum(n.success_once for n in noisy) >= 3


@lru_cache
def a_start() -> WorldView:
    """A pick that can be done from every side."""
    env = one_world("tidy_house", "pick", "003_cracker_box")
    env.reset(seed=0, options={"episode": [0]})
    return env.view(0)


@pytest.mark.parametrize(
    ("wish", "low", "high"),
    [("top", -1.0, -0.93), ("tilted", -0.95, -0.33), ("side", -0.36, 1.0)],
)
def test_the_hand_comes_from_where_it_was_asked_to(wish: str, low: float, high: float):
    view = a_start()
    assert view.subtask is not None
    found = plan_pick(view, view.subtask.obj, np.zeros((0, 3)), 0, wish)
    assert found is not None
    placement, goals, _ = found
    assert low <= goals.rot[placement.goal, 2, 0] <= high


def executed(action_noise: ActionNoise, action: np.ndarray) -> np.ndarray:
    return action_noise.disturb(action_noise.slow(action))


def test_a_manner_slows_by_stretching_time():
    action_noise = ActionNoise(Style(speed=0.5), ROBOT.action, np.random.default_rng(0))
    assert [action_noise.due() for _ in range(6)] == [False, True] * 3
    action = np.linspace(-1.0, 1.0, 13).astype(np.float32)
    out = executed(action_noise, action)
    assert out[7] == action[7]
    np.testing.assert_array_equal(
        np.delete(out, 7), np.delete(action, 7) * np.float32(0.5)
    )


def test_bursts_of_noise_disturb_a_robot_at_rest_and_pause():
    style = Style(noise=0.1, base_noise=0.1, noise_kind="bursts")
    action_noise = ActionNoise(style, ROBOT.action, np.random.default_rng(0))
    still = np.zeros(13, np.float32)
    out = np.array([executed(action_noise, still) for _ in range(400)])
    disturbed = out.any(axis=1)
    assert 0.3 < disturbed.mean() < 0.7
    assert np.diff(disturbed.astype(int)).any() and not out[:, ROBOT.action.gripper].any()
    moved = [*np.arange(13)[ROBOT.action.arm], *np.arange(13)[ROBOT.action.body]]
    assert out[disturbed][:, moved].all()
    # Lengths of bursts and pauses.
    ends = np.flatnonzero(np.diff(disturbed.astype(int)))
    assert np.diff(ends).min() >= 5 and np.diff(ends).max() <= 30


def test_a_plain_manner_gives_the_very_action():
    action_noise = ActionNoise(PLAIN, ROBOT.action, np.random.default_rng(0))
    action = np.linspace(-1.0, 1.0, 13).astype(np.float32)
    assert action_noise.due() and action_noise.due()
    np.testing.assert_array_equal(executed(action_noise, action), action)


def test_noise_fades_where_the_robot_hardly_moves_and_spares_what_it_should():
    action_noise = ActionNoise(
        Style(noise=0.1, base_noise=0.1, noise_kind="step"),
        ROBOT.action,
        np.random.default_rng(0),
    )
    action = np.zeros(13, np.float32)
    action[0] = 0.5
    action[7] = -1.0
    moved = np.array([executed(action_noise, action) for _ in range(2000)]) - action
    np.testing.assert_allclose(moved[:, :7].std(axis=0), 0.1, rtol=0.15)
    assert not moved[:, 7:].any()
    action[0] = 0.025
    np.testing.assert_allclose(
        np.array([executed(action_noise, action)[1] for _ in range(2000)]).std(),
        0.01,
        rtol=0.15,
    )


def test_smooth_noise_drifts():
    action_noise = ActionNoise(Style(noise=0.1), ROBOT.action, np.random.default_rng(0))
    action = np.zeros(13, np.float32)
    action[0] = 0.5
    x = np.array([executed(action_noise, action)[1] for _ in range(4000)])
    assert x.std() == pytest.approx(0.1, rel=0.2)
    assert np.corrcoef(x[:-1], x[1:])[0, 1] == pytest.approx(0.86, abs=0.05)


def test_slower_scripts_read_speeds_of_their_own_time():
    view = a_start()
    slow = StyledView(view._env, 0)
    slow.style = Style(speed=0.5)
    np.testing.assert_allclose(slow.qd, 2.0 * view.qd)


class Notes(Sink):
    """Executed and intended actions of the first world."""

    def __init__(self) -> None:
        self.executed: list[np.ndarray] = []
        self.intended: list[np.ndarray] = []
        self.actors: set[str] = set()

    def on_step(self, env: Any, step: StepView) -> None:
        self.executed.append(step.actions[0].copy())
        self.intended.append(step.notes.intended[0].copy())
        self.actors.add(step.notes.actors[step.notes.actor[0]])


@pytest.mark.parametrize(
    "words", [("speed=0.8",), ("noise=0.1", "hold=4", "dither=0.05")]
)
def test_the_expert_tells_what_it_intends_without_its_noise(words: tuple[str, ...]):
    env = envs.make(
        task="tidy_house",
        subtask="pick",
        num_envs=1,
        split="train",
        autoreset="disabled",
        threads=1,
    )
    notes = Notes()
    rollout(
        env,
        make_expert(env, Styles.parse(words)),
        [0],
        seed=0,
        sinks=[notes],
        max_steps=60,
    )
    executed = np.array(notes.executed)
    intended = np.array(notes.intended)
    assert notes.actors == {"expert"}
    if words == ("speed=0.8",):
        np.testing.assert_array_equal(executed, intended)
        return
    moved = executed - intended
    assert (moved[:4, :7] != 0).all() and (moved[4:, :7] != 0).any()
    assert not moved[:, 7:].any() and np.abs(moved).max() < 0.6
    assert (np.abs(intended) <= 1.0).all()
