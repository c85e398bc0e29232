"""Hostile and broken inputs are refused in one line, with nothing written."""

from __future__ import annotations

import dataclasses
import errno
import os
import pwd
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjhab.cli.commands import Command
from mjhab.cli.main import main
from mjhab.core.errors import MjhabError, UsageError
from mjhab.core.files import cache
from mjhab.core.files.cache import cache_dir, write_cached
from mjhab.core.typed.bounds import Bound, Output, check_value
from mjhab.core.typed.flags import mark_of
from mjhab.data.select.query import Filter
from tests.hostile.cases import Case, cases
from tests.hostile.option_types import SPECS, bad_values, bounds_in, fields_of, made
from tests.hostile.outcome import outcome
from tests.hostile.readers import READERS
from tests.refusals import refused


@pytest.mark.parametrize("case", list(cases()), ids=str)
def test_it_is_refused(case: Case, tmp_path: Path):
    assert outcome(case, tmp_path) == "clean"


# -- options, each by its type -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", SPECS, ids=lambda command: command.name)
def test_no_command_takes_numbers_and_texts_out_of_all_range(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    for option, value in bad_values(command):
        with pytest.raises(UsageError) as refused:
            made(command, option, value)
        assert len(str(refused.value)) < 1000
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", SPECS, ids=lambda command: command.name)
def test_defaults_are_in_range(command: Command):
    for owner, name, default in fields_of(command):
        if default is not dataclasses.MISSING and mark_of(owner, name, Output) is None:
            check_value(owner, name, default)


@pytest.mark.parametrize("command", SPECS, ids=lambda command: command.name)
def test_every_bound_is_where_checks_find_it(command: Command):
    for owner, name, _ in fields_of(command):
        found = mark_of(owner, name, Bound)
        assert bounds_in(owner, name) == ([found] if found else []), name


# -- readers, fed with changed files -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", READERS)
def test_a_changed_file_is_read_or_refused(name: str, tmp_path: Path):
    reader = READERS[name]
    raw = reader.make(tmp_path)
    path = tmp_path / reader.file
    path.write_bytes(raw)
    reader.read(path)
    refused = 0
    for seed in range(reader.draws):
        path.write_bytes(reader.changed(raw, random.Random(f"{name}{seed}")))
        try:
            reader.read(path)
        except MjhabError as error:
            refused += 1
            assert str(error) and "\n" not in str(error)
        except Exception as error:
            raise AssertionError(f"copy {seed} of {name}") from error
    assert refused


WORDS = ("success", "steps", "label", "not", "and", "or", "in", "(", ")", "[", "]", "<", "==", "'a'",
         "9" * 5000, "-", "+", "1e999", ".", ",", "dropped", "events", "\0", "é", "*", ":=", "lambda")  # fmt: skip


@settings(max_examples=200, deadline=None)
@given(st.lists(st.sampled_from(WORDS), max_size=30))
def test_any_words_are_a_filter_or_refused(words: list[str]):
    try:
        Filter(" ".join(words))
    except UsageError as error:
        assert str(error).startswith(("filter, column", "characters of the filter"))


# -- folders that cannot be written, disks that are full ---------------------------------------------------------------


@pytest.fixture
def own_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that has not used its cache yet."""
    monkeypatch.setattr(cache, "_USABLE", set())
    monkeypatch.setenv(cache.CACHE_VARIABLE, "")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("HOME", "{file}"),
        ("HOME", "/proc"),
        ("MJHAB_CACHE", "{file}"),
        ("MJHAB_CACHE", "/proc/x"),
    ],
)
def test_a_cache_that_cannot_be_written_is_replaced_with_one_warning(
    variable: str,
    value: str,
    own_cache: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(variable, value.replace("{file}", str(tmp_path / "file")))
    folder = cache_dir()
    assert cache_dir() == folder and folder.is_dir()
    path = write_cached(folder / "models" / "a", lambda file: file.write_text("kept"))
    assert path.read_text() == "kept"
    assert capsys.readouterr().err.count("cannot be written") == 1


def test_a_user_without_a_home_has_a_temporary_cache_and_is_told_where_data_sets_go(
    own_cache: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def unknown(user: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {user}")

    monkeypatch.setenv("HOME", "")
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    for variable in ("MJHAB_ASSETS", "XDG_DATA_HOME"):
        monkeypatch.delenv(variable, raising=False)
    assert cache_dir() == cache_dir() and cache_dir().is_dir()
    assert capsys.readouterr().err.count("no home folder for the cache") == 1
    with refused(said=("no home folder;", "MJHAB_ASSETS")):
        cache.assets_dir()
    monkeypatch.setenv("MJHAB_ASSETS", "/data")
    assert cache.assets_dir() == Path("/data")


def test_a_cache_that_fills_up_goes_on_elsewhere(
    own_cache: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path / "small"))
    before = write_cached(
        cache_dir() / "models" / "a", lambda file: file.write_text("before")
    )

    def full(file: Path) -> None:
        if file.is_relative_to(tmp_path):
            raise OSError(errno.ENOSPC, "No space left on device", str(file))
        file.write_text("after")

    after = write_cached(cache_dir() / "models" / "b", full)
    assert not after.is_relative_to(tmp_path) and after.read_text() == "after"
    # What lay in the first cache is still found.
    assert (cache_dir() / "models" / "a").read_text() == "before" == before.read_text()


@pytest.mark.parametrize("kind", ["full", "closed", "ascii"])
def test_stdout_that_is_full_closed_or_ascii(kind: str):
    command = [sys.executable, "-m", "mjhab.cli.main", "robots", "list"]
    redirect = {"full": ">/dev/full", "closed": ">&-", "ascii": ">/dev/null"}[kind]
    environment = {**os.environ, "LC_ALL": "POSIX", "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        ["/bin/bash", "-c", f'"$@" {redirect}', "bash", *command],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr
    assert done.returncode == (1 if kind == "full" else 0)


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (
            OSError(errno.ENOSPC, "No space left on device", "/a/b"),
            1,
            "/a/b cannot be used (No space",
        ),
        (
            PermissionError(errno.EACCES, "Permission denied", "/a/b"),
            2,
            "/a/b cannot be used (Perm",
        ),
        (MemoryError(), 1, "not enough memory"),
    ],
)
def test_what_the_system_refuses_is_told_in_one_line(
    error: Exception,
    code: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    def fail() -> Any:
        raise error

    monkeypatch.setattr("mjhab.cli.worlds.robots.robot_rows", fail)
    assert main(["robots", "list"]) == code
    message = capsys.readouterr().err
    assert said in message and message.count("\n") == 1
