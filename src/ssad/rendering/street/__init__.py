"""Streets: the static geometry of a town, built from its lane graph as triangles, materials and masts."""

from ssad.rendering.street.build import build_street, cached_street
from ssad.rendering.street.model import Street, load_street, save_street
from ssad.rendering.street.palette import STYLES, TownStyle

__all__ = ["STYLES", "Street", "TownStyle", "build_street", "cached_street", "load_street", "save_street"]
