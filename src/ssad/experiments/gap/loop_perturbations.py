"""Perturbations of cameras and scenes in suites of kind `gap`: faults, shifts, attacks, textures, lights."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import torch

from ssad.core.driving import Perturbation, Sensor
from ssad.core.errors import ConfigError, unknown_name
from ssad.core.frames import Camera
from ssad.core.lane_graph import LaneGraph, SignKind
from ssad.core.types import F32, F64, AgentKind, Episode
from ssad.experiments.gap.universal_attack import universal
from ssad.rendering.agent_edit import SIGN
from ssad.rendering.agent_edit import LiveAttack as PhysicalAttack
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.onboard import Onboard
from ssad.rendering.target import class_of_target, parse_target
from ssad.scenarios.static.digital import ATTACKS, make_attack, needs
from ssad.scenarios.static.digital.budget import Budget, px
from ssad.scenarios.static.digital.live import LiveAttack
from ssad.scenarios.static.digital.universal import UniversalFit
from ssad.scenarios.static.faults import FAULTS, CameraFault
from ssad.scenarios.static.physical import make_carrier
from ssad.scenarios.static.physical.lights.loop import FOUND, LIT, NIGHT, SHINE, light_version, shining
from ssad.scenarios.static.physical.textures.card import load_texture, shipped_textures
from ssad.scenarios.static.physical.textures.export import Print
from ssad.scenarios.static.shifts import ShiftSpec
from ssad.scenarios.static.shifts.loop import LOOP_SHIFTS, ShiftedCamera
from ssad.world.models import MODELS

NONE: Final = "none"
GREY: Final = "grey"
GREY_SIGN: Final = "grey-sign"
TEXTURE: Final = "texture"
LIGHT: Final = "light"
WEAR: Final = "wear-"
ATTACK: Final = "attack-"
TARGET: Final = "sedan"
BESIDE: Final = 12.0  # m from a way within which its signs stand
SHARES: Final = (1.0, 0.9, 0.8, 0.7, 0.6)  # sizes of a patch that are tried, of the one that was trained
RADII: Final = (1.0, 2.0, 4.0, 8.0, 16.0)  # code values that attacks may move a pixel by, by severity
AT_ONCE, AT_ONCE_GPU = 8, 24  # pictures that are attacked at once; other processes may share the GPU's memory
STEPPED: Final = ("pgd", "cw", "momentum", "apgd")  # attacks whose name may end in their steps a picture
STEPS: Final = 5  # where it does not; docs/gap.md: two steps of 16 code values change nothing on YOLOv5n


@lru_cache(maxsize=1)
def perturbation_names() -> Mapping[str, str]:
    """All perturbations -> their family: fault, shift, attack, texture or light; lights that were found have none."""
    attacks = [name for name in ATTACKS if not needs(name)]
    return MappingProxyType(
        {
            NONE: "none",
            **dict.fromkeys(FAULTS, "fault"),
            **dict.fromkeys(LOOP_SHIFTS, "shift"),
            **dict.fromkeys((f"{ATTACK}{name}" for name in attacks), "attack"),
            **dict.fromkeys((f"{WEAR}{name}" for name in (GREY, GREY_SIGN, *shipped_textures())), TEXTURE),
            **dict.fromkeys(LIT, LIGHT),
        }
    )


def family_of(name: str) -> str:
    """Return the family of a perturbation.

    Raises:
        UnknownNameError: Unknown perturbation.
        ConfigError: An attack cannot take so few steps.
        FormatError: The folder holds no exported light.
    """
    if name.startswith(FOUND):
        shining(name)
        return LIGHT
    names = perturbation_names()
    if name in names:
        return names[name]
    method, options = method_of(name)
    if f"{ATTACK}{method}" not in names or not name.startswith(ATTACK):
        raise unknown_name("perturbation", name, names)
    make_attack(method, **options)  # it may want more steps
    return names[f"{ATTACK}{method}"]


def method_of(name: str) -> tuple[str, dict[str, int]]:
    """An attack's name in `ATTACKS` and its options: attack-pgd, attack-pgd-2 (two gradient steps a picture)."""
    method = name.removeprefix(ATTACK)
    stem, _, steps = method.rpartition("-")
    if stem in STEPPED and re.fullmatch("[1-9][0-9]{0,2}", steps):
        return stem, {"steps": int(steps)}
    return method, {"steps": STEPS} if method in STEPPED else {}


def has_severities(name: str) -> bool:
    """Return True if a perturbation has severities 1 to 5."""
    return family_of(name) != TEXTURE and name not in (NIGHT, f"{SHINE}shadow") and not name.startswith(FOUND)


def is_worn(name: str) -> bool:
    """Return True if a perturbation is on a car or on signs, so that drives without one are left out."""
    return family_of(name) in (TEXTURE, LIGHT) and name != NIGHT


def wearer(name: str, episode: Episode, graph: LaneGraph) -> int | None:
    """Return the agent that has a texture or is lit: the first car besides the ego; None without one.

    Args:
        name: Name of the perturbation.
        episode: The episode.
        graph: Lane graph of its town.

    Returns:
        Number of the agent; 0 if stop signs have the texture.
    """
    if _made_for(name) == SIGN:
        route = episode.agents[0].route
        return 0 if route is not None and len(signs_of_route(graph, route.xy)) else None
    cars = (
        agent_index
        for agent_index, agent in enumerate(episode.agents)
        if agent_index and MODELS[agent.model].kind == AgentKind.CAR
    )
    return next(cars, None)


@lru_cache(maxsize=256)
def _made_for(name: str) -> str:
    """Return the class that a perturbation is made for: car or stop_sign."""
    name = name.removeprefix(WEAR)
    if name not in shipped_textures():
        return SIGN if name == GREY_SIGN else "car"
    return class_of_target(parse_target(load_texture(name)[1].target))


def signs_of_route(graph: LaneGraph, route: F32) -> F64:
    """Return the positions of the stop signs along a route [N, 2], x, y [M, 2]."""
    sign_positions = graph.sign_xy[graph.sign_kind == SignKind.STOP].astype(np.float64).reshape(-1, 2)
    route_distances = np.linalg.norm(sign_positions[:, None] - route[None], axis=-1).min(1)
    nearby_signs: F64 = sign_positions[route_distances < BESIDE]
    return nearby_signs


def worn(name: str, agent: int, *, severity: int = 1, seed: int = 0) -> PhysicalAttack:
    """Return the edit that puts the texture or light of a perturbation on an agent, for `Onboard`.

    Args:
        name: Name of the perturbation: a light; a shipped texture; grey, grey-sign: a car, or the plate of a sign,
            painted grey all over, the control.
        agent: Number of the agent; ignored for signs.
        severity: Severity of a light.
        seed: Seed of a light.
    """
    if family_of(name) == LIGHT:
        light = shining(name, severity, seed)
        assert light is not None  # nobody is lit by the night alone
        return light.live(agent)
    name = name.removeprefix(WEAR)
    if name in (GREY, GREY_SIGN):
        target = SIGN if name == GREY_SIGN else TARGET
        surface = make_carrier("camouflage", {}).on(parse_target(target).mesh())
        return Print(torch.full((3, *surface.size), 0.5), "camouflage", {}, target).live(agent)
    texture, card = load_texture(name)
    full_texture = Print(texture, card.carrier, card.options, card.target)

    def edit(mesh: Mesh) -> SceneEdit:
        """Apply the texture at its trained size, or smaller if the car has no room for it."""
        for scale in SHARES:
            scaled_options = {
                key: scale * value if key in ("width", "height") else value for key, value in card.options.items()
            }
            try:
                return replace(full_texture, options=scaled_options).edit(mesh)
            except ConfigError:
                if scale == SHARES[-1]:
                    raise
        raise AssertionError

    return replace(full_texture.live(agent), edit=edit)


def texture_version(name: str) -> str:
    """Return the hash of the texture or exported light of a perturbation; "" for those that the code decides."""
    if family_of(name) == LIGHT:
        return light_version(name)
    name = name.removeprefix(WEAR)
    return "" if name in (GREY, GREY_SIGN) else _hash_of(name)


@lru_cache(maxsize=256)
def _hash_of(texture: str) -> str:
    return load_texture(texture)[1].hash


def perturbed(
    onboard: Onboard, cameras: Mapping[str, Camera], name: str, severity: int, *, detector: Any = None, seed: int = 0
) -> tuple[dict[str, Sensor], dict[str, Perturbation]]:
    """Return cameras under a perturbation, as `ssad.world.rollout.rollout` takes them.

    Args:
        onboard: Source of the cameras.
        cameras: Cameras by the names of their sensors.
        name: Name of the perturbation.
        severity: 1 to 5.
        detector: Detector that attacks are made against, and that decides whether they need intrinsics.
        seed: Seed of the weather.

    Returns:
        Sensors, and perturbations of their images, by name.
    """
    family = family_of(name)
    sensors: dict[str, Sensor] = dict(onboard.together(cameras))
    changes: dict[str, Perturbation] = {}
    for channel, camera in cameras.items():
        if family == "shift":
            sensors[channel] = ShiftedCamera(onboard.camera(camera), ShiftSpec(name, severity, seed))
        elif family == "fault":
            changes[channel] = CameraFault(name, severity)
        elif family == "attack":
            method, options = method_of(name)
            attack = make_attack(method, **options)
            budget = Budget(px(RADII[severity - 1]))
            batch_size = AT_ONCE if onboard.device == "cpu" else AT_ONCE_GPU
            if isinstance(attack, UniversalFit):
                attack = universal(attack, detector, camera, budget, device=onboard.device, batch=batch_size)
            changes[channel] = LiveAttack(
                attack, budget, detector=detector, intrinsic=camera.intrinsic, batch=batch_size
            )
    return sensors, changes
