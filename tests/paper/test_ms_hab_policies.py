"""Policies of the original: the same actions as a plain computation gives, and clear errors for other files."""

from __future__ import annotations

import dataclasses
import io
import pickle
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from mjhab.core.conventions.names import Conventions
from mjhab.core.errors import UsageError
from mjhab.core.seeding import stream
from mjhab.envs import make
from mjhab.evaluation.evaluate import EvalSpec, resolved_config
from mjhab.evaluation.resolve import inspect_policy
from mjhab.paper.ms_hab.checkpoint import LAYOUTS, load_network
from mjhab.paper.ms_hab.policy import ENV_OPTIONS, MsHabPolicy, ms_hab_policy
from mjhab.rollout.loop import rollout
from tests.paper import ms_hab_checkpoints as original
from tests.refusals import refused

WORLDS = 2
SEED = 7


def environment(**options: Any) -> Any:
    """What a policy reads of an environment of the profile."""
    return SimpleNamespace(
        config=SimpleNamespace(**(ENV_OPTIONS | {"object_axes": "scan"} | options))
    )


ENV = environment()


@dataclass(frozen=True)
class Case:
    """One network of the original: names and shapes of its parameters, a plain computation, frames it is given."""

    shapes: dict[str, tuple[int, ...]]
    action: Callable[..., torch.Tensor]
    frames: int


CASES = {
    "sac": Case(original.sac_shapes(), original.sac_action, 3),
    "ppo": Case(original.ppo_shapes(), original.ppo_action, 3),
    "bc": Case(original.bc_shapes(), original.bc_action, 1),
    "dp": Case(original.dp_shapes(), original.dp_plan, 2),
}


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """So small networks are quicker on one thread, above all beside other tests."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def observation(rng: np.random.Generator, worlds: int = WORLDS) -> dict[str, np.ndarray]:
    shape = (worlds, 128, 128, 1)
    depth = {
        c: rng.integers(0, 5000, shape).astype(np.int16)
        for c in ("fetch_head", "fetch_hand")
    }
    obs: dict[str, np.ndarray] = {
        "state": rng.normal(size=(worlds, 42)).astype(np.float32)
    }
    return obs | {
        f"sensor_data/{camera}/depth": images for camera, images in depth.items()
    }


def info(*indices: int) -> dict[str, Any]:
    return {"episode_spec": [{"seed": SEED, "index": index} for index in indices]}


def tensors(
    history: list[dict[str, np.ndarray]], world: int, frames: int
) -> tuple[dict, torch.Tensor]:
    """The last observations of an episode of one world, the first repeated where there are too few."""
    last = [history[max(0, len(history) - frames + i)] for i in range(frames)]
    depth = {
        f"{camera}_depth": torch.tensor(
            np.stack(
                [obs[f"sensor_data/{camera}/depth"][world, ..., 0] for obs in last]
            ).astype(np.float32)
        )
        for camera in ("fetch_head", "fetch_hand")
    }
    return depth, torch.tensor(np.stack([obs["state"][world] for obs in last]))


class Plain:
    """What a policy does in one world, computed with plain functions from the observations of its episode."""

    def __init__(
        self, case: Case, weights: original.Weights, world: int, index: int
    ) -> None:
        self.case = case
        self.weights = weights
        self.world = world
        self.history: list[dict[str, np.ndarray]] = []
        self.noise = stream(SEED, "policy", "ms_hab", index)
        self.plan: list[torch.Tensor] = []

    def act(self, obs: dict[str, np.ndarray]) -> np.ndarray:
        self.history.append(obs)
        seen = tensors(self.history, self.world, self.case.frames)
        if self.case.action is not original.dp_plan:
            action = self.case.action(self.weights, *seen)
        else:
            if not self.plan:
                noise = torch.from_numpy(
                    self.noise.standard_normal((100, 16, 13), dtype=np.float32)
                )
                self.plan = list(original.dp_plan(self.weights, *seen, noise))
            action = self.plan.pop(0)
        action = action.clamp(-1, 1).numpy()
        action[8:10] = 0.0
        return action


@pytest.mark.parametrize("name", CASES)
def test_actions_are_those_of_a_plain_computation(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    weights = original.random_weights(case.shapes)
    policy = ms_hab_policy(original.save(tmp_path / "policy.pt", weights), ENV)
    assert policy.name == f"ms_hab:{name}"
    rng = np.random.default_rng(1)
    plain = [Plain(case, weights, w, index) for w, index in enumerate((3, 4))]
    policy.reset(np.ones(WORLDS, bool))
    indices = [3, 4]
    spread = []
    for step in range(9):
        if step == 5:
            # World 1 begins another episode; world 0 goes on as if nothing had been.
            indices[1] = 9
            plain[1] = Plain(case, weights, 1, 9)
            policy.reset(np.array([False, True]))
        obs = observation(rng)
        got = policy.act(obs, info(*indices))
        want = np.stack([one.act(obs) for one in plain])
        assert (
            got.dtype == np.float32
            and got.shape == (WORLDS, 13)
            and (np.abs(got) <= 1).all()
        )
        np.testing.assert_allclose(got, want, atol=2e-4)
        spread.append(got)
    # The weights are such that actions differ from step to step and do not all lie at the limits.
    assert (
        np.std(spread, axis=0)[:, :8].min() > 1e-3
        and (np.abs(spread) < 0.99).mean() > 0.2
    )


def test_in_an_environment_of_other_conventions_the_state_is_asked_for(
    tmp_path: Path,
) -> None:
    path = original.save(tmp_path / "a.pt", original.random_weights(CASES["ppo"].shapes))
    rng = np.random.default_rng(3)
    obs = observation(rng)
    published = {**obs, "state": observation(rng)["state"]}
    asked = []

    def state_as(conventions: Conventions) -> np.ndarray:
        asked.append(conventions)
        return published["state"]

    for other in ({"object_axes": "object"}, {"joint_angles": "wrapped"}):
        env = environment(**other)
        env.state_as = state_as
        policy = ms_hab_policy(path, env)
        plain = ms_hab_policy(path, ENV)
        for each in (policy, plain):
            each.reset(np.ones(WORLDS, bool))
        np.testing.assert_array_equal(
            policy.act(obs, info(0, 1)), plain.act(published, info(0, 1))
        )
    assert asked == [Conventions("scan", "unwrapped")] * 2


@pytest.mark.parametrize("name", CASES)
def test_an_episode_does_not_depend_on_the_worlds_beside_it(
    name: str, tmp_path: Path
) -> None:
    _, network = load_network(
        original.save(tmp_path / "a.pt", original.random_weights(CASES[name].shapes))
    )
    rng = np.random.default_rng(2)
    many = MsHabPolicy(name, network)
    one = MsHabPolicy(name, network)
    many.reset(np.ones(2, bool))
    one.reset(np.ones(1, bool))
    for _ in range(2):
        obs = observation(rng)
        alone = {key: values[1:] for key, values in obs.items()}
        np.testing.assert_array_equal(
            many.act(obs, info(1, 5))[1:], one.act(alone, info(5))
        )


def test_the_networks_have_the_names_and_shapes_of_the_original() -> None:
    for name, case in CASES.items():
        layout = LAYOUTS[name]
        acting = {
            key: shape
            for key, shape in case.shapes.items()
            if not key.startswith(layout.training_only)
        }
        network = layout.build(acting)
        assert {
            key: tuple(value.shape) for key, value in network.state_dict().items()
        } == acting


def test_weights_that_are_not_finite_are_refused_by_name(tmp_path: Path) -> None:
    weights = original.random_weights(CASES["bc"].shapes)
    name = next(iter(weights))
    weights[name].view(-1)[0] = torch.nan
    path = original.save(tmp_path / "a.pt", weights)
    with pytest.raises(
        UsageError, match=f"1 of the .* numbers of its tensor {name} are not fin"
    ):
        load_network(path)


def test_frames_and_cameras_are_read_off_the_parameters(tmp_path: Path) -> None:
    weights = original.random_weights(original.bc_shapes(frames=3))
    _, network = load_network(original.save(tmp_path / "a.pt", weights))
    assert network.frames == 3 and network.cameras == (
        "fetch_head_depth",
        "fetch_hand_depth",
    )
    _, network = load_network(
        original.save(tmp_path / "b.pt", original.random_weights(CASES["sac"].shapes))
    )
    assert network.cameras == ("fetch_hand_depth", "fetch_head_depth")


def test_the_bare_parameters_are_a_checkpoint_too(tmp_path: Path) -> None:
    torch.save(original.random_weights(CASES["ppo"].shapes), tmp_path / "a.pt")
    assert load_network(tmp_path / "a.pt")[0] == "ppo"


def refuse(path: Path, *parts: str) -> None:
    with pytest.raises(UsageError) as caught:
        load_network(path)
    for part in (str(path), *parts):
        assert part in str(caught.value)


def test_other_layouts_are_told_apart_by_their_keys(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    weights = original.random_weights(CASES["ppo"].shapes)
    gone = {key: value for key, value in weights.items() if key != "actor_mean.2.bias"}
    original.save(path, {**gone, "actor_std": torch.zeros(3)})
    refuse(
        path,
        "keys of MS-HAB's PPO network",
        "missing: actor_mean.2.bias;",
        "too many: actor_std",
    )
    original.save(path, {**weights, "actor_mean.0.weight": torch.zeros(512, 700)})
    refuse(path, "of another shape: actor_mean.0.weight (512, 700) instead of (512, 768)")
    original.save(
        path,
        {
            key.replace("fetch_hand_depth", "all_depth"): value
            for key, value in weights.items()
        },
    )
    refuse(path, "too many: feature_net.extractors.all_depth.0.0.weight", "and 2 more")
    sac = original.random_weights(CASES["sac"].shapes)
    inner = {
        key.removeprefix("actor."): value
        for key, value in sac.items()
        if key.startswith("actor.")
    }
    original.save(path, inner)
    refuse(path, "Nearest is SAC: missing: actor.encoder", "too many: encoder.cnns")
    original.save(path, {"policy.net.0.weight": torch.zeros(3)})
    refuse(
        path,
        "another layout than MS-HAB's SAC, PPO, BC, DP",
        "too many: policy.net.0.weight",
    )
    dp = original.random_weights(CASES["dp"].shapes)
    narrow = {
        key: value[:60] if value.shape[0] == 64 else value for key, value in dp.items()
    }
    original.save(path, narrow)
    refuse(path, "keys of MS-HAB's DP network, but inconsistent sizes")
    torch.save({"agent": {}, "step": 3}, path)
    refuse(path, "holds no parameters of a policy", "it holds agent, step")


class Spy:
    """Unpickling it would leave a file behind."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return (Path.touch, (self.path,))


@pytest.mark.filterwarnings("error")
def test_files_that_are_no_checkpoints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mark = tmp_path / "executed"
    path = tmp_path / "a.pt"
    torch.save({"agent": {"w": torch.zeros(2)}, "extra": Spy(mark)}, path)
    refuse(
        path,
        "needs more than tensors and was refused; nothing in it was executed",
        "pathlib",
    )
    path.write_bytes(pickle.dumps({"agent": Spy(mark)}))
    refuse(
        path,
        "cannot be read as a checkpoint of torch",
        "Nothing in it was executed. Save the",
    )
    with pytest.raises(UsageError) as caught:
        load_network(path)
    assert "weights_only" not in str(caught.value) + capsys.readouterr().err
    assert not mark.exists()
    path.write_bytes(b"not a checkpoint")
    refuse(path, "cannot be read as a checkpoint of torch")
    path.unlink()
    refuse(path, "does not exist")
    with refused("policy", "ms_hab:", expected="as in ms_hab:CHECKPOINT.pt"):
        inspect_policy("ms_hab:")


def test_environments_and_observations_that_do_not_fit(tmp_path: Path) -> None:
    path = original.save(tmp_path / "a.pt", original.random_weights(CASES["ppo"].shapes))
    changes = {
        "obs_mode": "rgb",
        "cameras": ("fetch_head",),
        "camera_size": 64,
        "control_mode": "pd_joint_pos",
    }
    for option, value in changes.items():
        env = environment(**{option: value})
        with pytest.raises(
            UsageError, match=rf"{option} (is|are) .*Make it with profile='ms_hab'"
        ):
            ms_hab_policy(path, env)
    wide = environment(obs_mode="rgbd+seg", camera_size=(128, 128))
    policy = ms_hab_policy(path, wide)
    policy.reset(np.ones(WORLDS, bool))
    obs = observation(np.random.default_rng(0))
    lacking = {key: value for key, value in obs.items() if "hand" not in key}
    with refused(said="the observations lack sensor_data/fetch_hand/depth"):
        policy.act(lacking, info(0, 1))
    small = {
        **obs,
        "sensor_data/fetch_head/depth": np.zeros((WORLDS, 64, 64, 1), np.int16),
    }
    with refused(
        "observation sensor_data/fetch_head/depth",
        (2, 64, 64, 1),
        expected="(2, 128, 128, 1)",
    ):
        policy.act(small, info(0, 1))


def test_a_policy_brings_its_profile_and_the_user_may_choose_another(
    tmp_path: Path,
) -> None:
    path = original.save(tmp_path / "a.pt", original.random_weights(CASES["ppo"].shapes))
    facts = inspect_policy(f"ms_hab:{path}")
    assert facts.env_options["profile"] == "ms_hab"
    spec = EvalSpec.of(task="set_table", subtask="pick", policy=f"ms_hab:{path}")
    assert resolved_config(spec, facts)["profile"] == "ms_hab"
    chosen = dataclasses.replace(spec, env={"profile": "mjhab"})
    assert resolved_config(chosen, facts)["profile"] == "mjhab"


def test_a_policy_acts_in_an_environment(tmp_path: Path) -> None:
    weights = original.random_weights(CASES["sac"].shapes)
    path = original.save(tmp_path / "policy.pt", weights)
    env = make(
        task="set_table",
        subtask="pick",
        num_envs=2,
        autoreset="disabled",
        threads=1,
        **ENV_OPTIONS,
    )
    policy = ms_hab_policy(path, env)
    seen: list[tuple[dict, dict]] = []
    inner = policy.act

    def act(obs: dict[str, Any], info: dict[str, Any]) -> np.ndarray:
        actions = inner(obs, info)
        seen.append((obs, {"actions": actions}))
        return actions

    policy.act = act  # type: ignore[method-assign]
    records = rollout(env, policy, range(2), SEED, max_steps=3)
    assert [entry.steps for entry in records] == [3, 3] and len(seen) == 3
    for w in range(2):
        plain = Plain(CASES["sac"], weights, w, w)
        for obs, given in seen:
            np.testing.assert_allclose(given["actions"][w], plain.act(obs), atol=2e-4)


def test_cut_checkpoints_of_the_old_format_are_refused(tmp_path: Path) -> None:
    whole = io.BytesIO()
    weights = {"agent": {"x": torch.zeros(2)}}
    torch.save(weights, whole, _use_new_zipfile_serialization=False)
    path = tmp_path / "policy.pt"
    for length in range(0, len(whole.getvalue()), 5):
        path.write_bytes(whole.getvalue()[:length])
        with refused(where="policy.pt"):
            load_network(path)
