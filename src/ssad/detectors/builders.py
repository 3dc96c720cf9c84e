"""Builders of the light variants, by name."""

from __future__ import annotations

from typing import Any

from ssad.detectors.fcos3d import fcos3d
from ssad.detectors.mono3d.detector import Mono3D
from ssad.detectors.pgd_det import pgd_det


def fcos3d_light(**options: Any) -> Mono3D:
    """Build the light FCOS3D; options as for `ssad.detectors.fcos3d.fcos3d`."""
    return fcos3d(light=True, **options)


def pgd_det_light(**options: Any) -> Mono3D:
    """Build the light PGD-Det; options as for `ssad.detectors.pgd_det.pgd_det`."""
    return pgd_det(light=True, **options)
