"""Wraps gymnasium environments with goals as a batched TorchRL environment."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack, closing
from functools import partial
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import GymWrapper

from torchrl_her_envs.common.goal_env import (
    INFO,
    GoalEnv,
    Names,
    bounded_actions,
    needs_info,
    reward_range,
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
    is_dense,
    say_once,
    warn_once,
)
from torchrl_her_envs.common.rendering.pictures import as_picture
from torchrl_her_envs.common.seeding import as_seeds, block_keys, uniform
from torchrl_her_envs.gym.check import (
    EPISODES,
    KEYS,
    REWARD,
    SUCCESS,
    TERMINATED,
    Trial,
    check_goal_env,
    check_methods,
    coarse_goals,
    find_achieved_reward,
    find_limit,
    goals_to_try,
    has_compute_terminated,
    make_one,
    shown_of,
    spec_of,
    try_steps,
)
from torchrl_her_envs.gym.drawing import PICTURES, cannot_draw, choose_renderer, draws
from torchrl_her_envs.gym.fetch import fetch_names, fetch_stages
from torchrl_her_envs.gym.goal_functions import GoalFunction, ShapedReward
from torchrl_her_envs.gym.infos import Infos
from torchrl_her_envs.gym.layout import Layout
from torchrl_her_envs.gym.quiet import make_quietly


def make_gym_env(
    id: str,
    *,
    num_envs: int = 1,
    seed: int | Sequence[int] = 0,
    max_steps: int | None = None,
    parallel: bool = False,
    termination: str = "auto",
    achieved_reward: float | None = None,
    info_keys: Sequence[str] = (),
    shaping: Sequence[float] | None = None,
    observation_key: Names = "observation",
    achieved_goal_key: Names = "achieved_goal",
    desired_goal_key: Names = "desired_goal",
    pictures: bool = False,
    **options: Any,
) -> GymGoalEnv:
    """Makes a batch of a gymnasium environment that follows GoalEnv.

    Args:
        id: as ``gymnasium.make`` takes it, ``module:Env-v0`` included. The environments of
            gymnasium-robotics need no import.
        num_envs: number of environments.
        seed: seed of all environments; R seeds for R equal blocks of them, each as if alone.
        max_steps: length of an episode. If None, the registered length, or the length at which the
            environment truncates episodes of random actions, or 100.
        parallel: whether each environment gets a process, which pays if a step takes milliseconds and there
            are several cores.
        termination: rule that ends an episode at its goal, see :class:`GymGoalEnv`.
        achieved_reward: the least reward at which a goal counts as achieved, for dense rewards; if None, the
            least reward at which the environment's method ``_is_success`` is true.
        info_keys: keys of ``info`` that ``compute_reward`` reads, see :class:`GymGoalEnv`.
        shaping: two distances between which a missed goal's reward grows, see :class:`GymGoalEnv`.
        observation_key, achieved_goal_key, desired_goal_key: the environment's names of these entries. The
            entries of a list are joined in order; ``compute_reward`` gets them as a dictionary.
        pictures: whether to make environments with ``render_mode="rgb_array"``, if they have that mode.
        options: options of the environment, which ``gymnasium.make`` takes, such as ``render_mode``.

    Raises:
        ValueError: there is no such environment, it does not take an option, it lacks something that GoalEnv
            requires, its reward is dense, ``achieved_reward`` is not given and cannot be found, or
            environments cannot be shared out among the seeds.
        ImportError: a package that it needs is not installed.

    Example:
        >>> env = make_gym_env("torchrl_her_envs:torchrl_her/HandReach-v0", num_envs=2, seed=0)
        >>> env.rollout(3)["desired_goal"].shape
        torch.Size([2, 3, 2])
        >>> env.close()
    """
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, got {num_envs}")
    if max_steps is not None:
        options["max_episode_steps"] = max_steps
    check_termination(termination)
    keys = dict(zip(KEYS, (observation_key, achieved_goal_key, desired_goal_key), strict=True))
    names = None if all(key == name for key, name in keys.items()) else keys
    with ExitStack() as opened:
        reference_env = opened.enter_context(closing(make_one(id, names, options)))
        check_goal_env(id, reference_env)
        check_methods(id, reference_env)
        if spec_of(reference_env).max_episode_steps is None:
            options["max_episode_steps"] = limit = find_limit(reference_env)
            say_once(
                f"{id} has no registered time limit: episodes are cut off after {limit} steps "
                f"(task.options.max_steps={limit})"
            )
            reference_env = opened.enter_context(closing(make_one(id, names, options)))
        if pictures and draws(reference_env) and "render_mode" not in options:
            choose_renderer()
            options["render_mode"] = PICTURES
            reference_env = opened.enter_context(closing(make_one(id, names, options)))
        # Environments are made by spec: by id, new processes would have to register it, and so load TorchRL.
        make = partial(make_quietly, gymnasium.registry[spec_of(reference_env).id], names, **options)
        vector = AsyncVectorEnv if parallel else SyncVectorEnv
        envs = opened.enter_context(closing(vector([make] * num_envs, autoreset_mode=AutoresetMode.DISABLED)))
        env = GymGoalEnv(
            envs,
            reference_env,
            seed=seed,
            termination=termination,
            achieved_reward=achieved_reward,
            info_keys=info_keys,
            shaping=shaping,
        )
        opened.pop_all()  # from here on, GymGoalEnv.close closes all environments
    return env


class GymGoalEnv(GoalEnv, GymWrapper):
    """N environments of gymnasium's with goals, stepped by gymnasium and wrapped by TorchRL.

    Keys: ``observation``, ``achieved_goal``, ``desired_goal`` and ``reward`` in float32, ``action``
    (float32 [N, entries] within the environment's bounds, or whole numbers [N] if its actions are discrete),
    ``terminated``, ``truncated``, ``done``; and ``is_success``, whether the goal is achieved, if the
    environment's ``info`` has it. Each environment gets its actions in the shape and type of its space,
    rounded if these are whole numbers.
    The environments are independent: environment k with a given seed does the same in every batch.
    Observations and goals that are dictionaries become vectors, in the order of
    ``torchrl_her_envs.gym.layout.Layout``; the environment's own functions get goals in their original form.

    The environment's ``compute_terminated`` decides whether a goal ends an episode. Without this function,
    ``termination`` chooses the steps that terminate an episode at its goal:

    - ``"success"``: steps whose ``info["is_success"]`` is true. For virtual goals, which have no ``info``,
      steps with the reward of an achieved goal.
    - ``"reward"``: steps with the reward of an achieved goal, for real and virtual goals.
    - ``"never"``: no steps. An episode that the environment ends at its goal is ``truncated``.
    - ``"auto"``: chosen after 100 steps of random actions, and 100 more from achieved goals if these
      achieved none. ``"success"`` (or ``"reward"`` without ``is_success``) if the environment ended an
      episode at an achieved goal; ``"never"`` if it continued there, or if no goal was achieved. The choice
      is logged.
    - ``"watch"``: the environment ends episodes as it does by itself, and ``goal_ends`` counts the episodes
      that it ended or continued at their goals.

    The first three, if given, replace ``compute_terminated``; ``"own"`` keeps it. If the environment ends an
    episode for another reason, as by a fall, the episode is ``terminated`` by every rule.

    If the environment's functions read more than the goals, ``info_keys`` names the entries of ``info``. They
    become entries of transitions, ``("info", KEY)``, from which rewards of virtual goals are computed:
    ``EnvReward.of(env)``.

    :func:`make_gym_env` makes such environments.

    Args:
        envs: gymnasium's vector of environments, which must not reset by itself (``AutoresetMode.DISABLED``).
        reference_env: another environment of the same kind, whose functions give the rewards of goals.
        seed: seed of all environments; R seeds for R equal blocks of them, each as if alone.
        termination: rule that ends an episode at its goal.
        achieved_reward: the least reward at which a goal counts as achieved; the reward of equal goals if
            None.
        info_keys: keys of ``info`` that its functions read. The info of every step must have them, as numbers
            or arrays of numbers.
        shaping: the nearer and the farther of two distances between which a missed goal's reward grows to
            that of an achieved goal, see :class:`~torchrl_her_envs.gym.goal_functions.ShapedReward`; None for
            the environment's own sparse reward.

    Attributes:
        goal_ends: rule for the ends of episodes at goals, and counts of what the environment did there.
        achieved_reward: the least reward of an achieved goal.
        missed_reward: the least reward that was seen when the environment was tried; a sparse reward is
            always one of these two.
        dense_reward: whether missed goals have many different rewards.

    Raises:
        ValueError: environments cannot be shared out among the seeds, an achieved goal gives no more
            reward than a missed one, the reward is dense and no ``achieved_reward`` is given or found,
            ``shaping`` is not two growing distances, or ``termination`` is unknown or needs what the
            environment lacks.
    """

    def __init__(
        self,
        envs: VectorEnv,
        reference_env: gymnasium.Env,
        *,
        seed: int | Sequence[int] = 0,
        termination: str = "auto",
        achieved_reward: float | None = None,
        info_keys: Sequence[str] = (),
        shaping: Sequence[float] | None = None,
        **kwargs: Any,
    ) -> None:
        self._reward_of: GoalFunction | ShapedReward
        shown = shown_of(reference_env.observation_space)
        id = spec_of(reference_env).id
        self._layouts = {key: Layout(shown[key], f"{id}: {key}") for key in KEYS}
        super().__init__(envs, device="cpu", **kwargs)  # TorchRL's metaclass adds arguments
        self._reference_env = reference_env
        self.max_steps = spec_of(reference_env).max_episode_steps or 0
        self._try_out(check_termination(termination), achieved_reward, info_keys)
        if shaping is not None:
            self._reward_of = ShapedReward(self._reward_of, *reward_range(self), shaping)
            self.dense_reward = True
        self.set_seeds(as_seeds(seed))

    def _try_out(
        self, termination: Termination, achieved_reward: float | None, info_keys: Sequence[str]
    ) -> None:
        """Finds the environment's rules for rewards and ends by trying some of its goals and steps."""
        env, layout, id = self._reference_env, self._layouts["achieved_goal"], spec_of(self._reference_env).id
        seen = try_steps(env, layout).infos if len(info_keys) > 0 else []
        self._infos = infos = Infos(info_keys, seen, id)
        goals = goals_to_try(env, layout)
        info = infos.stack([seen[row % len(seen)] for row in range(len(goals[0]) if seen else 0)])
        reward_of = self._reward_of = self._function(REWARD, goals, info)
        trial = try_steps(env, layout)
        warn_once(coarse_goals(id, trial.achieved))
        check_stateless(id, reward_of.tried, reward_of(*goals, info))
        one, other = trial.pairs()
        pairs, stepped = (trial.achieved[one], trial.desired[other]), infos.stack(trial.infos)
        paired = {key: entries[one] for key, entries in stepped.items()}
        others = np.concatenate([reward_of.tried[EPISODES:], reward_of(*pairs, paired)])
        equal = float(reward_of.tried[:EPISODES].min())
        if info:
            of_equal_goals = reward_of(trial.desired, trial.desired, stepped)
            equal = equal_with_info(id, of_equal_goals, others, achieved_reward)
        elif achieved_reward is None and is_dense(equal, others):
            achieved_reward = find_achieved_reward(env, layout, reward_of, *pairs)
            if achieved_reward is not None:
                say_once(
                    f"{id} has a dense reward: goals count as achieved where _is_success becomes true "
                    f"(task.options.achieved_reward={achieved_reward:.4g})"
                )
        self.missed_reward, self.achieved_reward, self.dense_reward = check_rewards(
            id, equal, others, achieved_reward
        )
        computed = reward_of(trial.achieved, trial.desired, stepped)
        met = computed >= self.achieved_reward
        went_on = ~trial.terminated | met  # without failures, whose cost is not computed
        warn_once(reward_of.hint(info) or check_same_rewards(id, trial.reward[went_on], computed[went_on]))
        env_ends = None
        if termination in ("auto", "own", "watch") and has_compute_terminated(
            env, *(layout.unflatten(goal[0]) for goal in goals)
        ):
            self._terminated_of = self._function(TERMINATED, goals, info)
            env_ends = bool(self._terminated_of.tried.any())
        self.goal_ends = GoalEnds(id, env_ends=env_ends, tells_success=trial.success is not None)
        self._count_ends(trial, met)
        if termination in ("auto", "watch") and self.goal_ends.found() is None:
            trial = try_steps(env, layout, at_goals=True)
            computed = reward_of(trial.achieved, trial.desired, infos.stack(trial.infos))
            self._count_ends(trial, computed >= self.achieved_reward)
        self.goal_ends.decide(termination)
        if trial.success is not None:
            shape = (*self.batch_size, 1)
            self.observation_spec[SUCCESS] = Binary(n=1, shape=shape, dtype=torch.bool)
        if info:
            self.observation_spec[INFO] = infos.spec(self.batch_size[0])

    def _count_ends(self, trial: Trial, met: np.ndarray) -> None:
        met = met if trial.success is None else trial.success
        self.goal_ends.apply(met, trial.terminated, trial.truncated)

    @property
    def ends(self) -> Ends:
        """Rule for the ends of episodes, see :class:`~torchrl_her_envs.common.goal_rules.GoalEnds`."""
        return self.goal_ends.rule

    @property
    def info_keys(self) -> list[tuple[str, str]]:
        """Entries of transitions that ``compute_reward`` reads besides goals."""
        return self._infos.keys

    def _function(
        self, name: str, goals: tuple[np.ndarray, np.ndarray], info: dict[str, np.ndarray]
    ) -> GoalFunction:
        """Wraps a function of the environment, which takes goals in their original form, for goals [B, g]."""
        method, layout = self._reference_env.get_wrapper_attr(name), self._layouts["achieved_goal"]

        def function(achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
            return method(layout.unflatten(achieved), layout.unflatten(desired), info)

        return GoalFunction(function, *goals, name=f"{spec_of(self._reference_env).id}'s {name}", info=info)

    @property
    def task_name(self) -> str:
        return f"gym:{spec_of(self._reference_env).id}"

    @property
    def can_render(self) -> bool:
        """Whether the environment was made with ``render_mode="rgb_array"``."""
        return self._reference_env.render_mode == PICTURES

    def stages(self) -> list[dict[str, Any]]:
        """Returns the stages of the Fetch tasks; raises a ValueError for other environments."""
        return fetch_stages(spec_of(self._reference_env).id) or super().stages()

    def state_names(self) -> dict[str, list[int]]:
        """Returns names for entries of the state: ``observation``, ``desired_goal`` and their nested entries.

        Nested entries are named with dots between the keys, as in ``observation.arm.angles``. The Fetch tasks
        have further names, such as ``object``.
        """
        names, first = super().state_names() | fetch_names(spec_of(self._reference_env).id), 0
        for key in ("observation", "desired_goal"):
            layout = self._layouts[key]
            inner = {f"{key}.{name}": [first + at for at in places] for name, places in layout.places.items()}
            names, first = names | inner, first + layout.width
        return names

    def compute_reward(
        self, achieved_goal: Tensor, desired_goal: Tensor, info: TensorDictBase | None = None
    ) -> Tensor:
        """Returns the reward of an achieved goal when another was desired, by the environment's own rule.

        Args:
            achieved_goal: [..., g], the achieved goals.
            desired_goal: [..., g], broadcast against ``achieved_goal``.
            info: [...], with the entries ``info_keys`` if there are any, broadcast against the goals.

        Returns:
            Rewards, float32 [..., 1].

        Raises:
            ValueError: there are ``info_keys``, and no info is given.
        """
        return self._ask(self._reward_of, achieved_goal, desired_goal, info).float()

    def compute_terminated(
        self, achieved_goal: Tensor, desired_goal: Tensor, info: TensorDictBase | None = None
    ) -> Tensor:
        """Returns whether an episode terminates, as bool [..., 1], for pairs of goals [..., g]."""
        if self.ends == "own":
            return self._ask(self._terminated_of, achieved_goal, desired_goal, info).bool()
        reward = self.compute_reward(achieved_goal, desired_goal, info)
        return (reward >= self.achieved_reward) & (self.ends in ("success", "reward"))

    def set_seeds(self, seeds: Sequence[int]) -> None:
        """Seeds R equal blocks of environments, each as if it were alone; from their next reset on.

        Each reset of an environment gets a seed of its own, which depends on the environment's seed and the
        number of the episode alone.

        Args:
            seeds: R seeds.

        Raises:
            ValueError: the environments cannot be shared out among R blocks, or a seed is out of range.
        """
        self._seed_keys = block_keys(seeds, self.batch_size[0])
        self._episodes = np.zeros(self.batch_size[0], np.int64)

    def _draw_worlds(self, worlds: Sequence[int], size: int | None) -> list[Tensor]:
        if not self.can_render:
            mode = self._reference_env.render_mode
            raise ValueError(f'pictures need render_mode="rgb_array", got {mode!r}')
        try:
            drawn = self._drawn(worlds)
        except Exception as error:  # a renderer may raise any error
            raise ValueError(cannot_draw(self.task_name, error)) from error
        return [as_picture(picture, self.task_name, size=size) for picture in drawn]

    def _drawn(self, chosen: Sequence[int]) -> Sequence[Any]:
        if isinstance(self._env, SyncVectorEnv):
            return [self._env.envs[index].render() for index in chosen]
        everything = self._env.render()  # environments in other processes all draw at once
        return [everything[index] for index in chosen]

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes all environments."""
        self._reference_env.close()
        super().close(raise_if_closed=raise_if_closed)

    def _ask(
        self,
        function: GoalFunction | ShapedReward,
        achieved_goal: Tensor,
        desired_goal: Tensor,
        info: TensorDictBase | None,
    ) -> Tensor:
        """Calls a function for pairs of goals [..., g], and returns its results [..., 1]."""
        if info is None and self.info_keys:
            raise ValueError(needs_info(self))
        pair = torch.broadcast_tensors(achieved_goal, desired_goal)
        achieved, desired = (self._rows(goals) for goals in pair)
        given = {} if info is None else self._infos.read(info, pair[0].shape[:-1])
        answers = torch.from_numpy(function(achieved, desired, given))
        return answers.to(pair[0].device).view(*pair[0].shape[:-1], 1)

    def _rows(self, goals: Tensor) -> np.ndarray:
        """Converts goals [..., g] to an array of rows."""
        return goals.detach().cpu().reshape(-1, goals.shape[-1]).numpy()

    # TorchRL's hooks

    def _make_specs(self, env: VectorEnv, batch_size: torch.Size | None = None) -> None:
        n, space = env.num_envs, cast(spaces.Box | spaces.Discrete, env.single_action_space)
        seen = {key: Unbounded(shape=(n, self._layouts[key].width), dtype=torch.float32) for key in KEYS}
        self.observation_spec = Composite(seen, shape=(n,))
        if isinstance(space, spaces.Discrete):
            self.action_spec = Categorical(n=int(space.n), shape=(n,), dtype=torch.int64)
            self.first_action = int(space.start)
        else:
            self.action_spec = bounded_actions(*self.action_limits(), n)
        self.reward_spec = Unbounded(shape=(n, 1), dtype=torch.float32)
        self.done_spec = self._make_done_spec()

    def read_action(self, action: Tensor) -> np.ndarray:
        """Converts actions to the shape, bounds and dtype of the environments' action space."""
        space, rows = self._env.single_action_space, super().read_action(action)
        if isinstance(space, spaces.Discrete):
            return rows + space.start
        space = cast(spaces.Box, space)
        return np.clip(Layout(space, "action").unflatten(rows), space.low, space.high)

    def action_limits(self) -> tuple[Tensor, Tensor]:
        """Returns the bounds of the action space."""
        space = cast(spaces.Box, self._env.single_action_space)
        return torch.as_tensor(space.low).flatten(), torch.as_tensor(space.high).flatten()

    def read_obs(self, observations: dict[str, Any]) -> dict[str, Any]:
        """Returns observation and goals in float32, and ``is_success``; leaves out further keys."""
        shown = {key: self._layouts[key].flatten(observations[key]) for key in KEYS}
        if SUCCESS in self.observation_spec:
            word = observations.get(SUCCESS, np.zeros(self.batch_size))
            shown[SUCCESS] = np.asarray(word).astype(np.bool_)[:, None]
        info = {INFO: self._infos.rows(observations[INFO])} if self.info_keys else {}
        return {**super().read_obs(shown), **info}

    def _output_transform(self, step_outputs_tuple: tuple[Any, ...]) -> Any:
        """Returns the outputs of a step, with ends of episodes by the rule for goals."""
        shown, reward, terminated, truncated, info = step_outputs_tuple
        if SUCCESS in info:
            shown = {**shown, SUCCESS: info[SUCCESS]}
        shown = {**shown, INFO: self._infos.of_batch(info, len(reward))}
        if isinstance(self._reward_of, ShapedReward):
            goals = self._goals(shown)
            reward = reward + self._reward_of.bonus(*goals, self._reward_of.function(*goals, shown[INFO]))
        if self.ends != "own":
            met = self._met(shown)
            terminated, truncated = self.goal_ends.apply(met, terminated, truncated)
        return super()._output_transform((shown, reward, terminated, truncated, info))

    def _met(self, shown: dict[str, Any]) -> np.ndarray:
        """Returns a mask [N] of environments that achieve their goals, by ``is_success`` or the reward."""
        if self.goal_ends.asks_success:
            return np.asarray(shown.get(SUCCESS, np.zeros(self.batch_size))).astype(np.bool_)
        return self._reward_of(*self._goals(shown), shown[INFO]) >= self.achieved_reward

    def _goals(self, shown: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        achieved, desired = (self._layouts[key].flatten(shown[key]) for key in KEYS[1:])
        return achieved, desired

    def _set_seed(self, seed: int | None) -> None:
        self.set_seeds([seed or 0])

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        which = np.ones(self.batch_size, np.bool_) if mask is None else mask.view(-1).numpy()
        options = {"options": {"reset_mask": which}} if not which.all() else {}
        # Each reset gets a seed, since some environments (panda-gym's) otherwise draw one from the system.
        # The seed has 31 bits, since some environments pass it to generators that take at most 32.
        seeds = (uniform(self._seed_keys, self._episodes, 1)[:, 0] * 2**31).astype(np.int64)
        observations, info = self._env.reset(seed=seeds.tolist(), **options)
        self._episodes += which
        shown = {**observations, INFO: self._infos.of_batch(info, len(which), reset=True)}
        return TensorDict(self.read_obs(shown), batch_size=self.batch_size, device=self.device)
