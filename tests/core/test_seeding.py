"""Keys to random numbers: the same for ever, and another for every other key."""

from __future__ import annotations

import pytest

from ssad.core.seeding import digest, generator, seed32


def test_a_key_means_the_same_for_ever() -> None:
    """Recorded results depend on these numbers: they hold on every machine and in every version."""
    assert digest("a", 1, 2.5) == "9ab4229f59e7bd9c43ff09b7fb204548395a64d20e34ea826cf1cfec5b6f35d2"
    assert seed32("a", 1) == 1418535778
    assert generator("a", 1).integers(0, 1000, 4).tolist() == [701, 614, 550, 746]


@pytest.mark.parametrize(
    "other", [("a", "1"), ("a", 1.0), ("a", True), ("a", 2), ("a",), ("a1",), (1, "a"), ("a", 1, "")]
)
def test_keys_differ_by_value_type_and_place(other: tuple[object, ...]) -> None:
    assert digest(*other) != digest("a", 1)
    assert seed32(*other) != seed32("a", 1)
    assert generator(*other).integers(1 << 62) != generator("a", 1).integers(1 << 62)


def test_seeds_fill_31_bits() -> None:
    seeds = [seed32("fill", k) for k in range(2000)]
    assert 0 <= min(seeds) < 1 << 22
    assert (1 << 31) - (1 << 22) < max(seeds) < 1 << 31
    assert len(set(seeds)) > 1990


def test_generators_do_not_share_their_state() -> None:
    one, same = generator("k"), generator("k")
    one.random(100)
    assert same.random() == generator("k").random()
