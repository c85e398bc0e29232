from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjhab.cli.main import main
from mjhab.cli.view import _source
from mjhab.core.action_notes import HUMAN
from mjhab.data.select.interventions import intervention_steps
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import select
from mjhab.data.store.damage import episode_problems
from mjhab.data.store.reading import open_shard
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.evaluation.evaluate import EvalSpec
from mjhab.viewer.sources.hand_input import HOLD_KEY
from mjhab.viewer.sources.live import LiveSession
from mjhab.viewer.sources.pace import RealTimeClock
from mjhab.viewer.spec import ViewSpec
from tests.refusals import command, refused
from tests.viewer.test_pages import until

HORIZON = 8


@contextmanager
def session(
    policy: str = "random",
    shard: Path | None = None,
    *,
    playing: bool = True,
    worlds: int = 1,
    **env: Any,
) -> Iterator[LiveSession]:
    spec = EvalSpec.of(
        policy=policy,
        subtask="pick",
        worlds=worlds,
        episodes=worlds,
        threads=1,
        env={"horizon": HORIZON, "reward_mode": "dense", **env},
    )
    made = LiveSession(
        spec, 0, RealTimeClock(playing=playing, speed=math.inf), shard=shard
    )
    made.start()
    try:
        yield made
    finally:
        made.close()


def steps(made: LiveSession) -> int:
    return made.track.last if made.track is not None else -1


def is_over(made: LiveSession) -> bool:
    return made.track is not None and bool(made.track.over)


def env_of(made: LiveSession) -> SequentialTaskEnv:
    assert made.env is not None
    return made.env


def until_step(made: LiveSession, step: int) -> None:
    until(lambda: steps(made) >= step or made.problem, 20.0)
    assert not made.problem


def test_it_runs_to_the_end_and_waits_there() -> None:
    with session() as made:
        until(lambda: is_over(made), 20.0)
        track = made.track
        assert track is not None and track.last == HORIZON and not made.pace.playing
        assert track.moments[1].terms and track.moments[1].actor == "random"
        assert track.force_limits == (5000.0,)
        assert not np.array_equal(track.moments[0].qpos, track.moments[-1].qpos)
        made.pace.play(True)
        until(lambda: made.track is not track and is_over(made), 10.0)
        assert made.track is not None and made.track.index == 1


def test_single_steps_restart_and_next_episode() -> None:
    with session(playing=False) as made:
        until_step(made, 0)
        made.pace.step_once()
        until_step(made, 1)
        time.sleep(0.05)
        assert steps(made) == 1
        first = made.track
        made.hold_at_end = False
        made.restart()
        until(lambda: made.track is not first)
        made.pace.play(False)
        made.next_episode()
        until(lambda: made.track is not None and made.track.index >= 1)


def test_restart_keeps_the_episode_of_the_watched_world() -> None:
    with session(worlds=3, playing=False) as made:
        until_step(made, 0)
        made.watched = 2
        for ask, index in ((made.restart, 2), (made.next_episode, 3), (made.restart, 3)):
            before = made.track
            ask()
            until(lambda before=before: made.track is not before)
            assert made.track is not None and made.track.index == index


def test_a_person_takes_over_and_gives_back(tmp_path: Path) -> None:
    shard = tmp_path / "mine.h5"
    with session("random", shard, playing=False) as made:
        until_step(made, 0)
        for step in range(1, HORIZON + 1):
            if step in (3, 6):
                made.hear_hand(json.dumps({"keys": [HOLD_KEY] if step == 3 else []}))
                until(lambda step=step: made.hand_drives == (step == 3))
            made.pace.step_once()
            until_step(made, step)
        until(lambda: is_over(made))
        assert "as human" in made.recording
        until(lambda: "1 episodes" in made.recording)
    found = select(shard, Filter("interventions == 3 and 'human' in actors"))
    assert len(found.matched) == 1
    with open_shard(shard) as found:
        (episode,) = found
        assert episode.run.policy == HUMAN and not episode_problems(episode)
        who = [episode.actors[k] for k in episode.array("actor")]
        assert who == ["random"] * 2 + [HUMAN] * 3 + ["random"] * 3
        assert episode.run.config["policy"]["corrected"]["name"] == "random"
        assert np.flatnonzero(intervention_steps(episode)).tolist() == [2, 3, 4]
        np.testing.assert_array_equal(
            episode.array("actions"), episode.array("actions_intended")
        )


def test_human_from_the_first_step_and_an_early_end(tmp_path: Path) -> None:
    shard = tmp_path / "mine.h5"
    with session(HUMAN, shard, playing=False) as made:
        until_step(made, 0)
        made.pace.step_once()
        until_step(made, 1)
        made.finish_episode()
        until(lambda: is_over(made))
        made.restart()
        until(lambda: not is_over(made))
        until_step(made, 2)
        # A browser that is closed in the middle: the robot waits; ending the viewer keeps the episode.
        made.hand_gone()
        assert not made.pace.playing
    with open_shard(shard) as found:
        takes = list(found)
        assert [take.run.policy for take in takes] == [HUMAN, HUMAN]
        assert all(take.attributes["ending"] in ("cut", "timeout") for take in takes)
        assert len({take.run.config_id for take in takes}) == 2
        assert {take.run.config["env"]["horizon"] for take in takes} == {HORIZON}


@pytest.mark.parametrize(
    ("words", "env"),
    [
        ({"subtask": "pick"}, {"reward_mode": "dense"}),
        ({}, {"reward_mode": "dense"}),
        ({"subtask": "pick", "reward": "sparse"}, {"reward_mode": "sparse"}),
        ({"policy": HUMAN, "horizon": 600}, {"reward_mode": "dense", "horizon": 600}),
    ],
)
def test_running_worlds_show_reward_terms_and_last_as_long_as_asked(
    words: dict[str, Any], env: dict[str, Any]
) -> None:
    source = _source(ViewSpec.of(**words))
    assert isinstance(source, LiveSession)
    asked = {"num_envs": 1, **env}
    assert asked.items() <= source.spec.env.items()


def test_a_recorded_episode_is_chosen_by_its_position(shard: Path) -> None:
    source = _source(ViewSpec(places=(shard,), episode=1))
    source.start()
    assert source.choice == source.choices[1]
    source.close()


def test_the_same_episode_of_a_policy_is_kept_once(tmp_path: Path) -> None:
    shard = tmp_path / "mine.h5"
    with session("zero", shard) as made:
        until(lambda: is_over(made), 20.0)
        first = made.track
        made.restart()
        until(lambda: made.track is not first and is_over(made), 10.0)
    with open_shard(shard) as found:
        (episode,) = found
        assert episode.run.policy == "zero"


def test_an_early_end_does_not_take_the_place_of_the_whole_episode(
    tmp_path: Path,
) -> None:
    shard = tmp_path / "early.h5"
    with session(shard=shard, playing=False) as made:
        until(lambda: made.track is not None, 20.0)
        made.finish_episode()
        until(lambda: is_over(made), 20.0)
        made.restart()
        until(lambda: steps(made) == HORIZON and is_over(made), 20.0)
        assert made.recording.startswith("2 episodes")
    with open_shard(shard) as opened:
        found = {str(e.attributes["ending"]): e for e in opened}
        assert set(found) == {"cut", "timeout"}
        assert {e.record.index for e in opened} == {0}
        assert {e.run.policy for e in opened} == {"random"}
        assert "take" in found["cut"].run.config["policy"]
        assert "take" not in found["timeout"].run.config["policy"]


def test_another_policy_acts_without_a_new_episode() -> None:
    with session("zero", playing=False) as made:
        until_step(made, 0)
        track = made.track
        made.set_policy("random")
        made.pace.step_once()
        until_step(made, 1)
        assert made.track is track and track is not None
        assert track.moments[1].actor == "random"


def test_an_episode_that_has_ended_cannot_be_ended_again(tmp_path: Path) -> None:
    shard = tmp_path / "twice.h5"
    with session(shard=shard, playing=False) as made:
        until_step(made, 0)
        made.finish_episode()
        until(lambda: is_over(made))
        first = made.track
        made.finish_episode()
        made.pace.play(True)
        until(lambda: made.track is not first and is_over(made), 20.0)
        assert steps(made) == HORIZON


def test_a_single_step_is_one_of_the_watched_world() -> None:
    with session(worlds=2, playing=False) as made:
        until_step(made, 0)
        assert made._cuttable is not None
        made._cuttable.cut[1] = True
        for step in (1, 2, 3):
            made.pace.step_once()
            until_step(made, step)
        assert made.tracks[1] is not None and made.tracks[1].index == 2


def test_a_policy_that_gives_up_ends_the_episode(tmp_path: Path) -> None:
    file = tmp_path / "weak.py"
    file.write_text(
        "import numpy as np\n"
        "class Weak:\n"
        "    name = 'weak'\n"
        "    def reset(self, mask): pass\n"
        "    def act(self, obs, info): return np.zeros((1, 13), np.float32)\n"
        "    def fault(self, world): return 'the server is gone'\n"
    )
    with session(f"{file}:Weak") as made:
        until(lambda: is_over(made) or made.problem, 20.0)
        assert made.problem == "the server is gone" and steps(made) == 1


def test_a_policy_that_fails_is_told_and_can_be_replaced(tmp_path: Path) -> None:
    bad = tmp_path / "bad.py"
    bad.write_text(
        "class Bad:\n"
        "    name = 'bad'\n"
        "    def reset(self, mask): pass\n"
        "    def act(self, obs, info): raise RuntimeError('no idea')\n"
    )
    with session(f"{bad}:Bad") as made:
        until(lambda: made.problem, 20.0)
        assert "RuntimeError: no idea" in made.problem and "act" in made.problem
        made.set_policy("zero")
        until(lambda: steps(made) == HORIZON, 20.0)
        assert not made.problem
        made.set_policy("nobody")
        until(lambda: made.problem)
        assert "unknown policy 'nobody'" in made.problem


def test_a_viewer_that_cannot_listen_leaves_no_lock(tmp_path: Path) -> None:
    words = ["--subtask", "close", "--record", str(tmp_path / "mine.h5")]
    with refused(said="cannot listen"):
        command("view", *words, "--host", "192.0.2.1")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.h5"]


@pytest.mark.parametrize(
    ("words", "code", "why"),
    [
        (["--subtask", "pick", "--target", "sofa"], 2, "unknown target 'sofa'"),
        (["--subtask", "pick", "--home", "castle"], 2, "castle"),
        (["--subtask", "pick", "--reward", "big"], 2, "unknown reward mode 'big'"),
        (["--subtask", "close", "--record", "text.h5"], 1, "text.h5 is not an HDF5 file"),
    ],
)
def test_what_cannot_work_ends_the_command_before_a_page_is_served(
    words: list[str],
    code: int,
    why: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mjhab.viewer.pages.app.Viewer", pytest.fail)
    Path("text.h5").write_text("no shard")
    assert main(["view", *words, "--threads", "1"]) == code
    assert why in capsys.readouterr().err


def test_errors_of_ours_are_told_without_a_place_in_the_code() -> None:
    with session("zero", playing=False) as made:
        until_step(made, 0)
        made.set_policy("nobody")
        until(lambda: made.problem)
        assert made.problem.startswith("unknown policy") and "line" not in made.problem


def test_a_policy_that_sees_gets_a_world_with_cameras(tmp_path: Path) -> None:
    sees = tmp_path / "sees.py"
    sees.write_text(
        "import numpy as np\n"
        "class Sees:\n"
        "    name = 'sees'\n"
        "    env_options = {'obs_mode': 'depth', 'camera_size': 16}\n"
        "    def reset(self, mask): pass\n"
        "    def act(self, obs, info):\n"
        "        assert obs['sensor_data/fetch_head/depth'].shape[1] == 16\n"
        "        return np.zeros((1, 13), np.float32)\n"
    )
    with session("zero") as made:
        until(lambda: steps(made) == HORIZON, 20.0)
        made.set_policy(f"{sees}:Sees")
        until(
            lambda: made.track is not None and made.track.moments[-1].actor == "sees",
            60.0,
        )


def test_the_expert_tells_its_plan() -> None:
    with session("zero", playing=False) as made:
        until_step(made, 0)
        made.show_expert_plan(True)
        until(lambda: made.expert_plan is not None or made.problem, 60.0)
        plan = made.expert_plan
        assert plan is not None, made.problem
        view = env_of(made).view(0)
        base = view.q
        np.testing.assert_allclose(plan.path[0], base[:2], atol=0.05)
        assert plan.placement is not None and len(plan.hands) and plan.chosen is not None
        assert view.subtask is not None
        goal = view.object_pose(view.subtask.obj)[:3]
        assert np.linalg.norm(plan.hands[:, :3, 3] - goal, axis=1).max() < 0.5
        made.show_expert_plan(False)
        until(lambda: made.expert_plan is None)


def wait_in_thread(
    pace: RealTimeClock, meanwhile: Callable[[], object]
) -> threading.Thread:
    thread = threading.Thread(target=pace.wait, args=(meanwhile,), daemon=True)
    thread.start()
    return thread


def test_pace_waits_while_paused() -> None:
    pace = RealTimeClock(playing=False)
    looked: list[int] = []
    waiting = wait_in_thread(pace, lambda: looked.append(1))
    until(lambda: looked)
    assert waiting.is_alive()
    pace.step_once()
    waiting.join(5.0)
    assert not waiting.is_alive() and not pace.playing
    again = wait_in_thread(pace, bool)
    pace.play(True)
    again.join(5.0)
    assert not again.is_alive()


def test_what_is_asked_meanwhile_ends_the_wait() -> None:
    def refuse() -> None:
        raise KeyError("something else")

    with pytest.raises(KeyError):
        RealTimeClock(playing=False).wait(refuse)
