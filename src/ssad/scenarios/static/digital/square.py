"""Square attack: random squares, of which those that raise the loss stay. It asks for losses only."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.scenarios.static.digital.attack import Access, keep_best
from ssad.scenarios.static.digital.budget import Budget, lengths
from ssad.scenarios.static.digital.victim import Victim

HALVINGS = (10, 50, 200, 500, 1000, 2000, 4000, 6000, 8000)
"""After how many of 10,000 proposals the area of the squares is halved once more."""
TILES = 5  # of a side, from which L2 starts
TRIES = 10  # draws of signs until a square differs from what is there
TINY = 1e-10


@dataclass(frozen=True, slots=True)
class Square:
    """Random search over squares; a proposal is kept if it raises the loss.

    Under L-infinity, a proposal moves one square of the image to the border of the ball; under L2, it moves the mass of
    one square into another.

    Attributes:
        queries: Number of losses asked for, including those of the clean image and of the start.
        share: Share of the image that the first squares cover; they shrink by the schedule of the source, stretched
            over `queries`.
        name: What tables call it.
        access: It asks only for losses.

    Raises:
        ConfigError: Fewer than three queries, or a share outside (0, 1].

    Source: Andriushchenko et al., Square Attack: a query-efficient black-box adversarial attack via random search (ECCV
    2020), algorithms 1 to 3; for ImageNet it takes a share of 0.05 under L-infinity and of 0.1 under L2.
    """

    queries: int = 1000
    share: float = 0.05
    name: str = "square"
    access: Access = "black-box"

    def __post_init__(self) -> None:
        if self.queries < 3 or not 0.0 < self.share <= 1.0:
            raise ConfigError(f"{self.name}: queries must be 3 or more, share above 0 and at most 1")

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """See `Attack`."""
        clean = victim.clean
        chances = [victim.generator(key, "square") for key in victim.keys]
        start = _stripes if budget.norm == "linf" else _tiles
        propose = _square if budget.norm == "linf" else _moved
        first = torch.stack([start(one, chance) for one, chance in zip(clean, chances, strict=True)])
        change = budget.radius * (first if budget.norm == "linf" else first / lengths(first))
        images = budget.project(clean + change, clean)
        kept = images, victim.loss(images).float()
        proposals = self.queries - 2
        for k in range(proposals):
            side = self.side(k / proposals, clean.shape[2], clean.shape[3], least=1 if budget.norm == "linf" else 3)
            change = kept[0] - clean
            for one, chance in zip(change, chances, strict=True):
                propose(one, side, budget.radius, chance)
            images = budget.project(clean + change, clean)
            kept = keep_best(kept, images, victim.loss(images).float())
        return keep_best((clean, victim.loss(clean).float()), *kept)[0]

    def side(self, done: float, height: int, width: int, *, least: int = 1) -> int:
        """Side of the squares in pixels.

        Args:
            done: Share of the proposals that have been made.
            height: Of the image.
            width: Of the image.
            least: The smallest side.
        """
        area = self.share / 2 ** sum(int(done * 10_000) > mark for mark in HALVINGS)
        return max(min(max(round(math.sqrt(area * height * width)), least), min(height, width) - 1), 1)


def _stripes(clean: Tensor, chance: np.random.Generator) -> Tensor:
    """A change of 1 up or down [3, H, W], the same along each column."""
    signs = chance.choice([-1.0, 1.0], (3, 1, clean.shape[2]))
    return torch.from_numpy(signs).to(clean).expand(clean.shape).clone()


def _square(change: Tensor, side: int, radius: float, chance: np.random.Generator) -> None:
    """Sets one square of a change [3, H, W] to the radius, up or down by channel, other than it was."""
    window = change[_place(change, side, chance)]
    for _ in range(TRIES):
        signs = torch.from_numpy(chance.choice([-1.0, 1.0], (3, 1, 1))).to(change)
        if bool((signs != window.sign()).any()):
            break
    window.copy_((radius * signs).expand_as(window))


def _tiles(clean: Tensor, chance: np.random.Generator) -> Tensor:
    """Bumps side by side [3, H, W], each up or down by channel."""
    height, width = clean.shape[1:]
    side = max(min(height, width) // TILES, 1)
    change = torch.full_like(clean, TINY)
    for top in range(height % side // 2, height - side + 1, side):
        for left in range(width % side // 2, width - side + 1, side):
            change[:, top : top + side, left : left + side] += _bump(side, chance).to(clean) * _signs(clean, chance)
    return change


def _moved(change: Tensor, side: int, radius: float, chance: np.random.Generator) -> None:
    """Empty one window of a change [3, H, W], and add a bump to another.

    The new length of the second window combines the lengths of both windows and what is left of the ball.
    """
    side = min(side + 1 - side % 2, *change.shape[1:])
    taking, giving = _place(change, side, chance), _place(change, side, chance)
    window = change[taking]
    either = torch.zeros_like(change)
    either[taking] = change[taking]
    either[giving] = change[giving]
    left = max(radius**2 - float((change**2).sum()), 0.0) / len(change)
    room = ((either**2).sum((1, 2), keepdim=True) + left).sqrt()
    fresh = _bump(side, chance).to(change) * _signs(change, chance)
    fresh = fresh + window / (TINY + (window**2).sum((1, 2), keepdim=True).sqrt())
    change[giving] = 0.0
    change[taking] = fresh / (TINY + (fresh**2).sum((1, 2), keepdim=True).sqrt()) * room
    change *= radius / (TINY + float((change**2).sum()) ** 0.5)


def _place(change: Tensor, side: int, chance: np.random.Generator) -> tuple[slice, slice, slice]:
    """A square window of a change [3, H, W] at random."""
    top = int(chance.integers(0, change.shape[1] - side + 1))
    left = int(chance.integers(0, change.shape[2] - side + 1))
    return slice(None), slice(top, top + side), slice(left, left + side)


def _signs(like: Tensor, chance: np.random.Generator) -> Tensor:
    return torch.from_numpy(chance.choice([-1.0, 1.0], (3, 1, 1))).to(like)


def _bump(side: int, chance: np.random.Generator) -> Tensor:
    """A hill and a hollow side by side [side, side] of length 1, above each other or beside each other at random."""
    shape = _hill_and_hollow(side)
    return shape.T if chance.random() > 0.5 else shape


@lru_cache(maxsize=64)
def _hill_and_hollow(side: int) -> Tensor:
    if side == 1:
        return torch.ones(1, 1)
    shape = torch.cat([_hill(side // 2, side), -_hill(side - side // 2, side)])
    return shape / lengths(shape[None, None])[0, 0]


def _hill(height: int, width: int) -> Tensor:
    """Rectangles [height, width] around the middle, each larger and lower than the last; of length 1."""
    shape = torch.zeros(height, width)
    middle = height // 2, width // 2
    for k in range(max(middle) + 1):
        rows = slice(max(middle[0] - k, 0), middle[0] + k + 1)
        columns = slice(max(middle[1] - k, 0), middle[1] + k + 1)
        shape[rows, columns] += 1.0 / (k + 1) ** 2
    return shape / lengths(shape[None, None])[0, 0]
