"""nuScenes-N: the distribution shifts on a nuScenes folder, on the fly or written out."""

from ssad.bench.toolbox.manifest import check_manifest, read_manifest, verify
from ssad.bench.toolbox.plan import Options, Shard
from ssad.bench.toolbox.run import materialise
from ssad.bench.toolbox.scene import SceneShifter

__all__ = ["Options", "SceneShifter", "Shard", "check_manifest", "materialise", "read_manifest", "verify"]
