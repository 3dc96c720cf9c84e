"""A distribution shift: haze that lightens the images."""

from __future__ import annotations

from typing import Any

import numpy as np


class Haze:
    """Fades every image to white.

    Args:
        severity: 1 to 5; suites of kind `detection` need a class with this argument.
        share: Share of white at severity 1; in a suite `{example-haze: {share: 0.1}}`.
    """

    def __init__(self, severity: int = 3, share: float = 0.12) -> None:
        self.share = share * severity

    def shift(self, images: Any, frames: Any, generators: Any) -> Any:
        """Return the images uint8 [N, H, W, 3], faded; `frames` has camera, depth and boxes of each."""
        return (images + self.share * (255.0 - images)).round().astype(np.uint8)
