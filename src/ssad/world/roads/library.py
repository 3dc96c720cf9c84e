"""Towns by name: built-in, imported, random, or from a file."""

from __future__ import annotations

import tempfile
from functools import lru_cache
from importlib.resources import as_file, files
from pathlib import Path

from ssad.core.errors import MapError, unknown_name
from ssad.core.lane_graph import LaneGraph, load_graph
from ssad.core.safeio import home_folder, read_text
from ssad.world.roads.bake import LANELET2, bake
from ssad.world.roads.random_towns import RANDOM, write_random_town
from ssad.world.roads.signals import signal_names
from ssad.world.roads.xodr import MAX_BYTES, Network, read_network

BUILT_IN = (
    *("Twinford", "Crossgate", "ProvingGround", "Oldmarket", "Larkhill", "Ringmere", "Longreach"),
    "HighSpeedTrack",
)


def town_names() -> dict[str, str]:
    """Return name -> "built-in", or the path of an imported town. An import cannot take a built-in name."""
    towns = dict.fromkeys(BUILT_IN, "built-in")
    for path in sorted((home_folder() / "towns").glob("*.npz")):
        towns.setdefault(path.stem, str(path))
    return towns


def is_town(name: str) -> bool:
    """Return whether a name is one of `town_names`, or Random and a number (see `random_town`)."""
    return name in town_names() or RANDOM.fullmatch(name) is not None


def load_town(name: str) -> LaneGraph:
    """Return the lane graph of a town by its name, or the path of a baked town (.npz) or a map (.xodr, .osm).

    A graph is immutable and cached. UnknownNameError lists the closest names; MapError describes the problem of a
    file.
    """
    if name in BUILT_IN:
        return _built_in(name)
    path = home_folder() / "towns" / f"{name}.npz" if Path(name).name == name else Path(name)
    if path.suffix == ".npz" and path.is_file():
        return _stored(str(path), path.stat().st_mtime_ns)
    if RANDOM.fullmatch(name):
        return _random(name)
    if Path(name).suffix in (".xodr", LANELET2):
        return bake(Path(name))
    if Path(name).suffix == ".npz" or "/" in name or "\\" in name:
        raise MapError(f"{name}: no such file; give a town's name, a baked town (.npz) or a map (.xodr, .osm)")
    raise unknown_name("town", name, town_names())


def town_xodr(name: str) -> str:
    """Return the OpenDRIVE text of a town, as `load_town` finds it.

    Raises:
        MapError: The town has none: its lanes were not made from OpenDRIVE.
    """
    from ssad.world.roads.designs import generate_town

    if name in BUILT_IN:
        return generate_town(name)
    is_name = Path(name).name == name and Path(name).suffix != ".xodr"
    path = home_folder() / "towns" / f"{name}.xodr" if is_name else Path(name).with_suffix(".xodr")
    if not path.is_file() and RANDOM.fullmatch(name):
        return write_random_town(name)
    if not path.is_file():
        raise MapError(f"town '{name}' has no OpenDRIVE: there is no {path}; import its map: ssad import map FILE.xodr")
    return read_text(path, limit=MAX_BYTES)


def town_network(name: str) -> Network:
    """Return the OpenDRIVE network of a town, in the coordinates of its lane graph; MapError as `town_xodr`."""
    return _network(town_xodr(name))


@lru_cache(maxsize=4)
def _network(xodr: str) -> Network:
    with tempfile.TemporaryDirectory(prefix="ssad-map-") as folder:
        path = Path(folder) / "map.xodr"
        path.write_text(xodr, encoding="utf-8")
        return read_network(path)


@lru_cache(maxsize=8)
def town_signals(name: str) -> dict[int, str]:
    """Return the OpenDRIVE id of each signal of a town; MapError as `town_xodr`."""
    return signal_names(load_town(name), town_network(name))


@lru_cache(maxsize=8)
def _built_in(name: str) -> LaneGraph:
    with as_file(files("ssad.world.roads.towns") / f"{name}.npz") as path:
        return load_graph(path)


@lru_cache(maxsize=64)
def _random(name: str) -> LaneGraph:
    with tempfile.TemporaryDirectory(prefix="ssad-map-") as folder:
        path = Path(folder) / f"{name}.xodr"
        path.write_text(write_random_town(name), encoding="utf-8")
        return bake(path, name)


@lru_cache(maxsize=64)
def _stored(path: str, changed: int) -> LaneGraph:
    # The modification time is part of the cache key, so a new import is read again.
    return load_graph(path)
