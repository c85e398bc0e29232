"""The example of a new household task, end to end."""

from __future__ import annotations

from pathlib import Path

from tests.examples.plugins import run


def test_a_task_of_one_file_plans_spawns_and_steps() -> None:
    program = Path(__file__).with_name("clear_table_program.py")
    assert "all of ClearTable works" in run("clear_table.py", program)
