"""What suites of kind `gap` can do to a camera and to what it sees: faults, shifts, attacks, textures, lights."""

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
    """Family of a perturbation.

    Raises:
        UnknownNameError: There is no such perturbation.
        ConfigError: An attack cannot take so few steps.
        FormatError: There is no exported light in its folder.
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
    """Whether a perturbation has severities 1 to 5, or one alone."""
    return family_of(name) != TEXTURE and name not in (NIGHT, f"{SHINE}shadow") and not name.startswith(FOUND)


def is_worn(name: str) -> bool:
    """Whether a perturbation is on a car or on signs, so that drives without one are left out."""
    return family_of(name) in (TEXTURE, LIGHT) and name != NIGHT


def wearer(name: str, episode: Episode, graph: LaneGraph) -> int | None:
    """Who wears a texture or is lit: the first agent besides the ego that is a car; None: nobody in this episode can.

    Args:
        name: Of the perturbation.
        episode: The episode.
        graph: Its town.

    Returns:
        Number of the agent; 0 where stop signs wear it.
    """
    if _made_for(name) == SIGN:
        route = episode.agents[0].route
        return 0 if route is not None and len(signs_of_route(graph, route.xy)) else None
    cars = (k for k, one in enumerate(episode.agents) if k and MODELS[one.model].kind == AgentKind.CAR)
    return next(cars, None)


@lru_cache(maxsize=256)
def _made_for(name: str) -> str:
    """Whom a perturbation is made for: car or stop_sign."""
    name = name.removeprefix(WEAR)
    if name not in shipped_textures():
        return SIGN if name == GREY_SIGN else "car"
    return class_of_target(parse_target(load_texture(name)[1].target))


def signs_of_route(graph: LaneGraph, route: F32) -> F64:
    """Where the stop signs stand that a way [N, 2] comes by, x, y [M, 2]."""
    stop = graph.sign_xy[graph.sign_kind == SignKind.STOP].astype(np.float64).reshape(-1, 2)
    away = np.linalg.norm(stop[:, None] - route[None], axis=-1).min(1)
    beside: F64 = stop[away < BESIDE]
    return beside


def worn(name: str, agent: int, *, severity: int = 1, seed: int = 0) -> PhysicalAttack:
    """What makes an agent wear the texture of a perturbation, or lights it, for `Onboard`.

    Args:
        name: Of the perturbation: a light; a shipped texture; grey, grey-sign: a car, or the plate of a sign, painted
            grey all over, the control.
        agent: Who wears it; of no account where signs do.
        severity: Of a light.
        seed: Of a light.
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
    whole = Print(texture, card.carrier, card.options, card.target)

    def edit(mesh: Mesh) -> SceneEdit:
        """As large as it was trained, or smaller where the car has no room for it."""
        for share in SHARES:
            sized = {key: share * value if key in ("width", "height") else value for key, value in card.options.items()}
            try:
                return replace(whole, options=sized).edit(mesh)
            except ConfigError:
                if share == SHARES[-1]:
                    raise
        raise AssertionError

    return replace(whole.live(agent), edit=edit)


def texture_version(name: str) -> str:
    """Hash of the texture or of the exported light of a perturbation; "" of those that the code decides."""
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
    """Cameras under a perturbation, as `ssad.world.rollout.rollout` takes them.

    Args:
        onboard: What makes cameras.
        cameras: By the names of their sensors.
        name: Of the perturbation.
        severity: 1 to 5.
        detector: What attacks are made against, and whose intrinsics they need.
        seed: Of the weather.

    Returns:
        Sensors, and perturbations of their pictures, by name.
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
            at_once = AT_ONCE if onboard.device == "cpu" else AT_ONCE_GPU
            if isinstance(attack, UniversalFit):
                attack = universal(attack, detector, camera, budget, device=onboard.device, batch=at_once)
            changes[channel] = LiveAttack(attack, budget, detector=detector, intrinsic=camera.intrinsic, batch=at_once)
    return sensors, changes
