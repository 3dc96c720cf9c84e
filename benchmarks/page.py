"""Write docs/benchmarks.md from the measurements in benchmarks/results: python benchmarks/page.py"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RUNS = {
    "world-cpu": "One core of a 2-core AMD EPYC machine (process CPU time)",
    "world-h200": "One NVIDIA H200 (wall clock, CUDA graph)",
}
# agent-steps/s that the bare step (bicycle, contacts, nearest lane) could reach: estimates from byte and cycle counts
CEILING = {"cpu": (35e6, "ideal SIMD on one core"), "cuda": (8e9, "L2 bandwidth")}


def section(name: str, data: dict[str, Any]) -> list[str]:
    """One machine: speed by batch size, and where the time goes."""
    lines = [f"## {RUNS[name]}", ""]
    lines += ["| scenes | agents a scene | µs a step | agent-steps/s | spread |", "|---:|---:|---:|---:|---:|"]
    for row in data["rows"]:
        lines.append(
            f"| {row['batch']:,} | {row['agents']:.1f} | {row['us_per_step']:,.1f} | {row['agent_steps_per_s']:,.0f} | "
            f"{row['spread']:.0%} |"
        )
    best = max(row["agent_steps_per_s"] for row in data["rows"])
    limit, what = CEILING["cpu" if data["device"] == "cpu" else "cuda"]
    lines += [
        "",
        f"The best row is {best / limit:.0%} of {limit:.0e} agent-steps/s, the estimated bound by {what}",
        "of a bare step (bicycle, contacts and nearest lane alone).",
    ]
    if "highway" in data:
        other = data["highway"]
        lines += [
            "",
            f"highway-env's intersection-v1 in the same run: {other['agent_steps_per_s']:,.0f} vehicle sub-steps/s",
            f"with {other['agents']:.1f} vehicles. One scene of ours gives {data['ratio_at_B1']:.0f} times as many",
            "agent-steps/s.",
        ]
    parts = {key: value for key, value in data.items() if key.startswith("parts_us_B")}
    names = list(next(iter(parts.values())))
    lines += ["", "| kernel | " + " | ".join(f"{key[10:]} scenes" for key in parts) + " |"]
    lines.append("|---|" + "---:|" * len(parts))
    for kernel in names:
        shares = [f"{p[kernel]:,.0f} µs ({p[kernel] / sum(p.values()):.0%})" for p in parts.values()]
        lines.append(f"| {kernel} | " + " | ".join(shares) + " |")
    return [*lines, ""]


def read(name: str) -> dict[str, Any]:
    """A measurement."""
    data: dict[str, Any] = json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text())
    return data


def shifts() -> list[str]:
    """Images a second of the distribution shifts."""
    cpu, gpu = read("shift_speed"), read("shift_speed-h200")
    lines = [
        "# Speed of the distribution shifts",
        "",
        "`benchmarks/shift_speed.py`: 1600 x 900, 8 objects, mean over severities 1, 3 and 5, medians; the codec not",
        f"counted. One core of a 2-core machine; {gpu['device']} in batches of {gpu['batch']}. Beside it",
        "3D_Corruptions_AD, measured elsewhere on a like machine (one process).",
        "",
        "| shift | physical, 1 core | paper, 1 core | physical, H200 | paper, H200 | 3D_Corruptions_AD |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    names = [key.split()[1] for key in cpu["rows"] if key.startswith("physical") and not key.endswith("sum")]
    for name in names:
        cells = [
            data["rows"][f"{kind} {name}"]["images_per_s"] for data in (cpu, gpu) for kind in ("physical", "paper")
        ]
        other = cpu["rows"][f"physical {name}"]["others_per_s"]
        lines.append(f"| {name} | " + " | ".join(f"{cell:,.0f} /s" for cell in cells) + f" | {other:.1f} /s |")
    for kind in ("physical", "paper"):
        total = cpu["rows"][f"{kind} sum"]
        lines += [
            "",
            f"Sum over the 11 shifts, {kind}: {1e3 * total['seconds']:.0f} ms a picture on one core, against",
            f"{1e3 * total['others_seconds']:.0f} ms: {total['ratio']:.0f} times faster.",
        ]
    lines += ["", "From JPEG to JPEG on one core (decode, shift, encode at quality 95; sensor noise as 4:4:4):", ""]
    lines += ["| shift | images/s | share of the codec |", "|---|---:|---:|"]
    for name in names:
        row = cpu["rows"][f"end to end {name}"]
        lines.append(f"| {name} | {row['images_per_s']:.0f} | {row['codec_share']:.0%} |")
    return [*lines, ""]


def camera() -> list[str]:
    """Frames a second of the camera."""
    cpu, gpu = read("camera-cpu"), read("camera-h200")
    return [
        "# Speed of the camera",
        "",
        f"`benchmarks/camera_speed.py`: a street with {cpu['things']} vehicles, 640 x 640, 2 x 2 samples a pixel,",
        "shadows.",
        "",
        "| | ms a frame | frames/s |",
        "|---|---:|---:|",
        f"| one core | {cpu['ms_per_frame']:.0f} | {cpu['frames_per_s']:.0f} |",
        f"| {gpu['device']}, {gpu['batch']} views a call | {gpu['ms_per_frame']:.2f} | {gpu['frames_per_s']:,.0f} |",
        "",
        f"Re-texturing a car 20 m ahead with gradient, one core: {cpu['retexture_ms']:.1f} ms",
        f"({cpu['pieces']:,} pieces).",
        "",
    ]


def recorder() -> list[str]:
    """Samples of the recorder."""
    cpu = read("record-cpu")
    return [
        "# Speed of the recorder",
        "",
        f"`benchmarks/record_speed.py`: six cameras of {cpu['width']} x {cpu['width'] * 9 // 16} and a LiDAR, dense",
        f"traffic, files and tables included, {cpu['samples']} samples on {cpu['workers']} cores:",
        f"{cpu['s_per_1000'] / 60:.0f} minutes for 1,000 samples.",
        "",
    ]


def detectors() -> list[str]:
    """Images a second of the detectors, on each device that was measured."""
    lines = [
        "# Speed of the detectors",
        "",
        "`benchmarks/detector_speed.py`: medians, in turns with torchvision's FCOS (ResNet-50) on pictures of the same",
        "size, and with ultralytics' models of like size where the package is there. Attack: losses and their gradient",
        "to the picture, float32; the training step is in bfloat16 on a GPU. Images/s, and in brackets the ratio to",
        "torchvision's FCOS in the same run.",
        "",
    ]
    for path in sorted((ROOT / "benchmarks" / "results").glob("detectors-*.json")):
        data = read(path.stem)
        machine = f"{data['device']} of a 2-core machine" if "threads" in data["device"] else data["device"]
        lines += [
            f"{machine}, {data['batch']} {'picture' if data['batch'] == 1 else 'pictures'} a call:",
            "",
            "| detector | parameters | picture | forward | attack | training step |",
            "|---|---:|---|---:|---:|---:|",
        ]
        for row in data["rows"]:
            if row["detector"].startswith("torchvision"):
                continue
            cells = [f"{row['images_s'][k]:.1f} ({row['ratio'][k]:.1f})" for k in ("forward", "attack", "training")]
            size = " x ".join(map(str, row["size"]))
            lines.append(
                f"| {row['detector']} | {row['parameters'] / 1e6:.1f} M | {size} | " + " | ".join(cells) + " |"
            )
        lines.append("")
    return lines


def scores() -> list[str]:
    """Scoring beside the official toolkit."""
    data = read("score_speed")
    ours, other = data["ours"], data["devkit"]
    return [
        "# Speed of scoring",
        "",
        f"`benchmarks/score_speed.py`: {data['samples']:,} samples, {data['truth']:,} boxes of ground truth and",
        f"{data['predictions']:,} detections ({data['results_mb']:.0f} MB of results), whole processes in one run.",
        "",
        "| | CPU s | peak memory |",
        "|---|---:|---:|",
        f"| ssad score | {ours['cpu_s']:.2f} | {ours['peak_mib']} MiB |",
        f"| nuscenes-devkit 1.2.0 | {other['cpu_s']:.1f} | {other['peak_mib']} MiB |",
        "",
        f"{data['cpu_ratio']:.1f} times faster; the largest difference between the two results is "
        f"{data['largest_difference']:.1g}.",
        "",
    ]


def page() -> str:
    """The page."""
    lines = [
        "# Speed of the world",
        "",
        "Made by `benchmarks/page.py` from `benchmarks/results`, which `benchmarks/world_speed.py --json` writes.",
        "The full step: Autopilot traffic, signals, motion, contacts, the ego's record, restart of ended scenes,",
        "and the observation of 28 numbers a scene, on natural junction episodes. Medians of five repeats.",
        "",
    ]
    for name in RUNS:
        lines += section(name, json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text()))
    lines += shifts() + scores() + camera() + recorder() + detectors()
    return "\n".join(lines)


if __name__ == "__main__":
    (ROOT / "docs" / "benchmarks.md").write_text(page())
