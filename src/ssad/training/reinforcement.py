"""Reinforcement learning with stable-baselines3: recipes, training loop with checkpoints, and export of policies.

stable-baselines3 is needed for training only: the result is a `ssad.world.policy.Policy`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic.dataclasses import dataclass

from ssad.core import safeio
from ssad.core.checkpoints import WeightsCard, read_state, save_weights
from ssad.core.driving import Driver
from ssad.core.errors import ConfigError, FormatError, StoreError, unknown_name
from ssad.core.schema import VALUES, Above, Part, Whole, build_validated
from ssad.training.recipe import Decay, FromNone
from ssad.world.actions import ACTIONS, CHOICES
from ssad.world.policy import Policy, PolicyDriver, policy_of, tensors_of

LOG, LAST_CHECKPOINT = "log.jsonl", "last.pt"
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, config=VALUES)
class PolicyRecipe:
    """Settings of a policy training: all that decides the result but the scenarios.

    Attributes:
        algorithm: ppo, sac, td3, ddpg or dqn (which chooses between actions, see `ssad.world.actions.CHOICES`).
        steps: Steps of the world, over all scenes.
        observation: Sensor that the policy looks at.
        action: What it does, see `ssad.world.actions.to_controls`.
        reward: Name in `ssad.world.rewards.REWARDS`; an adversary's own reward has none.
        reward_scale: The reward is multiplied by it, so that values stay near 10.
        scenes: Scenes side by side.
        draws: Episodes of each scenario, the first of them nominal.
        hidden: Widths of the layers between.
        lr: Learning rate; falls to a 20th of it, evenly.
        gamma: Discount of a step.
        batch: Rows of a gradient step.
        rollout: ppo: steps of each scene between two updates.
        epochs: ppo: passes over them.
        gae: ppo: lambda of the advantages.
        entropy: ppo: weight of the entropy.
        noise: ppo: first standard deviation of the actions; td3, ddpg: of the noise added to them; dqn: share of random
            choices after the first third of the training.
        buffer: all but ppo: steps that are remembered.
        first: all but ppo: steps with random actions before the first update.
        updates: all but ppo: gradient steps after each step of all scenes.
        validate: Steps from one validation to the next.
        seed: Of all random draws.
    """

    algorithm: Literal["ppo", "sac", "td3", "ddpg", "dqn"]
    steps: Whole
    observation: Literal["safebench", "frea", "traffic", "adversary", "adversary-on-road"] = "traffic"
    action: Literal["safebench", "frea", "pedals", "adversary"] = "pedals"
    reward: str = "driver"
    reward_scale: Above = 0.05
    scenes: Whole = 64
    draws: Whole = 4
    hidden: tuple[Whole, ...] = (128, 128)
    lr: Above = 5e-4
    gamma: Decay = 0.99
    batch: Whole = 1024
    rollout: Whole = 128
    epochs: Whole = 5
    gae: Part = 0.95
    entropy: float = 0.0
    noise: Above = 0.5
    buffer: Whole = 200_000
    first: FromNone = 5_000
    updates: Whole = 4
    validate: Whole = 128_000
    seed: FromNone = 0


POLICY_RECIPES: dict[str, PolicyRecipe] = {
    "ppo": PolicyRecipe("ppo", 1_000_000),
    "sac": PolicyRecipe("sac", 256_000, batch=256, lr=7e-4, validate=64_000),
    "td3": PolicyRecipe("td3", 320_000, batch=128, lr=3e-4, gamma=0.97, validate=64_000, noise=0.15),
}
"""How drivers are trained."""


def find_policy_recipe(table: Mapping[str, PolicyRecipe], name: str, changes: Mapping[str, Any]) -> PolicyRecipe:
    """Return a recipe of a table by name, with changed values.

    Raises:
        UnknownNameError: No recipe has that name.
        ConfigError: A value is not valid.
    """
    if name not in table:
        raise unknown_name("algorithm", name, table)
    return build_validated(
        partial(replace, table[name]), changes, subject=f"training {name}", kind=PolicyRecipe, name_field="algorithm"
    )


def import_sb3() -> Any:
    """Import stable-baselines3. ConfigError if it is not installed."""
    try:
        import stable_baselines3
    except ImportError as error:
        raise ConfigError(f"stable-baselines3 is not installed ({error}); install the extra 'train'") from None
    return stable_baselines3


def make_model(
    recipe: PolicyRecipe, env: Any, *, device: str = "cpu", buffer: tuple[Any, dict[str, Any]] | None = None
) -> Any:
    """Make a new stable-baselines3 model on a `VecEnv`.

    Args:
        recipe: The recipe.
        env: The vector environment.
        device: Device of the networks.
        buffer: ppo: class of a rollout buffer that scales its advantages itself, and its arguments.
    """
    sb3 = import_sb3()
    initial_rate, final_rate = recipe.lr, recipe.lr / 20.0

    def rate_schedule(left: float) -> float:
        return final_rate + (initial_rate - final_rate) * left

    common_options: dict[str, Any] = {
        "learning_rate": rate_schedule,
        "gamma": recipe.gamma,
        "batch_size": recipe.batch,
        "seed": recipe.seed,
        "device": device,
    }
    policy_options: dict[str, Any] = {"net_arch": list(recipe.hidden), "activation_fn": torch.nn.ReLU}
    if recipe.algorithm == "ppo":
        policy_options["log_std_init"] = math.log(recipe.noise)
        if buffer is not None:
            common_options |= {
                "rollout_buffer_class": buffer[0],
                "rollout_buffer_kwargs": buffer[1],
                "normalize_advantage": False,
            }
        return sb3.PPO(
            "MlpPolicy",
            env,
            n_steps=recipe.rollout,
            n_epochs=recipe.epochs,
            gae_lambda=recipe.gae,
            ent_coef=recipe.entropy,
            policy_kwargs=policy_options,
            **common_options,
        )
    off_policy_options: dict[str, Any] = {
        "buffer_size": recipe.buffer,
        "learning_starts": recipe.first,
        "train_freq": 1,
        "gradient_steps": recipe.updates,
        "policy_kwargs": policy_options,
    }
    if recipe.algorithm in ("td3", "ddpg"):
        action_shape = env.action_space.shape
        off_policy_options["action_noise"] = sb3.common.noise.NormalActionNoise(
            np.zeros(action_shape), np.full(action_shape, recipe.noise)
        )
    if recipe.algorithm == "dqn":
        if ACTIONS[recipe.action] != CHOICES.shape[1]:
            raise ConfigError(f"dqn chooses between actions of two numbers; '{recipe.action}' has another number")
        from ssad.world.sb3 import DiscreteActions

        env = DiscreteActions(env)
        off_policy_options |= {
            "exploration_fraction": 1 / 3,
            "exploration_final_eps": recipe.noise,
            "target_update_interval": 1_000,
        }
    return getattr(sb3, recipe.algorithm.upper())("MlpPolicy", env, **off_policy_options, **common_options)


def load_start_networks(model: Any, recipe: PolicyRecipe, folder: Path) -> str:
    """Load the networks of the last checkpoint of an earlier training into a new model.

    Args:
        model: A model from `make_model`.
        recipe: Its recipe.
        folder: Output folder of the earlier training.

    Returns:
        Hash of the checkpoint.

    Raises:
        ConfigError: The folder has no checkpoint.
        FormatError: The checkpoint is broken, or its networks have other sizes.
    """
    path = folder / LAST_CHECKPOINT
    state = read_state(path, "key")
    if state is None:
        raise ConfigError(f"{path}: not found; start from the folder of a training with {recipe.algorithm}")
    try:
        model.policy.load_state_dict(state["policy"])
    except (KeyError, RuntimeError, TypeError):
        raise FormatError(
            f"{path}: its networks are not those of this training; use the algorithm, hidden, observation and action "
            "that it was made with"
        ) from None
    return sha256(path.read_bytes()).hexdigest()


def export(model: Any, recipe: PolicyRecipe) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Export the policy of a model: its tensors in the format of `ssad.world.policy`, and its config.

    Returns:
        Tensors by name, and the part of the card's config that a policy needs.
    """
    if recipe.algorithm == "ppo":
        body, head, squash = model.policy.mlp_extractor.policy_net, model.policy.action_net, "clip"
    elif recipe.algorithm == "sac":
        body, head, squash = model.actor.latent_pi, model.actor.mu, "tanh"
    elif recipe.algorithm == "dqn":
        body, head, squash = model.q_net.q_net, None, "best"
    else:
        body, head, squash = model.actor.mu, None, "tanh"
    layers = [layer for layer in [*body, head] if isinstance(layer, torch.nn.Linear)]
    policy_config = {"observation": recipe.observation, "action": recipe.action, "squash": squash}
    return tensors_of(layers), policy_config


def current_policy(model: Any, recipe: PolicyRecipe) -> Policy:
    """Return the current policy of a model."""
    tensors, policy_config = export(model, recipe)
    return policy_of(WeightsCard("", "", recipe.seed, (), config=policy_config), tensors, "training")


def train_policy(
    model: Any,
    recipe: PolicyRecipe,
    out: Path,
    *,
    validate: Callable[[Policy], dict[str, float]] | None = None,
    report: Say = print,
    seconds: float | None = None,
    metadata: str = "",
) -> dict[str, Any]:
    """Train a model, or go on where OUT/last.pt stopped.

    OUT/last.pt holds all that is needed to go on (all but ppo: what they remember, too), OUT/log.jsonl a line for each
    validation. A checkpoint is written only while all weights are finite.

    Args:
        model: As `make_model` gives it.
        recipe: The recipe.
        out: Folder to write to.
        validate: Metrics of a policy, of which `score` says which one is best.
        report: Called with a line about progress.
        seconds: Stop after this time, s; run it again to go on.
        metadata: What else the result depends on; it must be the same when the training goes on.

    Returns:
        The state of the checkpoint: `best`, the tensors of the best policy by `score` (the last one without
        `validate`), `best_row`, its line of the log, and `steps`.

    Raises:
        ConfigError: The training diverged: weights are not finite. The last good checkpoint stays.
        FormatError: last.pt is of another recipe, of other scenarios, or broken.
        StoreError: A file cannot be written.
    """
    import_sb3()
    key = safeio.dump_json({"learning": asdict(recipe), "about": metadata})
    state = _read_last(out / LAST_CHECKPOINT, key)
    if state is not None:
        _restore(model, state, out / LAST_CHECKPOINT)
    if model.num_timesteps >= recipe.steps and state is not None:
        return state
    callback = _checkpoint_callback(
        model, recipe, out, key=key, state=state, validate=validate, say=report, seconds=seconds
    )
    try:
        model.learn(recipe.steps - model.num_timesteps, callback=callback, reset_num_timesteps=False)
    except ValueError as error:  # torch's distributions reject NaN
        if "Expected parameter" not in str(error):
            raise
        callback.diverged()
    callback.keep()
    final_state: dict[str, Any] = callback.state
    return final_state


def _checkpoint_callback(model: Any, recipe: PolicyRecipe, out: Path, **options: Any) -> Any:
    """Return the callback that validates and writes checkpoints; its base class is imported late."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Keeper(BaseCallback):  # type: ignore[misc]  # stable-baselines3 may not be installed
        def __init__(self) -> None:
            super().__init__()
            self.state: dict[str, Any] = dict(options["state"] or {"best": None, "best_row": {}, "steps": 0})
            self.next = self.state["steps"] + recipe.validate
            self.began = time.monotonic()
            self.start = model.num_timesteps

        def _on_rollout_start(self) -> None:
            if self.num_timesteps >= self.next:
                self.keep()

        def _on_step(self) -> bool:
            time_limit = options["seconds"]
            return time_limit is None or time.monotonic() - self.began < time_limit

        def diverged(self) -> None:
            checkpoint_info = (
                f"{out / LAST_CHECKPOINT} is of step {self.state['steps']}"
                if self.state["steps"]
                else "there is no checkpoint"
            )
            raise ConfigError(
                f"the training diverged before step {self.num_timesteps}: weights are not "
                f"finite; {checkpoint_info}; use a "
                "smaller lr in another folder"
            )

        def keep(self) -> None:
            if not all(bool(value.isfinite().all()) for value in model.policy.state_dict().values()):
                self.diverged()
            steps = model.num_timesteps
            self.next = steps + recipe.validate
            if steps == self.state["steps"]:
                return
            tensors, _ = export(model, recipe)
            elapsed = max(time.monotonic() - self.began, 1e-9)
            row: dict[str, Any] = {"step": steps, "steps_s": round((steps - self.start) / elapsed, 1)}
            recent_returns = [episode["r"] for episode in model.ep_info_buffer or ()]
            if recent_returns:
                row["return"] = round(float(np.mean(recent_returns)) / recipe.reward_scale, 3)
            if options["validate"] is not None:
                row |= {
                    name: round(value, 5) for name, value in options["validate"](current_policy(model, recipe)).items()
                }
            best_row = self.state["best_row"]
            if self.state["best"] is None or row.get("score", 0.0) >= best_row.get("score", 0.0):
                self.state |= {"best": tensors, "best_row": row}
            self.state |= {"steps": steps, "key": options["key"]} | _snapshot(model)
            _write(out, self.state, row)
            options["say"](
                "  ".join(
                    f"{column} {entry:.4g}" if isinstance(entry, float) else f"{column} {entry}"
                    for column, entry in row.items()
                )
            )

    return Keeper()


_MEMORY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def _snapshot(model: Any) -> dict[str, Any]:
    """Return the complete state of a model."""
    policy = model.policy
    state = {"policy": policy.state_dict(), "optimizers": [optimizer.state_dict() for optimizer in _optimizers(model)]}
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None:
        rows = buffer.buffer_size if buffer.full else buffer.pos
        state["memory"] = {name: torch.from_numpy(getattr(buffer, name)[:rows].copy()) for name in _MEMORY}
        state["place"] = (buffer.pos, buffer.full)
    if getattr(model, "log_ent_coef", None) is not None:
        state["log_ent_coef"] = model.log_ent_coef.detach().clone()
    return state


def _optimizers(model: Any) -> list[Any]:
    if hasattr(model, "actor"):
        optimizers = [model.actor.optimizer, model.critic.optimizer]
        return (
            [*optimizers, model.ent_coef_optimizer]
            if getattr(model, "ent_coef_optimizer", None) is not None
            else optimizers
        )
    return [model.policy.optimizer]


def _restore(model: Any, state: Mapping[str, Any], path: Path) -> None:
    """Restore a model from its checkpoint. FormatError if it does not fit."""
    try:
        model.policy.load_state_dict(state["policy"])
        for optimizer, optimizer_state in zip(_optimizers(model), state["optimizers"], strict=True):
            optimizer.load_state_dict(optimizer_state)
        buffer = getattr(model, "replay_buffer", None)
        if buffer is not None:
            for name, rows in state["memory"].items():
                getattr(buffer, name)[: len(rows)] = rows.numpy()
            buffer.pos, buffer.full = state["place"]
        if "log_ent_coef" in state:
            model.log_ent_coef.data.copy_(state["log_ent_coef"])
        model.num_timesteps = int(state["steps"])
    except (KeyError, RuntimeError, ValueError, TypeError) as error:
        raise FormatError(f"{path}: of another training, or broken ({type(error).__name__}); delete it") from None
    # a new seed: resumed scenes must not repeat the first episodes
    model.set_random_seed(model.seed + 1 + model.num_timesteps)


def _read_last(path: Path, key: str) -> dict[str, Any] | None:
    state = read_state(path, "key")
    if state is not None and state["key"] != key:
        raise FormatError(f"{path}: of another recipe or other scenarios; choose another folder, or delete it")
    return state


def _write(out: Path, state: Mapping[str, Any], row: Mapping[str, Any]) -> None:
    safeio.make_folder(out)
    try:
        with safeio.atomic_path(out / LAST_CHECKPOINT) as path:
            torch.save(dict(state), path)
        earlier_rows = [earlier for earlier in read_log(out) if earlier["step"] < row["step"]]
        safeio.write_atomic(out / LOG, "".join(safeio.dump_json(earlier) + "\n" for earlier in [*earlier_rows, row]))
    except OSError as error:
        raise StoreError(f"{out}: cannot be written: {error.strerror or error}") from None


def read_log(out: Path) -> list[dict[str, Any]]:
    """Return the lines of OUT/log.jsonl, one per validation; empty without the file."""
    path = out / LOG
    return [safeio.parse_json(line) for line in safeio.read_text(path).splitlines()] if path.is_file() else []


def draw_curves(out: Path) -> None:
    """Draw OUT/curves.png: returns of training episodes and validation metrics over steps."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    rows = read_log(out)
    figure, (return_axes, metric_axes) = pyplot.subplots(1, 2, figsize=(11, 4))
    return_axes.plot(*zip(*((row["step"], row["return"]) for row in rows if "return" in row), strict=True), marker="o")
    return_axes.set(xlabel="step", ylabel="return of an episode")
    for name in sorted({column for row in rows for column in row} - {"step", "steps_s", "return", "score"}):
        points = [(row["step"], row[name]) for row in rows if name in row]
        metric_axes.plot(*zip(*points, strict=True), marker="o", label=name)
    metric_axes.set(xlabel="step", ylabel="validation", ylim=(0, 1.02))
    metric_axes.legend(fontsize=7)
    figure.tight_layout()
    with safeio.atomic_path(out / "curves.png") as path:
        figure.savefig(path, dpi=110, format="png")
    pyplot.close(figure)


def finish(
    path: Path,
    recipe: PolicyRecipe,
    model: Any,
    *,
    state: Mapping[str, Any],
    data: str,
    command: str,
    test: Callable[[Driver], dict[str, float]],
    metadata: Mapping[str, Any] | None = None,
) -> str:
    """Write the best policy of a training with its card and curves; returns a line about it.

    Args:
        path: NAME.safetensors in the folder of the training.
        recipe: Its recipe.
        model: The model.
        state: What `learn` returned.
        data: What it learned from, for the card.
        command: What trains it anew.
        test: Measures a driver.
        metadata: What else the card says of the training.
    """
    best_row = state["best_row"]
    recipe_values = {recipe_field.name: getattr(recipe, recipe_field.name) for recipe_field in fields(recipe)}
    config = export(model, recipe)[1] | recipe_values | {"steps_done": best_row["step"], **(metadata or {})}
    draft_card = WeightsCard("", "", recipe.seed, (), config=config)
    metrics = test(PolicyDriver(policy_of(draft_card, state["best"], str(path.parent)), name=path.stem))
    card = WeightsCard(data=data, command=command, seed=recipe.seed, classes=(), metrics=metrics, config=config)
    save_weights(path, state["best"], card=card)
    draw_curves(path.parent)
    summary = "  ".join(f"{name} {value:.3f}" for name, value in metrics.items())
    return f"{path}: best at step {best_row['step']}: {summary}; card, log.jsonl and curves.png beside it"
