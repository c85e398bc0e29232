"""`benchmarks.scaling`: its model, a small table, and wrong numbers."""

from __future__ import annotations

import json

import pytest

from benchmarks.scaling import StepTime, main, threads_of


def test_the_model_is_found_again() -> None:
    true = StepTime(2e-4, 3e-5, 3e-4, 0.0)
    cells = [(worlds, threads) for worlds in (1, 16, 256) for threads in (1, 2)]
    rows = [
        {"worlds": worlds, "threads": threads, "env_sps": true.speed(worlds, threads)}
        for worlds, threads in cells
    ]
    found = StepTime.fit(rows, "env")
    assert [found.fixed, found.serial, found.parallel] == pytest.approx(
        [2e-4, 3e-5, 3e-4]
    )
    assert found.error < 1e-6
    # However many cores there are, the serial part stays.
    assert found.speed(1000, 10**6) == pytest.approx(
        1000 / (2e-4 + 1000 * 3e-5), rel=1e-3
    )


def test_threads_are_powers_of_two_and_all_cores() -> None:
    assert [threads_of(count) for count in (1, 2, 6, 8)] == [
        (1,), (1, 2), (1, 2, 4, 6), (1, 2, 4, 8),
    ]  # fmt: skip


def test_a_small_table(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--worlds", "1", "2", "--threads", "1", "--rounds", "1"]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [(row["worlds"], row["threads"]) for row in found["rows"]] == [(1, 1), (2, 1)]
    assert all(row["engine_sps"] > 0 and row["env_sps"] > 0 for row in found["rows"])
    assert [row["cores"] for row in found["predicted"]] == [4, 8, 16, 32, 64]
    assert set(found["models"]) == {"engine", "env"}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--worlds", "0"), "--worlds must be at least 1"),
        (("--threads", "0"), "--threads must be at least 1"),
        (("--rounds", "0"), "--rounds must be at least 1"),
        (("--worlds", *map(str, range(1, 102)), "--threads", "1"), "101 combinations"),
    ],
)
def test_wrong_numbers(
    words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    assert said in capsys.readouterr().err
