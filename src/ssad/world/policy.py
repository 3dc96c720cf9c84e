"""Learned policies: weights with a card, what they look at, and the controls that they give; torch alone runs them.

A policy is a stack of linear layers with ReLU between them, from one sensor of `ssad.world.sensors` to one action of
`ssad.world.actions.to_controls`. Its card says which ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssad.core.checkpoints import Card, load_card
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
        squash: How the last layer's numbers become an action: "clip" or "tanh" into [-1, 1]; "best": they are the
            values of `CHOICES`, and the largest is taken.
        card: Where it comes from.
    """

    observation: str
    action: str
    layers: tuple[tuple[Tensor, Tensor], ...]
    squash: str
    card: Card

    def actions(self, rows: F32) -> F32:
        """Actions in [-1, 1].

        Args:
            rows: [N, width] readings of its sensor.

        Returns:
            [N, n]; the bits of a row do not depend on the others.
        """
        given = np.clip(rows, -_BOUND, _BOUND).astype(np.float32)
        for number, (weight, bias) in enumerate(self._columns):
            # sums in a fixed order: a matrix product may take another one for another number of rows
            total = np.tile(bias, (len(given), 1))
            part = np.empty_like(total)
            for k, column in enumerate(weight):
                total += np.multiply(given[:, k : k + 1], column, out=part)
            given = total if number + 1 == len(self.layers) else np.maximum(total, 0.0, out=total)
        x = torch.from_numpy(given)
        if self.squash == "best":
            chosen: F32 = CHOICES[x.numpy().argmax(1)]
            return chosen
        x = x.double().tanh().float() if self.squash == "tanh" else x.clamp(-1.0, 1.0)
        found: F32 = x.numpy()
        return found

    @cached_property
    def _columns(self) -> tuple[tuple[F32, F32], ...]:
        """Weight [in, out] and bias [out] of each layer."""
        return tuple((np.ascontiguousarray(weight.numpy().T), bias.numpy()) for weight, bias in self.layers)

    def controls(self, rows: F32) -> F32:
        """Throttle, brake, steer and reverse [N, 4] from readings [N, width]."""
        return to_controls(self.action, self.actions(rows))


class PolicyDriver:
    """Drives by a policy; deterministic, without memory, for any number of agents at once.

    Attributes:
        name: What tables call it.
        policy: What it does.
        version: Hash of its weights.
        sensors: What it looks at.
    """

    controller = Controller.EXTERNAL

    def __init__(self, policy: Policy, *, name: str) -> None:
        self.name, self.policy, self.version = name, policy, policy.card.hash
        self.sensors = (policy.observation,)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Nothing to forget."""

    def act(self, view: Observation) -> F32:
        """Throttle, brake, steer and reverse [N, 4] from what its sensor shows; 0 where the episode has ended."""
        rows = view.readings[self.policy.observation]
        out = np.zeros((len(rows), 4), np.float32)
        out[~view.done] = self.policy.controls(rows[~view.done])
        return out


def load_policy(path: str | Path) -> Policy:
    """A policy from NAME.safetensors and the card NAME.json beside it.

    Raises:
        FormatError: A file is missing or broken, the card does not say what the policy looks at and does, or the
            weights are of another size.
    """
    card, state = load_card(path)
    return policy_of(card, state, str(path))


def policy_of(card: Card, state: Mapping[str, Tensor], where: str) -> Policy:
    """A policy from its card and tensors; `where` names them in messages.

    Raises:
        FormatError: As `load_policy`.
    """
    observation, action, squash = (str(card.config.get(key, "")) for key in ("observation", "action", "squash"))
    for what, value, known in (
        ("observation", observation, WIDTHS),
        ("action", action, ACTIONS),
        ("squash", squash, SQUASHES),
    ):
        if value not in known:
            raise FormatError(f"{where}: the card of a policy names its {what} ({', '.join(known)}), not '{value}'")
    count = len(state) // 2
    names = {f"{k}.{part}" for k in range(count) for part in ("weight", "bias")}
    if not count or set(state) != names:
        raise FormatError(f"{where}: not the weights of a policy: expected 0.weight, 0.bias, 1.weight, ...")
    layers = tuple((state[f"{k}.weight"].float(), state[f"{k}.bias"].float()) for k in range(count))
    width = WIDTHS[observation]
    for number, (weight, bias) in enumerate(layers):
        if weight.ndim != 2 or bias.shape != weight.shape[:1] or weight.shape[1] != width:
            shape = list(weight.shape)
            before = f"the observation '{observation}'" if number == 0 else "the layer before it"
            raise FormatError(f"{where}: layer {number} has the shape {shape}, but {before} has {width} numbers")
        width = weight.shape[0]
    if squash == "best" and ACTIONS[action] != CHOICES.shape[1]:
        raise FormatError(f"{where}: a policy that chooses has an action of two numbers; '{action}' has another number")
    wanted = len(CHOICES) if squash == "best" else ACTIONS[action]
    if width != wanted:
        raise FormatError(f"{where}: the last layer gives {width} numbers, the action '{action}' has {wanted}")
    return Policy(observation, action, layers, squash, card)


def tensors_of(layers: Any) -> dict[str, Tensor]:
    """Tensors by name, as `policy_of` reads them, of linear layers in order."""
    found: dict[str, Tensor] = {}
    for number, layer in enumerate(layers):
        found |= {f"{number}.weight": layer.weight.detach().clone(), f"{number}.bias": layer.bias.detach().clone()}
    return found
