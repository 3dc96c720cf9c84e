"""Camera images and distribution shifts in the report of a run of drives."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from ssad.core import safeio
from ssad.core.images import save_picture
from ssad.core.lane_graph import load_graph, town_file
from ssad.core.traces import load_trace
from ssad.recorders.nuscenes import Recording, record_nuscenes
from ssad.recorders.shifted.contact_sheet import write_sheets
from ssad.rendering.camera_sheets import write_gallery
from ssad.rendering.trace_sheet import onboard_sheet, pick_trace


def write_pictures(names: Sequence[str], folder: Path) -> None:
    """Make what is missing of DIR/pictures; pictures.json says what each shows.

    Args:
        names: shifts: contact sheets of the distribution shifts; camera: what the camera sees.
        folder: The results folder.

    Raises:
        StoreError: A file cannot be written.
    """
    picture_folder, captions = folder / "pictures", {}
    if "shifts" in names:
        captions["shifts.jpg"] = "The 11 natural distribution shifts at severity 3, on a street of Larkhill."
        captions["shifts-severities.jpg"] = "Each shift at severities 1 to 5."
        if not all((picture_folder / name).is_file() for name in captions):
            with tempfile.TemporaryDirectory() as temporary:
                street = Recording(Path(temporary) / "street", ("Larkhill",), scenes=1, seconds=0.5, width=960)
                write_sheets(record_nuscenes(street, workers=0), safeio.make_folder(picture_folder) / "shifts.jpg")
    if "camera" in names:
        captions |= write_gallery(safeio.make_folder(picture_folder))
        trace_path = pick_trace(folder)
        if trace_path is not None:
            captions["camera.jpg"] = f"An episode of this run ({trace_path.stem}) from the ego's camera and from above."
            if not (picture_folder / "camera.jpg").is_file():
                trace = load_trace(trace_path)
                graph = load_graph(folder / "towns" / town_file(trace.town))
                save_picture(picture_folder / "camera.jpg", onboard_sheet(trace, graph))
    if captions:
        safeio.write_atomic(picture_folder / "pictures.json", safeio.dump_json(captions, indent=1) + "\n")
