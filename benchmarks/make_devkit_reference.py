"""Write tests/data/devkit: what the official devkit says about the sets of tests/helpers/devkit_sets.py.

    SSAD_DEVKIT_PYTHON=.../bin/python uv run python benchmarks/make_devkit_reference.py

SSAD_DEVKIT_PYTHON is an interpreter with nuscenes-devkit 1.2.0. It pins numpy below 2; both work, and give the same:
    uv venv ENV; echo 'numpy>=2' > override.txt; uv pip install -p ENV --override override.txt nuscenes-devkit==1.2.0
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from helpers.devkit_sets import SETS, SPLIT, VERSION, write_set  # noqa: E402

from ssad.core.safeio import write_atomic  # noqa: E402


def main() -> None:
    """Evaluate every set, one JSON file each."""
    devkit = os.environ.get("SSAD_DEVKIT_PYTHON")
    if not devkit:
        raise SystemExit("set SSAD_DEVKIT_PYTHON to an interpreter that has nuscenes-devkit 1.2.0")
    script = ROOT / "tests" / "helpers" / "devkit_eval.py"
    with tempfile.TemporaryDirectory() as folder:
        roots = [str(write_set(Path(folder), name)) for name in SETS]
        out = Path(folder) / "out.json"
        subprocess.run([devkit, str(script), str(out), VERSION, SPLIT, *roots], check=True, stderr=subprocess.DEVNULL)
        for name, summary in json.loads(out.read_text()).items():
            if "error" in summary:
                raise SystemExit(f"{name}: {summary['error']}")
            # the time differs from run to run
            del summary["eval_time"]
            write_atomic(ROOT / "tests" / "data" / "devkit" / f"{name}.json", json.dumps(summary, indent=1) + "\n")


if __name__ == "__main__":
    main()
