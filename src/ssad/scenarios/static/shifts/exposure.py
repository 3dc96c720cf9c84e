"""Overexposure: the picture of a camera that exposes for longer, in light, through its own tone curve."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import warp as wp

from ssad.core.frames import Applied
from ssad.core.types import U8
from ssad.rendering.camera.sensor import BRIGHTEST, KNEE, SHOULDER
from ssad.scenarios.static.shifts.batch import Batch, on
from ssad.scenarios.static.shifts.kernels.exposure import recode
from ssad.scenarios.static.shifts.light import to_codes, to_linear
from ssad.scenarios.static.shifts.parameters import OVEREXPOSURE
from ssad.scenarios.static.shifts.spec import ShiftSpec


@lru_cache(maxsize=16)
def exposure_table(stops: float) -> U8:
    """The code [256] of each code in a picture exposed by `stops` EV more.

    The curve of `ssad.rendering.camera`: linear up to `KNEE`, a soft shoulder above, full at `BRIGHTEST`. What is white
    in the given picture is taken for just so bright.
    """
    shown = to_linear(np.arange(256))
    most = KNEE + (1 - KNEE) * (1 - np.exp(-(BRIGHTEST - KNEE) / SHOULDER))
    rest = 1 - (np.clip(shown, KNEE, most) - KNEE) / (1 - KNEE)
    light = np.where(shown > KNEE, KNEE - SHOULDER * np.log(rest), shown)
    longer = np.minimum(light * 2.0**stops, BRIGHTEST)
    soft = KNEE + (1 - KNEE) * (1 - np.exp(-(np.maximum(longer, KNEE) - KNEE) / SHOULDER))
    return np.rint(to_codes(np.where(longer > KNEE, soft, longer))).astype(np.uint8)


def overexpose(batch: Batch, specs: Sequence[ShiftSpec]) -> tuple[Batch, list[Applied]]:
    """overexposure, in both calibrations."""
    stops = [OVEREXPOSURE[spec.severity - 1] for spec in specs]
    out = batch.like()
    dim, words, chunk = batch.chunks()
    tables = on(batch, np.stack([exposure_table(value) for value in stops]), wp.uint8)
    batch.launch(recode, dim, [batch.words(), tables, words, chunk], out.words())
    return out, [Applied(True, {"stops": value}) for value in stops]
