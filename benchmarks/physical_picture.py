"""The six panels of the paper's figure of physical attacks: python benchmarks/physical_picture.py

It writes docs/images/physical.jpg.

One picture of a drive in Oldmarket, where no texture was trained: clean, under a random patch and camouflage, and under
the shipped textures of Adv. Patch, DAS and TPA, each with what YOLOv5n finds.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import numpy as np
import torch

from ssad.core.images import save_picture
from ssad.core.machine import start_warp_quietly
from ssad.detectors import make_detector
from ssad.experiments.perception.physical.target_sheet import target_sheet
from ssad.experiments.perception.physical.target_views import RecordedTargetImages
from ssad.recorders.target_images import record_target_images
from ssad.recorders.target_recording import TargetRecording
from ssad.rendering.target import TargetCar
from ssad.scenarios.static.physical import albedo_of, control, make_carrier
from ssad.scenarios.static.physical.textures.card import load_texture

OUT = Path(__file__).parents[1] / "docs" / "images" / "physical.jpg"
TOWN, DETECTOR = "Oldmarket", "yolov5n"
PANELS = {
    "benign": None,
    "random patch": "adv-patch",
    "Adv. Patch": "adv-patch",
    "random camouflage": "das",
    "DAS": "das",
    "TPA": "tpa",
}


@torch.no_grad()
def main() -> None:
    """Record, show, write."""
    start_warp_quietly()
    detector, target = make_detector(DETECTOR), TargetCar()
    with tempfile.TemporaryDirectory() as folder:
        record_target_images(TargetRecording(Path(folder), ((TOWN, 1),), (), target=target), workers=0)
        clips = RecordedTargetImages(Path(folder), 1, tuple(detector.classes))
        ((_, clean, truth),) = clips.clean()
        shown = []
        for title, texture in PANELS.items():
            image = clean
            if texture is not None:
                colour, card = load_texture(f"{texture}-{DETECTOR}-twinford")
                surface = make_carrier(card.carrier, card.options).on(target.mesh())
                colour = control("random", surface.size) if title.startswith("random") else colour
                ((_, view),) = clips.wearing(surface)
                image = view.picture.together([view.picture], {0: albedo_of(colour)[None]})
            shown.append((title, image))
    sheet = target_sheet(detector, shown, truth, "cpu")
    save_picture(OUT, np.asarray(cv2.resize(sheet, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA), np.uint8))


if __name__ == "__main__":
    main()
