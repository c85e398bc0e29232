"""Names from files: what is one, and that no path made of one leaves its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjhab.core.names import MAX_NAME_CHARACTERS, below, check_name
from tests.refusals import refused

GOOD = (
    "v3_sc0_staging_00",
    "builtin_m0_00",
    "003_cracker_box_:0000",
    "frl_apartment_remote-control_01",
    "kitchen_counter/drawer1_bottom",
    "receptacle_aabb_sofa_frl_apartment_sofa",
    "frl_apartment_table_01_:0000|receptacle".partition("|")[0],
    "a" * MAX_NAME_CHARACTERS,
)
HOSTILE: tuple[Any, ...] = (
    "",
    "..",
    ".",
    "../../x",
    "/abs/path",
    "a/../b",
    "a//b",
    "a/",
    "a/.hidden",
    ".hidden",
    "a\\b",
    "a b",
    "a\nb",
    "a\0b",
    "a" * (MAX_NAME_CHARACTERS + 1),
    "ä",
    "‮txt",
    "$HOME",
    "~/x",
    "a;b",
    "<script>",
    "a..b",
    None,
    3,
    ["a"],
)


@pytest.mark.parametrize("name", GOOD)
def test_names_of_the_data_sets_pass(name: str, tmp_path: Path) -> None:
    assert check_name("name", name) == name
    assert below(tmp_path, f"{name}.h5") == tmp_path / f"{name}.h5"


@pytest.mark.parametrize("name", HOSTILE, ids=repr)
def test_hostile_names_are_refused(name: Any) -> None:
    with refused("field 'task'"):
        check_name("field 'task'", name)


def test_a_long_name_is_not_repeated_whole() -> None:
    with pytest.raises(ValueError) as caught:
        check_name("name", "x" * 1_000_000)
    assert len(str(caught.value)) < 300


@given(st.text(st.sampled_from("ab./:-_ \\\0é"), max_size=12))
def test_what_passes_stays_below_every_folder(text: str) -> None:
    try:
        name = check_name("name", text)
    except ValueError:
        return
    root = Path("/root/of/all")
    assert below(root, name).is_relative_to(root) and ".." not in below(root, name).parts


@pytest.mark.parametrize("part", ["../x", "/abs", "a/../../x", "..", ".", ""])
def test_no_path_leaves_its_folder(part: str, tmp_path: Path) -> None:
    with refused(said="would be written outside of"):
        below(tmp_path, part)
