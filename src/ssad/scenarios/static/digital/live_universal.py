"""The universal attack in the loop: one change for all images of a camera, fitted before the drive in other drives."""

from __future__ import annotations

import torch

from ssad.core.checkpoints import state_hash
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.protocols import Detector
from ssad.rendering.sensor_suite import SensorSuite
from ssad.scenarios.static.digital.budget import Budget
from ssad.scenarios.static.digital.live import own_truth
from ssad.scenarios.static.digital.objectives import make_objective
from ssad.scenarios.static.digital.universal import Universal, UniversalFit
from ssad.scenarios.static.digital.victim import NothingToAttackError, Victim, steady

_FITTED: dict[tuple[object, ...], Universal] = {}


def universal_change(
    fit: UniversalFit,
    detector: Detector,
    camera: Camera,
    budget: Budget,
    *,
    suite: SensorSuite,
    batch: int,
    loss: str = "margin",
) -> Universal:
    """Return the attack that adds the change fitted for a detector and a camera; fitted once per process.

    The detections in the clean images serve as the truth, as in `LiveAttack`.

    Args:
        fit: Settings of the fit.
        detector: The attacked detector.
        camera: The camera.
        budget: Maximum change of each image.
        suite: The sensors; it gives the images of other drives.
        batch: Images at once; it changes no result.
        loss: Loss that the fit raises.

    Raises:
        ConfigError: There are no images of other drives, or the detector finds nothing in any of them.
    """
    if suite.other_images is None:
        raise ConfigError("attack universal: it is fitted to images of other drives, and there are none here")
    detector_key = state_hash(detector) or id(detector)
    cache_key = (
        fit,
        detector_key,
        camera.channel,
        camera.width,
        camera.intrinsic.tobytes(),
        budget,
        loss,
        suite.device,
    )
    if cache_key not in _FITTED:
        clean_images = suite.other_images(camera, fit.frames)
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
                        Victim(detector, image_batch, truth, make_objective(loss), intrinsic=intrinsic_batch)
                    )
                except NothingToAttackError:
                    continue
        if not victims:
            raise ConfigError(f"attack universal: {detector.name} finds nothing in images of other drives")
        _FITTED[cache_key] = fit.fit(victims, budget)
    return _FITTED[cache_key]
