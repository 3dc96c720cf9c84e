"""A loss that attacks ascend: it lowers the best scores of an image."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ssad.core.detections import Dense
from ssad.scenarios.static.digital.objectives import Situation, log_scores


@dataclass(frozen=True)
class TopScores:
    """Minus the mean log-score of the best places of an image.

    Attributes:
        places: Number of best places; in a suite `loss: example-top?places=50`.
        name: Name in records.
        needs_objects: True if an image without objects has nothing to ascend.
    """

    places: int = 20
    name: str = "example-top"
    needs_objects: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """Return one value per image [B], higher where the detector does worse."""
        best = log_scores(dense).amax(-1)
        return -best.topk(min(self.places, best.shape[1]), dim=1).values.mean(1)
