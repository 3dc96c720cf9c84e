"""FCOS3D and PGD-Det behind the `Detector` protocol."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional
from torchvision.ops import batched_nms, box_iou

from ssad.core.detections import Assignment, Dense, Detections, Solids, Truth
from ssad.core.errors import ConfigError
from ssad.core.eval_mode import in_eval_mode
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.tensor_boxes import solid_corners
from ssad.detectors.adapters.common import check_images, check_threshold, input_scale, resized_size
from ssad.detectors.mono3d.backbone import Backbone, Neck
from ssad.detectors.mono3d.config import Mono3DConfig
from ssad.detectors.mono3d.decode import (
    FlatMaps,
    flatten,
    global_yaw,
    hull,
    places_of,
    project,
    select_rows,
    unproject,
    yaw_of_vectors,
)
from ssad.detectors.mono3d.head import Head
from ssad.detectors.mono3d.losses import losses
from ssad.detectors.mono3d.nms import rotated_nms
from ssad.detectors.mono3d.targets import assign

MULTIPLE = 32


class Mono3D(nn.Module):
    """A monocular 3D detector; parts and weights carry mmdetection3d's names (backbone, neck, bbox_head).

    It starts frozen and in eval mode. Truth and detections are in the camera frame of the intrinsic that is
    passed in, which is used as given: a place is column and row times stride plus half the stride, the centre of
    its cell, counted from the corner of the image as in an intrinsic.

    `Dense`: maps are mmdetection3d's in eval mode, in pixels of the network's input; quality: centreness; box:
    hull of the projected corners, or PGD's own 2D box, clipped at the border; empty in training mode ([B, 0, 4]).

    Args:
        config: The configuration.
        seed: Seed of the fresh weights.
    """

    task: Literal["2d", "3d"] = "3d"

    def __init__(self, config: Mono3DConfig, *, seed: int = 0) -> None:
        super().__init__()
        self.config = config
        self.name = config.name
        self.classes = MMDET3D_CLASSES
        # Fresh weights depend on the seed alone, and the global generator stays unchanged.
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)
            self.backbone = Backbone(config.trunk, width=config.width)
            self.neck = Neck(self.backbone.out_channels, config.channels, len(config.strides))
            self.bbox_head = Head(config)
        self.register_buffer("mean", torch.tensor(config.mean)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(config.std)[:, None, None], persistent=False)
        self.requires_grad_(False).eval()

    def forward(self, images: Tensor, intrinsic: Tensor) -> Dense:
        """Return the raw outputs of `dense`."""
        return self.dense(images, intrinsic)

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Raw outputs, differentiable with respect to the images.

        Args:
            images: [B, 3, H, W] in [0, 1].
            intrinsic: [B, 3, 3].

        Raises:
            ConfigError: Another shape or type, or no intrinsic.
        """
        maps, features, network_intrinsic, size = self._maps(images, intrinsic)
        scale, rows_above = self._scale(size, network_intrinsic), self._rows_above(size)
        flat_maps = flatten(maps)
        places = places_of(maps["cls_scores"], self.config.strides)
        with _full_precision(images):
            if self.training:
                box = flat_maps.reg.new_zeros((len(images), 0, 4))
            else:
                solids = self._solids(flat_maps, places.xy, network_intrinsic[:, None])
                box = self._boxes(flat_maps, places.xy, solids, intrinsic=network_intrinsic[:, None], size=size)
        return Dense(
            logit=flat_maps.logit,
            quality=flat_maps.centreness,
            box=box,
            place=(places.xy - places.xy.new_tensor([0.0, rows_above])) / scale,
            stride=places.stride / scale[0],
            level=places.level,
            size=size,
            maps={**maps, "intrinsic": [network_intrinsic]},
            features=tuple(features),
        )

    def _maps(
        self, images: Tensor, intrinsic: Tensor | None
    ) -> tuple[dict[str, list[Tensor]], Sequence[Tensor], Tensor, tuple[int, int]]:
        """Return the head's maps, its input, the intrinsics [B, 3, 3] in the network's input, and the image size."""
        size, network_intrinsic = self._check(images, intrinsic)
        network_intrinsic = self._scale_intrinsic(network_intrinsic, size, self._scale(size, network_intrinsic))
        features = self.neck(self.backbone(self._preprocess(images)))
        return (
            self.bbox_head(features, self._depth_factor(network_intrinsic), self._rays(features, network_intrinsic)),
            features,
            network_intrinsic,
            size,
        )

    @torch.no_grad()
    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        """Return the detections of each image, best first.

        The score is class times centreness (times PGD's confidence of depth).
        """
        min_score = check_threshold(self.name, self.config.threshold if threshold is None else threshold)
        with in_eval_mode(self):
            maps, _, network_intrinsic, size = self._maps(images, intrinsic)  # without the boxes of all places
        return self._select_detections(maps, network_intrinsic, size, threshold=min_score, best_first=True)

    def select(self, dense: Dense, threshold: float) -> list[Detections]:
        """Return the detections of each image in mmdetection3d's order, without boxes that the source suppresses.

        They are ordered by class and descending score, or by score alone if there were too many.

        Args:
            dense: Raw outputs.
            threshold: Minimum score.
        """
        maps, intrinsic = _head_maps(dense), dense.maps["intrinsic"][0]
        return self._select_detections(maps, intrinsic, dense.size, threshold=threshold, best_first=False)

    def _select_detections(
        self,
        maps: dict[str, list[Tensor]],
        intrinsic: Tensor,
        size: tuple[int, int],
        *,
        threshold: float,
        best_first: bool,
    ) -> list[Detections]:
        """Select and suppress detections; suppression runs on the host, with one transfer from the device."""
        with _full_precision(intrinsic):
            flat_maps, places = flatten(maps), places_of(maps["cls_scores"], self.config.strides)
            class_scores = self._class_scores(flat_maps, intrinsic)
            top_rows = self._top_places(maps, class_scores.amax(-1))
            class_scores = class_scores.gather(1, top_rows[..., None].expand(-1, -1, class_scores.shape[2]))
            image, place, label = (class_scores > threshold).nonzero(as_tuple=True)
            rows, score = top_rows[image, place], class_scores[image, place, label]
            outputs, xy = select_rows(flat_maps, image, rows), places.xy[rows]
            solids = centre, extent, yaw = self._solids(outputs, xy, intrinsic, image)
            image_boxes = self._boxes(outputs, xy, solids, intrinsic=intrinsic[image], size=size)
            candidates = torch.cat([centre, extent, outputs.reg[:, 7:9], outputs.direction], 1)
            ground = torch.stack([centre[:, 0], centre[:, 2], extent[:, 0], extent[:, 2], -yaw], -1)
            host_columns = [
                candidate_column.cpu() for candidate_column in (image, label, score, image_boxes, ground, candidates)
            ]
            image, label, score, image_boxes, ground, candidates = host_columns
            survivors = self._suppress(ground, image_boxes, score, label, image, best_first=best_first)
            values = (
                self._vote(candidates, image_boxes, score, label, image, survivors)
                if self.config.vote is not None
                else candidates[survivors]
            )
            centre, extent, velocity, direction = torch.split(values, [3, 3, 2, outputs.direction.shape[1]], 1)
            device_rows, device = survivors.to(intrinsic.device), intrinsic.device
            yaw = yaw[device_rows]
            if self.config.heading == "vectors":
                # Voting averages vectors, not angles, so the yaw is decoded anew; the viewing angle stays.
                yaw = yaw - outputs.reg[device_rows, 6] + yaw_of_vectors(direction).to(yaw)
            columns = (
                score[survivors],
                label[survivors],
                image_boxes[survivors],
                centre,
                extent,
                yaw,
                velocity,
                outputs.attribute[device_rows].argmax(-1),
            )
            counts = torch.bincount(image[survivors], minlength=len(intrinsic)).tolist()
            image_columns = zip(*(torch.split(column.to(device), counts) for column in columns), strict=True)
            return [
                Detections(image_column[0], image_column[1], image_column[2], Solids(*image_column[3:]))
                for image_column in image_columns
            ]

    def _class_scores(self, flat_maps: FlatMaps, intrinsic: Tensor) -> Tensor:
        """Return scores [B, P, 10]: class times centreness, for PGD-Det times confidence of depth; see `fade`."""
        scores = flat_maps.logit.sigmoid() * flat_maps.centreness.sigmoid()[..., None]
        if flat_maps.bins is not None:
            scores = scores * flat_maps.bins.softmax(-1).topk(2, -1)[0].mean(-1, keepdim=True) ** self.config.sure
        if self.config.fade:
            scores = (
                scores
                * torch.exp(-self.config.fade * self._depth(flat_maps, intrinsic[:, None]).clamp_min(0.0))[..., None]
            )
        return scores

    def _depth(self, flat_maps: FlatMaps, intrinsic: Tensor) -> Tensor:
        """Return the depth [..., P] of places, m; intrinsic [..., 3, 3], one per place or broadcast."""
        depth = flat_maps.reg[..., 2]
        return (
            depth
            if flat_maps.bins is None
            else self.bbox_head.fuse(depth, flat_maps.bins, self._depth_factor(intrinsic))
        )

    def _vote(  # noqa: PLR0917
        self, values: Tensor, image_boxes: Tensor, score: Tensor, label: Tensor, image: Tensor, survivors: Tensor
    ) -> Tensor:
        """Return the mean of the values of the candidates that support each survivor, weighted by their scores.

        Args:
            values: Values of all candidates [N, K], image by image.
            image_boxes: Their boxes in the image [N, 4].
            score: Their scores [N].
            label: Their classes [N].
            image: Their images [N].
            survivors: Rows of the survivors, image by image.

        Returns:
            One row for each survivor.
        """
        means = [values[:0]]
        images, counts = _run_lengths(image[survivors])
        starts, ends = torch.searchsorted(image, images), torch.searchsorted(image, images, right=True)
        for rows, start, end in zip(torch.split(survivors, counts), starts.tolist(), ends.tolist(), strict=True):
            supports = box_iou(image_boxes[rows], image_boxes[start:end]) >= self.config.vote
            supports &= label[rows][:, None] == label[start:end]
            supports[torch.arange(len(rows)), rows - start] = True  # a box without area as well
            weight = supports * score[start:end]
            means.append(weight @ values[start:end] / weight.sum(1, keepdim=True))
        return torch.cat(means)

    def _top_places(self, maps: dict[str, list[Tensor]], best: Tensor) -> Tensor:
        """Return the best places [B, R] of each level, by their best scores [B, P]."""
        rows: list[Tensor] = []
        start = 0
        for level_map in maps["cls_scores"]:
            count = level_map.shape[2] * level_map.shape[3]
            level_scores = best[:, start : start + count]
            if count > self.config.before:
                rows.append(level_scores.topk(self.config.before, 1)[1] + start)
            else:
                rows.append(
                    torch.arange(start, start + count, device=level_scores.device).expand(len(level_scores), -1)
                )
            start += count
        return torch.cat(rows, 1)

    def _suppress(
        self, ground: Tensor, image_boxes: Tensor, score: Tensor, label: Tensor, image: Tensor, *, best_first: bool
    ) -> Tensor:
        """Return the rows of the candidates that survive suppression, image by image; all at once, on the host.

        Args:
            ground: Rectangles of all candidates on the ground.
            image_boxes: Their boxes in the image.
            score: Their scores.
            label: Their classes.
            image: Their images, ascending.
            best_first: Whether to order by score alone.
        """
        # One group for each image and class: a single pass suppresses all images.
        rows = rotated_nms(ground, score, image * len(self.classes) + label, threshold=self.config.nms)
        if self.config.image_nms is not None:
            rows = self._suppress_in_images(rows, image_boxes, score, label, image)
        row_image = image[rows]
        is_full = torch.bincount(row_image)[row_image] > self.config.most
        # Within an image: by score alone if requested or if there are too many, else in the order of the classes.
        sort_key = torch.where(is_full | best_first, -score[rows].double(), torch.arange(len(rows)).double())
        ranking = sort_key.argsort(stable=True)
        ranking = ranking[row_image[ranking].argsort(stable=True)]
        rows, row_image = rows[ranking], row_image[ranking]
        is_within_limit = torch.arange(len(rows)) - torch.searchsorted(row_image, row_image) < self.config.most
        return rows[is_within_limit]

    def _suppress_in_images(
        self, rows: Tensor, image_boxes: Tensor, score: Tensor, label: Tensor, image: Tensor
    ) -> Tensor:
        """Drop rows (image by image) whose boxes in the image overlap too much with better ones."""
        assert self.config.image_nms is not None
        kept_rows = [rows[:0]]
        for image_rows in torch.split(rows, _run_lengths(image[rows])[1]):
            remaining_rows = image_rows
            if len(image_rows) > 1:
                order = batched_nms(
                    image_boxes[image_rows], score[image_rows], label[image_rows], self.config.image_nms
                ).sort()[0]
                remaining_rows = image_rows[order]
            kept_rows.append(remaining_rows)
        return torch.cat(kept_rows)

    @torch.no_grad()
    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """Assign targets as in the source; extra: see `ssad.detectors.mono3d.targets`.

        Raises:
            ConfigError: The truth does not fit.
        """
        if len(truth) != len(dense.logit):
            raise ConfigError(f"{self.name}: truth of {len(truth)} images for a batch of {len(dense.logit)}")
        intrinsic = dense.maps["intrinsic"][0]
        places = places_of(dense.maps["cls_scores"], self.config.strides)
        with _full_precision(intrinsic):
            return assign(
                self.config,
                places,
                truth,
                intrinsic,
                self._scale(dense.size, intrinsic),
                rows_above=self._rows_above(dense.size),
            )

    @torch.no_grad()
    def discount_centreness(self, dense: Dense, assignment: Assignment, *, doubt: float) -> Assignment:
        """Return the assignment with centreness reduced by the error of the currently predicted depth.

        A centreness learned from it ranks boxes by how well they are placed, as in IoU-Net (Jiang et al., ECCV 2018).

        Args:
            dense: Raw outputs.
            assignment: Assignment of these images.
            doubt: Error of the depth at which centreness falls to 1/e, m.
        """
        image, place = (assignment.label >= 0).nonzero(as_tuple=True)
        with _full_precision(dense.logit):
            depth = self._depth(
                select_rows(flatten(_head_maps(dense)), image, place), dense.maps["intrinsic"][0][image]
            )
        depth_error = (depth - assignment.extra["reg"][image, place, 2]).abs()
        centreness = assignment.extra["centreness"].clone()
        centreness[image, place] *= torch.exp(-depth_error / doubt)
        return replace(assignment, extra={**assignment.extra, "centreness": centreness})

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """Return the training losses; see `ssad.detectors.mono3d.losses`.

        Raises:
            ConfigError: The assignment was made for images of another number or size.
        """
        if assignment.label.shape != dense.logit.shape[:2]:
            raise ConfigError(f"{self.name}: the assignment was made for pictures of another number or size")
        intrinsic = dense.maps["intrinsic"][0]
        places = places_of(dense.maps["cls_scores"], self.config.strides)
        with _full_precision(intrinsic):
            return losses(
                self.config,
                flatten(_head_maps(dense)),
                places,
                assignment,
                intrinsic,
                factor=self._depth_factor(intrinsic),
                fuse=self.bbox_head.fuse,
                reduction=reduction,
            )

    def _solids(
        self, flat_maps: FlatMaps, xy: Tensor, intrinsic: Tensor, image: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return centre, size, yaw of places; intrinsic [..., 3, 3] (broadcast), or one per image and image [P]."""
        centre2d = xy - flat_maps.reg[..., :2]
        place_intrinsic = intrinsic if image is None else intrinsic[image]
        depth = self._depth(flat_maps, place_intrinsic)
        centre = unproject(torch.cat([centre2d, depth[..., None]], -1), intrinsic, image)
        direction = flat_maps.direction.argmax(-1) if self.config.heading == "bins" else None
        yaw = global_yaw(
            flat_maps.reg[..., 6], direction, centre2d[..., 0], place_intrinsic, offset=self.config.dir_offset
        )
        return centre, flat_maps.reg[..., 3:6], yaw

    def _boxes(
        self,
        flat_maps: FlatMaps,
        xy: Tensor,
        solids: tuple[Tensor, Tensor, Tensor],
        *,
        intrinsic: Tensor,
        size: tuple[int, int],
    ) -> Tensor:
        """Return 2D boxes [..., P, 4] at the image's pixel edges: PGD's own, else of the solids' corners."""
        if self.config.pgd:
            box = torch.cat([xy - flat_maps.reg[..., 9:11], xy + flat_maps.reg[..., 11:13]], -1)
        else:
            box = hull(project(solid_corners(*solids), intrinsic[..., None, :, :]))
        limit = torch.tensor([size[1], size[0]] * 2, dtype=box.dtype, device=box.device)
        box = box - box.new_tensor([0.0, self._rows_above(size)]).repeat(2)
        return (box / self._scale(size, box).repeat(2)).clamp_min(0.0).minimum(limit)

    def _check(self, images: Tensor, intrinsic: Tensor | None) -> tuple[tuple[int, int], Tensor]:
        size = check_images(self.name, images)
        if intrinsic is None or intrinsic.shape != (len(images), 3, 3):
            received = "none" if intrinsic is None else str(list(intrinsic.shape))
            raise ConfigError(f"{self.name}: a 3D detector needs the cameras' intrinsic [B, 3, 3]; got {received}")
        focal = intrinsic[:, [0, 1], [0, 1]]
        # On a GPU this check would wait for all queued work.
        if intrinsic.device.type == "cpu" and not bool(intrinsic.isfinite().all() & (focal > 0).all()):
            raise ConfigError(f"{self.name}: an intrinsic has no focal length above 0, or holds NaN")
        return size, intrinsic.to(images.device, self._dtype())

    def _dtype(self) -> torch.dtype:
        return next(self.parameters()).dtype

    def _scale(self, size: tuple[int, int], template: Tensor) -> Tensor:
        return input_scale(resized_size(size, self.config.input_width), size, template)[:2]

    def _rows_above(self, size: tuple[int, int]) -> int:
        """Return the number of rows added above the resized image, see `Mono3DConfig.trained_width`."""
        trained = self.config.trained_width
        if trained is None or self.config.input_width == trained:
            return 0
        heights = [resized_size(size, width)[0] for width in (trained, self.config.input_width)]
        return round(self.config.horizon * (heights[0] - heights[1])) % MULTIPLE

    def _scale_intrinsic(self, intrinsic: Tensor, size: tuple[int, int], scale: Tensor) -> Tensor:
        """Return the intrinsics in the network's input."""
        if self.config.input_width is None and self.config.trained_width is None:
            return intrinsic
        added = intrinsic.new_tensor([[0.0, 0.0, 0.0], [0.0, 0.0, self._rows_above(size)]])
        return torch.cat([intrinsic[:, :2] * scale[:, None] + added, intrinsic[:, 2:]], 1)

    def _depth_factor(self, intrinsic: Tensor) -> Tensor | None:
        if self.config.virtual_focal is None:
            return None
        return intrinsic[..., 0, 0] / self.config.virtual_focal

    def _rays(self, maps: list[Tensor], intrinsic: Tensor) -> list[Tensor] | None:
        """Return the tangents [B, 2, h, w] of the places of each level, right and down, times 4 (1 at the border)."""
        if not self.config.rays:
            return None
        level_rays = []
        for level_map, stride in zip(maps, self.config.strides, strict=True):
            x, y = (
                stride * (torch.arange(length, device=level_map.device, dtype=intrinsic.dtype) + 0.5)
                for length in (level_map.shape[3], level_map.shape[2])
            )
            right = (x - intrinsic[:, 0, 2:]) / intrinsic[:, 0, :1]
            down = (y - intrinsic[:, 1, 2:]) / intrinsic[:, 1, 1:2]
            shape = (len(level_map), level_map.shape[2], level_map.shape[3])
            level_rays.append(4.0 * torch.stack([right[:, None].expand(shape), down[:, :, None].expand(shape)], 1))
        return level_rays

    def _preprocess(self, images: Tensor) -> Tensor:
        """Normalise images as BGR in 0..255 less the mean, and pad with 0 right, below and above."""
        images = images.to(self._dtype())
        size = (images.shape[2], images.shape[3])
        resized = resized_size(size, self.config.input_width)
        if resized != size:
            is_downscaled = resized[0] < size[0]
            images = functional.interpolate(
                images, resized, mode="bilinear", align_corners=False, antialias=is_downscaled
            )
        mean, std = self.get_buffer("mean"), self.get_buffer("std")
        images = (images.flip(1) * 255 - mean) / std
        rows_above = self._rows_above(size)
        return functional.pad(images, (0, -resized[1] % MULTIPLE, rows_above, -(resized[0] + rows_above) % MULTIPLE))


def _run_lengths(ascending: Tensor) -> tuple[Tensor, list[int]]:
    """Return the distinct values of ascending whole numbers, and the count of each."""
    counts = torch.bincount(ascending)
    values = counts.nonzero()[:, 0]
    return values, counts[values].tolist()


def _head_maps(dense: Dense) -> dict[str, list[Tensor]]:
    return {name: value for name, value in dense.maps.items() if name != "intrinsic"}


def _full_precision(template: Tensor) -> torch.autocast:
    """Disable mixed precision within the block: boxes and losses need all their digits."""
    return torch.autocast(template.device.type, enabled=False)
