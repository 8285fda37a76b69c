"""The three small worlds with which the thesis argues: bit flipping, treasure hunt, chain.

They say in a few steps what the throwing tasks say in thousands: where hindsight misleads (chapter
5) and why it saves time (appendix C). All places are whole numbers inside, so that a goal is
either achieved or not; only what the agent sees is in float32.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded

from torchrl_her_envs.seeded_worlds import SeededWorlds
from torchrl_her_envs.seeding import as_seeds, uniform

_MOST_STEPS = (1 << 20) - 1  # each episode has room for so many moments of random numbers
_MOST_BITS = 127  # a start takes two numbers a bit and one more, and a moment has 256
_LINE = 100  # length of the treasure hunt's world


class LatticeGoals:
    """Uniform over the points of a regular lattice: a :class:`~torchrl_her_envs.GoalDistribution`.

    Args:
        low: [g], the least coordinates.
        high: [g], the greatest ones.
        count: points along each coordinate; 1 if ``low`` and ``high`` are the same point.

    Raises:
        ValueError: ``high`` is below ``low``, or ``count`` is below 1 or too few for both ends.

    Example:
        >>> goals = LatticeGoals([0.0], [1.0], count=3)
        >>> goals.from_uniform(torch.tensor([[0.0], [0.5], [0.9]])).flatten().tolist()
        [0.0, 0.5, 1.0]
    """

    is_box = False  # the points of a box, not all of it

    def __init__(self, low: Sequence[float], high: Sequence[float], *, count: int) -> None:
        self.low = torch.tensor(low, dtype=torch.float64)
        self.high = torch.tensor(high, dtype=torch.float64)
        if self.low.shape != self.high.shape or (self.high < self.low).any():
            raise ValueError(f"a lattice needs low <= high, got low={low}, high={high}")
        least = 2 if (self.high > self.low).any() else 1
        if count < least:
            raise ValueError(f"count must be at least {least} from low={low} to high={high}, got {count}")
        self.count = count

    def from_uniform(self, u: Tensor) -> Tensor:
        """Maps [..., g] numbers in [0, 1) to points of the lattice."""
        steps = (u * self.count).floor().clamp(max=self.count - 1)  # float32 rounds up to the count
        return self.low + steps * (self.high - self.low) / max(self.count - 1, 1)

    def sample(self, n: int, *, generator: torch.Generator | None = None) -> Tensor:
        """Draws [n, g] points (float64)."""
        return self.from_uniform(torch.rand(n, len(self.low), dtype=torch.float64, generator=generator))

    def scaled(self, factor: float, shift: float) -> LatticeGoals:
        """The same lattice in coordinates ``factor * x + shift``, with a positive factor."""
        low, high = (self.low * factor + shift).tolist(), (self.high * factor + shift).tolist()
        return LatticeGoals(low, high, count=self.count)


@dataclass
class SmallWorldState:
    """All that N small worlds are: places and goals [N, size], steps and episodes [N], all int64.

    ``step`` counts the steps of the present episode, ``episode`` the resets of a world.
    """

    place: Tensor
    goal: Tensor
    step: Tensor
    episode: Tensor


class SmallWorld(SeededWorlds):
    """What the small worlds share: N worlds on a lattice of places, where the goal is a place too.

    Keys: ``observation`` and ``achieved_goal`` (both the place; of :class:`Chain` in layers, a part of
    it is achieved), ``desired_goal``, ``state`` (the observation with the desired goal behind it),
    ``action`` (a whole number), ``reward`` (0 where the goal is achieved, -1 elsewhere), ``terminated``
    (the goal is achieved), ``truncated`` (the last step, or an end that says nothing about the goal),
    ``done``.

    Actions are ``Categorical``, [N] of int64, rather than one-hot: TorchRL's ``QValueActor`` takes
    the first of several best actions then, where its one-hot action has a one for each of them;
    and a replay buffer stores one number a row. ``DQNLoss`` and ``EGreedyModule`` take both alike.

    No episode starts at its goal: a terminal state has no action. Worlds are independent: world k
    with a given seed does the same in every batch, and a partial reset leaves the others as they are.

    Args:
        goals: where desired goals come from.
        places: number of places along each coordinate.
        low: the first place as the agent sees it.
        high: the last one.
        num_actions: number of actions.
        max_steps: number of steps after which an episode is truncated.
        num_envs: N, the number of worlds.
        seed: of all that is random; R seeds for R equal blocks of worlds, each as if alone.
        size: coordinates of a place; as many as a goal has, unless only some of them are achieved.

    Attributes:
        threshold: half the distance of two neighbouring places, as the agent sees them.
        worlds: where the worlds are now.

    Raises:
        ValueError: a number out of its range, or worlds that cannot be shared out among the seeds.
    """

    summary: ClassVar[str]  # one line for people

    def __init__(
        self,
        goals: LatticeGoals,
        *,
        places: int,
        low: float,
        high: float,
        num_actions: int,
        max_steps: int,
        num_envs: int,
        seed: int | Sequence[int],
        size: int | None = None,
    ) -> None:
        max_steps = _check_whole("max_steps", max_steps, 1, _MOST_STEPS)
        num_envs = _check_whole("num_envs", num_envs, 1, None)
        super().__init__(device="cpu", batch_size=(num_envs,))
        self.max_steps, self.num_actions = max_steps, num_actions
        self._goals, self._low, self._high = goals, low, high
        self._last = places - 1
        self.threshold = (high - low) / self._last / 2
        size = size or len(goals.low)
        self.worlds = SmallWorldState(
            *(torch.zeros(shape, dtype=torch.int64) for shape in ((num_envs, size),) * 2 + ((num_envs,),) * 2)
        )
        self._make_specs(size, len(goals.low))
        self.set_seeds(as_seeds(seed))

    # What the outside asks for

    @property
    def goal_distribution(self) -> LatticeGoals:
        """Where desired goals come from, in the coordinates that the agent sees."""
        return self._goals

    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """The reward of having achieved one goal when another was desired.

        Args:
            achieved_goal: [..., g], as the agent sees it.
            desired_goal: [..., g], broadcast against it.

        Returns:
            [..., 1]: 0 where they are the same place, -1 elsewhere.

        Raises:
            ValueError: goals of another width than g.
        """
        return self.compute_terminated(achieved_goal, desired_goal).to(achieved_goal.dtype) - 1.0

    def compute_terminated(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Whether the goal is achieved, which ends an episode: [..., 1] of bool."""
        size = len(self._goals.low)
        for goal in (achieved_goal, desired_goal):
            if goal.shape[-1:] != (size,):
                raise ValueError(f"goals must be of shape [..., {size}], got {list(goal.shape)}")
        apart = (achieved_goal - desired_goal).square().sum(-1, keepdim=True)
        return apart < self.threshold**2

    # What a world is made of

    @abstractmethod
    def _start(self, which: Tensor) -> tuple[Tensor, Tensor]:
        """Where the given worlds [M] start, and their goals: both [M, size] of int64, never the same."""

    @abstractmethod
    def _move(self, action: Tensor) -> tuple[Tensor, Tensor | None]:
        """The places [N, size] that actions [N] lead to, and which worlds [N] end there, if any can."""

    def _goal_of(self, place: Tensor) -> Tensor:
        """What of places [N, size] is achieved, or wanted: [N, g]."""
        return place

    # TorchRL's hooks

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        w = self.worlds
        which = torch.arange(len(w.step)) if mask is None else mask.view(-1).nonzero().squeeze(-1)
        w.episode[which] += 1
        w.step[which] = 0
        w.place[which], w.goal[which] = self._start(which)
        shown = self._show()
        off = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        shown.update({"done": off, "terminated": off.clone(), "truncated": off.clone()})
        # With the device that it has anyway: otherwise TorchRL copies every entry.
        return TensorDict(shown, batch_size=self.batch_size, device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        self._check_action(action)
        w = self.worlds
        w.step = w.step + 1
        w.place, ended = self._move(action)
        terminated = (w.place == w.goal).all(-1, keepdim=True)
        truncated = (w.step >= self.max_steps).unsqueeze(-1)
        if ended is not None:
            truncated = truncated | ended.unsqueeze(-1)
        shown = self._show()
        shown["reward"] = terminated.to(torch.float32) - 1.0
        shown.update({"terminated": terminated, "truncated": truncated, "done": terminated | truncated})
        return TensorDict(shown, batch_size=self.batch_size, device=self.device)

    # How it is done

    def _uniform(self, which: Tensor, count: int) -> Tensor:
        """[M, count] numbers of the present moment of the given worlds: their start, or a step."""
        w = self.worlds
        moment = w.episode[which] * (_MOST_STEPS + 1) + w.step[which]
        return uniform(self._keys[which.numpy()], moment, count)

    def _check_action(self, action: Tensor) -> None:
        (n,) = self.batch_size
        if action.shape != (n,) or action.is_floating_point():
            got = f"shape {list(action.shape)} of {action.dtype}"
            raise ValueError(f"actions must be whole numbers of shape [{n}], got {got}")
        wrong = (action < 0) | (action >= self.num_actions)
        if bool(wrong.any()):
            world = int(wrong.nonzero()[0])
            raise ValueError(
                f"actions must be from 0 to {self.num_actions - 1}, got {int(action[world])} in world {world}"
            )

    def _show(self) -> dict[str, Tensor]:
        """What the agent sees of the worlds."""
        place, goal = self._scale(self.worlds.place), self._scale(self._goal_of(self.worlds.goal))
        return {
            "state": torch.cat((place, goal), -1),
            "observation": place,
            "achieved_goal": self._goal_of(place).clone(),
            "desired_goal": goal,
        }

    def _scale(self, place: Tensor) -> Tensor:
        """Places as the agent sees them: in float64 up to the end, as goals that are sampled are."""
        steps = place.to(torch.float64)
        return (self._low + steps * (self._high - self._low) / self._last).to(torch.float32)

    def _make_specs(self, observed: int, size: int) -> None:
        (n,) = self.batch_size

        def seen(width: int) -> Bounded:
            return Bounded(low=self._low, high=self._high, shape=(n, width), dtype=torch.float32)

        def flag() -> Binary:
            return Binary(n=1, shape=(n, 1), dtype=torch.bool)

        self.observation_spec = Composite(
            state=seen(observed + size),
            observation=seen(observed),
            achieved_goal=seen(size),
            desired_goal=seen(size),
            shape=(n,),
        )
        self.action_spec = Categorical(n=self.num_actions, shape=(n,), dtype=torch.int64)
        self.reward_spec = Unbounded(shape=(n, 1), dtype=torch.float32)
        self.done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=(n,))


class BitFlip(SmallWorld):
    """A row of bits, of which each action flips one, until they are the bits that are wanted.

    Thesis, section 5.1, after Andrychowicz et al. (2017): bits and wanted bits are drawn uniformly
    (here: among those that differ), and each step costs 1. The thesis adds an action that has no
    effect and ends the game. In hindsight the goal of that step is the state itself, so that its
    virtual reward is always 0: the bias that Filtered-HER removes.

    Such an end is ``truncated``, not ``terminated``: it says nothing about the goal. Were it
    terminal, giving up would cost 1 in all, less than three flips do: it would not be useless.

    Args:
        bits: n, the number of bits, which are shown as 0 and 1.

    Keyword Args:
        useless_action: whether there is an action n, which does nothing and ends the episode.
        max_steps: steps of an episode; n if None.
        num_envs: number of worlds.
        seed: of all starts and goals; R seeds for R equal blocks of worlds, each as if alone.

    Raises:
        ValueError: a number out of its range, or worlds that cannot be shared out among the seeds.

    Example:
        >>> env = BitFlip(4, useless_action=True, num_envs=3, seed=0)
        >>> shown = env.reset().set("action", torch.tensor([4, 4, 4]))
        >>> after = env.step(shown)["next"]
        >>> torch.equal(after["observation"], shown["observation"]), after["truncated"].all().item()
        (True, True)
        >>> after["reward"].flatten().tolist(), after["terminated"].any().item()
        ([-1.0, -1.0, -1.0], False)
    """

    summary = "flip bits until they are the ones that are wanted"

    def __init__(
        self,
        bits: int,
        *,
        useless_action: bool = False,
        max_steps: int | None = None,
        num_envs: int = 1,
        seed: int | Sequence[int] = 0,
    ) -> None:
        bits = _check_whole("bits", bits, 1, _MOST_BITS)
        super().__init__(
            LatticeGoals([0.0] * bits, [1.0] * bits, count=2),
            places=2,
            low=0.0,
            high=1.0,
            num_actions=bits + useless_action,
            max_steps=bits if max_steps is None else max_steps,
            num_envs=num_envs,
            seed=seed,
        )
        self.bits, self.useless_action = bits, useless_action

    def _start(self, which: Tensor) -> tuple[Tensor, Tensor]:
        u = self._uniform(which, 2 * self.bits + 1)
        goal, flips = (u[:, :-1] < 0.5).to(torch.int64).chunk(2, -1)
        # Uniform over all differences but none: bits below the first one that differs agree, and that
        # one is bit i with probability 2**-(i + 1) / (1 - 2**-n).
        first = (-(1.0 - u[:, -1:] * (1.0 - 2.0**-self.bits)).log2()).floor().clamp(max=self.bits - 1)
        bit = torch.arange(self.bits)
        flips = torch.where(bit == first, 1, torch.where(bit < first, 0, flips))
        return goal ^ flips, goal

    def _move(self, action: Tensor) -> tuple[Tensor, Tensor | None]:
        flipped = torch.arange(self.bits) == action.unsqueeze(-1)  # no bit, if it is the useless action
        return self.worlds.place ^ flipped, (action == self.bits if self.useless_action else None)


class TreasureHunt(SmallWorld):
    """A pirate on a line from 0 to 100 goes left (action 0) or right (1) until it is at the treasure.

    Thesis, section 5.2: pirate and treasure are at random places (here: at different ones). The
    best policy is to walk towards the treasure, and at the treasure no action means anything; HER
    all the same stores transitions that start at their goal, as when the pirate walks against an
    end of the line.

    Args:
        step: how far an action goes, in units of the line: a divisor of 100. Treasures lie at its
            multiples, and at an end of the line the pirate stays.

    Keyword Args:
        max_steps: steps of an episode; 100 / ``step``, which is enough from anywhere, if None.
        num_envs: number of worlds.
        seed: of all starts and goals; R seeds for R equal blocks of worlds, each as if alone.

    Places x are shown as ``x / 50 - 1``.

    Raises:
        ValueError: a number out of its range, or worlds that cannot be shared out among the seeds.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> env = TreasureHunt(10, num_envs=2, seed=0)
        >>> walk = lambda place, goal: (goal > place).squeeze(-1).long()
        >>> policy = TensorDictModule(walk, ["observation", "desired_goal"], ["action"])
        >>> steps = env.rollout(10, policy)
        >>> steps["next", "terminated"][:, -1].any().item()
        True
    """

    summary = "walk on a line from 0 to 100 to a treasure"

    def __init__(
        self,
        step: int = 1,
        *,
        max_steps: int | None = None,
        num_envs: int = 1,
        seed: int | Sequence[int] = 0,
    ) -> None:
        step = _check_whole("step", step, 1, _LINE)
        if _LINE % step:
            divisors = ", ".join(str(d) for d in range(1, _LINE + 1) if _LINE % d == 0)
            raise ValueError(f"step must divide {_LINE}, so be one of {divisors}; got {step}")
        last = _LINE // step
        super().__init__(
            LatticeGoals([-1.0], [1.0], count=last + 1),
            places=last + 1,
            low=-1.0,
            high=1.0,
            num_actions=2,
            max_steps=last if max_steps is None else max_steps,
            num_envs=num_envs,
            seed=seed,
        )

    def _start(self, which: Tensor) -> tuple[Tensor, Tensor]:
        u = self._uniform(which, 2)
        goal = (u[:, :1] * (self._last + 1)).to(torch.int64)
        other = (u[:, 1:] * self._last).to(torch.int64)
        return other + (other >= goal), goal

    def _move(self, action: Tensor) -> tuple[Tensor, Tensor | None]:
        return (self.worlds.place + 2 * action.unsqueeze(-1) - 1).clamp(0, self._last), None


class Chain(SmallWorld):
    """A chain of n steps from the first place to the last: forward with probability p, else back.

    Thesis, appendix C. The agent starts at the first place, its goal is always the last one, and
    there are as many steps as it takes without a mistake (premise 4). Action 1 goes forward with
    probability p (premise 1); where it fails, and always with action 0, the agent goes back: by
    one place, or to the first place in the reset-state form. At the first place it stays.

    So action 1 alone arrives in one of ``p ** -n`` episodes. With p = 1 actions do what they say,
    and a policy that asks for forward with probability q arrives in one of ``q ** -n`` until it
    learns; with hindsight it learns place by place.

    The agent sees n links: k of them closed (1) and the others open (-1) at place k. All closed is
    the goal. In ``layers`` the chain is a task of sub-tasks: what is achieved are the links of the
    last of so many equal parts alone, as in throwing it is the ball: before, hindsight has nothing to say.

    Args:
        length: n, the number of steps from the start to the goal.
        forward_probability: p, in (0, 1].

    Keyword Args:
        layers: how many equal parts the chain has, of ``n / layers`` steps each.
        alternating: whether it is action 0 that goes forward at odd places, so that always doing
            the same leads nowhere: a network at random does just that, and solves the chain else.
        reset_state: whether the way back leads to the first place ("reset-state game").
        max_steps: steps of an episode; n if None.
        num_envs: number of worlds.
        seed: of all transitions; R seeds for R equal blocks of worlds, each as if alone.

    Raises:
        ValueError: a number out of its range, or worlds that cannot be shared out among the seeds.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> ones = torch.ones(2, dtype=torch.int64)
        >>> forward = TensorDictModule(lambda place: ones, ["observation"], ["action"])
        >>> steps = Chain(3, 1.0, num_envs=2).rollout(3, forward)
        >>> steps["next", "observation"][0].tolist()
        [[1.0, -1.0, -1.0], [1.0, 1.0, -1.0], [1.0, 1.0, 1.0]]
        >>> steps["next", "reward"][0].flatten().tolist()
        [-1.0, -1.0, 0.0]
        >>> steps = Chain(4, 1.0, layers=2, num_envs=2).rollout(4, forward)
        >>> steps["next", "achieved_goal"][0].tolist()
        [[-1.0, -1.0], [-1.0, -1.0], [1.0, -1.0], [1.0, 1.0]]
    """

    summary = "walk a chain from its first place to its last"

    def __init__(
        self,
        length: int,
        forward_probability: float,
        *,
        layers: int = 1,
        alternating: bool = False,
        reset_state: bool = False,
        max_steps: int | None = None,
        num_envs: int = 1,
        seed: int | Sequence[int] = 0,
    ) -> None:
        length = _check_whole("length", length, 1, _MOST_STEPS)
        layers = _check_whole("layers", layers, 1, length)
        if length % layers:
            raise ValueError(f"layers must divide length={length}, got {layers}")
        if not 0.0 < forward_probability <= 1.0:
            raise ValueError(f"forward_probability must be in (0, 1], got {forward_probability}")
        goal = [1.0] * (length // layers)
        super().__init__(
            LatticeGoals(goal, goal, count=1),
            places=2,
            low=-1.0,
            high=1.0,
            num_actions=2,
            max_steps=length if max_steps is None else max_steps,
            num_envs=num_envs,
            seed=seed,
            size=length,
        )
        self.length, self.forward_probability, self.reset_state = length, forward_probability, reset_state
        self.layers, self.alternating = layers, alternating
        self._all = torch.arange(num_envs)

    def _start(self, which: Tensor) -> tuple[Tensor, Tensor]:
        links = torch.zeros(len(which), self.length, dtype=torch.int64)
        return links, links + 1

    def _move(self, action: Tensor) -> tuple[Tensor, Tensor | None]:
        place = self.worlds.place.sum(-1, keepdim=True)
        forward = (action.unsqueeze(-1) + place * self.alternating) % 2 == 1
        if self.forward_probability < 1.0:
            forward = forward & (self._uniform(self._all, 1) < self.forward_probability)
        back = torch.zeros_like(place) if self.reset_state else place - 1
        place = torch.where(forward, place + 1, back)
        return (place > torch.arange(self.length)).to(torch.int64), None

    def _goal_of(self, place: Tensor) -> Tensor:
        return place[:, -(self.length // self.layers) :]


def _check_whole(name: str, value: int, low: int, high: int | None) -> int:
    """An option as an int; raises where it is not a whole number in its range."""
    if isinstance(value, Integral) and not isinstance(value, bool):
        whole = int(value)
        if low <= whole and (high is None or whole <= high):
            return whole
    allowed = f"at least {low}" if high is None else f"from {low} to {high}"
    raise ValueError(f"{name} must be a whole number {allowed}, got {value!r}")
