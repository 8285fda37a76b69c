"""Transform that gives some episodes a goal that was achieved before, in place of the task's own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite
from torchrl.envs import Transform

from torchrl_her.behavior.factors import GoalCandidates
from torchrl_her.behavior.memory import AchievedGoals
from torchrl_her.behavior.proposal import GoalProposal
from torchrl_her.checks import entry_of
from torchrl_her.env_keys import PROPOSED, PROPOSED_REACHED, EnvKeys
from torchrl_her.goals.rewards import RewardFunction, achieved_reward_of, call_reward, outcomes
from torchrl_her.goals.weights import weights_by_run
from torchrl_her.modules.noise import generator_states, set_generator_states
from torchrl_her.randomness import Generators, check_generators, uniform


class BehaviorGoals(Transform):
    """Replaces the task's own goal by one that was achieved before, in a fraction of the episodes.

    At a reset, some goals that the run has achieved are drawn, and ``proposal`` chooses one of them. The
    episode's reward, terminated and done are then computed for it. All other episodes keep the task's goal.
    Two flags [..., 1] are written: ``proposed``, where the goal is a proposed one, and ``proposed_reached``,
    where a proposed goal was achieved in the episode.
    Leave this transform out of environments for evaluation.

    In a curriculum, put it after :class:`~torchrl_her.StateToObs` and before :class:`~torchrl_her.ZeroPad`.
    If episodes have stages, ``stage_key`` restricts it to those in ``stage``; if runs have stages, switch it
    on and off with :meth:`set_active`.

    The environments of R runs are R equal blocks of the batch's first dimension, in the order of the runs.
    Episodes that end by a time limit count as ended only if a transform before this one, or the environment,
    sets that limit. Put the transform around a ParallelEnv and not inside of its workers, each of which would
    have its own memory of goals. Memory and counts are part of the transform's ``state_dict()``, and so of
    the collector's.

    Args:
        reward_fn: maps (achieved, desired) goals to (reward, terminated), as the environment's own does.

    Keyword Args:
        proposal: how goals are chosen; None for any achieved goal, with equal probability.
        remember: whether the transform remembers achieved goals; if not, add goals by ``memory.add``.
        real_share: share of the episodes in which the task's own goal stays.
        memory: number of goals that each run remembers.
        runs: R, the number of independent runs.
        generators: generators, one for each run; None for torch's own, with one run only.
        continues_after_termination: whether the environment can be stepped further after it terminated an
            episode; if not, the episode is truncated there.
        keys: keys of the entries that are read. All are also written, except observation and achieved goal.
        real_goal_key: key under which the task's own goal is written.
        stage_key: key of the stage [..., 1] that an episode is played in, if episodes have stages.
        stage: index of the stage in which goals are proposed.

    Attributes:
        memory: the achieved goals of each run, :class:`~torchrl_her.behavior.AchievedGoals`.
        ended, achieved: [R] int64, numbers of episodes with proposed goals that have ended, and of those in
            which the goal was achieved, since :meth:`success` was last called.

    Raises:
        ValueError: an option is out of its range; when used, the batch is not R equal blocks.
        KeyError: when used, the environment lacks an entry.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_her import GoalReward
        >>> from torchrl_her_envs import make_env
        >>> env = make_env("hand_v0", num_envs=4, seed=0)
        >>> goals = BehaviorGoals(GoalReward(0.1), real_share=0.0, continues_after_termination=True)
        >>> env = TransformedEnv(env, goals)
        >>> _ = env.rollout(10)  # its goals are remembered
        >>> begun = env.reset()
        >>> begun["proposed"].flatten().tolist()
        [True, True, True, True]
        >>> (begun["desired_goal"] == begun["real_desired_goal"]).any().item()
        False
    """

    def __init__(
        self,
        reward_fn: RewardFunction,
        *,
        proposal: GoalProposal | None = None,
        remember: bool = True,
        real_share: float = 0.5,
        memory: int = 50_000,
        runs: int = 1,
        generators: Sequence[torch.Generator] | None = None,
        continues_after_termination: bool = False,
        keys: EnvKeys = EnvKeys(),
        real_goal_key: NestedKey = "real_desired_goal",
        stage_key: NestedKey | None = None,
        stage: int = 0,
    ) -> None:
        if not 0.0 <= real_share <= 1.0:
            raise ValueError(f"real_share must be in [0, 1], got {real_share}")
        self.proposal = proposal or GoalProposal()
        weights_by_run(self.proposal.weights, runs)
        keys.check_ends(continues_after_termination=continues_after_termination)
        in_keys = [keys.observation, keys.achieved_goal, keys.desired_goal]
        out_keys = [keys.desired_goal, real_goal_key, PROPOSED, PROPOSED_REACHED]
        super().__init__(in_keys=in_keys, out_keys=out_keys)
        self.generators: Generators = check_generators(runs, generators) or [None]
        self.reward_fn, self.remember, self.real_share = reward_fn, remember, real_share
        self.runs, self.achieved_reward = runs, achieved_reward_of(reward_fn)
        self.continues_after_termination = continues_after_termination
        self.memory = AchievedGoals(memory, runs=runs)
        self.keys, self.stage_key, self.stage = keys, stage_key, stage
        self.ended = torch.zeros(runs, dtype=torch.int64)
        self.achieved = torch.zeros(runs, dtype=torch.int64)
        self._active = [True] * runs

    def set_active(self, active: bool, *, run: int = 0) -> None:
        """Switches memory and proposals of a run on or off; its weights start anew when switched on."""
        if active and not self._active[run]:
            self.proposal.restart(run)
        self._active[run] = active

    def success(self) -> Tensor:
        """Returns the success rate [R] of the goals proposed since the last call; NaN if there were none."""
        rate = self.achieved.double() / self.ended.double()
        self.achieved, self.ended = torch.zeros_like(self.achieved), torch.zeros_like(self.ended)
        return rate

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the transform's whole state as tensors and plain data; it is a part of ``state_dict()``."""
        return {
            "memory": self.memory.state_dict(),
            **self.proposal.state_dict(),
            "generators": generator_states(self.generators),
            "ended": self.ended,
            "achieved": self.achieved,
            "active": list(self._active),
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores the state that :meth:`get_extra_state` returned.

        Raises:
            ValueError: the state is of another number of runs, or of other weights and factors.
        """
        self.memory.load_state_dict(state["memory"])
        self.proposal.load_state_dict(state)
        set_generator_states(self.generators, state["generators"])
        self.ended, self.achieved = state["ended"].clone(), state["achieved"].clone()
        self._active = list(state["active"])

    # TorchRL's hooks

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        goal_key, real_key, proposed_key, reached_key = self.out_keys
        real = self._get(tensordict_reset, goal_key)
        number = real.shape[:-1].numel()
        if number % self.runs:
            raise ValueError(f"a batch must have a multiple of runs={self.runs} environments, got {number}")
        mask = tensordict.get("_reset", None)
        begins = torch.ones_like(real[..., :1], dtype=torch.bool) if mask is None else mask
        begins = begins.view(*real.shape[:-1], 1)
        proposed, goals = self._propose(tensordict_reset, begins.flatten())
        flags = proposed.view(begins.shape)
        wanted = real
        if goals is not None:
            wanted = _rows(real).index_put((proposed,), goals.to(real)).view(real.shape)
        # Set for all environments: TorchRL discards the values of those that were not reset.
        shown = (wanted, real, flags, torch.zeros_like(flags))
        for key, value in zip((goal_key, real_key, proposed_key, reached_key), shown, strict=True):
            tensordict_reset.set(key, value)
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        goal_key, real_key, proposed_key, reached_key = self.out_keys
        proposed, real = self._get(tensordict, proposed_key), self._get(next_tensordict, goal_key)
        achieved = self._get(next_tensordict, self.in_keys[1])
        next_tensordict.set(real_key, real)
        next_tensordict.set(proposed_key, proposed)
        next_tensordict.set(reached_key, torch.zeros_like(proposed))
        if self.remember:
            self._remember(tensordict, next_tensordict, achieved)
        if not bool(proposed.any()):
            return next_tensordict
        wanted = torch.where(proposed, tensordict.get(goal_key), real)
        outcome = outcomes(self.reward_fn, achieved, next_tensordict, tensordict)
        reward, terminated = call_reward(self.reward_fn, outcome, wanted)
        before = self._get(next_tensordict, self.keys.reward)
        ended = self._get(next_tensordict, self.keys.terminated)
        fell = ended & (before < self.achieved_reward)
        if bool(fell.any()):  # a failure, such as a fall, ends the episode for any goal
            own_reward, own_end = call_reward(self.reward_fn, outcome, real)
            fell = fell & ~own_end
            reward = reward + (before - own_reward).clamp(max=0.0) * fell  # the cost of the fall
        reached = self._get(tensordict, reached_key) | (proposed & (reward >= self.achieved_reward))
        terminated = torch.where(proposed, terminated | fell, ended)
        done = terminated
        if self.keys.truncated is not None:
            truncated = self._get(next_tensordict, self.keys.truncated)
            if not self.continues_after_termination:
                truncated = truncated | (ended & ~terminated)
            next_tensordict.set(self.keys.truncated, truncated)
            done = terminated | truncated
        done = torch.where(proposed, done, self._get(next_tensordict, self.keys.done))
        reward = torch.where(proposed, reward.to(before), before)
        written = (goal_key, self.keys.reward, self.keys.terminated, self.keys.done, reached_key)
        for key, value in zip(written, (wanted, reward, terminated, done, reached), strict=True):
            next_tensordict.set(key, value)
        self._count(proposed & done, reached)
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Raises a RuntimeError: goals are proposed where episodes begin, not in a replay buffer."""
        raise RuntimeError("BehaviorGoals is for environments: sampled transitions have their goals already")

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        goal_key, real_key, *flags = self.out_keys
        goal = observation_spec[goal_key]
        observation_spec[real_key] = goal.clone()
        for key in flags:
            shape = (*goal.shape[:-1], 1)
            observation_spec[key] = Binary(shape=shape, dtype=torch.bool, device=goal.device)
        return observation_spec

    # Helpers

    def _takes_part(self, tensordict: TensorDictBase, goals: Tensor) -> Tensor | None:
        """Returns which environments [N] store and propose goals; None if all do."""
        part = None
        if not all(self._active):
            active = torch.tensor(self._active, device=goals.device)
            part = active.repeat_interleave(len(goals) // self.runs)
        if self.stage_key is not None:
            in_stage = self._get(tensordict, self.stage_key).reshape(-1) == self.stage
            part = in_stage if part is None else part & in_stage
        return part

    def _remember(self, before: TensorDictBase, after: TensorDictBase, achieved: Tensor) -> None:
        achieved = _rows(achieved)
        part = self._takes_part(before, achieved)
        if part is not None and not bool(part.any()):
            return
        self.memory.add(achieved, _rows(self._get(after, self.in_keys[0])), which=part)
        if self.proposal.is_updated_on("achieved"):
            goals = achieved if part is None else achieved[part]
            self.proposal.update(goals, self._counts(part, len(achieved)))

    def _propose(self, tensordict: TensorDictBase, begins: Tensor) -> tuple[Tensor, Tensor | None]:
        """Returns which of the environments [N] get a proposed goal, and these goals [m, g]."""
        part = self._takes_part(tensordict, begins)
        chosen = begins if part is None else begins & part
        known = torch.tensor([size > 0 for size in self.memory.sizes], device=begins.device)
        chosen = chosen & known.repeat_interleave(len(begins) // self.runs)
        if self.real_share > 0 and bool(chosen.any()):
            numbers = uniform(self._counts(chosen, len(begins)), 1, self.generators, device=begins.device)
            chosen = chosen.index_put((chosen.clone(),), numbers.squeeze(-1) >= self.real_share)
        if not bool(chosen.any()):
            return torch.zeros_like(begins), None
        counts = self._counts(chosen, len(begins))
        index = self.memory.draw(counts, self.proposal.candidates, self.generators)
        candidates = GoalCandidates(
            goals=self.memory.goals(index),
            reached=self.memory.observations(index),
            start=_rows(self._get(tensordict, self.in_keys[0]))[chosen],
            target=_rows(self._get(tensordict, self.out_keys[0]))[chosen],
            counts=counts,
            known=self._sample(counts),
        )
        goals, valid = self.proposal.choose(candidates, self.generators)
        if not bool(valid.all()):  # environments without a valid goal keep the task's
            chosen, goals = chosen.index_put((chosen.clone(),), valid), goals[valid]
            counts = self._counts(chosen, len(begins))
        if self.proposal.is_updated_on("proposed"):
            self.proposal.update(goals, counts)
        return chosen, goals

    def _sample(self, counts: Sequence[int]) -> Sequence[Tensor]:
        """Draws a sample of achieved goals for each run with new episodes, as large as the factors need."""
        draws, number = [min(1, count) for count in counts], self.proposal.samples
        if number == 0:
            return ()
        goals = self.memory.goals(self.memory.draw(draws, number, self.generators))
        return [part.flatten(0, 1) for part in goals.split(draws)]

    def _count(self, ended: Tensor, achieved: Tensor) -> None:
        """Counts the episodes with proposed goals that have ended, and those that achieved their goal."""
        if not bool(ended.any()):
            return
        counts = [flags.reshape(self.runs, -1).sum(1) for flags in (ended, ended & achieved)]
        self.ended, self.achieved = (
            total.to(count.device) + count
            for total, count in zip((self.ended, self.achieved), counts, strict=True)
        )
        for factor in self.proposal.factors:
            factor.record(*counts)

    def _counts(self, which: Tensor | None, rows: int) -> list[int]:
        """Returns the number of the given environments that belong to each run."""
        if which is None:
            return [rows // self.runs] * self.runs
        return which.view(self.runs, -1).sum(1).tolist()

    def _get(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        return entry_of(tensordict, key, by="BehaviorGoals")


def _rows(entry: Tensor) -> Tensor:
    """Returns an entry [..., n] in the shape [N, n], also if there is a single environment."""
    return entry.reshape(-1, entry.shape[-1])
