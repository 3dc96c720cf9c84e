"""The training loop: one process a device, resumable, logged a line an epoch."""

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
from ssad.training.batches import PictureSet, make_batch, order, repeats
from ssad.training.recipe import Recipe, recipe_data

LOG = "log.jsonl"
LAST = "last.pt"


class Step(nn.Module):
    """From a batch to its losses, as one module, so that gradients can be shared between devices."""

    def __init__(self, detector: Any, *, amp: bool, doubt: float = 0.0) -> None:
        super().__init__()
        self.detector = detector
        self.amp, self.doubt = amp, doubt

    def forward(self, images: Tensor, truth: list[Truth]) -> dict[str, Tensor]:
        """Losses by name."""
        with torch.autocast("cuda", torch.bfloat16) if self.amp and images.is_cuda else nullcontext():
            lens = None
            if self.detector.task == "3d":
                lens = torch.stack([t.intrinsic for t in truth if t.intrinsic is not None])
            dense = self.detector.dense(images, lens)
        assignment = self.detector.assign(dense, truth)
        if self.doubt:
            assignment = self.detector.doubted(dense, assignment, doubt=self.doubt)
        return dict(self.detector.losses(dense, assignment))


@dataclass(frozen=True, slots=True)
class Share:
    """Which of `world` processes this is."""

    rank: int = 0
    world: int = 1


def train(
    detector: Any,
    bank: PictureSet,
    recipe: Recipe,
    *,
    out: Path,
    device: str = "cpu",
    validate: Callable[[Any], dict[str, float]] | None = None,
    say: Callable[[str], None] = lambda line: None,
    share: Share = Share(),
    seconds: float | None = None,
    about: str = "",
) -> Any:
    """Train a detector on a set of pictures.

    OUT/last.pt holds all that is needed to resume after a stop; OUT/log.jsonl has a line for each epoch.

    Args:
        detector: The detector; it is changed.
        bank: Pictures and their truth.
        recipe: The recipe.
        out: Folder to write to.
        device: Where to train.
        validate: Metrics of a detector; called every `recipe.validate` epochs but the last.
        say: Called with a line about progress.
        share: The part of the work of this process.
        seconds: Stop after the epoch in which this time runs out, s; it can be resumed.
        about: What else the result depends on (data, first weights); it must be the same when the training is resumed.

    Returns:
        The detector to use: the average of the weights, if one is kept.

    Raises:
        FormatError: last.pt is of another recipe, of other data, or broken.
        StoreError: A file cannot be written.
        ConfigError: The loss is not finite.
    """
    where = torch.device(device)
    detector.to(where)
    layout = torch.channels_last if where.type == "cuda" else torch.contiguous_format
    detector.to(memory_format=layout)
    _unfreeze(detector, recipe)
    for part in detector.modules():
        if hasattr(part, "compiled"):
            part.compiled = recipe.compile
    step_of = Step(detector, amp=recipe.amp, doubt=recipe.doubt)
    shared: Any = step_of
    if share.world > 1:
        ids = [where.index or 0] if where.type == "cuda" else None
        shared = nn.parallel.DistributedDataParallel(step_of, device_ids=ids)
    optimizer = _optimizer(detector, recipe)
    learning = [p for p in detector.parameters() if p.requires_grad]
    average = copy.deepcopy(detector).requires_grad_(False).eval() if recipe.average else None
    follow = _follower(average, detector)
    batch = max(recipe.batch // share.world, 1)
    often = repeats(bank.truth, recipe.rare)
    per_epoch = _same(len(order(len(bank), batch, seed=0, epoch=0, often=often)), share, where)
    epoch, step, spent, quickest = _resume(out / LAST, detector, average, optimizer, recipe, about)
    start = time.monotonic()
    while epoch < (last := _same(recipe.last_epoch(epoch, spent, quickest), share, where)):
        total = per_epoch * last
        _training_mode(detector, recipe)
        sums: dict[str, Tensor] = {}
        began = time.monotonic()
        rate = recipe.lr
        seed = recipe.seed * 1000 + share.rank
        for number, indices in enumerate(order(len(bank), batch, seed=seed, epoch=epoch, often=often)[:per_epoch]):
            rate = recipe.rate(step, total, per_epoch)
            for group in optimizer.param_groups:
                group["lr"] = rate
            key = (recipe.seed, epoch, number, share.rank)
            images, truth = make_batch(bank, indices, recipe, key=key, device=where)
            images = images.contiguous(memory_format=layout)
            if recipe.radius:
                images = harden(step_of, images, truth, recipe, key=key)
            losses = shared(images, truth)
            loss = weighed(losses, recipe.weigh)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            if recipe.clip:
                nn.utils.clip_grad_norm_(learning, recipe.clip)
            optimizer.step()
            follow(min(recipe.average, (1 + step) / (10 + step)))
            for name, value in losses.items():
                sums[name] = sums.get(name, torch.zeros((), device=where)) + value.detach()
            step += 1
        epoch += 1
        shown, took = per_epoch * batch * share.world, time.monotonic() - began
        spent, quickest = spent + took, min(quickest, took)
        ends = recipe.last_epoch(epoch, spent, quickest)
        row: dict[str, Any] = {
            "epoch": epoch,
            "of": ends,
            "lr": rate,
            "images_s": round(shown / took, 1),
            **{f"loss_{name}": round(float(value) / per_epoch, 5) for name, value in sums.items()},
        }
        if not all(math.isfinite(v) for v in row.values()):
            raise ConfigError(f"the loss is not finite in epoch {epoch}; use a smaller lr")
        if share.rank == 0:
            final = average if average is not None else detector
            state = {
                "model": detector.state_dict(),
                "average": None if average is None else average.state_dict(),
                "optimizer": optimizer.state_dict(),
                "epoch": epoch,
                "step": step,
                "spent": spent,
                "quickest": quickest,
                "about": about,
                "recipe": safeio.dump_json(recipe_data(recipe)),
            }
            _save(out, state, row)
            if validate is not None and epoch % recipe.validate == 0 and epoch < ends:
                row |= validate(final.eval())
                write_row(out, row)
            say("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
        if seconds is not None and _over(time.monotonic() - start > seconds, share, where):
            break
    best = average if average is not None else detector
    return best.requires_grad_(False).eval()


def weighed(losses: Mapping[str, Tensor], factors: Mapping[str, float]) -> Tensor:
    """The sum of losses times their factors, 1 where there is none.

    Args:
        losses: By name.
        factors: By name.

    Raises:
        ConfigError: There is a factor of a loss that the detector does not have.
    """
    for name in factors:
        if name not in losses:
            raise ConfigError(f"weigh: there is no loss '{name}'; there are {', '.join(losses)}")
    return torch.stack([value * factors.get(name, 1.0) for name, value in losses.items()]).sum()


def harden(step: Step, images: Tensor, truth: list[Truth], recipe: Recipe, *, key: tuple[int, ...]) -> Tensor:
    """Pictures that are harder to learn from: after projected ascent of the training losses from a random start.

    Args:
        step: From pictures to losses; its parameters get no gradient from this, its norms keep their statistics.
        images: [B, 3, H, W] in [0, 1].
        truth: What is in each.
        recipe: `radius` and `attack_steps`; one step is 1.25 radii long, several are 2.5 / steps of it.
        key: What the random start comes from.

    Returns:
        [B, 3, H, W] within the radius.

    Source: Madry et al. (ICLR 2018); one step: Wong et al., Fast is Better than Free (ICLR 2020).
    """
    detector, budget = step.detector, Budget(px(recipe.radius))
    chance = torch.Generator(images.device).manual_seed(seed32("adversarial training", *key))
    draws = 2 * torch.rand(images.shape, generator=chance, device=images.device) - 1
    found = budget.project(images + budget.start(draws, "uniform"), images)
    length = budget.radius * min(1.25, 2.5 / recipe.attack_steps)
    modes = [(part, part.training) for part in detector.modules()]
    for part, _ in modes:
        part.training = part.training and not isinstance(part, nn.modules.batchnorm._BatchNorm)
    for _ in range(recipe.attack_steps):
        asked = found.detach().requires_grad_()
        (gradient,) = torch.autograd.grad(torch.stack(list(step(asked, truth).values())).sum(), asked)
        found = budget.project(found + length * budget.steepest(gradient), images)
    for part, mode in modes:
        part.training = mode
    return found


def _same(count: int, share: Share, where: torch.device) -> int:
    """The least of all processes' counts: their shares of the data differ, their numbers of steps must not."""
    if share.world == 1:
        return count
    least = torch.tensor(float(count), device=where)
    distributed.all_reduce(least, distributed.ReduceOp.MIN)
    return int(least)


def _over(mine: bool, share: Share, where: torch.device) -> bool:
    """Whether time is over, as the first process says: all must stop after the same epoch."""
    if share.world == 1:
        return mine
    flag = torch.tensor(float(mine), device=where)
    distributed.broadcast(flag, 0)
    return bool(flag)


def _unfreeze(detector: Any, recipe: Recipe) -> None:
    """Everything learns but what the recipe holds. ConfigError: it holds what there is not."""
    names = [name for name, _ in detector.named_parameters()]
    for prefix in recipe.freeze:
        if not any(name.startswith(prefix) for name in names):
            raise ConfigError(f"recipe {recipe.detector}: freeze: no parameter's name starts with '{prefix}'")
    for name, value in detector.named_parameters():
        value.requires_grad_(not name.startswith(recipe.freeze) if recipe.freeze else True)


def _training_mode(detector: Any, recipe: Recipe) -> None:
    detector.train()
    if recipe.norm_eval:
        for part in detector.modules():
            if isinstance(part, nn.modules.batchnorm._BatchNorm):
                part.eval()


def _optimizer(detector: Any, recipe: Recipe) -> torch.optim.Optimizer:
    """Weight decay on matrices and kernels only."""
    learning = [p for p in detector.parameters() if p.requires_grad]
    groups = [
        {"params": [p for p in learning if p.ndim > 1], "weight_decay": recipe.weight_decay},
        {"params": [p for p in learning if p.ndim <= 1], "weight_decay": 0.0},
    ]
    if recipe.optimizer == "sgd":
        return torch.optim.SGD(groups, lr=recipe.lr, momentum=recipe.momentum)
    fused = all(p.is_cuda for p in learning)
    return torch.optim.AdamW(groups, lr=recipe.lr, betas=(recipe.momentum, 0.999), fused=fused)


def _follower(average: Any, detector: Any) -> Callable[[float], None]:
    """A function of a decay that moves an average of weights and statistics, and copies counters."""
    if average is None:
        return lambda decay: None
    kept, fresh = average.state_dict(), detector.state_dict()
    floats = [name for name, value in kept.items() if value.is_floating_point()]
    counters = [name for name in kept if name not in set(floats)]
    mean, new = [kept[n] for n in floats], [fresh[n] for n in floats]
    old, counts = [kept[n] for n in counters], [fresh[n] for n in counters]

    @torch.no_grad()
    def follow(decay: float) -> None:
        torch._foreach_lerp_(mean, new, 1.0 - decay)
        if counts:
            torch._foreach_copy_(old, counts)

    return follow


def _save(out: Path, state: dict[str, Any], row: dict[str, Any]) -> None:
    safeio.make_folder(out)
    try:
        with safeio.atomic_path(out / LAST) as path:
            torch.save(state, path)
    except OSError as error:
        raise StoreError(f"{out}: cannot be written: {error.strerror or error}") from None
    write_row(out, row)


def read_rows(out: Path) -> list[dict[str, Any]]:
    """The lines of OUT/log.jsonl, an epoch each."""
    return [safeio.parse_json(line) for line in safeio.read_text(out / LOG).splitlines()]


def write_row(out: Path, row: dict[str, Any]) -> None:
    """Write the line of an epoch; lines of this epoch and of later ones are removed.

    Raises:
        StoreError: The file cannot be written.
    """
    try:
        rows = read_rows(out) if (out / LOG).is_file() else []
        kept = [one for one in rows if one["epoch"] < row["epoch"]]
        safeio.write_atomic(out / LOG, "".join(safeio.dump_json(one) + "\n" for one in [*kept, row]))
    except OSError as error:
        raise StoreError(f"{out}: cannot be written: {error.strerror or error}") from None


def read_last(path: Path, recipe: Recipe, about: str) -> dict[str, Any] | None:
    """The state from which an interrupted training goes on.

    Args:
        path: The file that the training wrote.
        recipe: The recipe of this training.
        about: Data, first weights and number of GPUs of this training.

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
    if state.get("about", "") != about:
        raise FormatError(
            f"{path}: of other data, other first weights or another number of GPUs; choose another folder, or delete it"
        )
    return state


def _resume(  # noqa: PLR0917
    path: Path, detector: Any, average: Any, optimizer: torch.optim.Optimizer, recipe: Recipe, about: str
) -> tuple[int, int, float, float]:
    """Epoch and step to go on with, the time that epochs took, s, and that of the quickest."""
    state = read_last(path, recipe, about)
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
        why = type(error).__name__
        raise FormatError(
            f"{path}: of another detector or data set, or broken ({why}); choose another folder"
        ) from None
