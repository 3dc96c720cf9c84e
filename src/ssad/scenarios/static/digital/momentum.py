"""Momentum iterative method: PGD from the clean image with accumulated directions."""

from __future__ import annotations

from ssad.scenarios.static.digital.pgd import PGD, Start


def momentum(
    *, steps: int = 10, decay: float = 1.0, step: float | None = None, start: Start = "none", restarts: int = 0
) -> PGD:
    """Return MI-FGSM.

    Args:
        steps: Gradient steps.
        decay: Decay of the sum of directions.
        step: Length of all steps as a share of the radius; None: 2.5 / steps, as for PGD. The source takes 1 / steps,
            made for transfer: an image whose direction turns once then ends inside the ball, and after 8-bit rounding
            the attack is much weaker than PGD on the detector itself.
        start: Position of the first start.
        restarts: Further random starts.

    Source: Dong et al., Boosting Adversarial Attacks with Momentum (CVPR 2018).
    """
    return PGD(steps, step=step, schedule="constant", start=start, restarts=restarts, decay=decay, name="momentum")
