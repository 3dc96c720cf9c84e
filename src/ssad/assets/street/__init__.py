"""Streets: the static geometry of a town, from its lane graph to triangles, materials and masts."""

from ssad.assets.street.build import build_street, cached_street
from ssad.assets.street.model import Street, load_street, save_street
from ssad.assets.street.palette import STYLES, TownStyle

__all__ = ["STYLES", "Street", "TownStyle", "build_street", "cached_street", "load_street", "save_street"]
