"""Answers of mmdetection3d 1.4.0; for an interpreter that has it (with mmcv 2.1.0, mmdet 3.x, mmengine).

    PYTHON mmdet3d_reference.py fcos3d|pgd OUT --seed N --size W H [--small] [--picture P.npy] [--cam2img K.npy]
    PYTHON mmdet3d_reference.py export OUT --seed N

The first builds the model from mmdetection3d's own nuScenes configuration with weights from the seed (--small: the
same classes, ResNet-50 with 8 channels, heads of 32) and writes OUT/weights.safetensors (not for --small) and
OUT/reference.npz: maps/NAME/LEVEL (the head's, eval mode), boxes/NAME, targets/NAME [B, P, ...], losses/NAME of a batch
of three pictures (the last without an object), alone/NAME [B] of each by itself, gradient [B, 3, H, W] of the sum of
the batch's losses to the normalised pictures (--small: summed over cells of 8 x 8), truth/IMAGE/NAME; targets, the
batch's losses and the gradient in double precision. The second
formats made-up detections of six cameras as NuScenesMetric does for a submission: OUT/reference.npz with translation,
size, rotation, velocity, score, label, attribute. Other names: mono3d_case.py, which draws all from the seed.
"""

import argparse
import copy
import json
import tempfile
from pathlib import Path

import mmdet3d
import numpy as np
import torch
from mmdet3d.models.dense_heads import pgd_head
from mmdet3d.registry import MODELS
from mmdet3d.structures import CameraInstance3DBoxes, Det3DDataSample, points_cam2img
from mmdet3d.utils import register_all_modules
from mmengine.config import Config
from mmengine.structures import InstanceData
from mono3d_case import cam2img, objects, picture, rig, sightings, weights

CONFIGS = {
    "fcos3d": "fcos3d/fcos3d_r101-caffe-dcn_fpn_head-gn_8xb2-1x_nus-mono3d.py",
    "pgd": "pgd/pgd_r101-caffe_fpn_head-gn_16xb2-1x_nus-mono3d.py",
}
NAMES = {
    "fcos3d": ("cls_scores", "bbox_preds", "dir_cls_preds", "attr_preds", "centernesses"),
    "pgd": ("cls_scores", "bbox_preds", "dir_cls_preds", "depth_cls_preds", "weights", "attr_preds", "centernesses"),
}
CLASSES = (
    "car",
    "truck",
    "trailer",
    "bus",
    "construction_vehicle",
    "bicycle",
    "motorcycle",
    "pedestrian",
    "traffic_cone",
    "barrier",
)
CAMERAS = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")


def build(kind, seed, *, small):
    """The model in eval mode with weights from the seed."""
    register_all_modules()
    config = Config.fromfile(Path(mmdet3d.__file__).parent / ".mim" / "configs" / CONFIGS[kind]).model
    config.backbone.init_cfg = None
    if small:
        width, channels = 8, 32
        config.backbone.update(depth=50, base_channels=width, stem_channels=width)
        config.neck.update(in_channels=[width * 4 << k for k in range(4)], out_channels=channels)
        head = config.bbox_head
        head.update(in_channels=channels, feat_channels=channels, centerness_branch=(channels,))
        head.update({f"{name}_branch": (channels,) for name in ("cls", "dir", "attr")})
        head.reg_branch = tuple(() if not branch else (channels,) for branch in head.reg_branch)
        if kind == "pgd":
            head.depth_branch = (channels,)
    model = MODELS.build(config).eval()
    state = model.state_dict()
    drawn = weights({name: tuple(value.shape) for name, value in state.items()}, seed=seed)
    model.load_state_dict({name: torch.from_numpy(value) for name, value in drawn.items()})
    return model


def sample(lens, size, truth=None):
    """What mmdetection3d knows of a picture: camera, size, and true objects."""
    found = Det3DDataSample()
    found.set_metainfo(
        {
            "cam2img": lens.tolist(),
            "scale_factor": (1.0, 1.0),
            "img_shape": size,
            "ori_shape": size,
            "box_type_3d": CameraInstance3DBoxes,
        }
    )
    if truth is None:
        return found
    t = {name: torch.from_numpy(value) for name, value in truth.items()}
    rows = torch.cat([t["centre"], t["size"], t["yaw"][:, None], t["velocity"]], 1)
    solid = CameraInstance3DBoxes(rows, box_dim=9, origin=(0.5, 0.5, 0.5))
    found.gt_instances_3d = InstanceData(
        bboxes_3d=solid,
        labels_3d=t["label"],
        attr_labels=t["attribute"],
        centers_2d=t["centre2d"],
        depths=t["centre"][:, 2].clone(),
    )
    found.gt_instances = InstanceData(bboxes=t["box"], labels=t["label"])
    return found


def prepare(model, pictures, samples):
    """The batch as the model's own preprocessing makes it."""
    data = {
        "inputs": {"img": [torch.from_numpy(p.transpose(2, 0, 1).copy()) for p in pictures]},
        "data_samples": samples,
    }
    done = model.data_preprocessor(data, False)
    return done["inputs"]["imgs"], done["data_samples"]


def answers(model, kind, image, lens):
    """Maps and boxes of one picture."""
    batch, samples = prepare(model, [image], [sample(lens, image.shape[:2])])
    found = {}
    with torch.no_grad():
        maps = model.bbox_head(model.extract_feat({"imgs": batch}))
        # prediction changes the maps in place
        for name, values in zip(NAMES[kind], maps, strict=True):
            found.update({f"maps/{name}/{k}": v.numpy().copy() for k, v in enumerate(values) if v is not None})
        (done,) = model.predict({"imgs": batch}, samples)
    solid = done.pred_instances_3d
    found["boxes/bboxes_3d"] = solid.bboxes_3d.tensor.numpy()
    found.update({f"boxes/{name}": solid[name].numpy() for name in ("scores_3d", "labels_3d", "attr_labels")})
    if kind == "pgd":
        found["boxes/bboxes"] = done.pred_instances.bboxes.numpy()
    return found


def training(model, pictures, lens, truths):
    """Targets, losses and the gradient of a batch; losses of each picture alone."""
    size = pictures[0].shape[:2]
    batch, samples = prepare(model, pictures, [sample(lens, size, t) for t in truths])
    model.train()  # batch norms stay in eval mode
    head = model.bbox_head
    found, alone = {}, {}
    for one, data in zip(batch, samples, strict=True):
        with torch.no_grad():
            losses = model.loss({"imgs": one[None]}, [copy.deepcopy(data)])
        for name, value in losses.items():
            alone.setdefault(name.removeprefix("loss_"), []).append(float(value))
    found.update({f"alone/{name}": np.array(values) for name, values in alone.items()})
    model.double()  # in single precision a gradient through 101 layers has three digits
    batch = batch.double()
    for one in samples:
        solid = one.gt_instances_3d
        solid.bboxes_3d.tensor = solid.bboxes_3d.tensor.double()
        solid.centers_2d, solid.depths = solid.centers_2d.double(), solid.depths.double()
        one.gt_instances.bboxes = one.gt_instances.bboxes.double()
    pgd_head.points_cam2img = lambda points, lens, **named: points_cam2img(points.to(lens.dtype), lens, **named)
    # the head turns the true boxes' yaw in place: each call has a copy of its own
    batch.requires_grad_(True)
    maps = head(model.extract_feat({"imgs": batch}))
    copies = copy.deepcopy(samples)
    sizes = [m.shape[-2:] for m in maps[0]]
    points = head.get_points(sizes, batch.dtype, batch.device)
    columns = head.get_targets(points, [s.gt_instances_3d for s in copies], [s.gt_instances for s in copies])
    for name, levels in zip(("label", "reg", "centreness", "attribute"), columns, strict=True):
        rows = [level.unflatten(0, (len(pictures), -1)) for level in levels]
        found[f"targets/{name}"] = torch.cat(rows, 1).numpy()
    copies = copy.deepcopy(samples)
    losses = head.loss_by_feat(
        *maps, [s.gt_instances_3d for s in copies], [s.gt_instances for s in copies], [s.metainfo for s in copies]
    )
    found.update({f"losses/{name.removeprefix('loss_')}": np.array(float(v)) for name, v in losses.items()})
    sum(losses.values()).backward()
    found["gradient"] = batch.grad[:, :, : size[0], : size[1]].numpy()
    return {name: v.astype(np.float32) if v.dtype == np.float64 else v for name, v in found.items()}


def export(seed):
    """Made-up detections of six cameras, formatted for a submission."""
    from mmdet3d.evaluation.metrics.nuscenes_metric import NuScenesMetric
    from nuscenes.eval.common.config import config_factory

    torch.Tensor.cuda = lambda self: self  # the source moves boxes to the GPU
    to_ego, to_world = rig(seed=seed)
    metric = NuScenesMetric.__new__(NuScenesMetric)
    metric.eval_detection_configs = config_factory("detection_cvpr_2019")
    metric.modality = {}
    cameras = {name: {"cam2ego": m.tolist()} for name, m in zip(CAMERAS, to_ego, strict=True)}
    metric.data_infos = [{"token": "one", "ego2global": to_world.tolist(), "images": cameras}]
    rows = []
    for one in sightings(seed=seed):
        t = {name: torch.from_numpy(value) for name, value in one.items()}
        values = torch.cat([t["centre"], t["size"], t["yaw"][:, None], t["velocity"]], 1)
        solid = CameraInstance3DBoxes(values, box_dim=9, origin=(0.5, 0.5, 0.5))
        rows.append(
            {"bboxes_3d": solid, "scores_3d": t["score"], "labels_3d": t["label"], "attr_labels": t["attribute"]}
        )
    with tempfile.TemporaryDirectory() as folder:
        path = metric._format_camera_bbox(rows, list(range(6)), CLASSES, folder)
        boxes = json.loads(Path(path).read_text())["results"]["one"]
    found = {name: np.array([b[name] for b in boxes]) for name in ("translation", "size", "rotation", "velocity")}
    found["score"] = np.array([b["detection_score"] for b in boxes])
    found["label"] = np.array([CLASSES.index(b["detection_name"]) for b in boxes])
    found["attribute"] = np.array([b["attribute_name"] for b in boxes])
    return found


def main():
    """Read the command line, write the answers."""
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=[*CONFIGS, "export"])
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--size", type=int, nargs=2, default=(416, 256), metavar=("W", "H"))
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--cam2img", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    given.out.mkdir(parents=True, exist_ok=True)
    if given.kind == "export":
        np.savez_compressed(given.out / "reference.npz", **export(given.seed))
        return
    width, height = given.size
    model = build(given.kind, given.seed, small=given.small)
    if not given.small:
        from safetensors.torch import save_file

        save_file(model.state_dict(), given.out / "weights.safetensors")
    images = [picture(width, height, seed=given.seed + k) for k in range(3)]
    image = np.load(given.picture) if given.picture else images[0]
    lens = np.load(given.cam2img) if given.cam2img else cam2img(width, height)
    found = answers(model, given.kind, image, lens)
    truths = [objects(width, height, seed=given.seed + k, count=(12, 7, 0)[k]) for k in range(3)]
    found.update(training(model, images, cam2img(width, height), truths))
    if given.small:
        found["gradient"] = found["gradient"].reshape(3, 3, height // 8, 8, width // 8, 8).sum((3, 5))
    found.update({f"truth/{k}/{name}": value for k, one in enumerate(truths) for name, value in one.items()})
    np.savez_compressed(given.out / "reference.npz", **found)


if __name__ == "__main__":
    main()
