"""Ranges of options that commands print for later use."""

from mjhab.config.ranges import whole_number


def test_the_largest_seed_that_a_check_draws_is_in_its_range() -> None:
    assert whole_number("check_seed", 2**32 - 1) == 2**32 - 1
