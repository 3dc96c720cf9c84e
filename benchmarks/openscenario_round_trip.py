"""Round trip of scenarios through OpenSCENARIO: scripted actors with every feature drive as before.

    python -m benchmarks.openscenario_round_trip --page

Scenarios are drawn on the proving ground: speeds with each dynamics, changes of lane, meetings, bodies, friction, and
triggers of each kind with edges, delays, `all` and `any`. Each is exported, read again, and driven beside the
original. Where the checker of ASAM (`qc_openscenario`) is on the path, it reads each file. `--page` writes the part on
round trips of docs/results/openscenario-imports.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.insert import insert, store_commit
from ssad.core.seeding import generator
from ssad.core.types import (
    Actor,
    Arrival,
    Body,
    EpisodeLimits,
    LateralPhase,
    Phase,
    PhaseTrigger,
    Pose,
    Scenario,
)
from ssad.drivers import make_system
from ssad.interchange.export import export_openscenario
from ssad.interchange.openscenario_reader import read_openscenario
from ssad.scenarios.dynamic import build_episode
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

PAGE = "results/openscenario-imports.md"
COUNT = 30
TOWN = "ProvingGround"
CLOSE = 0.01  # m
Y = -5.25  # m of the middle of the ego's lane
ROAD = (Pose(217.0, Y), Pose(417.0, Y))
Triggers = list[PhaseTrigger]


def triggers(other: str) -> Triggers:
    """Return a trigger of each kind; those on another agent refer to one by name."""
    return [
        PhaseTrigger("time", 1.5),
        PhaseTrigger("time", 1.0, delay=0.7),
        PhaseTrigger("ego_distance", 60.0, 0),
        PhaseTrigger("ego_speed", 4.0),
        PhaseTrigger("travelled", 8.0),
        PhaseTrigger("travelled", 12.0, agent="ego"),
        PhaseTrigger("speed", 5.0, agent="ego", edge="rising"),
        PhaseTrigger("speed", 5.5, rule="below"),
        PhaseTrigger("relative_speed", -1.0, rule="below"),
        PhaseTrigger("acceleration", 0.2, agent="ego", edge="falling", delay=0.3),
        PhaseTrigger("standstill", 0.5),
        PhaseTrigger("distance", 55.0, agent="ego", reference=other, free_space=True, measure="road"),
        PhaseTrigger("distance", 3.0, rule="above", measure="lateral"),
        PhaseTrigger("distance", 40.0, agent="ego", position=(290.0, Y), free_space=True),
        PhaseTrigger("position", 15.0, agent="ego", position=(260.0, Y)),
        PhaseTrigger("time_to_collision", 12.0, agent="ego", reference=other, measure="road"),
        PhaseTrigger("time_headway", 8.0, agent="ego", reference=other, free_space=True),
        PhaseTrigger(all=(PhaseTrigger("time", 2.0), PhaseTrigger("ego_speed", 3.0))),
        PhaseTrigger(any=(PhaseTrigger("time", 6.0), PhaseTrigger("travelled", 9.0))),
        PhaseTrigger("time", 1.0, any=(PhaseTrigger("ego_speed", 6.0), PhaseTrigger("travelled", 20.0))),
    ]


def speeds() -> list[Phase]:
    """Return a change of speed with each dynamics."""
    return [
        Phase(3.0),
        Phase(2.0, acceleration=2.0),
        Phase(11.0, acceleration=1.5, jerk=1.0),
        Phase(9.0, shape="sinusoidal", duration=3.0),
        Phase(4.0, shape="cubic", acceleration=2.5),
        Phase(8.0, shape="linear", distance=25.0),
        Phase(6.0, shape="step"),
        Phase(1.5, reference="ego"),
        Phase(0.8, reference="ego", factor=True, shape="sinusoidal", duration=2.0),
        Phase(-1.0, reference="ego", continuous=True),
        Phase(7.0, arrival=Arrival((330.0, 0.0), (310.0, Y))),
    ]


def lanes() -> list[LateralPhase]:
    """Return a change of lane with each dynamics."""
    return [
        LateralPhase(1, shape="sinusoidal", duration=3.0),
        LateralPhase(-1, shape="cubic", distance=30.0),
        LateralPhase(0, offset=0.6, shape="linear", rate=0.5),
        LateralPhase(1, offset=-0.3, shape="sinusoidal", rate=1.2),
    ]


def scenario(number: int) -> Scenario:
    """Return the scenario with a number; each feature occurs in some of `COUNT`."""
    random = generator("openscenario", "round trip", number)

    def pick(options: list, index: int):  # type: ignore[no-untyped-def,type-arg]
        return options[(number + index) % len(options)]

    y = -1.75
    first = dataclasses.replace(pick(speeds(), 0), name="first", when=pick(triggers("target"), 0))
    second = dataclasses.replace(pick(speeds(), 3), name="second", when=pick(triggers("target"), 7))
    third = dataclasses.replace(
        pick(speeds()[:7], 1),
        name="third",
        when=pick(
            [
                PhaseTrigger("after", 1.5),
                # A phase that follows another agent never ends.
                PhaseTrigger(
                    "phase_start" if second.continuous else "phase_end", agent="target", phase="second", delay=0.4
                ),
                PhaseTrigger("phase_start", agent="target", phase="first"),
            ],
            0,
        ),
    )
    phases = [first, dataclasses.replace(second, anytime=number % 2 == 0), third]
    phases = [
        phase if phase.arrival is None else dataclasses.replace(phase, arrival=Arrival((330.0, y), (310.0, Y)))
        for phase in phases
    ]
    side = dataclasses.replace(pick(lanes(), 0), name="side", when=pick(triggers("target")[:8], 5))
    sides = (side,) if side.lanes != 1 or number % 3 else (dataclasses.replace(side, lanes=-1),)
    target = Actor(
        "target",
        pick(["car", "suv", "van", "compact"], 0),
        Pose(240.0 + 20.0 * float(random.random()), y, 0.0),
        phases=tuple(phases),
        lateral=sides if number % 3 == 0 else (),
        speed=pick([0.0, 5.0, 8.0], 0),
        body=Body(length=4.2, width=1.8, max_brake=9.0) if number % 4 == 0 else Body(),
    )
    walker_phase = Phase(
        1.4, when=pick(triggers("target")[:5], 2), name="walk", shape="step" if number % 2 else "linear"
    )
    walker = Actor("walker", "walker", Pose(300.0, 6.0, -np.pi / 2), phases=(walker_phase,))
    return Scenario(
        f"trip/{number:02d}",
        "Custom",
        TOWN,
        ROAD,
        actors=(target, walker),
        limits=EpisodeLimits(max_steps=150, contact="count"),
        parameters={"ego_speed": float(pick([0.0, 5.0, 10.0], 1))},
        friction=pick([0.9, 0.5], 0),
    )


def farthest(before: Scenario, after: Scenario) -> float:
    """Return the greatest distance between the agents of two scenarios while they are driven, m."""
    graph = load_town(TOWN)
    drive: Callable[[Scenario], object] = lambda item: rollout(  # noqa: E731
        World([build_episode(item, graph, seed=0)], {TOWN: graph}), make_system("blind")
    )[0]
    first, second = drive(before), drive(after)
    if first.x.shape != second.x.shape:  # type: ignore[attr-defined]
        return float("inf")
    return float(np.hypot(first.x - second.x, first.y - second.y).max())  # type: ignore[attr-defined]


def findings(path: Path, folder: Path) -> int | None:
    """Return the number of issues that ASAM's checker finds in a file; None without the checker."""
    program = shutil.which("qc_openscenario")
    if program is None:
        return None
    (folder / "config.xml").write_text(
        f'<Config><Param name="InputFile" value="{path}"/><CheckerBundle application="xoscBundle">'
        f'<Param name="resultFile" value="{folder}/result.xqar"/></CheckerBundle></Config>'
    )
    subprocess.run([program, "-c", folder / "config.xml"], cwd=folder, check=True, capture_output=True)
    return len(re.findall("<Issue ", (folder / "result.xqar").read_text()))


def main() -> None:
    """Send all scenarios on the round trip, print, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", action="store_true", help=f"write docs/{PAGE}")
    arguments = parser.parse_args()
    distances: list[float] = []
    issues: list[int | None] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number in range(COUNT):
            before = scenario(number)
            files, _ = export_openscenario([before], folder / str(number))
            path = next(path for path in files if path.suffix == ".xosc")
            distances.append(farthest(before, read_openscenario(path).scenario))
            issues.append(findings(path, folder))
            print(f"{before.name}: {distances[-1]:.6f} m, issues {issues[-1]}")
    checked = [count for count in issues if count is not None]
    findings_text = f"{sum(checked)} in {len(checked)} files" if checked else "not checked"
    lines = [
        "| scenarios | within 1 cm | farthest, m | issues that ASAM's checker finds |",
        "|---:|---:|---:|---:|",
        f"| {COUNT} | {sum(distance < CLOSE for distance in distances)} | {max(distances):.4f} | {findings_text} |",
    ]
    print("\n".join(lines))
    if arguments.page:
        insert(PAGE, "trips", ["", *lines, ""])
        store_commit(PAGE)


if __name__ == "__main__":
    main()
