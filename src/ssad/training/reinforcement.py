"""Reinforcement learning with stable-baselines3: recipes, the loop with its checkpoints, and what is exported.

stable-baselines3 is needed for training alone: what comes out is a `ssad.world.policy.Policy`.
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
from ssad.core.checkpoints import Card, read_state, save_weights
from ssad.core.driving import Driver
from ssad.core.errors import ConfigError, FormatError, StoreError, unknown_name
from ssad.core.schema import VALUES, Above, Part, Whole, checked
from ssad.training.recipe import Decay, FromNone
from ssad.world.actions import ACTIONS, CHOICES
from ssad.world.policy import Policy, PolicyDriver, policy_of, tensors_of

LOG, LAST = "log.jsonl", "last.pt"
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, config=VALUES)
class Learning:
    """How a policy is trained: all that decides the result but the scenarios.

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
    observation: Literal["safebench", "frea", "traffic", "adversary"] = "traffic"
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


LEARNINGS: dict[str, Learning] = {
    "ppo": Learning("ppo", 1_000_000),
    "sac": Learning("sac", 256_000, batch=256, lr=7e-4, validate=64_000),
    "td3": Learning("td3", 320_000, batch=128, lr=3e-4, gamma=0.97, validate=64_000, noise=0.15),
}
"""How drivers are trained."""


def find_learning(table: Mapping[str, Learning], name: str, changes: Mapping[str, Any]) -> Learning:
    """A recipe of a table by name, with some of its values changed.

    Raises:
        UnknownNameError: There is no such recipe.
        ConfigError: A value does not fit.
    """
    if name not in table:
        raise unknown_name("algorithm", name, table)
    return checked(partial(replace, table[name]), changes, what=f"training {name}", kind=Learning, fixed="algorithm")


def require() -> Any:
    """stable-baselines3; ConfigError without it."""
    try:
        import stable_baselines3
    except ImportError as error:
        raise ConfigError(f"stable-baselines3 is not installed ({error}); install the extra 'train'") from None
    return stable_baselines3


def make_model(learning: Learning, env: Any, *, device: str = "cpu") -> Any:
    """A fresh model of stable-baselines3 on a `VecEnv`.

    Args:
        learning: The recipe.
        env: The scenes.
        device: Where the networks are.
    """
    sb3 = require()
    first, last = learning.lr, learning.lr / 20.0

    def rate(left: float) -> float:
        return last + (first - last) * left

    common: dict[str, Any] = {
        "learning_rate": rate,
        "gamma": learning.gamma,
        "batch_size": learning.batch,
        "seed": learning.seed,
        "device": device,
    }
    nets: dict[str, Any] = {"net_arch": list(learning.hidden), "activation_fn": torch.nn.ReLU}
    if learning.algorithm == "ppo":
        nets["log_std_init"] = math.log(learning.noise)
        return sb3.PPO(
            "MlpPolicy",
            env,
            n_steps=learning.rollout,
            n_epochs=learning.epochs,
            gae_lambda=learning.gae,
            ent_coef=learning.entropy,
            policy_kwargs=nets,
            **common,
        )
    more: dict[str, Any] = {
        "buffer_size": learning.buffer,
        "learning_starts": learning.first,
        "train_freq": 1,
        "gradient_steps": learning.updates,
        "policy_kwargs": nets,
    }
    if learning.algorithm in ("td3", "ddpg"):
        size = env.action_space.shape
        more["action_noise"] = sb3.common.noise.NormalActionNoise(np.zeros(size), np.full(size, learning.noise))
    if learning.algorithm == "dqn":
        if ACTIONS[learning.action] != CHOICES.shape[1]:
            raise ConfigError(f"dqn chooses between actions of two numbers; '{learning.action}' has another number")
        from ssad.world.sb3 import Choosing

        env = Choosing(env)
        more |= {
            "exploration_fraction": 1 / 3,
            "exploration_final_eps": learning.noise,
            "target_update_interval": 1_000,
        }
    return getattr(sb3, learning.algorithm.upper())("MlpPolicy", env, **more, **common)


def begin_with(model: Any, learning: Learning, folder: Path) -> str:
    """Give a fresh model the networks of an earlier training, as its last checkpoint has them.

    Args:
        model: As `make_model` gives it.
        learning: Its recipe.
        folder: Where the earlier training wrote to.

    Returns:
        A hash of the checkpoint.

    Raises:
        ConfigError: There is no checkpoint in the folder.
        FormatError: It is broken, or its networks are of other sizes.
    """
    path = folder / LAST
    state = read_state(path, "key")
    if state is None:
        raise ConfigError(f"{path}: not found; start from the folder of a training with {learning.algorithm}")
    try:
        model.policy.load_state_dict(state["policy"])
    except (KeyError, RuntimeError, TypeError):
        raise FormatError(
            f"{path}: its networks are not those of this training; use the algorithm, hidden, observation and action "
            "that it was made with"
        ) from None
    return sha256(path.read_bytes()).hexdigest()


def export(model: Any, learning: Learning) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """The policy of a model: its tensors as `ssad.world.policy` reads them, and what its card must say.

    Returns:
        Tensors by name, and the part of the card's config that a policy needs.
    """
    if learning.algorithm == "ppo":
        body, head, squash = model.policy.mlp_extractor.policy_net, model.policy.action_net, "clip"
    elif learning.algorithm == "sac":
        body, head, squash = model.actor.latent_pi, model.actor.mu, "tanh"
    elif learning.algorithm == "dqn":
        body, head, squash = model.q_net.q_net, None, "best"
    else:
        body, head, squash = model.actor.mu, None, "tanh"
    layers = [part for part in [*body, head] if isinstance(part, torch.nn.Linear)]
    about = {"observation": learning.observation, "action": learning.action, "squash": squash}
    return tensors_of(layers), about


def policy_now(model: Any, learning: Learning) -> Policy:
    """The policy of a model as it is now."""
    tensors, about = export(model, learning)
    return policy_of(Card("", "", learning.seed, (), config=about), tensors, "training")


def learn(
    model: Any,
    learning: Learning,
    out: Path,
    *,
    validate: Callable[[Policy], dict[str, float]] | None = None,
    say: Say = print,
    seconds: float | None = None,
    about: str = "",
) -> dict[str, Any]:
    """Train a model, or go on where OUT/last.pt stopped.

    OUT/last.pt holds all that is needed to go on (all but ppo: what they remember, too), OUT/log.jsonl a line for each
    validation. A checkpoint is written only while all weights are finite.

    Args:
        model: As `make_model` gives it.
        learning: The recipe.
        out: Folder to write to.
        validate: Metrics of a policy, of which `score` says which one is best.
        say: Called with a line about progress.
        seconds: Stop after this time, s; run it again to go on.
        about: What else the result depends on; it must be the same when the training goes on.

    Returns:
        The state of the checkpoint: `best`, the tensors of the best policy by `score` (the last one without
        `validate`), `best_row`, its line of the log, and `steps`.

    Raises:
        ConfigError: The training diverged: weights are not finite. The last good checkpoint stays.
        FormatError: last.pt is of another recipe, of other scenarios, or broken.
        StoreError: A file cannot be written.
    """
    require()
    key = safeio.dump_json({"learning": asdict(learning), "about": about})
    state = _read_last(out / LAST, key)
    if state is not None:
        _put_back(model, state, out / LAST)
    if model.num_timesteps >= learning.steps and state is not None:
        return state
    keeper = _keeper(model, learning, out, key=key, state=state, validate=validate, say=say, seconds=seconds)
    try:
        model.learn(learning.steps - model.num_timesteps, callback=keeper, reset_num_timesteps=False)
    except ValueError as error:  # torch's distributions refuse what is not a number
        if "Expected parameter" not in str(error):
            raise
        keeper.diverged()
    keeper.keep()
    found: dict[str, Any] = keeper.state
    return found


def _keeper(model: Any, learning: Learning, out: Path, **options: Any) -> Any:
    """The callback that validates and keeps checkpoints; its base class is stable-baselines3's."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Keeper(BaseCallback):  # type: ignore[misc]  # stable-baselines3 may not be installed
        def __init__(self) -> None:
            super().__init__()
            self.state: dict[str, Any] = dict(options["state"] or {"best": None, "best_row": {}, "steps": 0})
            self.next = self.state["steps"] + learning.validate
            self.began = time.monotonic()
            self.start = model.num_timesteps

        def _on_rollout_start(self) -> None:
            if self.num_timesteps >= self.next:
                self.keep()

        def _on_step(self) -> bool:
            limit = options["seconds"]
            return limit is None or time.monotonic() - self.began < limit

        def diverged(self) -> None:
            kept = f"{out / LAST} is of step {self.state['steps']}" if self.state["steps"] else "there is no checkpoint"
            raise ConfigError(
                f"the training diverged before step {self.num_timesteps}: weights are not finite; {kept}; use a "
                "smaller lr in another folder"
            )

        def keep(self) -> None:
            if not all(bool(value.isfinite().all()) for value in model.policy.state_dict().values()):
                self.diverged()
            steps = model.num_timesteps
            self.next = steps + learning.validate
            if steps == self.state["steps"]:
                return
            tensors, _ = export(model, learning)
            passed = max(time.monotonic() - self.began, 1e-9)
            row: dict[str, Any] = {"step": steps, "steps_s": round((steps - self.start) / passed, 1)}
            recent = [episode["r"] for episode in model.ep_info_buffer or ()]
            if recent:
                row["return"] = round(float(np.mean(recent)) / learning.reward_scale, 3)
            if options["validate"] is not None:
                row |= {
                    name: round(value, 5) for name, value in options["validate"](policy_now(model, learning)).items()
                }
            best = self.state["best_row"]
            if self.state["best"] is None or row.get("score", 0.0) >= best.get("score", 0.0):
                self.state |= {"best": tensors, "best_row": row}
            self.state |= {"steps": steps, "key": options["key"]} | _taken(model)
            _write(out, self.state, row)
            options["say"]("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))

    return Keeper()


_MEMORY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def _taken(model: Any) -> dict[str, Any]:
    """All that changes in a model."""
    policy = model.policy
    parts = {"policy": policy.state_dict(), "optimizers": [one.state_dict() for one in _optimizers(model)]}
    memory = getattr(model, "replay_buffer", None)
    if memory is not None:
        rows = memory.buffer_size if memory.full else memory.pos
        parts["memory"] = {name: torch.from_numpy(getattr(memory, name)[:rows].copy()) for name in _MEMORY}
        parts["place"] = (memory.pos, memory.full)
    if getattr(model, "log_ent_coef", None) is not None:
        parts["log_ent_coef"] = model.log_ent_coef.detach().clone()
    return parts


def _optimizers(model: Any) -> list[Any]:
    if hasattr(model, "actor"):
        own = [model.actor.optimizer, model.critic.optimizer]
        return [*own, model.ent_coef_optimizer] if getattr(model, "ent_coef_optimizer", None) is not None else own
    return [model.policy.optimizer]


def _put_back(model: Any, state: Mapping[str, Any], path: Path) -> None:
    """A model as it was at its checkpoint; FormatError if it does not fit."""
    try:
        model.policy.load_state_dict(state["policy"])
        for optimizer, kept in zip(_optimizers(model), state["optimizers"], strict=True):
            optimizer.load_state_dict(kept)
        memory = getattr(model, "replay_buffer", None)
        if memory is not None:
            for name, rows in state["memory"].items():
                getattr(memory, name)[: len(rows)] = rows.numpy()
            memory.pos, memory.full = state["place"]
        if "log_ent_coef" in state:
            model.log_ent_coef.data.copy_(state["log_ent_coef"])
        model.num_timesteps = int(state["steps"])
    except (KeyError, RuntimeError, ValueError, TypeError) as error:
        raise FormatError(f"{path}: of another training, or broken ({type(error).__name__}); delete it") from None
    # scenes start anew: other episodes than at the very beginning
    model.set_random_seed(model.seed + 1 + model.num_timesteps)


def _read_last(path: Path, key: str) -> dict[str, Any] | None:
    state = read_state(path, "key")
    if state is not None and state["key"] != key:
        raise FormatError(f"{path}: of another recipe or other scenarios; choose another folder, or delete it")
    return state


def _write(out: Path, state: Mapping[str, Any], row: Mapping[str, Any]) -> None:
    safeio.make_folder(out)
    try:
        with safeio.atomic_path(out / LAST) as path:
            torch.save(dict(state), path)
        kept = [one for one in read_log(out) if one["step"] < row["step"]]
        safeio.write_atomic(out / LOG, "".join(safeio.dump_json(one) + "\n" for one in [*kept, row]))
    except OSError as error:
        raise StoreError(f"{out}: cannot be written: {error.strerror or error}") from None


def read_log(out: Path) -> list[dict[str, Any]]:
    """The lines of OUT/log.jsonl, a validation each; none if there is no such file."""
    path = out / LOG
    return [safeio.parse_json(line) for line in safeio.read_text(path).splitlines()] if path.is_file() else []


def draw_curves(out: Path) -> None:
    """OUT/curves.png: the return of training episodes, and what the validations found, over steps."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    rows = read_log(out)
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4))
    left.plot(*zip(*((r["step"], r["return"]) for r in rows if "return" in r), strict=True), marker="o")
    left.set(xlabel="step", ylabel="return of an episode")
    for name in sorted({n for r in rows for n in r} - {"step", "steps_s", "return", "score"}):
        points = [(r["step"], r[name]) for r in rows if name in r]
        right.plot(*zip(*points, strict=True), marker="o", label=name)
    right.set(xlabel="step", ylabel="validation", ylim=(0, 1.02))
    right.legend(fontsize=7)
    figure.tight_layout()
    with safeio.atomic_path(out / "curves.png") as path:
        figure.savefig(path, dpi=110, format="png")
    pyplot.close(figure)


def finish(
    path: Path,
    learning: Learning,
    model: Any,
    *,
    state: Mapping[str, Any],
    data: str,
    command: str,
    test: Callable[[Driver], dict[str, float]],
    about: Mapping[str, Any] | None = None,
) -> str:
    """Write the best policy of a training with its card and curves; returns a line about it.

    Args:
        path: NAME.safetensors in the folder of the training.
        learning: Its recipe.
        model: The model.
        state: What `learn` returned.
        data: What it learned from, for the card.
        command: What trains it anew.
        test: Measures a driver.
        about: What else the card says of the training.
    """
    best = state["best_row"]
    own = {f.name: getattr(learning, f.name) for f in fields(learning)}
    config = export(model, learning)[1] | own | {"steps_done": best["step"], **(about or {})}
    draft = Card("", "", learning.seed, (), config=config)
    metrics = test(PolicyDriver(policy_of(draft, state["best"], str(path.parent)), name=path.stem))
    card = Card(data=data, command=command, seed=learning.seed, classes=(), metrics=metrics, config=config)
    save_weights(path, state["best"], card=card)
    draw_curves(path.parent)
    numbers = "  ".join(f"{name} {value:.3f}" for name, value in metrics.items())
    return f"{path}: best at step {best['step']}: {numbers}; card, log.jsonl and curves.png beside it"
