"""`ssad train feasible-region`: the states in which the ego can avoid a collision, learned offline from drives.

The region is the zero sublevel set of a value V of the ego's state: V <= 0 where some driving in the data keeps the ego
clear of others, V > 0 where none does. It is learned without a simulator: twin critics Q regress to the discounted
safety target (1 - gamma) h + gamma max(h, V'), where h is positive while bodies touch and -1 otherwise, and V is a low
expectile of the larger Q over the actions in the data. `ssad.training.feasible_ppo` uses V as a critic.

Source: FREA (Chen et al. 2024, arXiv 2406.02983) for the state, h and most settings; its value is that of the largest
feasible region of Zheng et al. (FISOR, ICLR 2024) after the discounted safety Bellman equation of Fisac et al. (2019).
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import pydantic.dataclasses
import torch
from torch import Tensor, nn

from ssad.core import safeio
from ssad.core.checkpoints import WeightsCard, copy_state, load_card, save_weights
from ssad.core.driving import Driver, WorldState
from ssad.core.errors import ConfigError, FormatError
from ssad.core.geometry import obb_distance
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.schema import VALUES, Above, Part, Whole, build_validated
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, I32, AgentKind, Bool, Contact, Controller, End, Episode
from ssad.drivers import make_system
from ssad.training.driver import draw_episodes, natural_scenarios
from ssad.training.recipe import Decay, FromNone, command_line_changes
from ssad.training.reinforcement import Say
from ssad.world.rollout import Loop
from ssad.world.selection import FreaSelection
from ssad.world.world import World

SHIPPED: Final = Path(__file__).parent / "weights" / "feasible-region.safetensors"
STATE: Final = 18  # numbers of a state: x, y, length, width, heading and speed of the ego and of two others
TOUCHING: Final = 0.1  # m between bodies up to which they count as touching
NO_ADVERSARY: Final = "none"
ACTION: Final = 3  # throttle, brake, steer
_RADIUS: Final = 25.0  # m within which others are part of the state
_SCALE: Final = np.tile(np.array([10.0, 10.0, 5.0, 2.0, 1.0, 10.0], np.float32), 3)
_EVADING: Final = 1_001  # index of the evasions' driver, beyond those of the loop
_EVASIONS: Final = np.array(
    # throttle, brake, steer, reverse
    [[0, 1, 0, 0], [0, 1, 0.2, 0], [0, 1, -0.2, 0], [0, 0.4, 0, 0], [0, 0, 0.15, 0], [0, 0, -0.15, 0], [1, 0, 0, 0]],
    np.float32,
)


@pydantic.dataclasses.dataclass(frozen=True, slots=True, config=VALUES)
class RegionRecipe:
    """Settings of a training of the feasible region.

    Attributes:
        transitions: Steps of egos that are recorded.
        steps: Gradient steps.
        scenes: Parallel scenes while recording.
        draws: Episodes of each scenario.
        evasions: Chance that an evasion of 0.5 to 2 s begins in a step.
        hidden: Widths of the hidden layers.
        lr: Learning rate; falls linearly to zero.
        gamma: Discount of a step.
        unsafe: h while bodies touch. A state is infeasible where the discounted chance of a contact is above
            1 / (1 + unsafe). FREA has 18; its adversaries hit less often, and in these drives that would make 94 % of
            the states infeasible.
        expectile: Weight of a Q below V; a Q above V has the weight 1 - expectile.
        tau: Share of the critics that their targets take over at each step.
        batch: Transitions of a gradient step.
        seed: Seed of all random draws.
    """

    transitions: Whole = 400_000
    steps: Whole = 60_000
    scenes: Whole = 64
    draws: Whole = 4
    evasions: Part = 0.03
    hidden: tuple[Whole, ...] = (64, 64)
    lr: Above = 3e-4
    gamma: Decay = 0.98
    unsafe: Above = 2.0
    expectile: Part = 0.9
    tau: Part = 0.005
    batch: Whole = 1024
    seed: FromNone = 0


@dataclass(frozen=True, slots=True)
class RegionPlan:
    """Plan of a training of the feasible region.

    Attributes:
        out: Folder to write to.
        scenarios: Sets and files with background traffic.
        egos: Driving systems of the ego, used in turn.
        adversaries: Weights of adversaries, used in turn; "none": natural traffic.
        changes: Changed values of the recipe.
        device: Device of the networks.
    """

    out: Path
    scenarios: tuple[str, ...] = ("training", "training-lanes")
    egos: tuple[str, ...] = ("autopilot", "ppo")
    adversaries: tuple[str, ...] = ("adv-ppo-paper", "adv-ddpg", NO_ADVERSARY)
    changes: tuple[tuple[str, Any], ...] = ()
    device: str = "cpu"


class FeasibleRegion(nn.Module):
    """Value V of an ego's state; at most 0 where it has a way out."""

    def __init__(self, hidden: Sequence[int] = (64, 64)) -> None:
        super().__init__()
        self.hidden = tuple(hidden)
        self.net = _network(STATE, self.hidden, 1)
        self.hash = ""

    def forward(self, state: Tensor) -> Tensor:
        """Return V [N] of scaled states [N, 18]."""
        value: Tensor = self.net(state)[:, 0]
        return value

    def value(self, states: F32) -> F32:
        """Return V [N] of states [N, 18] as `region_states` gives them."""
        with torch.no_grad():
            values: F32 = self(torch.from_numpy(states / _SCALE)).numpy()
        return values

    @classmethod
    def load(cls, path: str | Path | None = None) -> FeasibleRegion:
        """Load a region from NAME.safetensors and its card; None: the shipped one.

        Raises:
            FormatError: The weights are missing or broken, or are not those of a region.
        """
        source = SHIPPED if path is None else Path(path)
        card, tensors = load_card(source)
        hidden = card.config.get("hidden")
        if not isinstance(hidden, list | tuple) or not hidden or not all(isinstance(width, int) for width in hidden):
            raise FormatError(f"{source}: the card of a feasible region names the widths of its layers, hidden")
        region = cls(hidden)
        copy_state(region, tensors, source)
        region.hash = card.hash
        return region.eval()


@dataclass(frozen=True)
class Transitions:
    """Recorded steps of egos.

    Attributes:
        state: [N, 18] before the step.
        action: [N, 3] throttle, brake and steer of the step.
        next_state: [N, 18] after it.
        is_last: [N] whether the drive ends with it in a contact.
    """

    state: F32
    action: F32
    next_state: F32
    is_last: Bool

    def __len__(self) -> int:
        return len(self.state)


def region_states(state: WorldState, scenes: I32, agents: I32 | None = None) -> F32:
    """Return the input of the feasible region, [N, 18], in the frame of the ego.

    Rows of x, y, length, width, heading and speed of the ego, of an adversary, and of the nearest other vehicle; zeros
    for a vehicle that is absent or more than 25 m away.

    Args:
        state: State of the world.
        scenes: [N] scenes.
        agents: [N] the adversary of each; None: the nearest vehicle.
    """
    pose, speed = state.pose[scenes].astype(np.float64), state.speed[scenes]
    offset = pose[..., :2] - pose[:, :1, :2]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    kind = state.kind[scenes]
    is_near = state.active[scenes] & (distance <= _RADIUS) & (kind != AgentKind.NONE) & (kind <= AgentKind.BICYCLE)
    is_near[:, 0] = False
    rows = np.arange(len(scenes))
    ranked = np.where(is_near, distance, np.inf)
    first = ranked.argmin(1) if agents is None else np.asarray(agents)
    has_first = np.isfinite(ranked[rows, first])
    ranked[rows, first] = np.inf
    second = ranked.argmin(1)
    has_second = np.isfinite(ranked[rows, second])
    cosine, sine = np.cos(pose[:, 0, 2]), np.sin(pose[:, 0, 2])
    values = np.zeros((len(scenes), 3, 6), np.float32)
    for place, (index, is_there) in enumerate(
        [(np.zeros_like(first), np.ones(len(scenes), bool)), (first, has_first), (second, has_second)]
    ):
        x, y = offset[rows, index].T
        size = state.size[scenes, index]
        turn = np.asarray(wrap_angle(pose[rows, index, 2] - pose[:, 0, 2]))
        row = [cosine * x + sine * y, cosine * y - sine * x, size[:, 0], size[:, 1], turn, speed[rows, index]]
        values[:, place] = np.where(is_there[:, None], np.stack(row, 1), 0.0)
    return values.reshape(len(scenes), STATE)


def body_distance(states: F32) -> F64:
    """Return the distance between the ego's body and the nearest other one of states [N, 18], m; inf without one."""
    rows = states.reshape(-1, 3, 6).astype(np.float64)
    boxes = rows[..., [0, 1, 4, 2, 3]]
    distance = np.where(rows[:, 1:, 2] > 0.0, obb_distance(boxes[:, :1], boxes[:, 1:]), np.inf)
    nearest: F64 = distance.min(1)
    return nearest


def record_transitions(
    episodes: Sequence[Episode],
    graphs: Mapping[str, LaneGraph],
    ego: Driver,
    adversary: Driver | None,
    *,
    count: int,
    scenes: int,
    evasions: float,
    seed: int,
) -> Transitions:
    """Record steps of an ego that evades at random from time to time, with or without an adversary.

    Args:
        episodes: Episodes of the scenes.
        graphs: Lane graphs of their towns.
        ego: Driver of the ego.
        adversary: Driver of the agents that FREA's rules select; None: no adversaries.
        count: Minimum number of transitions.
        scenes: Parallel scenes.
        evasions: Chance that an evasion begins in a step.
        seed: Seed of the draws of episodes and evasions.

    Returns:
        Transitions in which another vehicle is within 25 m. A contact adds a last transition, from and to the state of
        the contact.
    """
    random = generator("feasible region", seed)
    world = World(episodes, graphs, assign=np.arange(scenes) % len(episodes))
    remaining, evasion = np.zeros(scenes, np.int64), np.zeros(scenes, np.int64)

    def driven_egos(state: WorldState) -> Bool:
        mask = np.zeros(state.active.shape, bool)
        mask[:, 0] = remaining == 0
        return mask

    drivers: dict[Any, Driver] = {driven_egos: ego}
    drivers |= {} if adversary is None else {FreaSelection(count=1): adversary}
    loop = Loop(world, drivers, policies=make_system)
    loop.reset(episodes=random.integers(len(episodes), size=scenes).astype(np.int32))
    all_scenes = np.arange(scenes, dtype=np.int32)
    parts: list[tuple[F32, F32, F32, Bool]] = []
    recorded = 0
    while recorded < count:
        remaining = np.maximum(remaining - 1, 0)
        begins = (remaining == 0) & (random.random(scenes) < evasions)
        remaining[begins] = random.integers(5, 21, size=int(begins.sum()))
        evasion[begins] = random.integers(len(_EVASIONS), size=int(begins.sum()))
        if begins.any():
            mask = np.zeros((scenes, world.agents), bool)
            mask[:, 0] = begins
            world.take(mask, Controller.EXTERNAL, policy=_EVADING)
        controls = np.zeros((scenes, world.agents, 4), np.float32)
        controls[:, 0] = np.where(remaining[:, None] > 0, _EVASIONS[evasion], 0.0)
        before = region_states(world.state(), all_scenes)
        loop.step(controls)
        state = world.state()
        after, action = region_states(state, all_scenes), state.control[:, 0, :ACTION].copy()
        has_contact = (state.contact & int(Contact.VEHICLE | Contact.CYCLIST)) != 0
        has_other = before[:, 8] > 0.0
        parts.append((before[has_other], action[has_other], after[has_other], np.zeros(int(has_other.sum()), bool)))
        ends = has_contact & (body_distance(after) <= TOUCHING)
        parts.append((after[ends], action[ends], after[ends], np.ones(int(ends.sum()), bool)))
        recorded += int(has_other.sum() + ends.sum())
        ended = np.flatnonzero(world.ended() != End.RUNNING)
        if len(ended):
            loop.reset(ended, episodes=random.integers(len(episodes), size=len(ended)).astype(np.int32))
            remaining[ended] = 0
    return Transitions(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def train_region(
    data: Transitions, recipe: RegionRecipe, *, device: str = "cpu", report: Say = lambda line: None
) -> FeasibleRegion:
    """Learn the feasible region from recorded drives.

    Args:
        data: The drives.
        recipe: Settings.
        device: Device of the networks.
        report: Called with progress messages.

    Returns:
        The region, on the CPU.

    Raises:
        ConfigError: The training diverged: weights are not finite.
    """
    torch.manual_seed(recipe.seed)
    region = FeasibleRegion(recipe.hidden).to(device)
    critics, targets = (
        nn.ModuleList([_network(STATE + ACTION, recipe.hidden, 1) for _ in range(2)]).to(device) for _ in range(2)
    )
    targets.load_state_dict(critics.state_dict())
    optimizers = [torch.optim.Adam(module.parameters(), lr=recipe.lr, eps=1e-5) for module in (region, critics)]
    schedules = [
        torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: max(1.0 - step / recipe.steps, 0.0))
        for optimizer in optimizers
    ]
    unsafe = np.where(body_distance(data.state) <= TOUCHING, recipe.unsafe, -1.0).astype(np.float32)
    columns = (data.state / _SCALE, data.action, data.next_state / _SCALE, unsafe, data.is_last.astype(np.float32))
    tensors = [torch.from_numpy(np.ascontiguousarray(column, np.float32)).to(device) for column in columns]
    chance = torch.Generator(device=device).manual_seed(recipe.seed)
    for step in range(recipe.steps):
        index = torch.randint(len(data), (recipe.batch,), generator=chance, device=device)
        state, action, next_state, h, is_last = (tensor[index] for tensor in tensors)
        pair = torch.cat([state, action], 1)
        with torch.no_grad():
            larger = torch.maximum(targets[0](pair), targets[1](pair))[:, 0]
        below = larger - region(state)
        weight = torch.where(below < 0.0, recipe.expectile, 1.0 - recipe.expectile)
        _descend(optimizers[0], (weight * below.square()).mean(), region)
        with torch.no_grad():
            backed_up = (1.0 - recipe.gamma) * h + recipe.gamma * torch.maximum(h, region(next_state))
            target = torch.where(is_last > 0.0, h, backed_up)
        estimates = torch.cat([critic(pair) for critic in critics], 1)
        loss = (estimates - target[:, None]).square().mean(0).sum()
        _descend(optimizers[1], loss, critics)
        with torch.no_grad():
            for slow, fast in zip(targets.parameters(), critics.parameters(), strict=True):
                slow.lerp_(fast, recipe.tau)
        for schedule in schedules:
            schedule.step()
        if (step + 1) % max(recipe.steps // 5, 1) == 0:
            report(f"step {step + 1} of {recipe.steps}: loss of the critics {float(loss.detach()):.3f}")
    if not all(bool(value.isfinite().all()) for value in region.state_dict().values()):
        raise ConfigError("the training of the feasible region diverged: weights are not finite; use a smaller lr")
    return region.cpu().eval()


def measure_region(region: FeasibleRegion, data: Transitions) -> dict[str, float]:
    """Return the shares of recorded states that a region calls infeasible.

    Returns:
        infeasible: share of all states with V > 0; touching: that of states in which bodies touch; apart: that of
        states with at least 5 m between bodies.
    """
    value, distance = region.value(data.state), body_distance(data.state)
    groups = {"infeasible": distance >= 0.0, "touching": distance <= TOUCHING, "apart": distance >= 5.0}
    return {name: float(np.mean(value[mask] > 0.0)) for name, mask in groups.items() if mask.any()}


def run_region_training(plan: RegionPlan, *, report: Say = print) -> Iterator[str]:
    """Record drives, learn the feasible region, and write OUT/feasible-region.safetensors with its card.

    Args:
        plan: Plan of the training.
        report: Called with progress messages.

    Yields:
        A line about what was written.

    Raises:
        ConfigError: The plan is not valid, there is no traffic, or the training diverged.
    """
    recipe = build_validated(
        partial(replace, RegionRecipe()),
        dict(plan.changes),
        subject="training feasible-region",
        kind=RegionRecipe,
        name_field="",
    )
    torch.set_num_threads(1)  # more slow down networks this small
    scenarios, graphs = natural_scenarios(plan.scenarios)
    if not scenarios:
        raise ConfigError(f"{', '.join(plan.scenarios)}: no scenario has background traffic to keep clear of")
    episodes = draw_episodes(scenarios, graphs, draws=recipe.draws, seed=0)
    pairs = [(ego, adversary) for ego in plan.egos for adversary in plan.adversaries]
    parts = []
    for number, (ego, adversary) in enumerate(pairs):
        parts.append(
            _record(episodes, graphs, ego, adversary, recipe, count=-(-recipe.transitions // len(pairs)), part=number)
        )
        report(f"{len(parts[-1])} transitions of {ego}, adversary: {adversary}")
    data = Transitions(
        *(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Transitions))
    )
    region = train_region(data, recipe, device=plan.device, report=report)
    held_out = _record(episodes, graphs, plan.egos[0], plan.adversaries[0], recipe, count=10_000, part=len(pairs))
    metrics = {name: round(value, 4) for name, value in measure_region(region, held_out).items()}
    card = WeightsCard(
        data=f"{len(data)} steps of {', '.join(plan.egos)} in {', '.join(plan.scenarios)}",
        command=command_of(plan),
        seed=recipe.seed,
        classes=(),
        metrics=metrics,
        config=asdict(recipe),
    )
    safeio.make_folder(plan.out)
    path = plan.out / "feasible-region.safetensors"
    save_weights(path, region.state_dict(), card=card)
    yield f"{path}: " + "  ".join(f"{name} {value:.3f}" for name, value in metrics.items())


def _record(
    episodes: Sequence[Episode],
    graphs: Mapping[str, LaneGraph],
    ego: str,
    adversary: str,
    recipe: RegionRecipe,
    *,
    count: int,
    part: int,
) -> Transitions:
    """Record one part of the data."""
    from ssad.scenarios.dynamic.policy.adv_ppo import Adversary

    return record_transitions(
        episodes,
        graphs,
        make_system(ego),
        None if adversary == NO_ADVERSARY else Adversary(name=adversary),
        count=count,
        scenes=recipe.scenes,
        evasions=recipe.evasions,
        seed=recipe.seed + part,
    )


def command_of(plan: RegionPlan) -> str:
    """Return the command that repeats the training."""
    arguments, defaults = ["ssad", "train", "feasible-region"], RegionPlan(Path())
    for name in ("scenarios", "egos", "adversaries"):
        if getattr(plan, name) != getattr(defaults, name):
            arguments += [f"--{name}", ",".join(getattr(plan, name))]
    return shlex.join([*arguments, *command_line_changes(plan.changes)])


def _network(width: int, hidden: Sequence[int], out: int) -> nn.Sequential:
    widths = [width, *hidden]
    layers: list[nn.Module] = []
    for narrow, wide in pairwise(widths):
        layers += [nn.Linear(narrow, wide), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(widths[-1], out))


def _descend(optimizer: torch.optim.Optimizer, loss: Any, module: nn.Module) -> None:
    """Take one gradient step."""
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(module.parameters(), 0.5)
    optimizer.step()
