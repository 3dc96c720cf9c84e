"""Momentum iterative method: PGD from the clean image with accumulated directions."""

from __future__ import annotations

from ssad.scenarios.static.digital.pgd import PGD, Start


def momentum(*, steps: int = 10, decay: float = 1.0, start: Start = "none", restarts: int = 0) -> PGD:
    """Return MI-FGSM.

    Args:
        steps: Gradient steps.
        decay: Decay of the sum of directions.
        start: Position of the first start.
        restarts: Further random starts.

    Source: Dong et al., Boosting Adversarial Attacks with Momentum (CVPR 2018); it takes constant steps of radius
    over steps.
    """
    return PGD(
        steps, step=1.0 / steps, schedule="constant", start=start, restarts=restarts, decay=decay, name="momentum"
    )
