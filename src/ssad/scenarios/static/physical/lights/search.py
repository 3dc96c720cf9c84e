"""Searches for the settings of a light: a swarm, a greedy search, gradient descent. All ask in batches, and count."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal, Self

import numpy as np
import torch
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass as checked_dataclass
from torch import Tensor

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError
from ssad.core.protocols import Detector
from ssad.core.schema import VALUES, Above, Whole
from ssad.core.seeding import digest, generator
from ssad.core.types import F64
from ssad.scenarios.static.digital.objectives import Aim, Situation, make_objective
from ssad.scenarios.static.digital.victim import steady
from ssad.scenarios.static.physical.lights.light import LightAttack, TargetSize
from ssad.scenarios.static.physical.lights.lit_image import LitImage
from ssad.scenarios.static.physical.zoom import around_target

TARGET = Aim(objects=(0,))  # the target is the first object of each image's truth
INERTIA, PULL = 0.7298, 1.4962  # of a swarm that converges (Clerc and Kennedy, IEEE Trans. Evol. Comput. 6, 2002)
MAX_SPEED = 0.3  # maximum speed of a particle, sides of the space per round
STEPS = (0.2, 0.1, 0.05)  # step sizes of the greedy search, one after the other
POWER = ("watts", "lumens")  # settings that determine the strength of a light
BATCH = 16  # images per call of a detector


@dataclass(frozen=True, slots=True)
class SearchView:
    """Image to search on, and its ground truth, the target first."""

    picture: LitImage
    truth: Truth


@checked_dataclass(frozen=True, slots=True, config=VALUES)
class SearchBudget:
    """Budget of a search.

    Attributes:
        settings: Number of settings to try, each on all images; for gradient descent the number of steps.
        members: Particles of a swarm; starts of the greedy search and of gradient descent.
        rate: Learning rate of gradient descent, in sides of the space.
        window: Side of the square crop around the target for the detector, px; None: the whole image.
        searches: Number of searches, each with its own draws and all `settings`; the best one counts.
    """

    settings: Whole = 120
    members: Whole = 10
    rate: Above = 0.05
    window: Annotated[int, Field(ge=64, multiple_of=32)] | None = 320
    searches: Whole = 1

    @model_validator(mode="after")
    def _check_members(self) -> Self:
        if self.members > self.settings:
            raise ValueError(f"members={self.members}: more than the settings that are tried ({self.settings})")
        return self


USUAL = SearchBudget()


@dataclass(slots=True)
class LightSearchResult:
    """Result of a search.

    Attributes:
        values: Best settings, in the units of their names.
        loss: Mean of the ascended loss over the images, with these settings: log(1 - score times overlap).
        before: Mean loss of the first settings.
        queries: Number of images shown to the detector.
        best: Best loss so far after each batch of settings.
    """

    values: dict[str, float]
    loss: float
    before: float
    queries: int
    best: list[float] = field(default_factory=list)


LossFunction = Callable[[F64], F64]
"""Settings in the unit cube [N, D] -> the loss of each [N], which is ascended."""


def search_light(
    attack: LightAttack,
    detector: Detector,
    target: TargetSize,
    views: Sequence[SearchView],
    *,
    budget: SearchBudget = USUAL,
    search: Literal["swarm", "greedy", "gradient"] | None = None,
    key: tuple[object, ...] = (),
) -> LightSearchResult:
    """Search for the settings of a light under which a target is detected worst.

    Args:
        attack: Light attack to search.
        detector: Detector under attack.
        target: Size of the target.
        views: Images to search on.
        budget: Budget of the search.
        search: Search method; None: the attack's own.
        key: Key of all random draws.

    Raises:
        ConfigError: There are no images, or there is no such search.
    """
    if not views:
        raise ConfigError(f"attack {attack.name}: no pictures to search on")
    method = search or attack.search
    if method not in ("swarm", "greedy", "gradient"):
        raise ConfigError(f"attack {attack.name}: search '{method}'; choose swarm, greedy or gradient")
    ranges = attack.ranges(target)
    query_count = [0]

    def loss(points: Tensor) -> Tensor:
        values = {
            name: lowest + (highest - lowest) * points[:, column]
            for column, (name, (lowest, highest)) in enumerate(ranges.items())
        }
        total = points.new_zeros(len(points))
        for view_index, view in enumerate(views):
            images, truth = view.picture.show(attack.change(values, view.picture, target)), view.truth
            query_count[0] += len(images)
            if budget.window is not None:  # the same crop at every call
                crop_generator = torch.Generator().manual_seed(
                    int(digest("light window", attack.name, *key, view_index)[:15], 16)
                )
                images, truth = around_target(images, truth, budget.window, crop_generator)
            losses = [_loss(detector, batch_images, truth) for batch_images in torch.split(images, BATCH)]
            total = total + torch.cat(losses).to(total)
        return total / len(views)

    best_point, best_losses = np.empty(0), list[float]()
    for search_index in range(budget.searches):
        random = generator("light search", attack.name, *key, *([search_index] if search_index else []))
        with steady(detector):
            if method == "gradient":
                candidate, losses = _descend(loss, len(ranges), budget, random)
            else:
                with torch.no_grad():
                    loss_function: LossFunction = lambda settings: loss(torch.from_numpy(settings)).numpy()  # noqa: E731
                    candidate, losses = (_swarm if method == "swarm" else _greedy)(
                        loss_function, len(ranges), budget, random
                    )
        if not best_losses or losses[-1] > best_losses[-1]:
            best_point = candidate
        # The history continues over all searches and never falls.
        best_losses += [max([*best_losses[-1:], value]) for value in losses]
    values = {
        name: float(lowest + (highest - lowest) * share)
        for (name, (lowest, highest)), share in zip(ranges.items(), best_point.tolist(), strict=True)
    }
    return LightSearchResult(values, best_losses[-1], best_losses[0], query_count[0], best_losses)


def random_settings(attack: LightAttack, target: TargetSize, *, key: tuple[object, ...]) -> dict[str, float]:
    """Draw settings uniformly over their ranges, at full power, the strongest that a search can choose."""
    random = generator("random light", attack.name, *key)
    values = {name: float(random.uniform(lowest, highest)) for name, (lowest, highest) in attack.ranges(target).items()}
    return {name: attack.ranges(target)[name][1] if name in POWER else value for name, value in values.items()}


def _loss(detector: Detector, images: Tensor, truth: Truth) -> Tensor:
    """Return the ascended loss of each image [N]: log(1 - best score times overlap on the target)."""
    dense = detector.dense(images)
    with torch.no_grad():
        assignment = detector.assign(dense, [truth] * len(images))
    return make_objective("hide")(dense, Situation(detector, assignment, TARGET))


def _swarm(
    loss_function: LossFunction, dimensions: int, budget: SearchBudget, random: np.random.Generator
) -> tuple[F64, list[float]]:
    """Run a particle swarm in the unit cube (Kennedy and Eberhart 1995)."""
    positions = random.random((budget.members, dimensions))
    velocities = random.uniform(-MAX_SPEED, MAX_SPEED, positions.shape)
    personal_best, personal_loss = positions.copy(), loss_function(positions)
    best_losses = [float(personal_loss.max())]
    for _ in range(budget.settings // budget.members - 1):
        leader = personal_best[int(personal_loss.argmax())]
        weights = random.random((2, *positions.shape))
        velocities = INERTIA * velocities + PULL * (
            weights[0] * (personal_best - positions) + weights[1] * (leader - positions)
        )
        velocities = velocities.clip(-MAX_SPEED, MAX_SPEED)
        positions = positions + velocities
        is_outside = (positions < 0.0) | (positions > 1.0)
        positions, velocities = (
            positions.clip(0.0, 1.0),
            np.where(is_outside, -0.5 * velocities, velocities),
        )  # it bounces off the walls
        losses = loss_function(positions)
        improved = losses > personal_loss
        personal_best[improved], personal_loss[improved] = positions[improved], losses[improved]
        best_losses.append(float(personal_loss.max()))
    return personal_best[int(personal_loss.argmax())], best_losses


def _greedy(
    loss_function: LossFunction, dimensions: int, budget: SearchBudget, random: np.random.Generator
) -> tuple[F64, list[float]]:
    """Step from the best of some random starts, one coordinate after the other, while that helps.

    The greedy search of AdvLB: of its candidates in a coordinate the best is taken if it is better than what was there.
    """
    initial_points = random.random((budget.members, dimensions))
    losses = loss_function(initial_points)
    point, best_loss = initial_points[int(losses.argmax())].copy(), float(losses.max())
    best_losses, remaining = [float(losses[0]), best_loss], budget.settings - budget.members
    for step in STEPS:
        improved = True
        while improved and remaining >= 2:
            improved = False
            for axis in random.permutation(dimensions).tolist():
                if remaining < 2:
                    break
                candidates = np.stack([point, point])
                candidates[:, axis] = np.clip(point[axis] + np.array([-step, step]), 0.0, 1.0)
                candidate_losses = loss_function(candidates)
                remaining -= 2
                if float(candidate_losses.max()) > best_loss:
                    point, best_loss, improved = (
                        candidates[int(candidate_losses.argmax())],
                        float(candidate_losses.max()),
                        True,
                    )
            best_losses.append(best_loss)
    return point, best_losses


def _descend(
    loss: Callable[[Tensor], Tensor], dimensions: int, budget: SearchBudget, random: np.random.Generator
) -> tuple[F64, list[float]]:
    """Run Adam from the best of some random starts, with points clipped to the unit cube."""
    with torch.no_grad():
        initial_points = torch.from_numpy(random.random((budget.members, dimensions)))
        initial_losses = loss(initial_points)
    point = initial_points[int(initial_losses.argmax())].clone()[None].requires_grad_()
    best_point, best_loss = point.detach().clone(), float(initial_losses.max())
    best_losses = [float(initial_losses[0]), best_loss]
    optimiser = torch.optim.Adam([point], lr=budget.rate)
    for _ in range(max(budget.settings - budget.members, 0)):
        value = loss(point)
        if float(value.detach()) > best_loss:
            best_point, best_loss = point.detach().clone(), float(value.detach())
        optimiser.zero_grad()
        torch.autograd.backward(-value.sum())
        assert point.grad is not None
        point.grad.nan_to_num_()
        optimiser.step()
        with torch.no_grad():
            point.clamp_(0.0, 1.0)
        best_losses.append(best_loss)
    return np.asarray(best_point[0].numpy(), np.float64), best_losses
