"""Training loop of detectors: one process per device, resumable, one log line per epoch."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, distributed, nn

from ssad.core import safeio
from ssad.core.checkpoints import read_state
from ssad.core.detections import Truth
from ssad.core.errors import ConfigError, FormatError, StoreError
from ssad.core.seeding import seed32
from ssad.scenarios.static.digital.budget import Budget, px
from ssad.training.batches import ImageSet, make_batch, order, repetition_counts
from ssad.training.recipe import Recipe, recipe_data

LOG = "log.jsonl"
LAST_CHECKPOINT = "last.pt"


class TrainingStep(nn.Module):
    """Losses of a batch as one module, so that gradients can be shared between devices."""

    def __init__(self, detector: Any, *, amp: bool, doubt: float = 0.0) -> None:
        super().__init__()
        self.detector = detector
        self.amp, self.doubt = amp, doubt

    def forward(self, images: Tensor, truth: list[Truth]) -> dict[str, Tensor]:
        """Return losses by name."""
        with torch.autocast("cuda", torch.bfloat16) if self.amp and images.is_cuda else nullcontext():
            intrinsics = None
            if self.detector.task == "3d":
                intrinsics = torch.stack(
                    [image_truth.intrinsic for image_truth in truth if image_truth.intrinsic is not None]
                )
            dense = self.detector.dense(images, intrinsics)
        assignment = self.detector.assign(dense, truth)
        if self.doubt:
            assignment = self.detector.discount_centreness(dense, assignment, doubt=self.doubt)
        return dict(self.detector.losses(dense, assignment))


@dataclass(frozen=True, slots=True)
class ProcessRank:
    """Rank of this process among `world` processes."""

    rank: int = 0
    world: int = 1


def train(
    detector: Any,
    image_set: ImageSet,
    recipe: Recipe,
    *,
    out: Path,
    device: str = "cpu",
    validate: Callable[[Any], dict[str, float]] | None = None,
    report: Callable[[str], None] = lambda line: None,
    share: ProcessRank = ProcessRank(),
    seconds: float | None = None,
    metadata: str = "",
) -> Any:
    """Train a detector on a set of pictures.

    OUT/last.pt holds all that is needed to resume after a stop; OUT/log.jsonl has a line for each epoch.

    Args:
        detector: The detector; it is changed.
        image_set: Pictures and their truth.
        recipe: The recipe.
        out: Folder to write to.
        device: Where to train.
        validate: Metrics of a detector; called every `recipe.validate` epochs but the last.
        report: Called with a line about progress.
        share: The part of the work of this process.
        seconds: Stop after the epoch in which this time runs out, s; it can be resumed.
        metadata: What else the result depends on (data, first weights); it must be the same when training resumes.

    Returns:
        The detector to use: the average of the weights, if one is kept.

    Raises:
        FormatError: last.pt is of another recipe, of other data, or broken.
        StoreError: A file cannot be written.
        ConfigError: The loss is not finite.
    """
    target_device = torch.device(device)
    detector.to(target_device)
    memory_format = torch.channels_last if target_device.type == "cuda" else torch.contiguous_format
    detector.to(memory_format=memory_format)
    _unfreeze(detector, recipe)
    for module in detector.modules():
        if hasattr(module, "compiled"):
            module.compiled = recipe.compile
    loss_step = TrainingStep(detector, amp=recipe.amp, doubt=recipe.doubt)
    parallel_step: Any = loss_step
    if share.world > 1:
        device_ids = [target_device.index or 0] if target_device.type == "cuda" else None
        parallel_step = nn.parallel.DistributedDataParallel(loss_step, device_ids=device_ids)
    optimizer = _optimizer(detector, recipe)
    trainable = [parameter for parameter in detector.parameters() if parameter.requires_grad]
    average = copy.deepcopy(detector).requires_grad_(False).eval() if recipe.average else None
    update_average = _follower(average, detector)
    local_batch = max(recipe.batch // share.world, 1)
    frequencies = repetition_counts(image_set.truth, recipe.rare)
    per_epoch = _common_count(
        len(order(len(image_set), local_batch, seed=0, epoch=0, weights=frequencies)), share, target_device
    )
    epoch, step, time_spent, fastest = _resume(out / LAST_CHECKPOINT, detector, average, optimizer, recipe, metadata)
    start_time = time.monotonic()
    while epoch < (last_epoch := _common_count(recipe.last_epoch(epoch, time_spent, fastest), share, target_device)):
        total_steps = per_epoch * last_epoch
        _training_mode(detector, recipe)
        loss_sums: dict[str, Tensor] = {}
        epoch_start = time.monotonic()
        learning_rate = recipe.lr
        seed = recipe.seed * 1000 + share.rank
        for batch_index, indices in enumerate(
            order(len(image_set), local_batch, seed=seed, epoch=epoch, weights=frequencies)[:per_epoch]
        ):
            learning_rate = recipe.rate(step, total_steps, per_epoch)
            for group in optimizer.param_groups:
                group["lr"] = learning_rate
            key = (recipe.seed, epoch, batch_index, share.rank)
            images, truth = make_batch(image_set, indices, recipe, key=key, device=target_device)
            images = images.contiguous(memory_format=memory_format)
            if recipe.radius:
                images = perturb_images(loss_step, images, truth, recipe, key=key)
            losses = parallel_step(images, truth)
            loss = weighted_sum(losses, recipe.weigh)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            if recipe.clip:
                nn.utils.clip_grad_norm_(trainable, recipe.clip)
            optimizer.step()
            # A smaller decay at first: the average must forget the initial weights.
            update_average(min(recipe.average, (1 + step) / (10 + step)))
            for name, value in losses.items():
                loss_sums[name] = loss_sums.get(name, torch.zeros((), device=target_device)) + value.detach()
            step += 1
        epoch += 1
        image_count, epoch_time = per_epoch * local_batch * share.world, time.monotonic() - epoch_start
        time_spent, fastest = time_spent + epoch_time, min(fastest, epoch_time)
        final_epoch = recipe.last_epoch(epoch, time_spent, fastest)
        row: dict[str, Any] = {
            "epoch": epoch,
            "of": final_epoch,
            "lr": learning_rate,
            "images_s": round(image_count / epoch_time, 1),
            **{f"loss_{name}": round(float(value) / per_epoch, 5) for name, value in loss_sums.items()},
        }
        if not all(math.isfinite(entry) for entry in row.values()):
            raise ConfigError(f"the loss is not finite in epoch {epoch}; use a smaller lr")
        # All processes hold the same weights; the first one writes them.
        if share.rank == 0:
            final_detector = average if average is not None else detector
            state = {
                "model": detector.state_dict(),
                "average": None if average is None else average.state_dict(),
                "optimizer": optimizer.state_dict(),
                "epoch": epoch,
                "step": step,
                "spent": time_spent,
                "quickest": fastest,
                "about": metadata,
                "recipe": safeio.dump_json(recipe_data(recipe)),
            }
            _save(out, state, row)
            if validate is not None and epoch % recipe.validate == 0 and epoch < final_epoch:
                row |= validate(final_detector.eval())
                write_row(out, row)
            report(
                "  ".join(
                    f"{column} {entry:.4g}" if isinstance(entry, float) else f"{column} {entry}"
                    for column, entry in row.items()
                )
            )
        if seconds is not None and _time_is_over(time.monotonic() - start_time > seconds, share, target_device):
            break
    result = average if average is not None else detector
    return result.requires_grad_(False).eval()


def weighted_sum(losses: Mapping[str, Tensor], factors: Mapping[str, float]) -> Tensor:
    """Return the sum of losses times their factors, 1 by default.

    Args:
        losses: Losses by name.
        factors: Factors by name.

    Raises:
        ConfigError: A factor names a loss that the detector does not have.
    """
    for name in factors:
        if name not in losses:
            raise ConfigError(f"weigh: there is no loss '{name}'; there are {', '.join(losses)}")
    return torch.stack([value * factors.get(name, 1.0) for name, value in losses.items()]).sum()


def perturb_images(
    step: TrainingStep, images: Tensor, truth: list[Truth], recipe: Recipe, *, key: tuple[int, ...]
) -> Tensor:
    """Attack images by projected gradient ascent of the training losses from a random start.

    Args:
        step: Losses of images; parameters get no gradients, and norms keep their statistics.
        images: [B, 3, H, W] in [0, 1].
        truth: Truth of each image.
        recipe: `radius` and `attack_steps`; one step is 1.25 radii long, several are 2.5 / steps of it.
        key: Key of the random start.

    Returns:
        [B, 3, H, W] within the radius.

    Source: Madry et al. (ICLR 2018); one step: Wong et al., Fast is Better than Free (ICLR 2020).
    """
    detector, budget = step.detector, Budget(px(recipe.radius))
    generator = torch.Generator(images.device).manual_seed(seed32("adversarial training", *key))
    noise = 2 * torch.rand(images.shape, generator=generator, device=images.device) - 1
    attacked_images = budget.project(images + budget.start(noise, "uniform"), images)
    step_length = budget.radius * min(1.25, 2.5 / recipe.attack_steps)
    training_modes = [(module, module.training) for module in detector.modules()]
    for module, _ in training_modes:
        # Attack steps must not update running statistics.
        module.training = module.training and not isinstance(module, nn.modules.batchnorm._BatchNorm)
    for _ in range(recipe.attack_steps):
        variable = attacked_images.detach().requires_grad_()
        (gradient,) = torch.autograd.grad(torch.stack(list(step(variable, truth).values())).sum(), variable)
        attacked_images = budget.project(attacked_images + step_length * budget.steepest(gradient), images)
    for module, mode in training_modes:
        module.training = mode
    return attacked_images


def _common_count(count: int, share: ProcessRank, device: torch.device) -> int:
    """The least of all processes' counts: their shares of the data differ, their numbers of steps must not."""
    if share.world == 1:
        return count
    minimum = torch.tensor(float(count), device=device)
    distributed.all_reduce(minimum, distributed.ReduceOp.MIN)
    return int(minimum)


def _time_is_over(is_over: bool, share: ProcessRank, device: torch.device) -> bool:
    """Return whether the time is over in the first process: all must stop after the same epoch."""
    if share.world == 1:
        return is_over
    vote = torch.tensor(float(is_over), device=device)
    distributed.broadcast(vote, 0)
    return bool(vote)


def _unfreeze(detector: Any, recipe: Recipe) -> None:
    """Unfreeze all parameters except those that the recipe freezes. ConfigError for an unknown prefix."""
    names = [name for name, _ in detector.named_parameters()]
    for prefix in recipe.freeze:
        if not any(name.startswith(prefix) for name in names):
            raise ConfigError(f"recipe {recipe.detector}: freeze: no parameter's name starts with '{prefix}'")
    for name, value in detector.named_parameters():
        value.requires_grad_(not name.startswith(recipe.freeze) if recipe.freeze else True)


def _training_mode(detector: Any, recipe: Recipe) -> None:
    detector.train()
    if recipe.norm_eval:
        for module in detector.modules():
            if isinstance(module, nn.modules.batchnorm._BatchNorm):
                module.eval()


def _optimizer(detector: Any, recipe: Recipe) -> torch.optim.Optimizer:
    """Return the optimizer, with weight decay on matrices and kernels only."""
    trainable = [parameter for parameter in detector.parameters() if parameter.requires_grad]
    groups = [
        {"params": [parameter for parameter in trainable if parameter.ndim > 1], "weight_decay": recipe.weight_decay},
        {"params": [parameter for parameter in trainable if parameter.ndim <= 1], "weight_decay": 0.0},
    ]
    if recipe.optimizer == "sgd":
        return torch.optim.SGD(groups, lr=recipe.lr, momentum=recipe.momentum)
    use_fused = all(parameter.is_cuda for parameter in trainable)
    return torch.optim.AdamW(groups, lr=recipe.lr, betas=(recipe.momentum, 0.999), fused=use_fused)


def _follower(average: Any, detector: Any) -> Callable[[float], None]:
    """Return a function of a decay that updates the average of weights and statistics, and copies counters."""
    if average is None:
        return lambda decay: None
    average_state, current_state = average.state_dict(), detector.state_dict()
    float_names = [name for name, value in average_state.items() if value.is_floating_point()]
    counter_names = [name for name in average_state if name not in set(float_names)]
    averages, current_values = (
        [average_state[entry] for entry in float_names],
        [current_state[entry] for entry in float_names],
    )
    average_counters, current_counters = (
        [average_state[entry] for entry in counter_names],
        [current_state[entry] for entry in counter_names],
    )

    @torch.no_grad()
    def update_average(decay: float) -> None:
        torch._foreach_lerp_(averages, current_values, 1.0 - decay)
        if current_counters:
            torch._foreach_copy_(average_counters, current_counters)

    return update_average


def _save(out: Path, state: dict[str, Any], row: dict[str, Any]) -> None:
    safeio.make_folder(out)
    try:
        with safeio.atomic_path(out / LAST_CHECKPOINT) as path:
            torch.save(state, path)
    except OSError as error:
        raise StoreError(f"{out}: cannot be written: {error.strerror or error}") from None
    write_row(out, row)


def read_rows(out: Path) -> list[dict[str, Any]]:
    """Return the lines of OUT/log.jsonl, one per epoch."""
    return [safeio.parse_json(line) for line in safeio.read_text(out / LOG).splitlines()]


def write_row(out: Path, row: dict[str, Any]) -> None:
    """Write the log line of an epoch, replacing lines of this and later epochs.

    Raises:
        StoreError: The file cannot be written.
    """
    try:
        rows = read_rows(out) if (out / LOG).is_file() else []
        earlier_rows = [earlier for earlier in rows if earlier["epoch"] < row["epoch"]]
        safeio.write_atomic(out / LOG, "".join(safeio.dump_json(earlier) + "\n" for earlier in [*earlier_rows, row]))
    except OSError as error:
        raise StoreError(f"{out}: cannot be written: {error.strerror or error}") from None


def read_last(path: Path, recipe: Recipe, metadata: str) -> dict[str, Any] | None:
    """The state from which an interrupted training goes on.

    Args:
        path: The file that the training wrote.
        recipe: The recipe of this training.
        metadata: Data, first weights and number of GPUs of this training.

    Returns:
        The state; None if there is none.

    Raises:
        FormatError: The file is broken, or comes from another recipe, other data, other first weights or another number
            of GPUs.
    """
    state = read_state(path, "recipe")
    if state is None:
        return None
    if state["recipe"] != safeio.dump_json(recipe_data(recipe)):
        raise FormatError(f"{path}: of another recipe; choose another folder, or delete it")
    if state.get("about", "") != metadata:
        raise FormatError(
            f"{path}: of other data, other first weights or another number of GPUs; choose another folder, or delete it"
        )
    return state


def _resume(  # noqa: PLR0917
    path: Path, detector: Any, average: Any, optimizer: torch.optim.Optimizer, recipe: Recipe, metadata: str
) -> tuple[int, int, float, float]:
    """Epoch and step to go on with, the time that epochs took, s, and that of the quickest."""
    state = read_last(path, recipe, metadata)
    if state is None:
        return 0, 0, 0.0, math.inf
    try:
        detector.load_state_dict(state["model"])
        if average is not None:
            average.load_state_dict(state["average"])
        optimizer.load_state_dict(state["optimizer"])
        times = float(state.get("spent", 0.0)), float(state.get("quickest", math.inf))
        return int(state["epoch"]), int(state["step"]), *times
    except (KeyError, RuntimeError, ValueError, TypeError, AttributeError) as error:
        error_name = type(error).__name__
        raise FormatError(
            f"{path}: of another detector or data set, or broken ({error_name}); choose another folder"
        ) from None
