"""Students that are told their subtask by a sentence: the code of a sentence, learning from shards, and acting."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mjhab.core.errors import UsageError
from mjhab.data.select.query import Filter
from mjhab.data.store.places import episodes
from mjhab.evaluation.resolve import PolicyOptions, resolve_policy
from mjhab.learning.batches import BatchSampler
from mjhab.learning.checkpoint import load_checkpoint, save_student
from mjhab.learning.configs import (
    ACT,
    BC,
    FLOW,
    InputConfig,
    student_from_plain,
    to_plain,
)
from mjhab.learning.demos import (
    Demonstrations,
    load_demonstrations,
    observation_spec_of_data,
)
from mjhab.learning.observation.sentences import SENTENCE_WIDTH, encode_sentence
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.policy import StudentPolicy
from mjhab.learning.runs.specs import ImitationSpec
from mjhab.learning.runs.training import Trainer
from mjhab.learning.students.heads import make_student
from mjhab.learning.students.student import Batch
from mjhab.tasks.instructions import (
    CARRY_WORDINGS,
    FURNITURE_WORDS,
    OBJECT_WORDS,
    subtask_instruction,
)
from mjhab.tasks.instructions import InstructionRequest as Sentence
from mjhab.tasks.subtasks.registry import SUBTASKS
from tests.data.fake_world import FakeEnv
from tests.data.make import record
from tests.learning.reinforcement.toy import LAYOUT as LINE
from tests.learning.reinforcement.toy import Toy, encoder_of
from tests.learning.small import (
    INPUTS,
    STATE,
    condition_of,
    config,
    fake_env,
    layout,
    train_config,
    train_in,
)
from tests.refusals import refused

TOLD = dataclasses.replace(
    INPUTS, cameras=(), image_size=0, condition=False, sentence=True
)
EVERY = "success or not success"
DRAWER = "kitchen_counter/drawer3"
WORDINGS = {
    "open": (
        "open the drawer of the kitchen counter",
        "pull the drawer of the kitchen counter open",
    ),
    "close": (
        "close the drawer of the kitchen counter",
        "push the drawer of the kitchen counter shut",
    ),
}


class TellingEnv(FakeEnv):
    """Tells instructions, as real environments do: even episodes the first wording, odd ones the last."""

    def reset(self, seed: int, options: dict[str, Any]) -> tuple[dict, dict]:
        obs, info = super().reset(seed, options)
        for world in self.worlds:
            told = tuple(self._sentence(world.index, *entry) for entry in self.plan)
            world.spec = {**world.spec, "instruction": told[0], "instructions": told}
        return obs, {**info, "episode_spec": [world.spec for world in self.worlds]}

    def _sentence(self, index: int, kind: str, target: str) -> str:
        return subtask_instruction(
            Sentence(kind, target), lambda count: index % 2 * (count - 1)
        )


def words_of_tasks() -> list[str]:
    """Every word that a sentence of the built-in tasks and objects may contain."""
    wordings = [words for kind in SUBTASKS.names() for words in SUBTASKS[kind].words]
    texts = [re.sub(r"\{\w+\}", "", words) for words in (*wordings, *CARRY_WORDINGS)]
    texts += [
        *FURNITURE_WORDS.values(),
        "kitchen counter drawer door shelf part sink fridge",
        "top bottom central left right middle leftmost rightmost second third highest lowest",
        "nearest furthest another place",
    ]
    texts += [name for names in OBJECT_WORDS.values() for name in names]
    texts += ["on in from of bowl apple"]
    return sorted(set(re.findall(r"\w+", " ".join(texts).lower())))


def test_every_word_of_the_tasks_has_a_code_of_its_own() -> None:
    words = words_of_tasks()
    codes = np.stack([encode_sentence(word) for word in words])
    assert len(words) > 50
    assert np.linalg.matrix_rank(codes) == len(words)


def test_the_code_of_a_sentence_is_the_sum_of_its_words() -> None:
    code = encode_sentence("open the drawer")
    parts = [encode_sentence(word) for word in ("open", "the", "drawer")]
    np.testing.assert_array_equal(code, np.sum(parts, axis=0))
    np.testing.assert_array_equal(code, encode_sentence("The drawer: open the DRAWER!"))
    assert not encode_sentence(" ?! ").any()


def test_codes_stay_as_they_are() -> None:
    """Checkpoints have learned from these codes."""
    assert np.flatnonzero(encode_sentence("close")).tolist() == [59, 81, 85]
    assert np.flatnonzero(encode_sentence("open")).tolist() == [26, 32, 76]
    assert encode_sentence("close").shape == (SENTENCE_WIDTH,)


def test_the_sentence_follows_the_measured_inputs() -> None:
    both = layout(dataclasses.replace(INPUTS, sentence=True))
    alone = layout(dataclasses.replace(INPUTS, sentence=True, condition=False))
    one_hot = condition_of(layout(), "pick", "024_bowl")
    code = encode_sentence("pick up the bowl")
    told = condition_of(both, "pick", "024_bowl", "pick up the bowl")
    np.testing.assert_array_equal(told, np.concatenate([one_hot, code]))
    # Without the one-hot any subtask may be asked for.
    np.testing.assert_array_equal(
        condition_of(alone, "wipe", "table", "pick up the bowl"), code
    )
    for one in (both, alone, layout()):
        assert one.width == one.measured_width + one.conditioning_width
        assert one.measured_width == layout().measured_width


def test_a_config_from_before_the_sentence_has_none() -> None:
    plain = to_plain(config())
    del plain["inputs"]["sentence"]
    assert student_from_plain(plain) == config()


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("told")
    for subtask in ("open", "close"):
        record(folder / f"{subtask}.h5", range(2), TellingEnv(subtask=subtask))
    record(folder / "chain.h5", range(5, 9), TellingEnv())
    return folder


def test_demonstrations_hold_the_sentence_of_the_active_subtask(source: Path) -> None:
    told = observation_spec_of_data(source, TOLD, Filter(EVERY))
    data = load_demonstrations(source, told, -1, Filter(EVERY))
    codes = data.vector[:, told.measured_width :]
    recorded = sorted(episodes(source), key=lambda episode: episode.name)
    seen: set[str] = set()
    for start, episode in zip(np.unique(data.first).tolist(), recorded, strict=True):
        active = episode.array("subtasks/active")[: episode.steps]
        for step, pointer in enumerate(active.tolist()):
            sentence = episode.record.instructions[pointer]
            np.testing.assert_array_equal(codes[start + step], encode_sentence(sentence))
            seen.add(sentence)
    assert seen >= {*WORDINGS["open"], *WORDINGS["close"]}


def test_data_without_instructions_are_refused(tmp_path: Path) -> None:
    record(tmp_path / "older.h5", range(1), FakeEnv(subtask="close"))
    told = "recorded without instructions.*inputs.sentence=true.*mjhab generate"
    with pytest.raises(UsageError, match=told):
        observation_spec_of_data(tmp_path, TOLD, Filter(EVERY))
    assert observation_spec_of_data(
        tmp_path, dataclasses.replace(TOLD, sentence=False), Filter(EVERY)
    )


def test_a_run_with_sentences_resumes_exactly(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = ImitationSpec.of(
        out=tmp_path / "whole",
        preset=train_config(inputs=TOLD),
        target=DRAWER,
        worlds=1,
        threads=1,
        data=source,
        where=EVERY,
        eval_episodes=0,
        round_episodes=0,
    )
    train_in(request, tmp_path / "whole")
    make_update = Trainer.update

    def stop_after_two(trainer: Trainer, one: Batch, rate: float = 1.0) -> object:
        if trainer.step == 2:
            raise KeyboardInterrupt
        return make_update(trainer, one, rate)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "update", stop_after_two)
        assert train_in(request, tmp_path / "part").interrupted
    train_in(request, tmp_path / "part", resume=True)
    whole, part = (
        load_checkpoint(tmp_path / run / "training.safetensors")
        for run in ("whole", "part")
    )
    assert whole.config.inputs.sentence and whole.layout.entries[-1] == (
        "sentence",
        SENTENCE_WIDTH,
    )
    assert whole.about["step"] == part.about["step"] == 4
    assert all(
        torch.equal(whole.tensors[name], part.tensors[name]) for name in whole.tensors
    )


def info_of(sentences: list[str], pointer: int = 0) -> dict[str, Any]:
    plan = ({"kind": "open", "target": DRAWER}, {"kind": "close", "target": DRAWER})
    worlds = len(sentences)
    return {
        "episode_spec": [{"index": 0, "plan": plan}] * worlds,
        "pointer": np.full(worlds, pointer),
        "instruction": np.array(sentences, object),
    }


def taught(algorithm: str, updates: int) -> StudentPolicy:
    """A student of both subtasks, in four worlds: it has seen that one takes action 0.5 and the other -0.5."""
    told = ObservationSpec(TOLD, STATE, layout().actions, (DRAWER,), layout().control)
    random = np.random.default_rng(0)
    parts = []
    for subtask, action in (("open", -0.5), ("close", 0.5)):
        for sentence in WORDINGS[subtask]:
            vector = random.normal(size=(20, told.width)).astype(np.float32)
            vector[:, told.measured_width :] = encode_sentence(sentence)
            steps = np.full(20, 19)
            parts.append(
                Demonstrations(
                    vector,
                    np.zeros((20, 0, 0, 0), np.uint8),
                    np.full((20, 13), action, np.float32),
                    0 * steps,
                    steps,
                    np.arange(20),
                    1,
                )
            )
    data = Demonstrations.join(parts)
    trainer = Trainer(
        make_student(config(algorithm, inputs=TOLD), told), seed=0, updates=updates
    )
    trainer.student.fit_normalizers(data)
    trainer.restart_average()
    sampler = BatchSampler([data], 32, 1.0, 0)
    for step in range(updates):
        trainer.update(Batch.of(sampler.batch(step, 4, InputConfig(shift=0))))
    return StudentPolicy(trainer.student.eval(), fake_env(4, told))


@pytest.mark.parametrize(("algorithm", "updates"), [(BC, 60), (FLOW, 120), (ACT, 40)])
def test_a_student_of_two_subtasks_does_what_the_sentence_says(
    algorithm: str, updates: int
) -> None:
    torch.set_num_threads(1)
    policy = taught(algorithm, updates)
    obs = {"state": np.zeros((4, 5), np.float32)}

    def act(*sentences: str, pointer: int = 0) -> list[float]:
        policy.reset(np.ones(4, bool))
        return policy.act(obs, info_of(list(sentences), pointer)).mean(axis=1).tolist()

    for first, other in zip(WORDINGS["open"], WORDINGS["close"], strict=True):
        actions = act(first, other, first, other)
        np.testing.assert_allclose(actions, [-0.5, 0.5, -0.5, 0.5], atol=0.2)
    # Wordings that it has not seen, of words that it has.
    opened, shut = act(
        "pull open drawer 3", "shut drawer 3", "open it", "Close it, please."
    )[:2]
    assert opened < -0.2 and shut > 0.2


def test_the_sentence_counts_not_the_subtask_and_changes_within_an_episode() -> None:
    torch.set_num_threads(1)
    policy = taught(BC, 60)
    obs = {"state": np.zeros((4, 5), np.float32)}
    policy.reset(np.ones(4, bool))
    told = [WORDINGS["open"][0]] * 4
    first = [policy.act(obs, info_of(told, pointer=1)) for _ in range(2)]
    told[1] = WORDINGS["close"][0]
    second = policy.act(obs, info_of(told, pointer=1))
    assert first[0].max() < 0.0
    assert second[1].min() > 0.0 > second[[0, 2, 3]].max()


def test_a_checkpoint_may_be_told_another_sentence(tmp_path: Path) -> None:
    told = layout(TOLD)
    files = {name: str(tmp_path / f"{name}.safetensors") for name in ("told", "deaf")}
    save_student(Path(files["told"]), make_student(config(inputs=TOLD), told, seed=1), {})
    deaf = dataclasses.replace(TOLD, sentence=False)
    save_student(Path(files["deaf"]), make_student(config(inputs=deaf), layout(deaf)), {})
    env = fake_env(2, told)
    obs = {"state": np.zeros((2, 5), np.float32)}

    def act(sentences: list[str], instruction: str = "") -> np.ndarray:
        policy = resolve_policy(
            files["told"], env, PolicyOptions(instruction=instruction)
        )
        policy.reset(np.ones(2, bool))
        return policy.act(obs, info_of(sentences))

    asked = act(["open it", "push it"], "shut it")
    np.testing.assert_array_equal(asked, act(["shut it", "shut it"]))
    assert (asked != act(["open it", "push it"])).any()
    for other in ("oeffne die schublade", "the of it"):
        with refused(option="instruction", given=other):
            act(["open it"] * 2, other)
    assert act(["open it"] * 2, "the fridge").shape == asked.shape
    with refused(where="deaf.safetensors", said="takes no instruction"):
        resolve_policy(files["deaf"], env, PolicyOptions(instruction="shut it"))


def test_agents_of_reinforcement_learning_see_the_sentence_of_their_episode() -> None:
    told = dataclasses.replace(
        LINE, inputs=dataclasses.replace(LINE.inputs, sentence=True)
    )
    env = Toy(2)
    sight = encoder_of(env, told)
    plan = ({"kind": "close", "target": DRAWER},)
    sentences = WORDINGS["close"]
    specs = [{"plan": plan, "instructions": (one,)} for one in sentences]
    info = {"episode_spec": specs, "pointer": np.zeros(2, int)}
    obs, _ = env.reset(seed=0)
    seen = sight.see(obs, info)
    codes = np.stack([encode_sentence(one) for one in sentences])
    np.testing.assert_array_equal(seen.vector[:, told.measured_width :].numpy(), codes)
