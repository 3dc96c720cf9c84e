"""A package of another author, installed: two driving systems and a detector, offered by entry points."""

from __future__ import annotations

from pathlib import Path

SOURCE = '''
from ssad.core.types import Controller


class Coast:
    """Never touches anything."""

    controller = Controller.EXTERNAL

    def reset(self, episodes):
        self.count = len(episodes)

    def act(self, view):
        import numpy as np

        return np.zeros((self.count, 3), np.float32)


class Outer:
    class Inner(Coast):
        pass


class Seer:
    """A detector that sees nothing."""

    name, task, classes = "seer", "2d", ("car",)

    def __init__(self, *, threshold=0.5):
        self.threshold = threshold

    def predict(self, images, intrinsic=None, *, threshold=None):
        raise NotImplementedError
'''
ENTRY_POINTS = """
[ssad.systems]
acme-coast = acme_drivers.systems:Coast
acme-inner = acme_drivers.systems:Outer.Inner
acme-extra = acme_drivers.systems:Coast [fast]
acme-gone = acme_drivers.systems:Cost
acme-broken = acme_drivers.broken:Coast
blind = acme_drivers.systems:Coast

[ssad.detectors]
acme-seer = acme_drivers.systems:Seer

[other.systems]
acme-other = acme_drivers.systems:Coast
"""


def install(site: Path) -> Path:
    """Fill a folder of packages as pip does: the modules, and metadata that names its entry points."""
    package, info = site / "acme_drivers", site / "acme_drivers-1.2.dist-info"
    package.mkdir()
    info.mkdir()
    (package / "__init__.py").write_text("")
    (package / "systems.py").write_text(SOURCE)
    (package / "broken.py").write_text("raise RuntimeError('no licence')")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-drivers\nVersion: 1.2\n")
    (info / "WHEEL").write_text("Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
    (info / "INSTALLER").write_text("pip\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    files = [path.relative_to(site) for path in sorted(site.rglob("*")) if path.is_file()]
    (info / "RECORD").write_text("".join(f"{name},,\n" for name in files))
    return site
