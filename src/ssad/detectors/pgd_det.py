"""PGD-Det (Wang et al., CoRL 2021: probabilistic and geometric depth), as mmdetection3d 1.4 builds it for nuScenes.

The released nuScenes models fuse regressed and probabilistic depth at each place; the paper's graph that propagates
depth between objects is in no release, nor here.
"""

from __future__ import annotations

from typing import Any

from ssad.detectors.mono3d.config import PGD_DET, PGD_DET_LIGHT
from ssad.detectors.mono3d.detector import Mono3D


def pgd_det(*, light: bool = False, seed: int = 0, **options: Any) -> Mono3D:
    """Build PGD-Det with fresh weights; options are fields of `Mono3DConfig`."""
    return Mono3D((PGD_DET_LIGHT if light else PGD_DET).with_changes(options), seed=seed)
