"""A defence before a detector: paler colours."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Grey:
    """Mixes each pixel with its mean over the channels.

    Attributes:
        share: Share of grey; in a suite `defence: {name: example-grey, options: {share: 0.5}}`.
        smooth: True if gradients agree with finite differences, which rounding or chance would prevent.
    """

    share: float = 0.8
    smooth: bool = True

    @property
    def name(self) -> str:
        """Name in tables."""
        return f"grey-{self.share:g}"

    def __call__(self, images: Tensor) -> Tensor:
        """Return images [B, 3, H, W] in [0, 1] of the same shape; nothing in them moves."""
        return (1 - self.share) * images + self.share * images.mean(1, keepdim=True)
