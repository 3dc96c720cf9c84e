"""What suites of kind `gap` can do to a camera: its faults, shifts, and attacks on its detector; severities 1 to 5."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import torch

from ssad.assets.mesh import Mesh
from ssad.camera.scene_edit import SceneEdit
from ssad.core.driving import Perturbation, Sensor
from ssad.core.errors import ConfigError, unknown_name
from ssad.core.frames import Camera
from ssad.core.types import AgentKind, Episode
from ssad.recording.live_attack import LiveAttack as PhysicalAttack
from ssad.recording.loop_sensors import Onboard
from ssad.recording.loop_shifts import LOOP_SHIFTS, ShiftedCamera
from ssad.recording.target import parse_target
from ssad.recording.texture_export import Print
from ssad.scenarios.static.digital import ATTACKS, make_attack, needs
from ssad.scenarios.static.digital.budget import Budget, px
from ssad.scenarios.static.digital.live import LiveAttack
from ssad.scenarios.static.faults import FAULTS, CameraFault
from ssad.scenarios.static.physical import make_carrier
from ssad.scenarios.static.physical.shipped import load_texture, shipped_textures
from ssad.scenarios.static.shifts import ShiftSpec
from ssad.world.models import MODELS

NONE: Final = "none"
GREY: Final = "grey"
TEXTURE: Final = "texture"
WEAR: Final = "wear-"
TARGET: Final = "sedan"
SHARES: Final = (1.0, 0.9, 0.8, 0.7, 0.6)  # sizes of a patch that are tried, of the one that was trained
RADII: Final = (1.0, 2.0, 4.0, 8.0, 16.0)  # code values that attacks may move a pixel by, by severity
STEPS: Final = 2  # gradient steps a picture; an attacker in the loop has no time for more


def perturbation_names() -> dict[str, str]:
    """All perturbations -> their family: fault, shift, attack or texture."""
    attacks = [name for name in ATTACKS if not needs(name)]
    return {
        NONE: "none", **dict.fromkeys(FAULTS, "fault"), **dict.fromkeys(LOOP_SHIFTS, "shift"),
        **dict.fromkeys((f"attack-{name}" for name in attacks), "attack"),
        **dict.fromkeys((f"{WEAR}{name}" for name in (GREY, *shipped_textures())), TEXTURE),
    }  # fmt: skip


def check_perturbation(name: str) -> None:
    """UnknownNameError: there is no such perturbation."""
    if name not in perturbation_names():
        raise unknown_name("perturbation", name, perturbation_names())


def first_car(episode: Episode) -> int | None:
    """Number of the first agent besides the ego that is a car, who wears a texture; None: there is none."""
    cars = [k for k, one in enumerate(episode.agents) if k and MODELS[one.model].kind == AgentKind.CAR]
    return cars[0] if cars else None


def worn(name: str, agent: int) -> PhysicalAttack:
    """What makes an agent wear the texture of a perturbation, for `ssad.recording.loop_sensors.Onboard`.

    Args:
        name: Of the perturbation: a shipped texture; grey: a car painted grey all over, the control.
        agent: Who wears it.
    """
    name = name.removeprefix(WEAR)
    if name == GREY:
        surface = make_carrier("camouflage", {}).on(parse_target(TARGET).mesh())
        return Print(torch.full((3, *surface.size), 0.5), "camouflage", {}, TARGET).live(agent)
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
    """Hash of the texture of a perturbation; "" of the control."""
    name = name.removeprefix(WEAR)
    return "" if name == GREY else load_texture(name)[1].hash


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
    family = perturbation_names()[name]
    sensors: dict[str, Sensor] = {channel: onboard.camera(camera) for channel, camera in cameras.items()}
    changes: dict[str, Perturbation] = {}
    for channel, camera in cameras.items():
        if family == "shift":
            sensors[channel] = ShiftedCamera(onboard.camera(camera), ShiftSpec(name, severity, seed))
        elif family == "fault":
            changes[channel] = CameraFault(name, severity)
        elif family == "attack":
            method = name.removeprefix("attack-")
            attack = make_attack(method, **({"steps": STEPS} if method in ("pgd", "cw", "momentum", "apgd") else {}))
            budget = Budget(px(RADII[severity - 1]))
            changes[channel] = LiveAttack(attack, budget, detector=detector, intrinsic=camera.intrinsic)
    return sensors, changes
