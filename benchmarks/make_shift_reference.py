"""Write tests/data/shifts/published.json: statistics of the published snow, rain and fog, to hold ours against.

    ENV/bin/python benchmarks/make_shift_reference.py

in an environment of its own, as the originals are no longer kept up and need old packages (Python 3.11):
    uv venv -p 3.11 ENV; uv pip install -p ENV "numpy<2" "setuptools<81" "scipy<1.13" "scikit-image<0.23" imgaug==0.4.0
    imagecorruptions==1.1.2 "opencv-python-headless<4.12"

Snow and fog: imagecorruptions (ImageNet-C); rain: imgaug's RainLayer; with the parameters, the grey and the darkening
of 3D_Corruptions_AD (Dong et al., CVPR 2023; ImageAddSnow, ImageAddFog and ImageAddRain in
TransFusion/mmdet3d/datasets/pipelines/Camera_corruptions.py at commit 0cdf2c1).
"""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "helpers"))
warnings.filterwarnings("ignore")

import imgaug.augmenters as iaa  # noqa: E402
from published_shifts import NAMES, picture, statistics  # noqa: E402

OUT = ROOT / "tests" / "data" / "shifts" / "published.json"
DENSITY = ((0.01, 0.06), (0.06, 0.10), (0.10, 0.15), (0.15, 0.20), (0.20, 0.25))
GREY = {"snow": (0.3,) * 5, "rain": (0.3,) * 5, "fog": (0.1, 0.2, 0.3, 0.4, 0.5)}
REPEATS = 64


def published(name: str, severity: int, image: np.ndarray, seed: int) -> np.ndarray:
    """A picture under a published shift."""
    if name == "rain":
        layer = iaa.RainLayer(
            density=DENSITY[severity - 1],
            density_uniformity=(0.8, 1.0),
            drop_size=(0.4, 0.6),
            drop_size_uniformity=(0.2, 0.5),
            angle=(-15, 15),
            speed=(0.04, 0.20),
            blur_sigma_fraction=(0.0001, 0.001),
            blur_sigma_limits=(0.5, 3.75),
            seed=seed,
        )
    else:
        kind = iaa.imgcorruptlike.Snow if name == "snow" else iaa.imgcorruptlike.Fog
        layer = kind(severity=severity, seed=seed)
    share = GREY[name][severity - 1]
    out = (128 * share + (1 - share) * layer(images=image[None])[0]).astype(np.uint8)
    if name == "fog":
        return out
    tone = cv2.cvtColor(out, cv2.COLOR_RGB2HSV)
    value = tone[..., 2] / tone[..., 2].max() * 256 * 0.7
    tone[..., 2] = np.clip(value, 0, 255)
    return cv2.cvtColor(tone, cv2.COLOR_HSV2RGB)


def main() -> None:
    """Mean and deviation of each statistic over pictures that differ in their seed."""
    image = picture()
    found = {}
    for name in GREY:
        for severity in range(1, 6):
            rows = [statistics(published(name, severity, image, 1000 * severity + k), image) for k in range(REPEATS)]
            told = zip(NAMES, np.mean(rows, axis=0), np.std(rows, axis=0, ddof=1), strict=True)
            found[f"{name} {severity}"] = {key: [round(float(m), 4), round(float(s), 4)] for key, m, s in told}
            print(name, severity, found[f"{name} {severity}"], flush=True)
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps({"repeats": REPEATS, "statistics": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
