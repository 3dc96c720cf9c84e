"""Training of a dirty road patch against the lane keeper, through a differentiable copy of its loop.

The copy renders the road from above (lines, asphalt and patch as the camera resolves them), detects and filters the
lane as `ssad.drivers.lane_keeping` does, and drives a kinematic bicycle with its pure pursuit. So the deviation
after the patch has a gradient with respect to each of its texels, as in the motion model of Sato et al. (USENIX
Security 2021).

    python -m ssad.training.road_patch --out patch
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ssad.core.seeding import generator
from ssad.drivers.lane_keeping.control import PREVIEW
from ssad.drivers.lane_keeping.lane import CHANGE, FITS, FULL_WEIGHT, INITIAL, NOISE, NOISE_STEP, STEP
from ssad.drivers.lane_keeping.markings import CONTRAST, FULL_CONTRAST, SIDE, RoadGrid
from ssad.rendering.camera.texture import to_srgb
from ssad.scenarios.static.physical.street.dirty_road import ASPHALT_ALBEDO, CELL, COVERING_WIDTH, DIRT, LENGTH
from ssad.scenarios.static.physical.textures.card import TextureCard, save_texture

LINE_ALBEDO = 0.72
LINE_WIDTH = 0.12  # m
DASH, PERIOD = 3.0, 9.0  # m
EXPOSURE = 0.78  # code value over albedo, both linear
FOOTPRINT = 1.0 / 764.0  # 1/m: length of the road in a pixel row over the square of its distance
MAX_GAIN = 2.5  # m of deviation beyond which more earns nothing: the lane is left in any case
COARSE = RoadGrid(half_width=4.0, row_step=1.0)
LANE_WIDTH = 3.5  # m
LATENCY = 0.35  # s with which the wheels follow, as a lag of first order


@dataclass(frozen=True, slots=True)
class RoadApproach:
    """Drive over a straight road towards the patch.

    Attributes:
        speed: m/s.
        offset: Place of the ego at the start, m to the left of the middle of the lane.
        width: Width of the lane, m.
        phase: m by which the dashes of the left line are shifted.
        is_solid: Whether the left line is solid.
        gain: Brightness, 1 for that of noon.
    """

    speed: float
    offset: float
    width: float
    phase: float
    is_solid: bool
    gain: float


def draw_approaches(count: int, *, key: tuple[object, ...]) -> list[RoadApproach]:
    """Return random approaches."""
    random = generator("road patch", *key)
    return [
        RoadApproach(
            float(random.uniform(11.0, 24.0)),
            float(random.uniform(-0.15, 0.15)),
            float(random.uniform(3.4, 3.8)),
            float(random.uniform(0.0, PERIOD)),
            bool(random.random() < 0.3),
            float(random.uniform(0.7, 1.2)),
        )
        for _ in range(count)
    ]


def road_brightness(patch: Tensor, grid: RoadGrid, approach: RoadApproach, pose: Tensor) -> Tensor:
    """Return the brightness of the road as the lane keeper sees it from above, code values [R, C].

    Args:
        patch: Albedo [H, W], rows from the far edge to the near one; its middle lies at x = 0.
        grid: Top view of the lane keeper.
        approach: The drive.
        pose: Ego's x, y and yaw on the road [3]; y = 0 is the middle of the lane.
    """
    ahead, lateral = (torch.from_numpy(values).float() for values in (grid.row_distance, grid.column_offset))
    albedo_sum = torch.zeros(len(ahead), len(lateral))
    patch_width = patch.shape[1] * CELL[1]
    footprint_shares = (-0.35, 0.0, 0.35)
    for footprint_share in footprint_shares:
        # A pixel averages over its footprint along the road.
        distance_ahead = (ahead + footprint_share * FOOTPRINT * ahead**2)[:, None]
        place_along = pose[0] + distance_ahead * torch.cos(pose[2]) - lateral * torch.sin(pose[2])
        place_across = pose[1] + distance_ahead * torch.sin(pose[2]) + lateral * torch.cos(pose[2])
        line_blur = 0.5 * (LINE_WIDTH + distance_ahead / 506.0)
        right_line = (
            (0.5 * LINE_WIDTH + line_blur - (place_across + 0.5 * approach.width - 0.1).abs()) / (2.0 * line_blur)
        ).clamp(0.0, 1.0)
        left_line = (
            (0.5 * LINE_WIDTH + line_blur - (place_across - 0.5 * approach.width).abs()) / (2.0 * line_blur)
        ).clamp(0.0, 1.0)
        if not approach.is_solid:
            left_line = left_line * (((place_along + approach.phase) % PERIOD) < DASH)
        texture_column, texture_row = -2.0 * place_across / patch_width, -2.0 * place_along / LENGTH
        patch_albedo = functional.grid_sample(
            patch[None, None],
            torch.stack([texture_column, texture_row], -1)[None],
            align_corners=False,
            padding_mode="border",
        )[0, 0]
        is_patch = (texture_column.abs() < 1.0) & (texture_row.abs() < 1.0)
        ground_albedo = torch.where(is_patch, patch_albedo, torch.full_like(patch_albedo, ASPHALT_ALBEDO))
        line_share = (left_line + right_line).clamp(0.0, 1.0)
        line_share = torch.where(is_patch, torch.zeros_like(line_share), line_share)  # the patch covers lines
        albedo_sum = albedo_sum + ground_albedo * (1.0 - line_share) + LINE_ALBEDO * line_share
    return 255.0 * to_srgb((albedo_sum / len(footprint_shares) * EXPOSURE * approach.gain).clamp(1e-4, 1.0))


def marking_strength(brightness: Tensor, grid: RoadGrid) -> Tensor:
    """Return `ssad.drivers.lane_keeping.markings.marking_strength`, differentiable."""
    shift = max(1, round(SIDE / grid.column_step))
    inner = brightness[:, shift:-shift]
    sides = torch.maximum(brightness[:, : -2 * shift], brightness[:, 2 * shift :])
    contrast = (inner - sides) / brightness.mean(1, keepdim=True)
    strength = (contrast - CONTRAST) / (FULL_CONTRAST - CONTRAST)
    return functional.pad(strength.clamp(0.0, 1.0), (shift, shift))


class LaneModel:
    """Differentiable copy of `ssad.drivers.lane_keeping.lane.LaneFilter`, which is always sure of its markings.

    Args:
        grid: Top view.
        width: Width of the lane at the start, m.
        offset: Place of its middle at the start, m to the left of the ego.
    """

    def __init__(self, grid: RoadGrid, *, width: float, offset: float = 0.0) -> None:
        self.grid = grid
        self.state = torch.tensor([offset, 0.0, 0.0, width], dtype=torch.float32)
        self.covariance = torch.diag(torch.tensor(INITIAL).square())
        ahead = torch.from_numpy(grid.row_distance).float()
        ones = torch.ones_like(ahead)
        left = torch.stack([ones, ahead, 0.5 * ahead**2, 0.5 * ones], 1)
        self._designs = (left, left * torch.tensor([1.0, 1.0, 1.0, -1.0]))
        self._row_weight = (FULL_WEIGHT / ahead).clamp(max=1.0).square() * grid.row_step / NOISE_STEP
        self._ahead, self._lateral = ahead, torch.from_numpy(grid.column_offset).float()

    def predict(self, forward: Tensor, turn: Tensor) -> None:
        """Move the lane by the motion of the ego in a step."""
        zero, unit = torch.zeros(()), torch.ones(())
        motion = torch.stack(
            [
                torch.stack([unit, forward, 0.5 * forward**2, zero]),
                torch.stack([zero, unit, forward, zero]),
                torch.tensor([0.0, 0.0, 1.0, 0.0]),
                torch.tensor([0.0, 0.0, 0.0, 1.0]),
            ]
        )
        change = torch.stack([-0.5 * forward * turn, -turn, zero, zero])
        self.state = motion @ self.state + change
        self.covariance = motion @ self.covariance @ motion.T + torch.diag(torch.tensor(CHANGE).square())

    def correct(self, strength: Tensor) -> None:
        """Correct the lane with markings [R, C]."""
        prior, prior_information = self.state, torch.linalg.inv(self.covariance)
        information = prior_information
        for reach, window in FITS:
            information, pull = prior_information, prior_information @ prior
            for design in self._designs:
                line = design @ self.state
                offsets = self._lateral[None] - line[:, None]
                inside = strength * (offsets.abs() <= window)
                total = inside.sum(1)
                place = line + (inside * offsets).sum(1) / total.clamp(min=1e-9)
                weight = (total * self.grid.column_step / 0.1).clamp(0.0, 1.0) * (self._ahead <= reach)
                precision = weight * self._row_weight / NOISE**2
                information = information + (design * precision[:, None]).T @ design
                pull = pull + design.T @ (precision * place)
            self.state = torch.linalg.solve(information, pull)
        covariance = torch.linalg.inv(information)
        self.covariance = 0.5 * (covariance + covariance.T)


def deviation(patch: Tensor, approach: RoadApproach, grid: RoadGrid, *, seconds: float = 2.5) -> Tensor:
    """Return the place of the ego beside the middle of its lane at each step of a drive over the patch [T], m.

    Args:
        patch: Albedo [H, W].
        approach: The drive; it begins where the patch comes into view.
        grid: Top view of the lane keeper.
        seconds: Length of the drive after the ego has reached the patch.
    """
    speed = torch.tensor(approach.speed)
    start = -0.5 * LENGTH - grid.far
    pose = torch.tensor([start, approach.offset, 0.0])
    lane = LaneModel(grid, width=approach.width - 0.1, offset=-approach.offset)
    curvature, turn, places = torch.zeros(()), torch.zeros(()), []
    for step in range(round((grid.far / approach.speed + seconds) / STEP)):
        if step:
            lane.predict(speed * STEP, turn)
        lane.correct(marking_strength(road_brightness(patch, grid, approach, pose), grid))
        distance = PREVIEW[0] + PREVIEW[1] * speed
        lateral = lane.state[0] + lane.state[1] * distance + 0.5 * lane.state[2] * distance**2
        target_curvature = 2.0 * lateral / (distance**2 + lateral**2)
        curvature = curvature + (target_curvature - curvature) * (1.0 - np.exp(-STEP / LATENCY))
        turn = curvature * speed * STEP
        middle = pose[2] + 0.5 * turn
        move = torch.stack([speed * STEP * torch.cos(middle), speed * STEP * torch.sin(middle), turn])
        pose = pose + move
        places.append(pose[1])
    return torch.stack(places)


def start_patch(width: float, *, shift: float, seed: int) -> Tensor:
    """Return the patch that a training starts with, as shares of the range of dirt [H, W]: faint lines that drift.

    Two lines as far apart as those of a lane, or one at the edge where there is no room for two, move to the left over
    the length of the patch; with noise, as a patch without any line has no gradient.

    Args:
        width: m across the road.
        shift: m to the left from the near edge to the far one.
        seed: Seed of the noise.
    """
    rows, columns = round(LENGTH / CELL[0]), round(width / CELL[1])
    lateral = 0.5 * width - CELL[1] * (torch.arange(columns) + 0.5)
    share = 1.0 - (torch.arange(rows) + 0.5)[:, None] / rows
    places = (-1.7, 1.75) if width > LANE_WIDTH else (-0.5 * width + 0.1,)
    lines = torch.stack([((lateral - place - shift * share).abs() < 0.1).float() for place in places]).amax(0)
    noise = generator("road patch start", seed).uniform(-0.1, 0.1, (rows, columns))
    return 0.3 + 0.45 * lines + torch.from_numpy(noise.astype(np.float32))


def train_road_patch(
    *,
    width: float = COVERING_WIDTH,
    steps: int = 40,
    batch: int = 2,
    rate: float = 0.04,
    stealth: float = 6.0,
    side: float = 1.0,
    seed: int = 0,
    report: bool = False,
    grid: RoadGrid = COARSE,
) -> tuple[Tensor, list[float]]:
    """Return the albedo [H, W] of a patch that leads the lane keeper out of its lane, and the deviations, m.

    Args:
        width: m across the road.
        steps: Steps of Adam.
        batch: Approaches of each step.
        rate: Learning rate, in shares of the range of dirt.
        stealth: Weight of the mean distance from the grey of the road, m per unit of albedo.
        side: 1: to the left; -1: to the right.
        seed: Seed of the approaches and of the first patch.
        report: Whether each fifth step is printed.
        grid: Top view of the lane keeper, coarser than its own.
    """
    share = start_patch(width, shift=1.6 * side, seed=seed).clamp(0.0, 1.0).requires_grad_()
    optimiser = torch.optim.Adam([share], lr=rate)
    history = []
    for step in range(steps):
        patch = DIRT[0] + (DIRT[1] - DIRT[0]) * share
        places = [deviation(patch, approach, grid) for approach in draw_approaches(batch, key=(seed, step))]
        # The mean over the drive rewards an early deviation.
        gain = torch.stack([(side * (0.5 * drive[-1] + 0.5 * drive.mean())).clamp(max=MAX_GAIN) for drive in places])
        loss = stealth * (patch - ASPHALT_ALBEDO).abs().mean() - gain.mean()
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        assert share.grad is not None
        share.grad.nan_to_num_()
        optimiser.step()
        with torch.no_grad():
            share.clamp_(0.0, 1.0)
        history.append(float(torch.stack([drive.detach()[-1] for drive in places]).mean()) * side)
        if report and step % 5 == 0:
            print(f"step {step}: {history[-1]:+.2f} m", flush=True)
    return DIRT[0] + (DIRT[1] - DIRT[0]) * share.detach(), history


def main(arguments: Sequence[str] | None = None) -> None:
    """Train a patch and write its card."""
    parser = argparse.ArgumentParser(description="Train a dirty road patch against the lane keeper.")
    parser.add_argument("--out", required=True, help="path of the card and the picture, without a suffix")
    parser.add_argument("--width", type=float, default=COVERING_WIDTH, help="m across the road")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    patch, history = train_road_patch(width=options.width, steps=options.steps, seed=options.seed, report=True)
    picture = (255.0 * to_srgb(patch)).round().clamp(0, 255).byte().numpy()
    card = TextureCard(
        attack="dirty-road",
        carrier="street",
        options={"length": LENGTH, "width": options.width},
        source="lane-keeper",
        weights="",
        target="road",
        data="straight roads of the differentiable copy of its loop",
        command=f"python -m ssad.training.road_patch --width {options.width:g} --steps {options.steps} "
        f"--seed {options.seed}",
        epochs=options.steps,
        metrics={"deviation": float(np.mean(history[-10:]))},
    )
    save_texture(Path(options.out), np.repeat(picture[..., None], 3, axis=2), card)


if __name__ == "__main__":
    main()
