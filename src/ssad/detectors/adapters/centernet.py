"""`centernet:FILE`: a CenterNet that learned from photographs (COCO), in the npm package `@vladmandic/human` (MIT).

`npm pack @vladmandic/human` gets the archive, and SSAD reads `models/centernet.json` in it. The network has a
MobileNetV3 backbone, 2.0 million weights, and an input of 512 x 512 pixels. Wide images are shown in square tiles.

Sources: the graph of the package (version 3.3.6: heads, strides, input); Zhou et al., Objects as Points (2019), for
peaks and the loss of the heat maps; Liu et al., Training-Time-Friendly Network for Real-Time Object Detection (AAAI
2020), for the four distances, the shape of the Gaussians and the weight of the loss of boxes. How these weights were
trained is not published in full.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

import torch
from torch import Tensor
from torch.nn import functional
from torchvision.ops import generalized_box_iou_loss

from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.core.errors import ConfigError, FormatError
from ssad.detectors.adapters.common import Adapter, check_images, check_truth, sum_by_image
from ssad.detectors.adapters.tfjs_graph import CONVOLUTIONS, GraphFile, GraphModel, read_graph_file
from ssad.detectors.yolo.classes import COCO
from ssad.detectors.yolo.decode import select

PACKAGE: Final = "@vladmandic/human"
MODEL: Final = "models/centernet.json"
NAME: Final = "centernet-photo"
HEAT_MAPS, DISTANCES = "tower_0/keypoints", "tower_0/wh"
STRIDE: Final = 4  # pixels of the network's input from one cell to the next
GREY: Final = 0.5
NMS_IOU, MAX_DETECTIONS, THRESHOLD = 0.5, 100, 0.25
TILES_PER_RATIO: Final = 1.5  # tiles for each side length of the long axis: neighbours overlap by a third or more
GAUSSIAN_SHARE: Final = 0.54 / 6  # standard deviation of a Gaussian, as a share of the sides of its box
FOCAL_POWER, PENALTY_POWER, BOX_WEIGHT = 2, 4, 5.0


def centernet_detector(file: str | Path, *, tiles: int | None = None, threshold: float = THRESHOLD) -> CenterNet:
    """Load the detector, frozen and in eval mode.

    Args:
        file: Archive that `npm pack @vladmandic/human` wrote, the folder of the installed package, or centernet.json
            beside centernet.bin.
        tiles: Square tiles along the longer side; 1: the whole image, padded to a square; None: one and a half times
            the ratio of the sides, rounded up.
        threshold: Default of `predict`.

    Raises:
        ConfigError: An option is out of range.
        FormatError: The file cannot be read, or holds no such network.
    """
    if tiles is not None and tiles not in range(1, 65):
        raise ConfigError(f"centernet:{file}: tiles is a whole number from 1 to 64, not {tiles}")
    graph = read_graph_file(Path(file).expanduser(), MODEL)
    logits = _logits_of(graph)
    detector = CenterNet(GraphModel(graph, (logits, DISTANCES, _features_of(graph, logits))), tiles, threshold)
    with torch.no_grad():
        detector.dense(torch.zeros(1, 3, *detector.network.input_size))
    return detector


def _logits_of(graph: GraphFile) -> str:
    """Return the node whose sigmoid the heat maps are."""
    graph_node = graph.nodes.get(HEAT_MAPS)
    while graph_node is not None and graph_node.op == "Identity" and graph_node.inputs:
        graph_node = graph.nodes.get(graph_node.inputs[0])
    if graph_node is None or graph_node.op != "Sigmoid" or not graph_node.inputs:
        raise FormatError(f"{graph.source}: no heat maps '{HEAT_MAPS}' that end in a sigmoid; use {MODEL} of {PACKAGE}")
    return graph_node.inputs[0]


def _features_of(graph: GraphFile, logits: str) -> str:
    """Return the input of the last convolutions before the heat maps."""
    name = logits
    while (graph_node := graph.nodes.get(name)) is not None and graph_node.op in CONVOLUTIONS and graph_node.inputs:
        name = graph_node.inputs[0]
    return name


class CenterNet(Adapter):
    """The network as a detector. Starts frozen and in eval mode.

    Places are the cells of all tiles, tile after tile. `Dense.quality` is None. maps: heat [B * T, C, h, w], logits;
    distances [B * T, 4, h, w], to left, top, right and bottom in pixels of the network's input. features: the neck of
    all tiles side by side.

    Args:
        network: Network with outputs logits, distances and features.
        tiles: See `centernet_detector`.
        threshold: Default of `predict`.
    """

    def __init__(self, network: GraphModel, tiles: int | None = None, threshold: float = THRESHOLD) -> None:
        super().__init__(NAME, COCO, threshold)
        self.network = network
        self.tiles = tiles
        if network.input_size[0] != network.input_size[1]:
            raise FormatError(f"{network.source}: an input of {network.input_size}; expected a square")
        self.requires_grad_(False).eval()

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Return raw outputs, differentiable with respect to the images.

        Args:
            images: [B, 3, H, W] in [0, 1].
            intrinsic: Not used.

        Raises:
            ConfigError: The images have another shape or type.
            FormatError: The heads have other shapes than those of the package.
        """
        size = check_images(self.name, images)
        images = images.to(next(self.network.parameters()).dtype)
        corners, side = tile_corners(size, self.tiles)
        input_side = self.network.input_size[0]
        padded = functional.pad(images, (0, max(side - size[1], 0), 0, max(side - size[0], 0)), value=GREY)
        tiles = torch.stack([padded[:, :, y : y + side, x : x + side] for x, y in corners], 1).flatten(0, 1)
        if side != input_side:
            tiles = functional.interpolate(tiles, (input_side, input_side), mode="bilinear", align_corners=False)
        heat_maps, distances, features = self.network(255 * tiles)
        cells = input_side // STRIDE
        if heat_maps.shape[1:] != (len(COCO), cells, cells) or distances.shape[1:] != (4, cells, cells):
            raise FormatError(
                f"{self.network.source}: heads of {list(heat_maps.shape[1:])} and {list(distances.shape[1:])}; "
                f"expected [{len(COCO)}, {cells}, {cells}] and [4, {cells}, {cells}]"
            )
        scale = side / input_side
        offset = torch.tensor(corners, device=heat_maps.device, dtype=heat_maps.dtype)[:, None]
        cell_offset = torch.arange(cells, device=heat_maps.device, dtype=heat_maps.dtype) * STRIDE
        cell = torch.stack((cell_offset.expand(cells, cells), cell_offset[:, None].expand(cells, cells)), -1).reshape(
            -1, 2
        )
        place = (offset + (cell + STRIDE / 2) * scale).reshape(-1, 2)
        corner = (offset + cell * scale).reshape(-1, 2)
        reach = self._by_place(distances * scale, len(images))
        object_box = torch.cat((corner - reach[..., :2], corner + reach[..., 2:]), -1)
        return Dense(
            logit=self._by_place(heat_maps, len(images)),
            quality=None,
            box=object_box,
            place=place,
            stride=torch.full((len(place),), STRIDE * scale, device=heat_maps.device),
            level=torch.zeros(len(place), dtype=torch.int64, device=heat_maps.device),
            maps={"heat": [heat_maps], "distances": [distances]},
            features=(torch.cat(list(features.unflatten(0, (len(images), -1)).unbind(1)), 3),),
            size=size,
        )

    def _by_place(self, maps: Tensor, images: int) -> Tensor:
        """Return maps [B * T, K, h, w] as rows [B, P, K]."""
        return maps.flatten(2).transpose(1, 2).reshape(images, -1, maps.shape[1])

    def choose(self, dense: Dense, min_score: float) -> list[Detections]:
        """Return the peaks of the heat maps, boxes of one object in several tiles suppressed within a class."""
        (heat_maps,) = dense.maps["heat"]
        is_peak = heat_maps == functional.max_pool2d(heat_maps, 3, 1, 1)
        score = self._by_place(torch.where(is_peak, heat_maps.sigmoid(), 0.0), len(dense.logit))
        # Nothing in the network orders the sides of a box.
        object_box = torch.cat(
            (dense.box[..., :2].minimum(dense.box[..., 2:]), dense.box[..., :2].maximum(dense.box[..., 2:])), -1
        )
        return select(score, object_box, threshold=min_score, iou=NMS_IOU, limit=MAX_DETECTIONS, size=dense.size)

    @torch.no_grad()
    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """Assign each object to the cell that its centre lies in, in every tile that holds the centre.

        Of two objects in one cell, the smaller is assigned. Places in a crowd box are ignored.

        Args:
            dense: Outputs for B images.
            truth: True objects of each image.

        Returns:
            The assignment. extra: box [B, P, 4], pixels of the image; heat [B, P, C], the Gaussians of all objects.
        """
        unit = torch.ones(4, device=dense.box.device, dtype=dense.box.dtype)
        targets = check_truth(self.name, truth, len(dense.box), scale=unit, classes=len(COCO))
        images, places = dense.box.shape[:2]
        label = torch.full((images, places), -1, device=unit.device)
        owner = torch.full_like(label, -1)
        target_box = torch.zeros_like(dense.box)
        heat_maps = torch.zeros_like(dense.logit)
        half = dense.stride / 2
        for image in range(images):
            rows = targets.real[image].nonzero()[:, 0]
            object_box = targets.box[image, rows]
            is_crowd = targets.crowd[image, rows]
            largest_first = (object_box[:, 2:] - object_box[:, :2]).prod(1).argsort(descending=True, stable=True)
            for row in largest_first.tolist():
                x1, y1, x2, y2 = object_box[row]
                if bool(is_crowd[row]):
                    is_inside = ((dense.place >= object_box[row, :2]) & (dense.place <= object_box[row, 2:])).all(1)
                    label[image] = torch.where(is_inside & (label[image] == -1), -2, label[image])
                    continue
                centre, sides = (
                    (object_box[row, :2] + object_box[row, 2:]) / 2,
                    object_box[row, 2:] - object_box[row, :2],
                )
                away = dense.place - centre
                class_index = int(targets.label[image, rows[row]])
                bell = (-0.5 * (away / (GAUSSIAN_SHARE * sides).maximum(half[:, None])).square().sum(1)).exp()
                heat_maps[image, :, class_index] = heat_maps[image, :, class_index].maximum(bell)
                is_centre = ((away > -half[:, None]) & (away <= half[:, None])).all(1)
                label[image, is_centre], owner[image, is_centre] = class_index, rows[row]
                target_box[image, is_centre] = torch.stack((x1, y1, x2, y2))
        return Assignment(label, owner, tuple(truth), {"box": target_box, "heat": heat_maps})

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """Return the losses, each divided by the number of centres (at least 1).

        Returns:
            heat: focal loss with a penalty that is lower around centres (Objects as Points, eq. 1). box: 5 * (1 -
            GIoU) at the centres.

        Raises:
            ConfigError: The assignment was made for images of another number or size.
        """
        if assignment.label.shape != dense.box.shape[:2]:
            raise ConfigError(f"{self.name}: the assignment was made for images of another number or size")
        images = len(dense.box)
        image, place = (assignment.label >= 0).nonzero(as_tuple=True)
        logit = dense.logit
        is_centre = torch.zeros_like(logit, dtype=torch.bool)
        is_centre[image, place, assignment.label[image, place]] = True
        probability = logit.sigmoid()
        penalty = (1 - assignment.extra["heat"].to(logit)) ** PENALTY_POWER * probability**FOCAL_POWER
        heat_loss = torch.where(
            is_centre,
            -((1 - probability) ** FOCAL_POWER) * functional.logsigmoid(logit),
            -penalty * functional.logsigmoid(-logit),
        )
        heat_loss = torch.where((assignment.label != -2)[..., None], heat_loss, 0.0).sum((1, 2))
        target = assignment.extra["box"].to(dense.box)[image, place]
        box_loss = BOX_WEIGHT * generalized_box_iou_loss(dense.box[image, place], target)
        parts = {"heat": heat_loss, "box": sum_by_image(box_loss, image, images)}
        centre_count = sum_by_image(torch.ones_like(box_loss), image, images)
        if reduction == "image":
            return {name: loss_sum / centre_count.clamp(min=1) for name, loss_sum in parts.items()}
        return {name: loss_sum.sum() / centre_count.sum().clamp(min=1) for name, loss_sum in parts.items()}


def tile_corners(size: tuple[int, int], tiles: int | None) -> tuple[list[tuple[int, int]], int]:
    """Return the upper left corners (x, y) of the square tiles of an image, and their side, pixels.

    Args:
        size: Height and width of the image.
        tiles: Number of tiles along the longer side; 1: one that holds the whole image; None: from the ratio of the
            sides.
    """
    short, long = min(size), max(size)
    tile_count = tiles or (1 if short == long else math.ceil(TILES_PER_RATIO * long / short))
    if tile_count == 1:
        return [(0, 0)], long
    starts = [round(number * (long - short) / (tile_count - 1)) for number in range(tile_count)]
    return [(start, 0) if size[1] >= size[0] else (0, start) for start in starts], short
