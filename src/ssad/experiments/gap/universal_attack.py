"""The universal attack in the loop: one change for all pictures of a camera, found before the drive in other drives."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
import torch

from ssad.core.checkpoints import state_hash
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.lane_graph import LaneGraph
from ssad.core.protocols import Detector
from ssad.core.types import EpisodeTrace
from ssad.rendering.onboard import Onboard
from ssad.scenarios.static.digital.budget import LEVELS, Budget
from ssad.scenarios.static.digital.live import own_truth
from ssad.scenarios.static.digital.objectives import make_objective
from ssad.scenarios.static.digital.universal import Universal, UniversalFit
from ssad.scenarios.static.digital.victim import NothingToAttackError, Victim, steady

OTHERS: Final = "training"  # drives of no set that perceiving drivers are tested in, nor of their towns
DRIVES: Final = 4
LOSS: Final = "margin"  # as `LiveAttack`
_FOUND: dict[tuple[object, ...], Universal] = {}


def universal(
    fit: UniversalFit, detector: Detector, camera: Camera, budget: Budget, *, device: str, batch: int
) -> Universal:
    """Return the attack that adds the change fitted for a detector and a camera; fitted once per process.

    The detections in the clean images serve as the truth, as in `LiveAttack`.

    Args:
        fit: Settings of the fit.
        detector: The attacked detector.
        camera: The camera.
        budget: Maximum change of each image.
        device: Device of renderer and detector.
        batch: Images at once; it changes no result.

    Raises:
        ConfigError: The detector finds nothing in any of the images.
    """
    detector_key = state_hash(detector) or id(detector)
    cache_key = (fit, detector_key, camera.channel, camera.width, camera.intrinsic.tobytes(), budget, device)
    if cache_key not in _FOUND:
        clean_images = pictures_of_other_drives(camera, fit.frames, device)
        intrinsic = (
            torch.from_numpy(camera.intrinsic).float().to(clean_images.device) if detector.task == "3d" else None
        )
        victims = []
        with steady(detector):
            for image_batch in torch.split(clean_images, batch):
                intrinsic_batch = None if intrinsic is None else intrinsic.expand(len(image_batch), 3, 3).contiguous()
                truth = own_truth(detector, image_batch, intrinsic_batch)
                if not any(len(image_truth.label) for image_truth in truth):
                    continue
                try:
                    victims.append(
                        Victim(detector, image_batch, truth, make_objective(LOSS), intrinsic=intrinsic_batch)
                    )
                except NothingToAttackError:
                    continue
        if not victims:
            raise ConfigError(f"attack universal: {detector.name} finds nothing in pictures of other drives")
        _FOUND[cache_key] = fit.fit(victims, budget)
    return _FOUND[cache_key]


@lru_cache(maxsize=1)
def _drives() -> list[tuple[EpisodeTrace, LaneGraph]]:
    """Return traces of the Autopilot in drives of other towns, with their towns."""
    from ssad.drivers import make_system
    from ssad.scenarios.dynamic import build_episode, load_scenarios
    from ssad.simulators.closed_loop import town
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
        graph = town(scenario.town)
        world = World([build_episode(scenario, graph, seed=0)], {graph.name: graph})
        traces += [(trace, graph) for trace in rollout(world, make_system("autopilot"))]
    return traces


def pictures_of_other_drives(camera: Camera, count: int, device: str) -> torch.Tensor:
    """Return images [count, 3, H, W] in [0, 1], spread evenly over some drives."""
    onboard_camera = Onboard(device=device).camera(camera)
    image_parts = []
    for index, (trace, graph) in enumerate(_drives()):
        drive_count = count * (index + 1) // DRIVES - count * index // DRIVES
        steps = np.linspace(0, len(trace.x) - 1, drive_count + 2).round().astype(int).tolist()[1:-1]
        image_parts.append(onboard_camera.of_trace(trace, graph, steps=steps))
    image_device = torch.device("cuda" if device != "cpu" else "cpu")
    return torch.from_numpy(np.concatenate(image_parts)).to(image_device).float() / LEVELS
