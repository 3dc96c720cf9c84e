"""Training of textures: gradient descent through camera, print and detector, with checkpoints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import numpy as np
import torch
from pydantic import Field, PlainValidator
from pydantic.dataclasses import dataclass as checked_dataclass
from torch import Tensor

from ssad.core import safeio
from ssad.core.detections import Truth
from ssad.core.errors import ConfigError, FormatError, UnknownNameError
from ssad.core.protocols import Detector
from ssad.core.schema import VALUES, Above, Least, Part, Whole
from ssad.core.seeding import digest, generator
from ssad.scenarios.static.digital.objectives import Aim, Objective, Situation, make_objective
from ssad.scenarios.static.digital.victim import steady
from ssad.scenarios.static.physical.textures.carrier import TextureSurface, albedo_of
from ssad.scenarios.static.physical.textures.inks import clamp_tones, ink_colour, project_onto_gamut, tones_of
from ssad.scenarios.static.physical.textures.printing import (
    Expectation,
    conspicuousness,
    non_printability,
    total_variation,
)
from ssad.scenarios.static.physical.zoom import STEP, around_target

TARGET = Aim(objects=(0,))
"""The target is the first object of each image's truth."""


class EditableImage(Protocol):
    """Protocol of an image whose target can wear textures."""

    @classmethod
    def together(
        cls, pictures: Sequence[Any], textures: Mapping[int, Tensor], noise: Sequence[torch.Generator] | None = None
    ) -> Tensor:
        """Render images [B, 3, H, W] in 0 to 1, differentiable in the textures [B, 3, h, w] of linear albedo."""


@dataclass(frozen=True, slots=True)
class TextureView:
    """Image to train or test on.

    Attributes:
        picture: Image whose target wears texture 0.
        truth: Ground truth, the target first.
    """

    picture: EditableImage
    truth: Truth


def _loss(value: Any) -> Any:
    """Validate a loss or the name of one."""
    if isinstance(value, str):
        try:
            make_objective(value)
        except UnknownNameError as error:
            raise ValueError(str(error)) from None
    elif not callable(value):
        raise ValueError("expected a loss, or the name of one")
    return value


@checked_dataclass(frozen=True, slots=True, config=VALUES)
class TextureAttack:
    """Settings for training a texture.

    Attributes:
        name: Name shown in tables.
        objective: Loss to ascend, or its name.
        epochs: Passes over all images.
        inks: Whether the texels are tones of inks on paper, so that whatever is learned can be printed
            (`ssad.scenarios.static.physical.textures.inks`); False: any colour.
        rate: Learning rate, in units of tones, or of colour (0 to 1).
        optimiser: adam, or sgd with momentum 0.9.
        decay: Weight decay towards mid-grey.
        batch: Images per step.
        smooth: Weight of the total variation.
        printed: Weight of the non-printability, of texels of any colour; tones of inks need none.
        stealth: Weight of the conspicuousness, of 100: the distance of the colours from those that the texture
            covers.
        expectation: Variation between prints.
        worst: Share of the images of an epoch that are drawn by how badly the attack performs on them, instead of
            once each; 0: none.
        window: Side of the square crop around the target for a 2D detector, px; None: the whole image, which 3D
            detectors always receive, since their boxes belong to its camera.
    """

    name: str
    objective: Annotated[str | Objective, PlainValidator(_loss)] = "hide"
    epochs: Whole = 20
    inks: bool = True
    rate: Above = 0.04
    optimiser: Literal["adam", "sgd"] = "adam"
    decay: Least = 0.0
    batch: Whole = 8
    smooth: Least = 0.1
    printed: Least = 0.01
    stealth: Least = 0.0
    expectation: Expectation = field(default_factory=Expectation)
    worst: Part = 0.0
    window: Annotated[int, Field(ge=4 * STEP, multiple_of=STEP)] | None = None


@dataclass(slots=True)
class TextureTrainingResult:
    """Trained texture and its training history.

    Attributes:
        colour: sRGB [3, H, W] in 0 to 1, on the CPU; all of it printable if the texels were tones of inks.
        losses: Mean of the ascended loss in each epoch.
        gradients: Maximum length of a texel's gradient in each epoch; 0 means that no gradient reaches the texture.
    """

    colour: Tensor
    losses: list[float]
    gradients: list[float]


def train_texture(
    attack: TextureAttack,
    detector: Detector,
    surface: TextureSurface,
    views: Sequence[TextureView],
    *,
    start: Tensor,
    printable: Tensor | None = None,
    paint: Tensor | None = None,
    appearance: Callable[[Tensor], Tensor] = albedo_of,
    key: tuple[object, ...] = (),
    device: str | torch.device = "cpu",
    checkpoint: Path | None = None,
    progress: Callable[[int, int], None] = lambda completed, total: None,
) -> TextureTrainingResult:
    """Train a texture on images of its target.

    Args:
        attack: Settings of the training.
        detector: Detector under attack; its modes, flags and buffers are restored afterwards.
        surface: Surface that carries the texture.
        views: Images whose target wears texture 0 on that surface; with 3D truth and a camera matrix for a 3D
            detector.
        start: Initial texture, sRGB [3, H, W]; with `attack.inks` the nearest printable one is.
        printable: Colours [N, 3] that can be printed, for `attack.printed`; None: that term is left out.
        paint: Linear RGB [3] of the covered surface, for `attack.stealth`.
        appearance: Maps the colours of a texture to the albedo of its print, or to the light of a projector.
        key: Key of all random draws.
        device: Device of the detector.
        checkpoint: File of the state after each epoch; an existing one is continued, to the bit on the CPU,
            also by more epochs than it was begun with.
        progress: Called with epochs done, and of how many.

    Raises:
        ConfigError: No pictures, a texture of another size, a target that is never in view, a loss that does not
            depend on the texture, or stealth without the paint.
        FormatError: The checkpoint is of another training, or broken.
    """
    if not views:
        raise ConfigError("no pictures to train a texture on")
    if tuple(start.shape) != (3, *surface.size):
        raise ConfigError(f"the texture is {list(start.shape)}, the surface takes {[3, *surface.size]}")
    if not (float(start.min()) >= 0.0 and float(start.max()) <= 1.0):
        raise ConfigError("a texture's colours lie in 0 to 1")
    if attack.stealth > 0.0 and paint is None:
        raise ConfigError(f"attack {attack.name}: stealth is for what is printed on something, whose colour is known")
    objective = make_objective(attack.objective) if isinstance(attack.objective, str) else attack.objective
    colour_of, bounded = (ink_colour, clamp_tones) if attack.inks else (_same, _clamp_colour)
    texels = (tones_of(start) if attack.inks else start).detach().to(device, torch.float32).clone().requires_grad_()
    middle = torch.full_like(start[:, :1, :1], 0.5)
    neutral = (tones_of(middle) if attack.inks else middle).to(texels)
    optimiser: torch.optim.Optimizer
    if attack.optimiser == "adam":
        optimiser = torch.optim.Adam([texels], lr=attack.rate, eps=1e-8)
    else:
        optimiser = torch.optim.SGD([texels], lr=attack.rate, momentum=0.9)
    state = _State(texels, optimiser, np.zeros(len(views)), [], [])
    # Without the number of epochs, so that a training can be resumed with more of them.
    training_id = digest("texture", replace(attack, epochs=1), surface.size, surface.place, len(views), key)
    if checkpoint is not None and checkpoint.is_file():
        state.load(checkpoint, training_id)
    mask = torch.as_tensor(surface.mask, device=device)
    ink_colours = None if printable is None or attack.inks else printable.to(texels)
    with steady(detector):
        for epoch in range(len(state.losses), attack.epochs):
            order = _order(attack, state.hard, generator("texture order", *key, epoch))
            # Numbers stay on the device until the end of the epoch: each transfer from a GPU waits for all its work.
            epoch_losses: list[Tensor] = []
            steepest = texels.new_zeros(())
            for step, batch_start in enumerate(range(0, len(order), attack.batch)):
                batch_indices = order[batch_start : batch_start + attack.batch]
                colour = colour_of(texels)
                losses = _ascended_losses(
                    attack, objective, detector, views, colour, batch_indices.tolist(), appearance, (*key, epoch, step)
                )
                loss = -losses.mean() + attack.smooth * total_variation(colour, mask)
                if ink_colours is not None and attack.printed > 0.0:
                    loss = loss + attack.printed * non_printability(colour, ink_colours, mask)
                if paint is not None and attack.stealth > 0.0:
                    loss = loss + attack.stealth * conspicuousness(albedo_of(colour), paint.to(colour), mask) / 100.0
                optimiser.zero_grad()
                torch.autograd.backward(loss)
                assert texels.grad is not None
                if not bool(texels.grad.isfinite().all()):
                    raise ConfigError(f"attack {attack.name}: the gradient is not finite in epoch {epoch + 1}")
                if attack.decay > 0.0:
                    texels.grad += attack.decay * (texels.detach() - neutral)
                steepest = torch.maximum(steepest, texels.grad.square().sum(0).max().sqrt())
                optimiser.step()
                with torch.no_grad():
                    texels.copy_(bounded(texels))
                epoch_losses.append(losses.detach())
            image_losses = torch.cat(epoch_losses).double().cpu().numpy()
            state.hard[order] = image_losses
            state.losses.append(float(image_losses.mean()))
            state.gradients.append(float(steepest))
            if not any(state.gradients):  # in later epochs a zero gradient means that nothing is left to hide
                raise ConfigError(
                    f"attack {attack.name}: loss '{objective.name}' has no slope in the texture: the target is never "
                    "in view, or is not found even without it"
                )
            if checkpoint is not None:
                state.save(checkpoint, training_id)
            progress(epoch + 1, attack.epochs)
    trained_colour = colour_of(texels.detach()).cpu()
    if attack.inks:
        # Textures cannot show every print, and what they show of it must be printable too.
        trained_colour = project_onto_gamut(trained_colour)
    return TextureTrainingResult(trained_colour, state.losses, state.gradients)


def _same(colour: Tensor) -> Tensor:
    return colour


def _clamp_colour(colour: Tensor) -> Tensor:
    return colour.clamp(0.0, 1.0)


def _ascended_losses(  # noqa: PLR0917
    attack: TextureAttack,
    objective: Objective,
    detector: Detector,
    views: Sequence[TextureView],
    colour: Tensor,
    image_indices: list[int],
    appearance: Callable[[Tensor], Tensor],
    key: tuple[object, ...],
) -> Tensor:
    """Return the loss [B] of some images, each with its own print and noise."""
    draws = [
        torch.Generator().manual_seed(int(digest("texture draw", *key, index)[:15], 16)) for index in image_indices
    ]
    images_to_dress, truth = (
        [views[index].picture for index in image_indices],
        [views[index].truth for index in image_indices],
    )
    textures = appearance(attack.expectation.draw(colour, draws))
    images = type(images_to_dress[0]).together(images_to_dress, {0: textures}, draws)
    is_3d = detector.task == "3d"
    if attack.window is not None and not is_3d:
        crops = [
            around_target(image[None], image_truth, attack.window, image_generator)
            for image, image_truth, image_generator in zip(images, truth, draws, strict=True)
        ]
        images, truth = torch.cat([crop for crop, _ in crops]), [image_truth for _, image_truth in crops]
    cameras = [ground_truth.intrinsic for ground_truth in truth if ground_truth.intrinsic is not None and is_3d]
    dense = detector.dense(images, torch.stack(cameras).to(images) if cameras else None)
    with torch.no_grad():
        assignment = detector.assign(dense, truth)
    return objective(dense, Situation(detector, assignment, TARGET))


def _order(attack: TextureAttack, image_losses: Any, random: np.random.Generator) -> Any:
    """Return the images of an epoch: each once, but a share replaced by those on which the attack fails."""
    order = random.permutation(len(image_losses))
    replaced = int(attack.worst * len(image_losses))
    if replaced and np.ptp(image_losses) > 0.0:
        standard_loss = (
            -(image_losses - image_losses.mean()) / image_losses.std()
        )  # a low loss: the target is still detected
        probability = np.exp(np.clip(standard_loss, -3.0, 3.0))
        order[:replaced] = random.choice(len(image_losses), size=replaced, p=probability / probability.sum())
    return order


@dataclass(slots=True)
class _State:
    """Everything that changes during a training; texels are tones of inks, or colours."""

    texels: Tensor
    optimiser: torch.optim.Optimizer
    hard: Any
    losses: list[float]
    gradients: list[float]

    def save(self, path: Path, name: str) -> None:
        """Write the state in one file."""
        optimiser_state = self.optimiser.state[self.texels]
        arrays = {"texels": self.texels.detach().cpu().numpy(), "hard": self.hard}
        arrays |= {"losses": np.array(self.losses), "gradients": np.array(self.gradients)}
        for key, value in optimiser_state.items():
            arrays[f"optimiser.{key}"] = torch.as_tensor(value).cpu().numpy()
        arrays["name"] = np.frombuffer(name.encode(), np.uint8)
        safeio.make_folder(path.parent)
        safeio.save_npz(path, arrays)

    def load(self, path: Path, name: str) -> None:
        """Read the state from a file. FormatError: it is of another training."""
        arrays = safeio.load_npz(path)
        try:
            if arrays["name"].tobytes().decode() != name or arrays["texels"].shape != tuple(self.texels.shape):
                raise FormatError(f"{path}: the checkpoint of another training; remove it, or choose another file")
            with torch.no_grad():
                self.texels.copy_(torch.from_numpy(arrays["texels"].copy()))
            self.hard = arrays["hard"].copy()
            self.losses = arrays["losses"].tolist()
            self.gradients = arrays["gradients"].tolist()
            optimiser_state = {}
            for key, value in arrays.items():
                if key.startswith("optimiser."):
                    tensor = torch.from_numpy(value.copy())
                    optimiser_state[key.removeprefix("optimiser.")] = (
                        tensor if tensor.ndim == 0 else tensor.to(self.texels.device)
                    )
            self.optimiser.state[self.texels] = optimiser_state
        except KeyError as error:
            raise FormatError(f"{path}: no checkpoint of a texture ({error} is missing)") from None
