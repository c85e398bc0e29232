"""Policies by name and from files of the user."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mjhab.evaluation import resolve
from mjhab.evaluation.resolve import (
    OpenedPolicy,
    PolicyFacts,
    PolicyKind,
    PolicyOptions,
    inspect_policy,
    register_policy_kind,
    resolve_policy,
)
from mjhab.rollout.policy import Policy, RandomPolicy, RolloutEnv, ZeroPolicy
from tests.refusals import refused
from tests.rollout.fake_env import FakeEnv

GOOD = """
import numpy as np
from helper import SPEED

class Plain:
    name = "plain"
    env_options = {"obs_mode": "depth"}
    def reset(self, mask):
        self.worlds = len(mask)
    def act(self, obs, info):
        return np.full((self.worlds, 13), SPEED, np.float32)

class WithEnv(Plain):
    def __init__(self, env):
        self.env = env

class MayHaveEnv(Plain):
    def __init__(self, env=None, gain=2.0):
        self.env, self.gain = env, gain

class Tuned(Plain):
    def __init__(self, gain=2.0):
        self.gain = gain

class Greedy(Plain):
    def __init__(self, env, checkpoint):
        pass

class Nameless:
    reset = Plain.reset
    act = Plain.act

class Deaf:
    name = "deaf"
    def act(self, obs, info):
        pass

class _Hidden:
    pass
"""


@pytest.fixture
def file(tmp_path: Path) -> Iterator[Path]:
    before = list(sys.path)
    (tmp_path / "helper.py").write_text("SPEED = 0.25\n")
    path = tmp_path / "mine.py"
    path.write_text(GOOD)
    yield path
    sys.path[:] = before
    sys.modules.pop("helper", None)


def test_policies_with_a_name() -> None:
    assert isinstance(resolve_policy("zero", FakeEnv(1)), ZeroPolicy)
    seeded = resolve_policy("random", FakeEnv(1), PolicyOptions(seed=5))
    again = RandomPolicy(5)
    info = {"episode_spec": [{"index": 3}]}
    for policy in (seeded, again):
        policy.reset(np.ones(1, bool))
    np.testing.assert_array_equal(seeded.act(None, info), again.act(None, info))
    assert inspect_policy("expert") == PolicyFacts("expert", reads_instruction=False)
    with refused("style", ("speed=0.5",)):
        resolve_policy("zero", FakeEnv(1), PolicyOptions(style=("speed=0.5",)))


def test_an_unknown_name_tells_all_forms() -> None:
    with refused("policy", "exprt", expected="expert", advice="FILE.py:CLASS"):
        inspect_policy("exprt")
    with refused("policy", "exprt"):
        resolve_policy("exprt", FakeEnv(1))


def test_a_class_of_a_file_acts(file: Path) -> None:
    env = FakeEnv(2)
    policy = resolve_policy(f"{file}:Plain", env)
    policy.reset(np.ones(2, bool))
    assert policy.name == "plain" and (policy.act(None, {}) == 0.25).all()
    assert resolve_policy(f"{file}:WithEnv", env).env is env  # type: ignore[attr-defined]
    assert resolve_policy(f"{file}:MayHaveEnv", env).env is env  # type: ignore[attr-defined]
    assert resolve_policy(f"{file}:Tuned", env).gain == 2.0  # type: ignore[attr-defined]


def test_what_is_known_of_a_file_before_there_is_an_environment(file: Path) -> None:
    facts = inspect_policy(f"{file}:Plain")
    assert facts.name == "mine.py:Plain" and facts.env_options == {"obs_mode": "depth"}
    assert set(facts.identity) == {"policy_sha256"}
    file.write_text(GOOD.replace("SPEED, np", "-SPEED, np"))
    changed = inspect_policy(f"{file}:Plain")
    assert changed.identity != facts.identity, (
        "another version of a policy is another policy"
    )
    policy = resolve_policy(f"{file}:Plain", FakeEnv(1))
    policy.reset(np.ones(1, bool))
    assert (policy.act(None, {}) == -0.25).all(), (
        "the file is read again when it has changed"
    )


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            ":Plian",
            ("unknown class 'Plian'", "Did you mean 'Plain'", "Deaf, Greedy, "),
        ),
        ("", ("one class of the file", "mine.py:Plain", "mine.py:Deaf")),
        (":Deaf", ("Deaf: has no reset", "reset(mask)", "act(obs, info)")),
        (":Nameless", ("Nameless: field 'name' is missing", "name = 'Nameless'")),
        (":Greedy", ("Greedy needs 2 arguments (env, checkpoint)", "default values")),
    ],
)
def test_a_class_that_is_no_policy(file: Path, name: str, words: tuple[str, ...]) -> None:
    with refused() as caught:
        resolve_policy(f"{file}{name}", FakeEnv(1))
    for word in words:
        assert word in str(caught.value)
    assert "_Hidden" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "import numpy\nimport no_such_library\n",
            "ModuleNotFoundError: No module named 'no_such_library' (line 2)",
        ),
        ("class A:\n    def act(self:\n", "SyntaxError"),
        (
            "def f():\n    return 1 / 0\n\nf()\n",
            "ZeroDivisionError: division by zero (line 2)",
        ),
        ("import sys\nsys.exit(3)\n", "SystemExit: 3 (line 2)"),
        ("import numpy as np\n", "defines no class at all"),
    ],
)
def test_a_file_that_cannot_be_used(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "broken.py"
    path.write_text(text)
    for _ in range(2):
        with refused(where="broken.py", said=words):
            inspect_policy(f"{path}:A")


def test_a_file_that_is_missing(tmp_path: Path) -> None:
    for spec in (tmp_path / "none.py:A", tmp_path / "none.py", "none.py:"):
        with refused("policy", str(spec), expected="a file that exists"):
            inspect_policy(str(spec))


def test_env_options_must_be_a_dict(tmp_path: Path) -> None:
    path = tmp_path / "odd.py"
    path.write_text(
        "class A:\n    name = 'a'\n    env_options = 'depth'\n    def reset(s, m): 0\n    def act(s, o, i): 0\n"
    )
    with refused("env_options", "depth", expected="a dict"):
        inspect_policy(f"{path}:A")


class _Kind(OpenedPolicy):
    """Another kind of policies."""

    @property
    def facts(self) -> PolicyFacts:
        return PolicyFacts(self.spec.removeprefix("test:"), {"weights": "abc"})

    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        return RandomPolicy(options.seed + env.num_envs)


def test_other_kinds_can_be_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resolve, "POLICY_KINDS", list(resolve.POLICY_KINDS))
    register_policy_kind(
        PolicyKind(
            "test:NAME", lambda spec: spec.startswith("test:"), f"{__name__}:_Kind"
        )
    )
    assert inspect_policy("test:mine") == PolicyFacts("mine", {"weights": "abc"})
    assert isinstance(resolve_policy("test:mine", FakeEnv(1)), RandomPolicy)
    with refused("policy", "tset:mine", advice="test:NAME"):
        inspect_policy("tset:mine")
