"""Pictures that a suite asks for, made once beside its results; the report puts them into its page."""

from __future__ import annotations

import tempfile
from pathlib import Path

from ssad.core import safeio

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
        from ssad.recording.camera_sheets import write_gallery

        captions |= write_gallery(safeio.make_folder(target))
        captions |= _onboard(Path(folder), target)
    if captions:
        safeio.write_atomic(target / PAGE, safeio.dump_json(captions, indent=1) + "\n")


def _onboard(folder: Path, target: Path) -> dict[str, str]:
    """An episode of the run from the ego's camera and from above, if a recording is there."""
    from ssad.core.images import save_picture
    from ssad.core.lane_graph import load_graph
    from ssad.core.traces import load_trace
    from ssad.recording.onboard import onboard_sheet, pick_trace
    from ssad.roads import load_town

    chosen = pick_trace(folder)
    if chosen is None:
        return {}
    trace = load_trace(chosen)
    path = target / "camera.jpg"
    if not path.is_file():
        own = folder / "towns" / f"{trace.town}.npz"
        save_picture(path, onboard_sheet(trace, load_graph(own) if own.is_file() else load_town(trace.town)))
    return {path.name: f"An episode of this run ({chosen.stem}) from the ego's camera and from above."}


def _shifts(path: Path) -> None:
    """Contact sheets of a drawn street."""
    from ssad.datasets.nuscenes.tiny import make_tiny
    from ssad.toolbox.contact_sheet import write_sheets

    with tempfile.TemporaryDirectory() as temporary:
        write_sheets(make_tiny(Path(temporary) / "street", scenes=1, samples=2, sweeps=1, size=(960, 540)), path)
