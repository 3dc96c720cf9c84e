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
    """The attack that adds the change that was found for a detector and a camera; found once a process.

    What the detector finds in the clean pictures is taken for the truth, as in `LiveAttack`.

    Args:
        fit: How it is found.
        detector: Who is attacked.
        camera: Whose pictures.
        budget: How far each picture may be moved.
        device: Where pictures are rendered and the detector is.
        batch: Pictures at once; it changes no result.

    Raises:
        ConfigError: The detector finds nothing in any of the pictures.
    """
    who = state_hash(detector) or id(detector)
    key = (fit, who, camera.channel, camera.width, camera.intrinsic.tobytes(), budget, device)
    if key not in _FOUND:
        pictures = pictures_of_other_drives(camera, fit.frames, device)
        lens = torch.from_numpy(camera.intrinsic).float().to(pictures.device) if detector.task == "3d" else None
        victims = []
        with steady(detector):
            for part in torch.split(pictures, batch):
                own = None if lens is None else lens.expand(len(part), 3, 3).contiguous()
                truth = own_truth(detector, part, own)
                if not any(len(one.label) for one in truth):
                    continue
                try:
                    victims.append(Victim(detector, part, truth, make_objective(LOSS), intrinsic=own))
                except NothingToAttackError:
                    continue
        if not victims:
            raise ConfigError(f"attack universal: {detector.name} finds nothing in pictures of other drives")
        _FOUND[key] = fit.fit(victims, budget)
    return _FOUND[key]


@lru_cache(maxsize=1)
def _drives() -> list[tuple[EpisodeTrace, LaneGraph]]:
    """Traces of the Autopilot in drives of other towns, with their towns."""
    from ssad.drivers import make_system
    from ssad.scenarios.dynamic import build_episode, load_scenarios
    from ssad.simulators.closed_loop import town
    from ssad.world.rollout import rollout
    from ssad.world.world import World

    natural = [one for one in load_scenarios(OTHERS) if one.type == "NaturalJunction"]
    chosen = natural[:: len(natural) // DRIVES][:DRIVES]
    found = []
    for scenario in chosen:
        graph = town(scenario.town)
        world = World([build_episode(scenario, graph, seed=0)], {graph.name: graph})
        found += [(trace, graph) for trace in rollout(world, make_system("autopilot"))]
    return found


def pictures_of_other_drives(camera: Camera, count: int, device: str) -> torch.Tensor:
    """Pictures [count, 3, H, W] in [0, 1], spread evenly over some drives."""
    onboard = Onboard(device=device).camera(camera)
    shown = []
    for k, (trace, graph) in enumerate(_drives()):
        share = count * (k + 1) // DRIVES - count * k // DRIVES
        steps = np.linspace(0, len(trace.x) - 1, share + 2).round().astype(int).tolist()[1:-1]
        shown.append(onboard.of_trace(trace, graph, steps=steps))
    where = torch.device("cuda" if device != "cpu" else "cpu")
    return torch.from_numpy(np.concatenate(shown)).to(where).float() / LEVELS
