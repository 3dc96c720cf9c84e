"""Careful drivers: the models by which regulators judge whether a collision was avoidable."""

from ssad.drivers.careful.encounter import Encounter
from ssad.drivers.careful.models import MODELS, CarefulModel, careful_model, react

__all__ = ["MODELS", "CarefulModel", "Encounter", "careful_model", "react"]
