"""The actor's learning rate, which adapts to the divergence of its policy."""

from __future__ import annotations

from mjhab.learning.reinforcement.configs import PpoConfig

RATE_STEP = 1.5
MOST_RATE = 3e-3
"""Factor and upper limit of the learning rate that adapts to the KL divergence (the scheme of rsl_rl and rl_games)."""


def adapted_rate(rate: float, divergence: float, config: PpoConfig) -> float:
    """The next learning rate, so that the KL divergence of an epoch stays near ``desired_kl`` of the config."""
    wanted = config.desired_kl
    if not wanted:
        return rate
    if divergence > 2.0 * wanted:
        rate /= RATE_STEP
    elif divergence < 0.5 * wanted:
        rate *= RATE_STEP
    return min(max(rate, config.least_learning_rate), MOST_RATE)
