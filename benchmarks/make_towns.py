"""`python benchmarks/make_towns.py FOLDER` writes the towns that ship with SSAD as .xodr and .npz."""

from __future__ import annotations

import sys
from pathlib import Path

from ssad.core.lane_graph import save_graph
from ssad.core.safeio import write_atomic
from ssad.world.roads.bake import bake
from ssad.world.roads.designs import DESIGNS, generate_town


def main(folder: str) -> None:
    """Write every built-in town as NAME.xodr and NAME.npz."""
    for name in DESIGNS:
        path = Path(folder) / f"{name}.xodr"
        write_atomic(path, generate_town(name))
        save_graph(bake(path, name), path.with_suffix(".npz"))


if __name__ == "__main__":
    main(sys.argv[1])
