"""Towns drawn at random: what they have in common, and that no two are alike."""

from pathlib import Path

import numpy as np
import pytest

from ssad.core.errors import ConfigError, UnknownNameError
from ssad.recorders.nuscenes import Recording
from ssad.world.roads import is_town, load_town, town_names, town_xodr
from ssad.world.roads.random_towns import random_town, write_random_town


@pytest.mark.parametrize("number", range(6))
def test_a_random_town_can_be_driven(number: int) -> None:
    town = random_town(number)
    assert town == random_town(number)
    name = f"Random{number}"
    graph = load_town(name)
    assert town_xodr(name) == write_random_town(name)
    assert graph.name == name
    assert len(graph.kind) > 40
    places = np.concatenate([np.array(street.points) for street in town.streets])
    assert np.ptp(places, axis=0).min() > 100.0
    widths = {street.width for street in town.streets}
    assert len(widths) == 1
    assert 3.1 <= widths.pop() <= 3.75


def test_no_two_are_alike() -> None:
    assert len({write_random_town(f"Random{n}").partition("<road")[2] for n in range(12)}) == 12


def test_names() -> None:
    assert is_town("Random7")
    assert is_town("Twinford")
    assert "Random7" not in town_names()
    for name in ("Random", "Random07", "random7", "Random-1", "Random7.5"):
        assert not is_town(name)
        with pytest.raises(UnknownNameError):
            load_town(name)
    with pytest.raises(ConfigError, match="unknown town"):
        Recording(Path("out"), towns=("Random07",))
