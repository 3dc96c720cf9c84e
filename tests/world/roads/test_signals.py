"""Crossing approaches are never green together: in the towns that ship, in CARLA's, and where a map says otherwise."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from ssad.core.types import SignalState
from ssad.world.episode_arrays import signal_programs
from ssad.world.roads import LaneGraph, bake
from ssad.world.roads.designs import generate_town
from tests.world.roads.towns import BUILT_IN, IMPORTED, built_in, imported

GO = (int(SignalState.GREEN), int(SignalState.YELLOW))


def crossing_pairs(graph: LaneGraph) -> list[tuple[int, int]]:
    """Real signals of one junction whose traffic comes neither from opposite sides nor from the same one."""
    real = np.flatnonzero(~graph.signal_virtual).tolist()
    pairs = []
    for a in real:
        for b in real:
            if a < b and graph.signal_junction[a] == graph.signal_junction[b]:
                angle = float(np.cos(graph.signal_yaw[a] - graph.signal_yaw[b]))
                if abs(angle) < 0.7:
                    pairs.append((a, b))
    return pairs


def states(graph: LaneGraph) -> np.ndarray:
    """[T, S] every 0.5 s through the longest cycle, twice."""
    programs = signal_programs(graph)
    out = []
    for time in np.arange(0.0, 2.0 * programs[:, 0].max(initial=1.0), 0.5):
        t = (time - programs[:, 1]) % np.maximum(programs[:, 0], 1.0)
        green, yellow = t < programs[:, 2], t < programs[:, 2] + programs[:, 3]
        state = np.where(green, SignalState.GREEN, np.where(yellow, SignalState.YELLOW, SignalState.RED))
        out.append(np.where(programs[:, 0] > 0.0, state, SignalState.OFF))
    return np.array(out)


def check(graph: LaneGraph) -> None:
    pairs = crossing_pairs(graph)
    assert pairs or graph.signal_virtual.all()  # a map without lights has no programme
    go = np.isin(states(graph), GO)
    assert go.any(axis=0)[~graph.signal_virtual].all()
    for a, b in pairs:
        assert not (go[:, a] & go[:, b]).any(), (graph.name, a, b)


@pytest.mark.parametrize("name", BUILT_IN)
def test_no_green_to_crossing_approaches(name: str) -> None:
    check(built_in(name))


@pytest.mark.parametrize("name", IMPORTED)
def test_no_green_to_crossing_approaches_in_carla_towns(carla_home: Path, name: str) -> None:
    check(imported(carla_home, name))


def test_a_map_that_shows_green_to_all_is_put_right(tmp_path: Path) -> None:
    """Controllers of a junction that share lights of crossing arms are not followed."""
    text = generate_town("Twinford")
    path = tmp_path / "Twinford.xodr"
    groups = re.findall(r"<controller name=.*?</controller>", text, flags=re.DOTALL)
    assert len(groups) >= 2
    first, second = groups[:2]
    light = re.findall(r"<control signalId=.*?/>", first)[0]
    # one light of the first phase is moved to the second, which crosses it
    text = text.replace(first, first.replace(light, "", 1))
    text = text.replace(second, second.replace("</controller>", light + "</controller>"))
    path.write_text(text, encoding="utf-8")
    check(bake(path, "Twinford"))
