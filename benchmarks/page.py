"""Write docs/results/speed.md from the measurements in benchmarks/results: python benchmarks/page.py"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ssad.scenarios.static.shifts import VERSIONS

ROOT = Path(__file__).parents[1]
RUNS = {
    "world-h200": "One NVIDIA H200 (wall clock, CUDA graph)",
    "world-cpu": "One core of a 2-core AMD EPYC machine (process CPU time), before beliefs and lane changes",
    "world-h200-before": "One NVIDIA H200 (wall clock, CUDA graph), before beliefs and lane changes",
}
# agent-steps/s that the bare step (bicycle, contacts, nearest lane) could reach: estimates from byte and cycle counts
CEILING = {"cpu": (35e6, "ideal SIMD on one core"), "cuda": (8e9, "L2 bandwidth")}


def section(name: str, data: dict[str, Any]) -> list[str]:
    """One machine: speed by batch size, and the share of each kernel."""
    lines = [f"### {RUNS[name]}", ""]
    lines += ["| scenes | agents per scene | µs per step | agent-steps/s | spread |", "|---:|---:|---:|---:|---:|"]
    for row in data["rows"]:
        lines.append(
            f"| {row['batch']:,} | {row['agents']:.1f} | {row['us_per_step']:,.1f} | {row['agent_steps_per_s']:,.0f} | "
            f"{row['spread']:.0%} |"
        )
    best = max(row["agent_steps_per_s"] for row in data["rows"])
    limit, what = CEILING["cpu" if data["device"] == "cpu" else "cuda"]
    lines += [
        "",
        f"The best row reaches {best / limit:.0%} of {limit:.0e} agent-steps/s. This is the estimated bound by {what}",
        "for a minimal step (bicycle model, contacts and nearest lane only).",
    ]
    if "highway" in data:
        other = data["highway"]
        lines += [
            "",
            f"For comparison, highway-env's intersection-v1 in the same run: {other['agent_steps_per_s']:,.0f} vehicle",
            f"sub-steps/s with {other['agents']:.1f} vehicles. One scene of SSAD gives {data['ratio_at_B1']:.0f} times",
            "as many agent-steps/s.",
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
        "## Speed of the distribution shifts",
        "",
        "Measured by `benchmarks/shift_speed.py` on images of 1600 x 900 with 8 objects, without the codec. Mean over",
        "severities 1, 3 and 5 of medians, on one core of a 2-core machine (processor time) and on",
        f"{gpu['device']} in batches of {gpu['batch']}. The last column is 3D_Corruptions_AD",
        "(one process), measured separately on a similar machine.",
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
    if gpu.get("versions") != VERSIONS:
        lines += ["", f"The columns of the {gpu['device']} are of an earlier version of the shifts."]
    for kind in ("physical", "paper"):
        total = cpu["rows"][f"{kind} sum"]
        lines += [
            "",
            f"All 11 shifts, {kind}: {1e3 * total['seconds']:.0f} ms per image on one core; 3D_Corruptions_AD takes",
            f"{1e3 * total['others_seconds']:.0f} ms ({total['ratio']:.0f} times as long).",
        ]
    lines += [
        "",
        "From JPEG file to JPEG file on one core (decode, shift, encode at quality 95; sensor noise as 4:4:4):",
        "",
    ]
    lines += ["| shift | images/s | share of the codec |", "|---|---:|---:|"]
    for name in names:
        row = cpu["rows"][f"end to end {name}"]
        lines.append(f"| {name} | {row['images_per_s']:.0f} | {row['codec_share']:.0%} |")
    return [*lines, ""]


def beside() -> list[str]:
    """The step beside the one before beliefs and lane changes, in turn: on a core and on a GPU."""
    ratio, gpu = read("world-ratio"), read("world-ratio-h200")
    parts = read("world-h200")[f"parts_us_B{gpu['batch']}"]
    step = sum(us for name, us in parts.items() if name != "look")  # world_ratio steps without it
    return [
        "### Beside the step before beliefs and lane changes",
        "",
        "`benchmarks/world_ratio.py` measures against commit 2dc730f, which had neither, in turn and in the same",
        f"traffic. On one core ({ratio['batch']:,} scenes, {ratio['rounds']} rounds): {ratio['ratio']:.2f} times its",
        f"speed (middle half of the rounds {ratio['low']:.2f} to {ratio['high']:.2f}). On the {gpu['device']}",
        f"({gpu['batch']:,} scenes, {gpu['rounds']} rounds, commit {gpu['commit']}): {gpu['ratio']:.2f} times",
        f"({gpu['low']:.2f} to {gpu['high']:.2f}); of the step, lane changes take",
        f"{parts['change_lanes'] / step:.0%}. Agent-steps a second of the tables above do not tell the",
        "two apart: the traffic of natural junctions has changed, too.",
        "",
    ]


def camera() -> list[str]:
    """Frames a second of the camera."""
    cpu, gpu = read("camera-cpu"), read("camera-h200")
    loop, many, closed = read("camera-loop-cpu"), read("camera-loop-h200"), read("closed-loop")
    case, flat = (next(one for one in closed["cases"] if one["case"] == name) for name in ("fcos3d", "yolo"))
    stages = sorted(case["share"].items(), key=lambda one: -one[1])
    return [
        "## Speed of the camera",
        "",
        f"Measured by `benchmarks/camera_speed.py`: a street with {cpu['things']} vehicles, 640 x 640 pixels, 2 x 2",
        "samples per pixel, with shadows.",
        "",
        "| | ms per frame | frames/s |",
        "|---|---:|---:|",
        f"| one core | {cpu['ms_per_frame']:.0f} | {cpu['frames_per_s']:.0f} |",
        *(
            f"| one core, {what} | {cpu[key]:.0f} | {1e3 / cpu[key]:.0f} |"
            for what, key in (("`quality=PLAIN`", "plain_ms_per_frame"), ("night, lamps on", "night_ms_per_frame"))
        ),
        f"| {gpu['device']}, {gpu['batch']} views per call | {gpu['ms_per_frame']:.2f} | {gpu['frames_per_s']:,.0f} |",
        "",
        f"Applying a new texture to a car 20 m ahead, with gradient, takes {cpu['retexture_ms']:.1f} ms on one core",
        f"({cpu['pieces']:,} textured fragments).",
        "",
        f"In the closed loop (`--scenes`), a camera of 640 x 384 on each ego of {loop['scenes']} natural episodes at",
        f"10 Hz renders {loop['frames_per_s']:.0f} frames/s on one core. Two processes on two cores render",
        f"{2 * loop['frames_per_s']:.0f} frames/s, {int(loop['frames_per_s'] / 5)} cameras in real time.",
        f"On {many['device']} {many['scenes']} episodes at once run at {many['times_real_time']:.2f} times real time,",
        f"{many['frames_per_s']:.0f} frames/s.",
        "",
        f"With `benchmarks/closed_loop_speed.py`, {case['scenes']} scenes with {case['cameras']} cameras of",
        f"{' x '.join(map(str, case['picture']))} each, `{case['detector']}` behind them, run at",
        f"{case['times real time, all scenes at once']:.2f} times real time together on {closed['device']}. Shares",
        f"of the time: {', '.join(f'{stage} {share:.0%}' for stage, share in stages if share >= 0.01)}.",
        f"{flat['scenes']} scenes with one camera and `{flat['detector']}` run at",
        f"{flat['times real time, all scenes at once']:.2f} times real time.",
        "",
    ]


def effects() -> list[str]:
    """Cost of the effects of the rendering."""
    views, loop = read("effects-cpu"), read("effects-loop-cpu")
    return [
        "## Cost of the effects",
        "",
        "Measured by `benchmarks/effect_cost.py` on one core, on the street of `benchmarks/camera_speed.py`: medians",
        "of pairs of pictures without any effect and with all of them.",
        "",
        "| view | without, ms | with all, ms | more |",
        "|---|---:|---:|---:|",
        *(
            f"| {name} | {view['ms_without']:.0f} | {view['ms_without'] + view['all']['ms']:.0f} "
            f"| {view['all']['ratio']:.0%} |"
            for name, view in views.items()
        ),
        "",
        f"In the closed loop (`--scenes`), a step of {loop['scenes']} natural episodes with a camera of 640 x 384 each",
        f"takes {loop['ratio']:.2f} times as long with all effects as with `lit-signals` alone, probes of new places",
        f"included (median of {loop['steps']} pairs).",
        "",
    ]


def sensor() -> list[str]:
    """Time of the sensor, in the renderer and in torch."""
    found = read("sensor-cpu")
    victim = found["yolov5n_ms"]
    steps = [
        found["torch_ms"][name]["touched"] / victim for name in ("lens, mosaic, noise", "lens, mosaic, noise, JPEG")
    ]
    return [
        "## Speed of the sensor",
        "",
        "Measured by `benchmarks/sensor_speed.py` on one core, 640 x 640 pixels. In torch: forward and backward from a",
        "texture on a car 20 m ahead to the image, of the whole image and of a `Window` of what the texture touches.",
        "",
        "| renderer | ms |",
        "|---|---:|",
        *(f"| {name} | {ms:.1f} |" for name, ms in found["rendered_ms"].items()),
        "",
        "| torch | whole image, ms | window, ms |",
        "|---|---:|---:|",
        *(f"| {name} | {ms['whole']:.1f} | {ms['touched']:.1f} |" for name, ms in found["torch_ms"].items()),
        "",
        f"YOLOv5n's losses on the same image, forward and backward: {victim:.0f} ms. A step in a window adds",
        f"{100 * steps[0]:.0f} % to that without JPEG, {100 * steps[1]:.0f} % with it.",
        "",
    ]


def recorder() -> list[str]:
    """Samples of the recorder."""
    cpu = read("record-cpu")
    return [
        "## Speed of the recorder",
        "",
        f"Measured by `benchmarks/record_speed.py`: six cameras of {cpu['width']} x {cpu['width'] * 9 // 16} and a",
        f"LiDAR in dense traffic, including all files and tables; {cpu['samples']} samples on {cpu['workers']} cores.",
        f"1,000 samples take {cpu['s_per_1000'] / 60:.0f} minutes.",
        "",
    ]


def detectors() -> list[str]:
    """Images a second of the detectors, on each device that was measured."""
    lines = [
        "## Speed of the detectors",
        "",
        "Measured by `benchmarks/detector_speed.py`: images/s (medians), and in brackets the ratio to torchvision's",
        "FCOS (ResNet-50), which ran alternately on images of the same size. Where ultralytics is installed, its",
        "models of similar size were measured too. Attack: losses and their gradient with respect to the image,",
        "float32. Training steps use bfloat16 on a GPU.",
        "",
    ]
    for path in sorted((ROOT / "benchmarks" / "results").glob("detectors-*.json")):
        data = read(path.stem)
        machine = f"{data['device']} of a 2-core machine" if "threads" in data["device"] else data["device"]
        lines += [
            f"{machine}, {data['batch']} {'image' if data['batch'] == 1 else 'images'} per call:",
            "",
            "| detector | parameters | image | forward | attack | training step |",
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


def attacks() -> list[str]:
    """Digital attacks beside those of other libraries, and beside bare passes."""
    data = read("attacks")
    art, other, cost = (data[name] for name in ("art", "torchattacks", "overhead"))
    libraries = sorted({**art["versions"], **other["versions"]}.items())
    lines = [
        "## Strength of digital attacks",
        "",
        f"Measured by `benchmarks/attack_reference.py`, with {', '.join(' '.join(pair) for pair in libraries)}.",
        f"YOLOv5n on {art['images']} images of towns that were not used for training, the detector's own training",
        f"loss, {art['steps']} steps, at most {art['radius_px']} code values; CPU time of one core. Lower AP50 and",
        "higher loss are a stronger attack:",
        "",
        "| attack | loss | AP50 | CPU s |",
        "|---|---:|---:|---:|",
    ]
    for row in art["rows"]:
        seconds = f"{row['cpu_s']:.0f}" if "cpu_s" in row else ""
        lines.append(f"| {row['attack']} | {row['loss']:.2f} | {100 * row['AP50']:.1f} % | {seconds} |")
    columns = [name for name in other["rows"][0] if name != "radius_px"]
    lines += [
        "",
        f"Accuracy that a small classifier of handwritten digits keeps ({other['images']} test images, clean",
        f"{100 * other['clean']:.1f} %; {other['steps']} steps):",
        "",
        f"| radius (code values) | {' | '.join(columns)} |",
        f"|---:|{'---:|' * len(columns)}",
    ]
    for row in other["rows"]:
        left = " | ".join(f"{100 * row[name]:.1f} %" for name in columns)
        lines.append(f"| {row['radius_px']:.0f} | {left} |")
    mixed = data["precision"]
    lines += [
        "",
        f"PGD with {mixed['steps']} steps on {mixed['images']} camera images of unseen towns, {mixed['device']},",
        "with gradients in float32 and in bfloat16 (in turn, beside other work on that GPU): as strong, and no faster.",
        "",
        "| detector | loss ascended | gradients | loss before | after | s |",
        "|---|---|---|---:|---:|---:|",
    ]
    for row in mixed["rows"]:
        what = " | ".join((row["detector"], row["loss"], row["precision"]))
        lines.append(f"| {what} | {row['before']:.4g} | {row['after']:.4g} | {row['s']:.2f} |")
    return [
        *lines,
        "",
        f"Ten steps of PGD take {cost['ratio']:.2f} times the CPU time of the forward and backward passes in them",
        f"(median of {cost['repeats']} runs in turn; {cost['interval'][0]:.2f} to {cost['interval'][1]:.2f}).",
        "",
    ]


def scores() -> list[str]:
    """Scoring beside the official toolkit."""
    data = read("score_speed")
    ours, other = data["ours"], data["devkit"]
    return [
        "## Speed of scoring",
        "",
        f"Measured by `benchmarks/score_speed.py`: {data['samples']:,} samples, {data['truth']:,} ground-truth boxes",
        f"and {data['predictions']:,} detections (a results file of {data['results_mb']:.0f} MB); whole processes.",
        "",
        "| | CPU s | peak memory |",
        "|---|---:|---:|",
        f"| ssad score | {ours['cpu_s']:.2f} | {ours['peak_mib']} MiB |",
        f"| nuscenes-devkit 1.2.0 | {other['cpu_s']:.1f} | {other['peak_mib']} MiB |",
        "",
        f"`ssad score` uses {data['cpu_ratio']:.1f} times less CPU time. The largest difference between the two "
        f"results is {data['largest_difference']:.1g}.",
        "",
    ]


def page() -> str:
    """The page."""
    lines = [
        "# Benchmarks",
        "",
        "> **Stored result.** Commit: of each section the last of its file in `benchmarks/results`, at most "
        "e190b41 (2026-11-25). Weights: not recorded. Torch: where a file names it, 2.15.0 on processors and "
        "2.11.0, which `pyproject.toml` no longer allows, on GPUs; else not recorded. Make it anew: the "
        "script that each section names, then `python benchmarks/page.py`.",
        "",
        "`benchmarks/page.py` makes this page from the measurements in `benchmarks/results`. Only some of these files",
        "name the commit or the versions that they were measured with; sections say so where they do.",
        "",
        "## Speed of the world",
        "",
        "Measured by `benchmarks/world_speed.py --json` on natural junction episodes; medians of five repetitions. A",
        "step is complete: Autopilot traffic, signals, motion, contacts, the ego's record, restart of finished scenes,",
        "and an observation of 28 numbers per scene.",
        "",
    ]
    for name in RUNS:
        lines += section(name, json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text()))
    lines += beside()
    lines += shifts() + scores() + camera() + effects() + sensor() + recorder() + detectors() + attacks()
    return "\n".join(lines)


if __name__ == "__main__":
    (ROOT / "docs" / "results" / "speed.md").write_text(page())
