"""Images of a camera in drives of other towns, for attacks that are fitted before the drive."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
import torch

from ssad.core.frames import Camera
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import EpisodeTrace
from ssad.rendering.onboard import Onboard
from ssad.scenarios.static.digital.budget import LEVELS

OTHERS: Final = "training"  # scenarios of no set that perceiving drivers are tested in, nor of their towns
DRIVES: Final = 4


@lru_cache(maxsize=1)
def _drives() -> list[tuple[EpisodeTrace, LaneGraph]]:
    """Return traces of the Autopilot in drives of other towns, with their towns."""
    from ssad.drivers import make_system
    from ssad.scenarios.dynamic import build_episode, load_scenarios
    from ssad.simulators.closed_loop import cached_town
    from ssad.world.rollout import rollout
    from ssad.world.world import World

    natural_scenarios = [
        scenario_candidate
        for scenario_candidate in load_scenarios(OTHERS)
        if scenario_candidate.type == "NaturalJunction"
    ]
    selected = natural_scenarios[:: len(natural_scenarios) // DRIVES][:DRIVES]
    traces = []
    for scenario in selected:
        graph = cached_town(scenario.town)
        world = World([build_episode(scenario, graph, seed=0)], {graph.name: graph})
        traces += [(trace, graph) for trace in rollout(world, make_system("autopilot"))]
    return traces


def images_of_other_drives(camera: Camera, count: int, device: str) -> torch.Tensor:
    """Return images [count, 3, H, W] in [0, 1], spread evenly over some drives."""
    onboard_camera = Onboard(device=device).camera(camera)
    image_parts = []
    for index, (trace, graph) in enumerate(_drives()):
        drive_count = count * (index + 1) // DRIVES - count * index // DRIVES
        steps = np.linspace(0, len(trace.x) - 1, drive_count + 2).round().astype(int).tolist()[1:-1]
        image_parts.append(onboard_camera.of_trace(trace, graph, steps=steps))
    image_device = torch.device("cuda" if device != "cpu" else "cpu")
    return torch.from_numpy(np.concatenate(image_parts)).to(image_device).float() / LEVELS
