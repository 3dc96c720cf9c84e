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
from ssad.scenarios.static.physical.lights.light import LightAttack, Target
from ssad.scenarios.static.physical.lights.lit_image import LitPicture
from ssad.scenarios.static.physical.zoom import around_target

TARGET = Aim(objects=(0,))  # the first object of each picture's truth
INERTIA, PULL = 0.7298, 1.4962  # of a swarm that converges (Clerc and Kennedy, IEEE Trans. Evol. Comput. 6, 2002)
FASTEST = 0.3  # of a particle, sides of the space a round
STEPS = (0.2, 0.1, 0.05)  # of the greedy search, one after the other
POWER = ("watts", "lumens")  # settings that say how strong a light is
AT_ONCE = 16  # pictures that a detector gets in one call


@dataclass(frozen=True, slots=True)
class LitView:
    """A picture to search on, and what is in it, the target first."""

    picture: LitPicture
    truth: Truth


@checked_dataclass(frozen=True, slots=True, config=VALUES)
class Budget:
    """How long is searched.

    Attributes:
        settings: How many settings are tried, each on all pictures; gradient descent makes so many steps.
        members: Particles of a swarm; starts of the greedy search and of gradient descent.
        rate: Of gradient descent, in sides of the space.
        window: Side of the square part around the target that the detector is shown, px; None: the whole picture.
        searches: How many searches are made, each from draws of its own and with all `settings`; the best one counts.
    """

    settings: Whole = 120
    members: Whole = 10
    rate: Above = 0.05
    window: Annotated[int, Field(ge=64, multiple_of=32)] | None = 320
    searches: Whole = 1

    @model_validator(mode="after")
    def _enough(self) -> Self:
        if self.members > self.settings:
            raise ValueError(f"members={self.members}: more than the settings that are tried ({self.settings})")
        return self


USUAL = Budget()


@dataclass(slots=True)
class Found:
    """What a search found.

    Attributes:
        values: The best settings, in the units of their names.
        loss: Mean over the pictures of what is ascended, with these settings: log(1 - score times overlap).
        before: The same of the first settings that were tried.
        queries: Pictures that the detector was asked about.
        best: The best loss so far after each batch of settings.
    """

    values: dict[str, float]
    loss: float
    before: float
    queries: int
    best: list[float] = field(default_factory=list)


Ask = Callable[[F64], F64]
"""Settings in the unit cube [N, D] -> the loss of each [N], which is ascended."""


def search_light(
    attack: LightAttack,
    detector: Detector,
    target: Target,
    views: Sequence[LitView],
    *,
    budget: Budget = USUAL,
    search: Literal["swarm", "greedy", "gradient"] | None = None,
    key: tuple[object, ...] = (),
) -> Found:
    """Find the settings of a light under which a target is found worst.

    Args:
        attack: What is searched.
        detector: What is attacked.
        target: Its size.
        views: Pictures to search on.
        budget: How long.
        search: In place of the attack's own.
        key: What all draws come from.

    Raises:
        ConfigError: There are no pictures, or no such search.
    """
    if not views:
        raise ConfigError(f"attack {attack.name}: no pictures to search on")
    how = search or attack.search
    if how not in ("swarm", "greedy", "gradient"):
        raise ConfigError(f"attack {attack.name}: search '{how}'; choose swarm, greedy or gradient")
    ranges = attack.ranges(target)
    asked = [0]

    def loss(points: Tensor) -> Tensor:
        values = {name: low + (high - low) * points[:, k] for k, (name, (low, high)) in enumerate(ranges.items())}
        total = points.new_zeros(len(points))
        for number, view in enumerate(views):
            images, truth = view.picture.show(attack.change(values, view.picture, target)), view.truth
            asked[0] += len(images)
            if budget.window is not None:  # the same part at every call
                place = torch.Generator().manual_seed(int(digest("light window", attack.name, *key, number)[:15], 16))
                images, truth = around_target(images, truth, budget.window, place)
            losses = [_loss(detector, part, truth) for part in torch.split(images, AT_ONCE)]
            total = total + torch.cat(losses).to(total)
        return total / len(views)

    point, best = np.empty(0), list[float]()
    for number in range(budget.searches):
        draws = generator("light search", attack.name, *key, *([number] if number else []))
        with steady(detector):
            if how == "gradient":
                found, losses = _descend(loss, len(ranges), budget, draws)
            else:
                with torch.no_grad():
                    ask: Ask = lambda points: loss(torch.from_numpy(points)).numpy()  # noqa: E731
                    found, losses = (_swarm if how == "swarm" else _greedy)(ask, len(ranges), budget, draws)
        if not best or losses[-1] > best[-1]:
            point = found
        best += [max([*best[-1:], value]) for value in losses]
    values = {
        name: float(low + (high - low) * share)
        for (name, (low, high)), share in zip(ranges.items(), point.tolist(), strict=True)
    }
    return Found(values, best[-1], best[0], asked[0], best)


def random_settings(attack: LightAttack, target: Target, *, key: tuple[object, ...]) -> dict[str, float]:
    """Settings that no search has seen: each uniform over its range, at full power, as a search may have it."""
    draws = generator("random light", attack.name, *key)
    drawn = {name: float(draws.uniform(low, high)) for name, (low, high) in attack.ranges(target).items()}
    return {name: attack.ranges(target)[name][1] if name in POWER else value for name, value in drawn.items()}


def _loss(detector: Detector, images: Tensor, truth: Truth) -> Tensor:
    """What is ascended, of each picture [N]: log(1 - best score times overlap on the target)."""
    dense = detector.dense(images)
    with torch.no_grad():
        assignment = detector.assign(dense, [truth] * len(images))
    return make_objective("hide")(dense, Situation(detector, assignment, TARGET))


def _swarm(ask: Ask, dimensions: int, budget: Budget, draws: np.random.Generator) -> tuple[F64, list[float]]:
    """A particle swarm in the unit cube (Kennedy and Eberhart 1995)."""
    place = draws.random((budget.members, dimensions))
    speed = draws.uniform(-FASTEST, FASTEST, place.shape)
    own, own_loss = place.copy(), ask(place)
    best = [float(own_loss.max())]
    for _ in range(budget.settings // budget.members - 1):
        leader = own[int(own_loss.argmax())]
        pulls = draws.random((2, *place.shape))
        speed = INERTIA * speed + PULL * (pulls[0] * (own - place) + pulls[1] * (leader - place))
        speed = speed.clip(-FASTEST, FASTEST)
        place = place + speed
        out = (place < 0.0) | (place > 1.0)
        place, speed = place.clip(0.0, 1.0), np.where(out, -0.5 * speed, speed)  # it bounces off the walls
        now = ask(place)
        better = now > own_loss
        own[better], own_loss[better] = place[better], now[better]
        best.append(float(own_loss.max()))
    return own[int(own_loss.argmax())], best


def _greedy(ask: Ask, dimensions: int, budget: Budget, draws: np.random.Generator) -> tuple[F64, list[float]]:
    """Random starts; from the best one, one coordinate after the other a step up or down while that helps.

    The greedy search of AdvLB: of its candidates in a coordinate the best is taken if it is better than what was there.
    """
    starts = draws.random((budget.members, dimensions))
    losses = ask(starts)
    point, top = starts[int(losses.argmax())].copy(), float(losses.max())
    best, left = [float(losses[0]), top], budget.settings - budget.members
    for step in STEPS:
        improved = True
        while improved and left >= 2:
            improved = False
            for k in draws.permutation(dimensions).tolist():
                if left < 2:
                    break
                moved = np.stack([point, point])
                moved[:, k] = np.clip(point[k] + np.array([-step, step]), 0.0, 1.0)
                tried = ask(moved)
                left -= 2
                if float(tried.max()) > top:
                    point, top, improved = moved[int(tried.argmax())], float(tried.max()), True
            best.append(top)
    return point, best


def _descend(
    loss: Callable[[Tensor], Tensor], dimensions: int, budget: Budget, draws: np.random.Generator
) -> tuple[F64, list[float]]:
    """Adam from the best of some random starts; a point that leaves the unit cube is put back to its wall."""
    with torch.no_grad():
        starts = torch.from_numpy(draws.random((budget.members, dimensions)))
        first = loss(starts)
    point = starts[int(first.argmax())].clone()[None].requires_grad_()
    kept, top = point.detach().clone(), float(first.max())
    best = [float(first[0]), top]
    optimiser = torch.optim.Adam([point], lr=budget.rate)
    for _ in range(max(budget.settings - budget.members, 0)):
        value = loss(point)
        if float(value.detach()) > top:
            kept, top = point.detach().clone(), float(value.detach())
        optimiser.zero_grad()
        torch.autograd.backward(-value.sum())
        assert point.grad is not None
        point.grad.nan_to_num_()
        optimiser.step()
        with torch.no_grad():
            point.clamp_(0.0, 1.0)
        best.append(top)
    return np.asarray(kept[0].numpy(), np.float64), best
