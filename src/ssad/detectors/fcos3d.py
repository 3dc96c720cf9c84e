"""FCOS3D (Wang et al., ICCV workshops 2021), as mmdetection3d 1.4 builds it for nuScenes, and a light variant."""

from __future__ import annotations

from typing import Any

from ssad.detectors.mono3d.config import FCOS3D, FCOS3D_LIGHT
from ssad.detectors.mono3d.detector import Mono3D


def fcos3d(*, light: bool = False, seed: int = 0, **options: Any) -> Mono3D:
    """Build FCOS3D with fresh weights; options are fields of `Mono3DConfig`."""
    return Mono3D((FCOS3D_LIGHT if light else FCOS3D).with_changes(options), seed=seed)
