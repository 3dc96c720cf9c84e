"""Reference of `realism` and library of `cat`, made from the same drives: `python -m benchmarks.traffic_reference`.

Drives the set `natural-unselected` with the Autopilot and another draw of traffic than any search has, and writes the
motions of its motor vehicles: their features of their motions (`ssad.metrics.realism`), and pieces of 8 s
(`ssad.scenarios.dynamic.transition.cat`). `--scenarios` takes another set or file and `--folder` another place, such as
for traffic of your own. About a minute on one core.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.seeding import generator
from ssad.core.types import AgentKind, Controller, EpisodeTrace
from ssad.experiments.adversarial.search_scores import motions, moving_vehicles
from ssad.metrics.realism import REFERENCE, realism, reference_data, traffic_reference, within_published
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.scenarios.dynamic.transition.cat import MOTIONS, library_data, motion_windows
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import VERSION, World

SEED = 1_000_003  # of the traffic: searches have others
BATCH = 50  # episodes side by side
MAX_MOTIONS = 3000  # of the library


def motor_vehicles(trace: EpisodeTrace) -> list[int]:
    """Return the motor vehicles but the ego that travel 5 m or more."""
    agents = [agent for agent in range(1, len(trace.kind)) if trace.kind[agent] <= AgentKind.MOTORCYCLE]
    return moving_vehicles(trace, agents)


def make(scenarios: str = "natural-unselected", folder: Path | None = None) -> list[str]:
    """Write both files.

    Args:
        scenarios: Set or file of scenarios with traffic.
        folder: Folder for both; None: where SSAD reads them.

    Returns:
        Lines about what was written.

    Raises:
        ConfigError: There is no vehicle that moves.
    """
    chosen = load_scenarios(scenarios)
    graphs = {town: load_town(town) for town in sorted({scenario.town for scenario in chosen})}
    features, windows, speeds, within = [], [], [], []
    for start in range(0, len(chosen), BATCH):
        episodes = [build_episode(s, graphs[s.town], seed=SEED) for s in chosen[start : start + BATCH]]
        world = World(episodes, graphs, ego=Controller.AUTOPILOT)
        for episode, trace in zip(episodes, rollout(world, {}), strict=True):
            agents = motor_vehicles(trace)
            features += motions(trace, graphs[episode.town], agents)
            within += [within_published(trace, agent) for agent in agents]
            poses, first_speeds = motion_windows(trace, agents)
            windows.append(poses)
            speeds.append(first_speeds)
    if not features:
        raise ConfigError(f"{scenarios}: no vehicle moves in these scenarios; give some with traffic")
    poses, first_speeds = np.concatenate(windows), np.concatenate(speeds)
    # a fixed choice among them, whatever the order of the scenarios
    selected = np.sort(generator("motions").permutation(len(poses))[:MAX_MOTIONS])
    reference_file, library_file = (file if folder is None else folder / file.name for file in (REFERENCE, MOTIONS))
    about = {"scenarios": scenarios, "episodes": len(chosen), "world": VERSION}
    safeio.write_atomic(reference_file, safeio.dump_json(reference_data(features, **about)) + "\n")
    safeio.save_npz(library_file, library_data(poses[selected], first_speeds[selected]))
    score = float(np.mean([realism(motion, traffic_reference(reference_file)) for motion in features]))
    share = float(np.concatenate(within).mean())
    return [
        f"{reference_file}: {len(features)} motions in {len(chosen)} episodes; their own realism {score:.3f}, within"
        f" published human driving {share:.4f} of the time",
        f"{library_file}: {len(selected)} of {len(poses)} motions of 8 s",
    ]


def main() -> None:
    """Drive and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenarios", default="natural-unselected", help="set or file")
    parser.add_argument("--folder", type=Path, help="folder to write to")
    given = parser.parse_args()
    print("\n".join(make(given.scenarios, given.folder)))


if __name__ == "__main__":
    main()
