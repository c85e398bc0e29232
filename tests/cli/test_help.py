"""Help texts name every style option and every preset that there is."""

from __future__ import annotations

import pytest

from mjhab.cli.main import main
from mjhab.cli.options.policies.train import (
    TrainActOptions,
    TrainBcOptions,
    TrainDaggerOptions,
    TrainDiffusionOptions,
    TrainFlowOptions,
    TrainPpoOptions,
    TrainRlpdOptions,
    TrainSacOptions,
)
from mjhab.learning import configs
from mjhab.learning.reinforcement.configs import PPO, RLPD, SAC
from mjhab.learning.reinforcement.configs import PRESETS as REINFORCEMENT_PRESETS
from mjhab.tasks.style import NAMES

LEARNERS = {
    configs.BC: TrainBcOptions,
    configs.FLOW: TrainFlowOptions,
    configs.ACT: TrainActOptions,
    configs.DIFFUSION: TrainDiffusionOptions,
    configs.DAGGER: TrainDaggerOptions,
    PPO: TrainPpoOptions,
    SAC: TrainSacOptions,
    RLPD: TrainRlpdOptions,
}


@pytest.mark.parametrize("command", ["eval", "generate"])
def test_help_names_every_style(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    about_styles = told[told.index("--style") :].split("--")[1]
    assert [name for name in NAMES if name not in about_styles.replace(",", " ").split()] == []


@pytest.mark.parametrize("algorithm", LEARNERS)
def test_help_names_every_preset(algorithm: str) -> None:
    presets = {**configs.PRESETS, **REINFORCEMENT_PRESETS}[algorithm]
    told = (LEARNERS[algorithm].__doc__ or "").replace(",", " ").replace(".", " ").split()
    assert [name for name in presets if name not in told] == []
