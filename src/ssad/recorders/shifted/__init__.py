"""nuScenes-N: the distribution shifts on a nuScenes folder, on the fly or written to disk."""

from ssad.recorders.shifted.manifest import check_manifest, read_manifest, verify
from ssad.recorders.shifted.options import Options, Shard
from ssad.recorders.shifted.write import write_shifted_roots
from ssad.scenarios.static.shifts.scene_shifter import SceneShifter

__all__ = ["Options", "SceneShifter", "Shard", "check_manifest", "read_manifest", "verify", "write_shifted_roots"]
