"""Same seed, same bits: over 1,000 steps, for any number of processes, batch size and order."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from ssad.core.types import Controller
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.roads import load_town
from ssad.world.world import World
from tests.world.worlds import DEVICES

STEPS = 1000
COUNT = 8


@lru_cache
def _bank():
    scenarios = load_scenarios("natural")
    scenarios = scenarios[:: max(1, len(scenarios) // COUNT)][:COUNT]
    graphs = {s.town: load_town(s.town) for s in scenarios}
    return [build_episode(s, graphs[s.town], seed=7) for s in scenarios], graphs


def _hashes(assign: list[int], device: str = "cpu") -> dict[int, str]:
    """Episode -> hash after STEPS steps with episodes that start again when they end."""
    episodes, graphs = _bank()
    world = World(episodes, graphs, assign=assign, ego=Controller.AUTOPILOT, autoreset=True, device=device)
    for _ in range(STEPS):
        world.step()
    return dict(zip(assign, world.hashes(), strict=True))


@pytest.mark.parametrize("device", DEVICES)
def test_hashes_after_1000_steps_do_not_depend_on_batch_order_or_processes(device: str) -> None:
    batch = _hashes(list(range(COUNT)), device)
    assert len(set(batch.values())) == COUNT
    assert _hashes(list(range(COUNT))[::-1], device) == batch
    many = np.arange(64) % COUNT
    wide = World(*_bank(), assign=many, ego=Controller.AUTOPILOT, autoreset=True, device=device)
    for _ in range(STEPS):
        wide.step()
    assert wide.hashes() == [batch[k % COUNT] for k in range(64)]
    for k in (0, COUNT - 1):
        assert _hashes([k], device) == {k: batch[k]}


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 4])
def test_several_processes_give_the_bits_of_one(count: int) -> None:
    here = _hashes(list(range(COUNT)))
    root = str(Path(__file__).parents[2])
    code = (
        "import json, sys; sys.path.insert(0, sys.argv[1]); from tests.world.test_world_determinism import _hashes; "
        "print(json.dumps(_hashes(json.loads(sys.argv[2]))))"
    )
    shares = [json.dumps(list(range(COUNT))[k::count]) for k in range(count)]
    processes = [
        subprocess.Popen([sys.executable, "-c", code, root, share], stdout=subprocess.PIPE, text=True)
        for share in shares
    ]
    found: dict[int, str] = {}
    for process in processes:
        out, _ = process.communicate(timeout=500)
        assert process.returncode == 0
        found |= {int(k): v for k, v in json.loads(out.strip().splitlines()[-1]).items()}
    assert found == here
