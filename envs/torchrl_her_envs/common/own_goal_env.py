"""A user's own TorchRL environments as one batch of environments with goals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from torchrl_her_envs.common.goal_env import (
    INFO,
    GoalEnv,
    Names,
    bounded_actions,
    info_rows,
    needs_info,
)
from torchrl_her_envs.common.goal_rules import (
    Ends,
    GoalEnds,
    Termination,
    check_rewards,
    check_same_rewards,
    check_stateless,
    check_termination,
    equal_with_info,
    warn_once,
)
from torchrl_her_envs.common.rendering.pictures import as_picture
from torchrl_her_envs.common.seeding import as_seeds, block_keys

KEYS = ("observation", "achieved_goal", "desired_goal")
_GOALS = KEYS[1:]
_SUCCESS = "is_success"
_TRIED_STEPS = 100
_PAIRED = 8  # number of achieved and of desired goals whose pairs are passed to the reward to try it


@dataclass(frozen=True, kw_only=True)
class FoundRules:
    """Rules that were found by trying an environment: how it rewards goals and ends episodes.

    Args:
        ends: rule for the ends of episodes at goals, and counts of what the environment did there.
        missed_reward: the least reward that was seen.
        achieved_reward: the least reward of an achieved goal.
        dense: whether missed goals have many different rewards.
    """

    ends: GoalEnds
    missed_reward: float
    achieved_reward: float
    dense: bool


class OwnGoalEnv(GoalEnv):
    """Environments of a user's own as one batch, with seeds, a time limit and ends at goals.

    The environments give vectors ``observation``, ``achieved_goal`` and ``desired_goal``, take a bounded or
    categorical ``action`` and have a method ``compute_reward(achieved_goal, desired_goal)``, which maps goals
    [..., g] to rewards [..., 1]. Optional:

    - ``compute_terminated(achieved_goal, desired_goal)``, which maps goals [..., g] to bool [..., 1]. If it
      is missing, ``termination`` chooses what ends an episode at its goal, as for
      :class:`~torchrl_her_envs.GymGoalEnv`, where ``is_success`` is an entry of steps, not of ``info``.
    - Further entries of steps that rewards depend on, if ``info_keys`` names them. Both functions then get a
      third argument, a dictionary of these entries [..., w], for real and virtual goals of the step.
      Transitions have the entries as ``("info", KEY)``.
    - ``max_steps``, the length of an episode; without it, the option ``max_steps`` must be given.
    - ``stages()``, see :class:`~torchrl_her_envs.GoalEnv`.
    - ``render()``, a picture [height, width, 3] of uint8, or [N, height, width, 3] of a batch.
    - ``set_seeds(seeds)`` of a batch, for R equal blocks; a batch without it has one seed.

    Args:
        envs: N environments without a batch size, or batches of environments, N in total.
        name: name of the task.
        seed: seed of all environments; R seeds for R equal blocks of them.
        max_steps: length of an episode; the environment's attribute if None.
        termination: rule that ends an episode at its goal.
        achieved_reward: the least reward at which a goal counts as achieved; the reward of equal goals if
            None.
        rules: rules found for another such environment; None to find them by trying some steps.
        info_keys: entries of a step that rewards read besides goals.
        names: the environment's own names of observation, achieved and desired goal, where they differ.

    Attributes:
        rules: how the environment rewards goals and ends episodes.
        goal_ends: rule for the ends of episodes at goals, and counts of what the environment did there.

    Raises:
        ValueError: something is missing or cannot be used; the message names it.
    """

    def __init__(
        self,
        envs: Sequence[EnvBase],
        *,
        name: str,
        seed: int | Sequence[int] = 0,
        max_steps: int | None = None,
        termination: str = "auto",
        achieved_reward: float | None = None,
        rules: FoundRules | None = None,
        info_keys: Sequence[str] = (),
        names: Mapping[str, Names] | None = None,
    ) -> None:
        first = envs[0]
        self._whole = len(first.batch_size) == 1  # each environment is a batch
        count = len(envs) * (first.batch_size[0] if self._whole else 1)
        super().__init__(device="cpu", batch_size=(count,))
        self._envs, self._name = list(envs), name
        limit = max_steps if max_steps is not None else getattr(first, "max_steps", None)
        if isinstance(limit, bool) or not isinstance(limit, int) or limit < 1:
            raise ValueError(
                f"{name} needs a time limit, a whole number of steps, as in task.options.max_steps=100, "
                f"got {limit!r}"
            )
        self.max_steps, self._info = limit, list(info_keys)
        self._names: dict[str, Names] = {key: key for key in KEYS} | dict(names or {})
        self._check(first)
        self._make_specs(first)
        self._latest: list[TensorDictBase] = []
        self._steps = torch.zeros(count, 1, dtype=torch.int64)
        if rules is None:
            self.goal_ends = GoalEnds(name, env_ends=None, tells_success=True)  # provisional, for the trial
            rules = self._try_out(check_termination(termination), achieved_reward)
        self.rules, self.goal_ends, self.dense_reward = rules, rules.ends, rules.dense
        self.missed_reward, self.achieved_reward = rules.missed_reward, rules.achieved_reward
        self.set_seeds(as_seeds(seed))

    # Interface of GoalEnv

    @property
    def task_name(self) -> str:
        return self._name

    @property
    def info_keys(self) -> list[tuple[str, str]]:
        """Entries of transitions that ``compute_reward`` reads besides goals."""
        return [(INFO, name) for name in self._info]

    @property
    def can_render(self) -> bool:
        """Whether the environment has a method ``render``."""
        return callable(getattr(self._envs[0], "render", None))

    @property
    def ends(self) -> Ends:
        """Rule for the ends of episodes, see :class:`~torchrl_her_envs.common.goal_rules.GoalEnds`."""
        return self.goal_ends.rule

    def stages(self) -> list[dict[str, Any]]:
        stages = getattr(self._envs[0], "stages", None)
        return stages() if callable(stages) else super().stages()

    def compute_reward(
        self, achieved_goal: Tensor, desired_goal: Tensor, info: TensorDictBase | None = None
    ) -> Tensor:
        """Returns the reward, float32 [..., 1], of having achieved one goal when another was desired."""
        return self._ask("compute_reward", achieved_goal, desired_goal, info).float()

    def compute_terminated(
        self, achieved_goal: Tensor, desired_goal: Tensor, info: TensorDictBase | None = None
    ) -> Tensor:
        """Returns whether an episode terminates, as bool [..., 1], for pairs of goals [..., g]."""
        if self.ends == "own":
            return self._ask("compute_terminated", achieved_goal, desired_goal, info).bool()
        return self._meets(achieved_goal, desired_goal, info) & (self.ends in ("success", "reward"))

    def set_seeds(self, seeds: Sequence[int]) -> None:
        """Seeds R equal blocks of environments.

        Args:
            seeds: R seeds.

        Raises:
            ValueError: the environments cannot be shared out among R blocks, a seed is out of range, or
                ``envs`` are batches without ``set_seeds`` and not R in number.
        """
        keys = (block_keys(seeds, self.batch_size[0]) >> np.uint64(33)).tolist()
        # Many environments seed torch's own generator, which the run uses, too: its state is restored.
        with torch.random.fork_rng(devices=[]):
            if callable(set_seeds := getattr(self._envs[0], "set_seeds", None)) and self._whole:
                set_seeds(seeds)
            elif self._whole and len(self._envs) != len(seeds):
                number = len(self._envs)
                raise ValueError(
                    f"{self._name} is {number} batches without set_seeds: it needs {number} seeds, "
                    f"got {len(seeds)}"
                )
            else:
                for env, key in zip(self._envs, keys[:: len(keys) // len(self._envs)], strict=True):
                    env.set_seed(key)

    def _draw_worlds(self, worlds: Sequence[int], size: int | None) -> list[Tensor]:
        if not self.can_render:
            return super()._draw_worlds(worlds, size)
        if self._whole:
            everything = [picture for env in self._envs for picture in env.render()]
            drawn = [everything[index] for index in worlds]
        else:
            drawn = [self._envs[index].render() for index in worlds]
        return [as_picture(picture, self._name, size=size) for picture in drawn]

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes all environments."""
        for env in self._envs:
            env.close(raise_if_closed=False)
        super().close(raise_if_closed=raise_if_closed)

    # TorchRL's hooks

    def _set_seed(self, seed: int | None) -> None:
        self.set_seeds([seed or 0])

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        which = torch.ones(*self.batch_size, 1, dtype=torch.bool) if mask is None else mask.view(-1, 1)
        self._steps = self._steps.masked_fill(which, 0)
        if not self._latest:
            self._latest = [env.reset() for env in self._envs]
        elif self._whole:
            parts = zip(self._envs, self._latest, which.chunk(len(self._envs)), strict=True)
            self._latest = [
                env.reset(latest.set("_reset", chunk)) if chunk.any() else latest
                for env, latest, chunk in parts
            ]
        else:
            for index in which.flatten().nonzero().flatten().tolist():
                self._latest[index] = self._envs[index].reset()
        off = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        ends = {"done": off, "terminated": off.clone(), "truncated": off.clone()}
        return TensorDict({**self._shown(self._latest), **ends}, self.batch_size, device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = self._own_actions(tensordict.get("action"))
        taken = actions.chunk(len(self._envs)) if self._whole else actions.unbind()
        after = []
        for index, (env, action) in enumerate(zip(self._envs, taken, strict=True)):
            stepped = env.step(self._latest[index].clone(False).set("action", action))
            self._latest[index] = env.step_mdp(stepped)
            after.append(stepped["next"])
        self._steps = self._steps + 1
        reward = self._stack(after, "reward").float().view(-1, 1)
        terminated = self._flag(after, "done" if after[0].get("terminated", None) is None else "terminated")
        truncated = self._flag(after, "truncated") | (self._steps >= self.max_steps)
        shown = self._shown(after)
        if self.ends != "own":
            if self.goal_ends.asks_success:
                met = self._flag(after, _SUCCESS)
            else:
                achieved, desired = (shown[key] for key in _GOALS)
                met = self._meets(achieved, desired, TensorDict(shown, self.batch_size))
            terminated, truncated = self.goal_ends.apply(met, terminated, truncated)
        ends = {"done": terminated | truncated, "terminated": terminated, "truncated": truncated}
        return TensorDict({**shown, "reward": reward, **ends}, self.batch_size, device=self.device)

    # Helpers

    def _stack(self, each: list[TensorDictBase], key: str) -> Tensor:
        entries = [part.get(key) for part in each]
        return torch.cat(entries) if self._whole else torch.stack(entries)

    def _entries(self, key: str) -> Sequence[str]:
        """Returns the environment's own names of observation or goal."""
        names = self._names[key]
        return [names] if isinstance(names, str) else names

    def _named(self, key: str, goals: Tensor) -> Any:
        """Converts goals [..., g] to the environment's own form: a dictionary if it has several entries."""
        if isinstance(self._names[key], str):
            return goals
        spec, names = self._envs[0].full_observation_spec, self._entries(key)
        parts = goals.split([spec[name].shape[-1] for name in names], -1)
        return dict(zip(names, parts, strict=True))

    def _flag(self, each: list[TensorDictBase], key: str) -> Tensor:
        """Returns the flag of a key, [N, 1]; False if the environments do not have it."""
        if each[0].get(key, None) is None:
            return torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return self._stack(each, key).bool().view(-1, 1)

    def _shown(self, each: list[TensorDictBase]) -> dict[str, Any]:
        shown: dict[str, Any] = {
            key: torch.cat([self._stack(each, name) for name in self._entries(key)], -1).float()
            for key in KEYS
        }
        for key, rows in shown.items():
            if not bool((finite := rows.isfinite()).all()):
                row, at = (~finite).nonzero()[0].tolist()
                raise ValueError(
                    f"{self._name}: {key} {at} must be a finite number, got {rows[row, at].item()}"
                )
        if _SUCCESS in self.observation_spec:
            shown[_SUCCESS] = self._flag(each, _SUCCESS)
        if self._info:
            info = {name: self._stack(each, name) for name in self._info}
            shown[INFO] = TensorDict(info, self.batch_size)
        return shown

    def _meets(self, achieved_goal: Tensor, desired_goal: Tensor, info: TensorDictBase | None) -> Tensor:
        return self.compute_reward(achieved_goal, desired_goal, info) >= self.achieved_reward

    def _ask(
        self, method: str, achieved_goal: Tensor, desired_goal: Tensor, info: TensorDictBase | None
    ) -> Tensor:
        achieved, desired = torch.broadcast_tensors(achieved_goal, desired_goal)
        given: list[dict[str, Tensor]] = []
        if self._info:
            if info is None:
                raise ValueError(needs_info(self))
            given.append(info_rows(info, self._info, achieved.shape[:-1]))
        pair = (self._named(*entry) for entry in zip(_GOALS, (achieved, desired), strict=True))
        answer = getattr(self._envs[0], method)(*pair, *given)
        shape = (*achieved.shape[:-1], 1)
        if not isinstance(answer, Tensor) or answer.shape != shape:
            got = list(answer.shape) if isinstance(answer, Tensor) else type(answer).__name__
            raise ValueError(
                f"{method} of {self._name} must give a tensor {list(shape)} for goals "
                f"{list(achieved.shape)}, got {got}"
            )
        return answer

    def _check(self, env: EnvBase) -> None:
        """Raises a ValueError that names what the environment lacks."""
        shown = env.full_observation_spec
        known = ", ".join(map(str, shown))
        for key in [name for role in KEYS for name in self._entries(role)]:
            if key not in shown:
                raise ValueError(f"{self._name}'s observations must have {key!r}, got {known}")
            if len(shown[key].shape) != 1 + self._whole:
                raise ValueError(f"{self._name}'s {key!r} must be a vector, got {list(shown[key].shape)}")
        achieved, desired = ([list(shown[name].shape) for name in self._entries(key)] for key in _GOALS)
        if achieved != desired:
            raise ValueError(
                f"{self._name}'s achieved and desired goals must have one shape, got "
                f"{' and '.join(', '.join(map(str, shapes)) for shapes in (achieved, desired))}"
            )
        for name in self._info:
            if name not in shown:
                raise ValueError(f"{self._name}'s info_keys must be among {known}, got {name!r}")
        if not callable(getattr(env, "compute_reward", None)):
            raise ValueError(
                f"{self._name} lacks the method 'compute_reward', which computes the rewards of other goals"
            )
        if list(env.action_keys) != ["action"] or list(env.reward_keys) != ["reward"]:
            raise ValueError(
                f"{self._name} must take one 'action' and give one 'reward', got {list(env.action_keys)} and "
                f"{list(env.reward_keys)}"
            )

    def _make_specs(self, env: EnvBase) -> None:
        (n,) = self.batch_size
        shown, action = env.full_observation_spec, env.action_spec_unbatched

        def flag() -> Binary:
            return Binary(n=1, shape=(n, 1), dtype=torch.bool)

        widths = {key: sum(shown[name].shape[-1] for name in self._entries(key)) for key in KEYS}
        seen = {key: Unbounded(shape=(n, width), dtype=torch.float32) for key, width in widths.items()}
        self.observation_spec = Composite(seen, shape=(n,))
        if _SUCCESS in shown:
            self.observation_spec[_SUCCESS] = flag()
        if self._info:
            info_specs = {
                name: Unbounded((n, *shown[name].shape[self._whole :]), dtype=shown[name].dtype)
                for name in self._info
            }
            self.observation_spec[INFO] = Composite(info_specs, shape=(n,))
        self.action_spec = self._action_spec(action)
        self.reward_spec = Unbounded(shape=(n, 1), dtype=torch.float32)
        self.done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=(n,))

    def _action_spec(self, action: TensorSpec) -> TensorSpec:
        (n,) = self.batch_size
        if type(action) is Categorical and not action.shape:
            return Categorical(n=int(action.space.n), shape=(n,), dtype=torch.int64)
        if isinstance(action, Bounded):
            return bounded_actions(action.space.low, action.space.high, n)
        raise ValueError(f"{self._name}'s actions must be Bounded or Categorical, got {action}")

    def action_limits(self) -> tuple[Tensor, Tensor]:
        """Returns the bounds of the environment's own spec."""
        space = self._envs[0].action_spec_unbatched.space
        return space.low.flatten(), space.high.flatten()

    def _own_actions(self, actions: Tensor) -> Tensor:
        """Converts actions of all environments to the shape, bounds and dtype of their own specs."""
        spec = self._envs[0].action_spec_unbatched
        if not isinstance(spec, Bounded):
            return actions.to(spec.dtype)
        rounded = actions if spec.dtype.is_floating_point else actions.round()
        return rounded.to(spec.dtype).reshape(-1, *spec.shape).clamp(spec.space.low, spec.space.high)

    def _try_out(self, termination: Termination, achieved_reward: float | None) -> FoundRules:
        """Finds the environment's rules for rewards and ends by some steps of random actions."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self.set_seeds([0])
            rounds = -(-_TRIED_STEPS // self.batch_size[0])
            steps = self.rollout(max(rounds, 2), break_when_any_done=False, auto_reset=True)
        after = steps["next"].reshape(-1)
        achieved, desired = (after[key] for key in _GOALS)
        chosen = torch.linspace(0, len(achieved) - 1, min(_PAIRED, len(achieved))).long()
        one, other, info = achieved[chosen], desired[chosen], after[chosen].unsqueeze(1)
        rewards = [self.compute_reward(one.unsqueeze(1), other, info).flatten().numpy()]
        with torch.random.fork_rng(devices=[]):
            self.rollout(_PAIRED, break_when_any_done=False)
        rewards.append(self.compute_reward(one.unsqueeze(1), other, info).flatten().numpy())
        check_stateless(self._name, *rewards)
        equal = float(self.compute_reward(other, other, after[chosen]).min())
        if self._info:
            of_equal_goals = self.compute_reward(desired, desired, after).flatten().numpy()
            equal = equal_with_info(self._name, of_equal_goals, rewards[0], achieved_reward)
        missed, met, dense = check_rewards(self._name, equal, rewards[0], achieved_reward)
        stepped = after["reward"].flatten()
        computed = self.compute_reward(achieved, desired, after).flatten()
        reached = computed >= met
        went_on = ~after["terminated"].flatten() | reached  # without failures, whose cost is not computed
        warn_once(check_same_rewards(self._name, stepped[went_on].numpy(), computed[went_on].numpy()))
        first, env_ends = self._envs[0], None
        if callable(getattr(first, "compute_terminated", None)):
            pairs = torch.cat((one, other)).unsqueeze(1), torch.cat((one, other))
            env_ends = bool(self._ask("compute_terminated", *pairs, torch.cat((info, info))).any())
        ends = GoalEnds(self._name, env_ends=env_ends, tells_success=_SUCCESS in self.observation_spec)
        if ends.tells_success:
            reached = after[_SUCCESS].flatten()
        ends.apply(reached, after["terminated"].flatten(), after["truncated"].flatten())
        ends.decide(termination)
        return FoundRules(ends=ends, missed_reward=missed, achieved_reward=met, dense=dense)
