"""Learned policies: weights and a card with the observation and the action. Inference needs torch only.

A policy is a stack of linear layers with ReLU between them, from one sensor of `ssad.world.sensors` to one action of
`ssad.world.actions.to_controls`. Its card names both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ssad.core.checkpoints import WeightsCard, load_card
from ssad.core.driving import Observation
from ssad.core.errors import FormatError
from ssad.core.types import F32, Controller, Episode
from ssad.world.actions import ACTIONS, CHOICES, WIDTHS, to_controls

SQUASHES = ("clip", "tanh", "best")
_BOUND = 1.0e4


@dataclass(frozen=True)
class Policy:
    """A deterministic policy.

    Attributes:
        observation: Name of the sensor.
        action: Kind of the action.
        layers: Weight [out, in] and bias [out] of each layer.
        squash: Map from the last layer to an action: "clip" or "tanh" into [-1, 1]; "best": the outputs are the
            values of `CHOICES`, and the largest is taken.
        card: Origin of the weights.
    """

    observation: str
    action: str
    layers: tuple[tuple[Tensor, Tensor], ...]
    squash: str
    card: WeightsCard

    def actions(self, rows: F32) -> F32:
        """Return actions in [-1, 1].

        Args:
            rows: [N, width] readings of its sensor.

        Returns:
            [N, n]; the bits of a row do not depend on the others.
        """
        activations = np.clip(rows, -_BOUND, _BOUND).astype(np.float32)
        for layer, (weight, bias) in enumerate(self._columns):
            # sums in a fixed order: a matrix product may take another one for another number of rows
            sums = np.tile(bias, (len(activations), 1))
            products = np.empty_like(sums)
            for index, column in enumerate(weight):
                sums += np.multiply(activations[:, index : index + 1], column, out=products)
            activations = sums if layer + 1 == len(self.layers) else np.maximum(sums, 0.0, out=sums)
        outputs = torch.from_numpy(activations)
        if self.squash == "best":
            best_actions: F32 = CHOICES[outputs.numpy().argmax(1)]
            return best_actions
        outputs = outputs.double().tanh().float() if self.squash == "tanh" else outputs.clamp(-1.0, 1.0)
        bounded: F32 = outputs.numpy()
        return bounded

    @cached_property
    def _columns(self) -> tuple[tuple[F32, F32], ...]:
        """Weight [in, out] and bias [out] of each layer."""
        return tuple((np.ascontiguousarray(weight.numpy().T), bias.numpy()) for weight, bias in self.layers)

    def controls(self, rows: F32) -> F32:
        """Return throttle, brake, steer and reverse [N, 4] for readings [N, width]."""
        return to_controls(self.action, self.actions(rows))


class PolicyDriver:
    """Driver that follows a policy; deterministic, stateless, for any number of agents at once.

    Attributes:
        name: Name in tables.
        policy: The policy.
        version: Hash of its weights.
        sensors: Sensors that it reads.
    """

    controller = Controller.EXTERNAL

    def __init__(self, policy: Policy, *, name: str) -> None:
        self.name, self.policy, self.version = name, policy, policy.card.hash
        self.sensors = (policy.observation,)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Do nothing: the policy is stateless."""

    def snapshot(self) -> Mapping[str, npt.NDArray[Any]]:
        """Return an empty mapping: the policy is stateless."""
        return {}

    def restore(self, states: Mapping[str, npt.NDArray[Any]]) -> None:
        """Do nothing: the policy is stateless."""

    def act(self, view: Observation) -> F32:
        """Return throttle, brake, steer and reverse [N, 4] from its sensor; 0 where the episode has ended."""
        rows = view.readings[self.policy.observation]
        controls = np.zeros((len(rows), 4), np.float32)
        controls[~view.done] = self.policy.controls(rows[~view.done])
        return controls


def load_policy(path: str | Path) -> Policy:
    """Load a policy from NAME.safetensors and the card NAME.json beside it.

    Raises:
        FormatError: A file is missing or broken, the card does not name the observation and the action, or the
            weights are of another size.
    """
    card, state = load_card(path)
    return policy_of(card, state, str(path))


def policy_of(card: WeightsCard, state: Mapping[str, Tensor], location: str) -> Policy:
    """Build a policy from its card and tensors; `location` names them in error messages.

    Raises:
        FormatError: As `load_policy`.
    """
    observation, action, squash = (str(card.config.get(key, "")) for key in ("observation", "action", "squash"))
    for field_name, value, allowed in (
        ("observation", observation, WIDTHS),
        ("action", action, ACTIONS),
        ("squash", squash, SQUASHES),
    ):
        if value not in allowed:
            raise FormatError(
                f"{location}: the card of a policy names its {field_name} ({', '.join(allowed)}), not '{value}'"
            )
    layer_count = len(state) // 2
    expected_keys = {
        f"{layer_index}.{tensor_name}" for layer_index in range(layer_count) for tensor_name in ("weight", "bias")
    }
    if not layer_count or set(state) != expected_keys:
        raise FormatError(f"{location}: not the weights of a policy: expected 0.weight, 0.bias, 1.weight, ...")
    layers = tuple(
        (state[f"{layer_index}.weight"].float(), state[f"{layer_index}.bias"].float())
        for layer_index in range(layer_count)
    )
    width = WIDTHS[observation]
    for position, (weight, bias) in enumerate(layers):
        if weight.ndim != 2 or bias.shape != weight.shape[:1] or weight.shape[1] != width:
            shape = list(weight.shape)
            source = f"the observation '{observation}'" if position == 0 else "the layer before it"
            raise FormatError(f"{location}: layer {position} has the shape {shape}, but {source} has {width} numbers")
        width = weight.shape[0]
    if squash == "best" and ACTIONS[action] != CHOICES.shape[1]:
        raise FormatError(
            f"{location}: a policy that chooses has an action of two numbers; '{action}' has another number"
        )
    output_width = len(CHOICES) if squash == "best" else ACTIONS[action]
    if width != output_width:
        raise FormatError(f"{location}: the last layer gives {width} numbers, the action '{action}' has {output_width}")
    return Policy(observation, action, layers, squash, card)


def tensors_of(layers: Any) -> dict[str, Tensor]:
    """Return the tensors of linear layers in order, by name, as `policy_of` reads them."""
    tensors: dict[str, Tensor] = {}
    for number, layer in enumerate(layers):
        tensors |= {f"{number}.weight": layer.weight.detach().clone(), f"{number}.bias": layer.bias.detach().clone()}
    return tensors
