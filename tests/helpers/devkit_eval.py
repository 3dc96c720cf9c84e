"""Run the official nuScenes devkit over datasets; for an interpreter that has nuscenes-devkit 1.2.0 installed.

    PYTHON tests/helpers/devkit_eval.py OUT.json VERSION SPLIT ROOT ...

Each ROOT holds the dataset and results.json. OUT gets {name of ROOT: metrics_summary, or {"error": message}}.
"""

import contextlib
import io
import json
import os
import sys
import tempfile


def main() -> None:
    """Evaluate each folder."""
    from nuscenes import NuScenes
    from nuscenes.eval.common.config import config_factory
    from nuscenes.eval.detection.evaluate import DetectionEval

    out, version, split, *roots = sys.argv[1:]
    found = {}
    for root in roots:
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
            try:
                data = NuScenes(version, root, verbose=False)
                results = os.path.join(root, "results.json")
                config = config_factory("detection_cvpr_2019")
                DetectionEval(data, config, results, split, folder, verbose=False).main(render_curves=False)
            except Exception as error:
                found[os.path.basename(root)] = {"error": f"{type(error).__name__}: {error}"}
                continue
            with open(os.path.join(folder, "metrics_summary.json")) as file:
                found[os.path.basename(root)] = json.load(file)
    with open(out, "w") as file:
        json.dump(found, file, indent=1, sort_keys=True)


if __name__ == "__main__":
    main()
