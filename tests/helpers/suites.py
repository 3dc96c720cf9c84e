"""Plans without a world behind them."""

from __future__ import annotations

from collections.abc import Sequence

from ssad.bench.cells import make_cells
from ssad.bench.run import Plan
from ssad.bench.suite import Suite
from ssad.core.types import Pose, Scenario


def fake_scenario(name: str) -> Scenario:
    return Scenario(name=name, type="StraightObstacle", town="Nowhere", route=(Pose(0, 0), Pose(9, 0)))


def fake_plan(
    names: Sequence[str],
    *,
    systems: Sequence[str] = ("autopilot",),
    chunk: int = 4,
    timeout_s: float = 60.0,
    seed: int = 0,
    repetitions: int = 1,
) -> Plan:
    suite = Suite(
        name="fake",
        systems=list(systems),
        scenarios=list(names),
        chunk=chunk,
        timeout_s=timeout_s,
        seed=seed,
        repetitions=repetitions,
    )
    versions = dict.fromkeys(systems, "")
    scenarios = [fake_scenario(name) for name in names]
    cells = make_cells(suite, scenarios, systems=versions, towns={"Nowhere": "0"})
    return Plan(suite, cells, "cpu", {}, versions)
