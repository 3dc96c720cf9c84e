"""Overexposure: the image of a longer exposure in linear light, through the tone curve of the camera."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import warp as wp

from ssad.core.frames import ShiftReport
from ssad.core.types import U8
from ssad.rendering.camera.sensor import BRIGHTEST, KNEE, SHOULDER
from ssad.scenarios.static.shifts.batch import Batch, to_device
from ssad.scenarios.static.shifts.kernels.exposure import recode
from ssad.scenarios.static.shifts.light import to_codes, to_linear
from ssad.scenarios.static.shifts.parameters import OVEREXPOSURE
from ssad.scenarios.static.shifts.spec import ShiftSpec


@lru_cache(maxsize=16)
def exposure_table(stops: float) -> U8:
    """Return the code [256] of each code in an image exposed by `stops` EV more.

    The curve of `ssad.rendering.camera`: linear up to `KNEE`, a soft shoulder above, saturated at `BRIGHTEST`. White in
    the given image is assumed to be exactly saturated.
    """
    displayed = to_linear(np.arange(256))
    max_displayed = KNEE + (1 - KNEE) * (1 - np.exp(-(BRIGHTEST - KNEE) / SHOULDER))
    # Inverse of the tone curve above the knee.
    headroom = 1 - (np.clip(displayed, KNEE, max_displayed) - KNEE) / (1 - KNEE)
    exposure = np.where(displayed > KNEE, KNEE - SHOULDER * np.log(headroom), displayed)
    longer_exposure = np.minimum(exposure * 2.0**stops, BRIGHTEST)
    compressed = KNEE + (1 - KNEE) * (1 - np.exp(-(np.maximum(longer_exposure, KNEE) - KNEE) / SHOULDER))
    return np.rint(to_codes(np.where(longer_exposure > KNEE, compressed, longer_exposure))).astype(np.uint8)


def overexpose(batch: Batch, specs: Sequence[ShiftSpec]) -> tuple[Batch, list[ShiftReport]]:
    """Apply overexposure, in both calibrations."""
    stops = [OVEREXPOSURE[spec.severity - 1] for spec in specs]
    result = batch.empty_like()
    thread_shape, word_count, chunk_size = batch.chunks()
    tables = to_device(batch, np.stack([exposure_table(value) for value in stops]), wp.uint8)
    batch.launch(recode, thread_shape, [batch.words(), tables, word_count, chunk_size], result.words())
    return result, [ShiftReport(True, {"stops": value}) for value in stops]
