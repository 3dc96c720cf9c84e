"""Square attack: random squares that are kept if they raise the loss. It queries losses only."""

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
TILES = 5  # per side of the image, for the start under L2
TRIES = 10  # draws of signs until a square differs from its old value
TINY = 1e-10


@dataclass(frozen=True, slots=True)
class Square:
    """Random search over squares; a proposal is kept if it raises the loss.

    Under L-infinity, a proposal moves one square of the image to the border of the ball; under L2, it moves the mass
    of one square into another.

    Attributes:
        queries: Number of loss queries, including those of the clean image and of the start.
        share: Share of the image that the first squares cover; they shrink by the schedule of the source, stretched
            over `queries`.
        name: Name shown in tables.
        access: Queries losses only.

    Raises:
        ConfigError: Fewer than three queries, or a share outside (0, 1].

    Source: Andriushchenko et al., Square Attack: a query-efficient black-box adversarial attack via random search
    (ECCV 2020), algorithms 1 to 3; for ImageNet it takes a share of 0.05 under L-infinity and of 0.1 under L2.
    """

    queries: int = 1000
    share: float = 0.05
    name: str = "square"
    access: Access = "black-box"

    def __post_init__(self) -> None:
        if self.queries < 3 or not 0.0 < self.share <= 1.0:
            raise ConfigError(f"{self.name}: queries must be 3 or more, share above 0 and at most 1")

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """Search over random squares, starting from stripes (L-infinity) or tiles (L2)."""
        clean = victim.clean
        generators = [victim.generator(key, "square") for key in victim.keys]
        initial_change = _stripes if budget.norm == "linf" else _tiles
        propose = _square if budget.norm == "linf" else _move_mass
        initial_changes = torch.stack(
            [
                initial_change(image_values, image_generator)
                for image_values, image_generator in zip(clean, generators, strict=True)
            ]
        )
        images = budget.to_border(clean, initial_changes)
        best = images, victim.loss(images).float()
        proposal_count = self.queries - 2
        for proposal in range(proposal_count):
            square_side = self.side(
                proposal / proposal_count, clean.shape[2], clean.shape[3], min_side=1 if budget.norm == "linf" else 3
            )
            change = best[0] - clean
            for image_values, image_generator in zip(change, generators, strict=True):
                propose(image_values, square_side, budget.radius, image_generator)
            # A moved mass has the length of the radius before values stop at 0 and 1.
            images = budget.around(clean, change) if budget.norm == "linf" else budget.to_border(clean, change)
            best = keep_best(best, images, victim.loss(images).float())
        # The clean image counts too: an image that no square makes worse is returned as it is.
        return keep_best((clean, victim.loss(clean).float()), *best)[0]

    def side(self, progress: float, height: int, width: int, *, min_side: int = 1) -> int:
        """Return the side of the squares in pixels.

        Args:
            progress: Share of the proposals that have been made.
            height: Height of the image.
            width: Width of the image.
            min_side: The smallest side.
        """
        area = self.share / 2 ** sum(int(progress * 10_000) > halving for halving in HALVINGS)
        return max(min(max(round(math.sqrt(area * height * width)), min_side), min(height, width) - 1), 1)


def _stripes(clean: Tensor, random: np.random.Generator) -> Tensor:
    """Return a change of 1 up or down [3, H, W], the same along each column."""
    signs = random.choice([-1.0, 1.0], (3, 1, clean.shape[2]))
    return torch.from_numpy(signs).to(clean).expand(clean.shape).clone()


def _square(change: Tensor, side: int, radius: float, random: np.random.Generator) -> None:
    """Set one square of a change [3, H, W] to the radius, up or down by channel, other than it was."""
    window = change[_random_window(change, side, random)]
    for _ in range(TRIES):
        signs = torch.from_numpy(random.choice([-1.0, 1.0], (3, 1, 1))).to(change)
        if bool((signs != window.sign()).any()):
            break
    window.copy_((radius * signs).expand_as(window))


def _tiles(clean: Tensor, random: np.random.Generator) -> Tensor:
    """Return bumps side by side [3, H, W], each up or down by channel."""
    height, width = clean.shape[1:]
    tile_side = max(min(height, width) // TILES, 1)
    change = torch.full_like(clean, TINY)
    for top in range(height % tile_side // 2, height - tile_side + 1, tile_side):
        for left in range(width % tile_side // 2, width - tile_side + 1, tile_side):
            change[:, top : top + tile_side, left : left + tile_side] += _bump(tile_side, random).to(clean) * _signs(
                clean, random
            )
    return change


def _move_mass(change: Tensor, side: int, radius: float, random: np.random.Generator) -> None:
    """Empty one window of a change [3, H, W], and add a bump to another.

    The new length of the second window combines the lengths of both windows and what is left of the ball.
    """
    side = min(side + 1 - side % 2, *change.shape[1:])
    target_window, source_window = _random_window(change, side, random), _random_window(change, side, random)
    target_change = change[target_window]
    window_change = torch.zeros_like(change)
    window_change[target_window] = change[target_window]
    window_change[source_window] = change[source_window]
    free_mass = max(radius**2 - float((change**2).sum()), 0.0) / len(change)
    target_length = ((window_change**2).sum((1, 2), keepdim=True) + free_mass).sqrt()
    new_change = _bump(side, random).to(change) * _signs(change, random)
    new_change = new_change + target_change / (TINY + (target_change**2).sum((1, 2), keepdim=True).sqrt())
    change[source_window] = 0.0
    change[target_window] = new_change / (TINY + (new_change**2).sum((1, 2), keepdim=True).sqrt()) * target_length
    change *= radius / (TINY + float((change**2).sum()) ** 0.5)


def _random_window(change: Tensor, side: int, random: np.random.Generator) -> tuple[slice, slice, slice]:
    """Return a random square window of a change [3, H, W]."""
    top = int(random.integers(0, change.shape[1] - side + 1))
    left = int(random.integers(0, change.shape[2] - side + 1))
    return slice(None), slice(top, top + side), slice(left, left + side)


def _signs(template: Tensor, random: np.random.Generator) -> Tensor:
    return torch.from_numpy(random.choice([-1.0, 1.0], (3, 1, 1))).to(template)


def _bump(side: int, random: np.random.Generator) -> Tensor:
    """Return a hill and a hollow [side, side] of length 1, above or beside each other at random."""
    shape = _hill_and_hollow(side)
    return shape.T if random.random() > 0.5 else shape


@lru_cache(maxsize=64)
def _hill_and_hollow(side: int) -> Tensor:
    if side == 1:
        return torch.ones(1, 1)
    shape = torch.cat([_hill(side // 2, side), -_hill(side - side // 2, side)])
    return shape / lengths(shape[None, None])[0, 0]


def _hill(height: int, width: int) -> Tensor:
    """Return nested rectangles [height, width] of length 1; each larger one adds less."""
    shape = torch.zeros(height, width)
    middle = height // 2, width // 2
    for ring in range(max(middle) + 1):
        rows = slice(max(middle[0] - ring, 0), middle[0] + ring + 1)
        columns = slice(max(middle[1] - ring, 0), middle[1] + ring + 1)
        shape[rows, columns] += 1.0 / (ring + 1) ** 2
    return shape / lengths(shape[None, None])[0, 0]
