"""Perceiving systems in the closed loop: driven with perturbed cameras, and observed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.seeding import digest
from ssad.core.types import Episode, EpisodeTrace
from ssad.drivers.perceiving.recorder import PerceptionRecorder
from ssad.drivers.perceiving.repair import RepairedAgents
from ssad.drivers.perceiving.sensors import sensor_suite
from ssad.drivers.perceiving.system import PerceivingSystem
from ssad.experiments.gap.other_drives import images_of_other_drives
from ssad.metrics import episode_metrics
from ssad.scenarios.static.catalogue import parse_perturbation
from ssad.scenarios.static.perturbation import Perturbation
from ssad.simulators.closed_loop import EpisodeRequest, drive


def drive_perceiving(
    requests: Sequence[EpisodeRequest],
    *,
    device: str,
    seed: int,
    repair: RepairedAgents | None = None,
    image_interval: float | None = 0.5,
) -> tuple[list[Episode], list[EpisodeTrace], PerceptionRecorder | None]:
    """Return episodes and traces of requests of one system under one perturbation, and what was perceived in them.

    Args:
        requests: What is to be driven; their specs say settings (of a `PerceivingSystem`; None: another driver),
            perturbation, severity, and the agent that it is on.
        device: Where the world and the cameras compute.
        seed: Of the perturbations.
        repair: What mends one error of the driver.
        image_interval: s from one picture that is kept to the next; None: none are kept.
    """
    spec = requests[0].spec
    if spec["settings"] is None:
        return *drive(requests, device=device, key=_pairing_key)[:2], None
    system = PerceivingSystem.model_validate(spec["settings"])
    recorder = PerceptionRecorder(system.view_cameras, len(requests), image_interval)
    driver = system.make(recorder, repair=repair, device=device)
    perturbation = perturbation_of(spec)
    if perturbation is not None and perturbation.needs_victim and driver.detector is None:
        raise ConfigError(
            f"system {system.name}: {perturbation.name} needs a victim, but its perceiver has no attribute detector; "
            "give it one (ssad.core.protocols.Detector), or leave attacks out"
        )
    suite = sensor_suite(
        driver.perceiver,
        device=device,
        other_images=lambda camera, count: images_of_other_drives(camera, count, device),
    )
    # A lane keeper has a camera besides those of its perceiver.
    suite = replace(suite, cameras={**suite.cameras, **driver.cameras})
    if perturbation is not None:
        suite = perturbation.in_loop(suite, target=spec["target"], victim=driver.detector, seed=seed)
    drive_results = drive(
        requests, device=device, key=_pairing_key, driver=driver, sensors=suite.build(), perturbation=suite.changes
    )
    return *drive_results[:2], recorder


def perturbation_of(spec: Mapping[str, Any]) -> Perturbation | None:
    """Return the perturbation of a cell, from its plain data; None for a clean one."""
    if spec["perturbation"] is None:
        return None
    return parse_perturbation(spec["perturbation"]).make(spec["severity"])


def drive_repaired(
    requests: Sequence[EpisodeRequest], traces: Sequence[EpisodeTrace], *, device: str, seed: int
) -> dict[int, dict[str, Any]]:
    """Drives that ended in a collision driven again with whom they hit found where it is: does that one error decide?

    Args:
        requests: What was driven.
        traces: What happened.
        device: See `drive_perceiving`.
        seed: See `drive_perceiving`.

    Returns:
        By the drive's number: whether there is a collision now, and whether with the same agent.
    """
    contacts = {index: np.flatnonzero(trace.contact_agent > 0) for index, trace in enumerate(traces)}
    struck_agents = {
        index: int(traces[index].contact_agent[steps[0]]) for index, steps in contacts.items() if len(steps)
    }
    if not struck_agents:
        return {}
    repair = RepairedAgents(dict(enumerate(struck_agents.values())))
    _, repaired_traces, _ = drive_perceiving(
        [requests[index] for index in struck_agents], device=device, seed=seed, repair=repair, image_interval=None
    )
    return {
        index: {
            "collision": bool(episode_metrics(repaired_trace, stop_signs=False).collision),
            "same": bool((repaired_trace.contact_agent == agent).any()),
        }
        for (index, agent), repaired_trace in zip(struck_agents.items(), repaired_traces, strict=True)
    }


def _pairing_key(request: EpisodeRequest) -> str:
    """Pictures are keyed by the episode: conditions of one drive must share their noise and weather."""
    return digest("gap", request.spec["scenario"]["name"], request.seed)[:16]
