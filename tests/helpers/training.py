"""Pictures of coloured squares, a small detector and a recipe for tests of training, also in other processes."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import distributed

from ssad.core.detections import Truth
from ssad.detectors.yolo.detector import Yolo
from ssad.detectors.yolov3 import YOLOV3_TINY
from ssad.training.batches import ImageSet
from ssad.training.loop import ProcessRank, train
from ssad.training.recipe import Recipe

CLASSES = ("car", "person")
SPEC = replace(YOLOV3_TINY, width=0.125)
SIZE = (64, 96)
COLOURS = ((230, 30, 30), (30, 30, 230))  # of the classes
RECIPE = Recipe("yolov3-tiny", 3, 4, 2e-3, warmup=2, zoom=(0.7, 1.4), average=0.9)


def bank(count: int = 8, *, seed: int = 0) -> ImageSet:
    """Grey pictures with one to three coloured squares side by side."""
    rng = np.random.default_rng(seed)
    pictures = np.full((count, *SIZE, 3), 114, np.uint8)
    truth = []
    for picture in pictures:
        labels, boxes = [], []
        for column in range(int(rng.integers(1, 4))):
            side = int(rng.integers(14, 28))
            x, y = 32 * column + int(rng.integers(0, 32 - side)), int(rng.integers(0, SIZE[0] - side))
            labels.append(int(rng.integers(0, 2)))
            picture[y : y + side, x : x + side] = COLOURS[labels[-1]]
            boxes.append([x, y, x + side, y + side])
        truth.append(Truth(torch.tensor(labels), torch.tensor(boxes, dtype=torch.float32)))
    return ImageSet(torch.from_numpy(pictures), tuple(truth))


def fresh() -> Yolo:
    """A small detector, the same every time."""
    return Yolo(SPEC, CLASSES)


def learn(rank: int, world: int, port: int, out: str) -> None:
    """One of several processes that train together; its parameters go to OUT/RANK.pt."""
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", rank=rank, world_size=world)
    try:
        whole = bank()
        mine = ImageSet(whole.pictures[rank::world], whole.truth[rank::world])
        detector = fresh()
        recipe = replace(RECIPE, epochs=2)
        # only the first process is out of time after an epoch: all must stop, and go on together
        train(detector, mine, recipe, out=Path(out), share=ProcessRank(rank, world), seconds=1e9 * rank)
        train(detector, mine, recipe, out=Path(out), share=ProcessRank(rank, world))
        torch.save({name: value.detach() for name, value in detector.named_parameters()}, Path(out) / f"{rank}.pt")
    finally:
        distributed.destroy_process_group()
