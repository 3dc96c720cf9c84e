"""nuScenes-N: the distribution shifts on a nuScenes folder, on the fly or written out."""

from ssad.evaluation.scene_shifter import SceneShifter
from ssad.toolbox.manifest import check_manifest, read_manifest, verify
from ssad.toolbox.options import Options, Shard
from ssad.toolbox.write import materialise

__all__ = ["Options", "SceneShifter", "Shard", "check_manifest", "materialise", "read_manifest", "verify"]
