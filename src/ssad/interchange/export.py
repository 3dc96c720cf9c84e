"""Folders of scenarios for other programs: one file per scenario, and the maps of their towns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from ssad.core.driving import step_options, steps_per_trace_step, with_finer_steps
from ssad.core.errors import ConfigError, SSADError
from ssad.core.lane_graph import LaneGraph
from ssad.core.safeio import make_folder, write_atomic
from ssad.core.traces import merge_steps
from ssad.core.types import Episode, Scenario
from ssad.interchange.commonroad_writer import STILL, commonroad_text
from ssad.interchange.openscenario_writer import openscenario_text
from ssad.scenarios.dynamic import build_episode
from ssad.scenarios.dynamic.frozen import freeze_episode
from ssad.world.roads import load_town, town_signals, town_xodr

ExportedFiles = tuple[list[Path], list[str]]
"""The files, and what they do not carry over, a line for each scenario that it is true of."""


def export_openscenario(scenarios: Sequence[Scenario], out: Path, *, seed: int = 0) -> ExportedFiles:
    """Write scenarios as OpenSCENARIO XML 1.2 with OpenDRIVE.

    Args:
        scenarios: The scenarios.
        out: Output folder.
        seed: Seed of the episodes.

    Returns:
        The files, and what they do not carry over.

    Raises:
        SSADError: A scenario cannot be built, its town has no OpenDRIVE, or a file cannot be written.
    """
    files: list[Path] = []
    lines: list[str] = []
    folder = make_folder(out)
    names = file_names(scenarios)
    for town in sorted({scenario.town for scenario in scenarios}):
        files.append(folder / f"{Path(town).stem}.xodr")
        write_atomic(files[-1], town_xodr(town))
    for scenario, name in zip(scenarios, names, strict=True):
        town = scenario.town
        text, omissions = openscenario_text(
            episode(scenario, seed), load_town(town), network=f"{Path(town).stem}.xodr", signals=town_signals(town)
        )
        files.append(folder / f"{name}.xosc")
        write_atomic(files[-1], text)
        lines += omissions
    return files, lines


def export_commonroad(
    scenarios: Sequence[Scenario], out: Path, *, seed: int = 0, system: str = "autopilot"
) -> ExportedFiles:
    """Write scenarios as CommonRoad XML 2020a, with the lanelets of their towns.

    The format has trajectories only: agents that react to the ego, or act at random, repeat what they did while
    a system drove the ego.

    Args:
        scenarios: The scenarios.
        out: Output folder.
        seed: Seed of the episodes.
        system: Name of that system.

    Returns:
        The files, and what they do not carry over.

    Raises:
        SSADError: A scenario cannot be built or driven, or a file cannot be written.
    """
    files: list[Path] = []
    lines: list[str] = []
    folder = make_folder(out)
    names = file_names(scenarios)
    numbers: Counter[str] = Counter()
    for scenario, name in zip(scenarios, names, strict=True):
        graph = load_town(scenario.town)
        replayed, was_replayed = _with_trajectories(episode(scenario, seed), graph, system)
        if was_replayed:
            lines.append(f"what others do by themselves: they repeat what they did beside '{system}'")
        numbers[scenario.town] += 1
        text, omissions = commonroad_text(replayed, graph, number=numbers[scenario.town])
        files.append(folder / f"{name}.xml")
        write_atomic(files[-1], text)
        lines += omissions
    return files, lines


def _with_trajectories(nominal: Episode, graph: LaneGraph, system: str) -> tuple[Episode, bool]:
    """Return an episode in which only the ego makes decisions, and whether it differs from the nominal one."""
    if all(agent.controller in STILL for agent in nominal.agents[1:]):
        return nominal, False
    from ssad.drivers import make_system
    from ssad.world.rollout import rollout
    from ssad.world.world import World

    driver = make_system(system)
    steps_in_one = steps_per_trace_step(driver)
    finer_episodes = with_finer_steps([nominal], steps_in_one)
    (fine_trace,) = rollout(World(finer_episodes, {nominal.town: graph}, **step_options(steps_in_one)), driver)
    trace = merge_steps(fine_trace, steps_in_one)
    return build_episode(freeze_episode(nominal, trace), graph, seed=nominal.seed), True


def episode(scenario: Scenario, seed: int) -> Episode:
    """Build the nominal episode of a scenario; errors name the scenario."""
    try:
        return build_episode(scenario, load_town(scenario.town), seed=seed)
    except SSADError as error:
        text = str(error)
        raise type(error)(text if scenario.name in text else f"scenario {scenario.name}: {text}") from None


def file_names(scenarios: Sequence[Scenario]) -> list[str]:
    """Return file names without folders. ConfigError if two scenarios would share one."""
    names = [scenario.name.replace("/", "-").replace(":", "-") for scenario in scenarios]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"two scenarios would be written to '{name}'; rename one, or name each only once")
    return names
