"""What suites of kind `gap` can do to a camera: its faults, shifts, and attacks on its detector; severities 1 to 5."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from ssad.core.driving import Perturbation, Sensor
from ssad.core.errors import unknown_name
from ssad.core.frames import Camera
from ssad.recording.loop_sensors import Onboard
from ssad.recording.loop_shifts import LOOP_SHIFTS, ShiftedCamera
from ssad.scenarios.static.digital import ATTACKS, make_attack, needs
from ssad.scenarios.static.digital.budget import Budget, px
from ssad.scenarios.static.digital.live import LiveAttack
from ssad.scenarios.static.faults import FAULTS, CameraFault
from ssad.scenarios.static.shifts import ShiftSpec

NONE: Final = "none"
RADII: Final = (1.0, 2.0, 4.0, 8.0, 16.0)  # code values that attacks may move a pixel by, by severity
STEPS: Final = 2  # gradient steps a picture; an attacker in the loop has no time for more


def perturbation_names() -> dict[str, str]:
    """All perturbations -> their family: fault, shift or attack."""
    attacks = [name for name in ATTACKS if not needs(name)]
    return {
        NONE: "none", **dict.fromkeys(FAULTS, "fault"), **dict.fromkeys(LOOP_SHIFTS, "shift"),
        **dict.fromkeys((f"attack-{name}" for name in attacks), "attack"),
    }  # fmt: skip


def check_perturbation(name: str) -> None:
    """UnknownNameError: there is no such perturbation."""
    if name not in perturbation_names():
        raise unknown_name("perturbation", name, perturbation_names())


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
