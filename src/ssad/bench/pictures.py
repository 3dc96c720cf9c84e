"""Pictures that a suite asks for, made once beside its results; the report puts them into its page."""

from __future__ import annotations

import tempfile
from pathlib import Path

from ssad import safeio

FOLDER, PAGE = "pictures", "pictures.json"


def make_pictures(names: list[str], folder: str | Path) -> None:
    """Makes what is missing of DIR/pictures; pictures.json says what each shows. StoreError."""
    target = Path(folder) / FOLDER
    captions = {}
    if "shifts" in names:
        captions["shifts.jpg"] = "The 11 natural distribution shifts at severity 3, on a drawn street."
        captions["shifts-severities.jpg"] = "Each shift at severities 1 to 5."
        if not all((target / name).is_file() for name in captions):
            _shifts(safeio.make_folder(target) / "shifts.jpg")
    if "camera" in names:
        from ssad.bench.gallery import write_gallery

        captions |= write_gallery(safeio.make_folder(target))
    if captions:
        safeio.write_atomic(target / PAGE, safeio.dump_json(captions, indent=1) + "\n")


def _shifts(path: Path) -> None:
    """Contact sheets of a drawn street."""
    from ssad.bench.toolbox.sheet import write_sheets
    from ssad.datasets.nuscenes.tiny import make_tiny

    with tempfile.TemporaryDirectory() as temporary:
        write_sheets(make_tiny(Path(temporary) / "street", scenes=1, samples=2, sweeps=1, size=(960, 540)), path)
