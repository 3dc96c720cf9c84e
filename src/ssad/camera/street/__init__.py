"""Streets: the static geometry of a town, from its lane graph to triangles, materials and masts."""

from ssad.camera.street.build import build_street, cached_street
from ssad.camera.street.model import Street, load_street, save_street
from ssad.camera.street.palette import STYLES, Style

__all__ = ["STYLES", "Street", "Style", "build_street", "cached_street", "load_street", "save_street"]
