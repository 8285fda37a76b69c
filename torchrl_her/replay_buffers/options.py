"""The options that :class:`~torchrl_her.HERWriter` and :class:`~torchrl_her.HERSampleUnit` share."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from typing import Any, Literal, get_args

from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

from torchrl_her.checks import check_whole, entry_of
from torchrl_her.env_keys import EnvKeys
from torchrl_her.goals.rewards import RewardFunction, ask_reward
from torchrl_her.goals.strategies import (
    RECENT,
    GoalSources,
    Strategy,
    check_goal_sources,
    get_strategy,
    sources_name,
)
from torchrl_her.goals.weights import GoalWeights
from torchrl_her.replay_buffers.keys import LEAST_COST, TransitionKeys, in_root_and_next, under_next

Per = Literal["transition", "episode"]
_SUSPICIOUS = 10  # number of one-step episodes that hardly occurs by chance


class _NotGiven(int):
    """Type of a default, to tell it from the same number given by a user."""


@dataclass(frozen=True, kw_only=True)
class HindsightOptions:
    """Options of relabeling, and the keys of the entries that it reads and writes.

    Args:
        k: virtual transitions for each real one (on average, when relabeling while sampling); 0 makes none.
        strategy: rule for the achieved goals of its episode that a transition may take: ``"future"`` (those
            achieved by its action or later), ``"final"`` (the last one), ``"episode"`` (any), another name
            given to :func:`~torchrl_her.register_strategy`, or a function as described there.
        goal_sources: number of virtual goals by source, in place of ``k`` and ``strategy``, which are short
            for a single source: ``k=4, strategy="future"`` is ``{"future": 4}``. Besides strategies there are
            two sources that look beyond the episode: ``"actual"``, the desired goals of recent episodes, and
            ``"achieved"``, goals that were achieved in these episodes. ``weights`` and filter act on the
            goals of all sources. None: ``k`` and ``strategy`` count.
        recent_actual, recent_achieved: number of the newest goals that ``"actual"`` and ``"achieved"``
            remember: one desired goal for each episode, and one achieved goal for each transition. Episodes
            that are being written are included. If these alone have more goals, a part is kept that is spread
            evenly over environments and time. A sample unit takes goals from this number of the newest stored
            episodes or transitions. Large numbers cost time only if the filter refuses nearly all goals.
        per: unit that gets a goal of its own. ``"transition"``: each transition, for learning from single
            transitions. ``"episode"``: each copy of a whole episode, for learning from sequences, as
            recurrent policies do; see :class:`~torchrl_her.HERWriter`.
        n_steps: transitions span up to n steps: ``reward`` is the discounted sum of the rewards for their
            goal, ``next`` is the one of the last step, and ``steps_to_next_obs`` the number of steps, by
            which TorchRL's losses discount. Transitions end where the reward function terminates, or with the
            episode. Sutton and Barto, Reinforcement Learning, 2018, equation 7.1.
        gamma: discount of the loss, by which rewards of ``n_steps`` are summed; needed if these are above 1.
        filter_achieved: take no goal that was already achieved in the state before the action
            (Filtered-HER). The reward decides, and not ``terminated``, since many environments never
            terminate. If episodes continue at their goals, transitions at the goal teach the agent to stay
            there. Then a goal is left out only if it was also achieved at the start of the episode, when
            nothing had moved yet.
        redraw: True replaces a goal that the filter refuses by one that it keeps. False writes no virtual
            transition for it.
        exclude: entries to leave out, in the root and under ``next``; the observation is never left out. By
            default ``state``, because it holds the real goal. Add whatever else was computed from the desired
            goal.
        keys: keys of the goals, in the root and under ``next``, and of reward and flags under ``next``.
        trajectory_key: key of ids that distinguish trajectories; the entry may be missing.
        env_ids_key: key of ids that distinguish environments, as :class:`~torchrl_her.EnvIds` makes them; the
            entry may be missing, and is not stored by the writer.
        real_goal_key: key of the task's own goal, if another goal was proposed in its place
            (:class:`~torchrl_her.behavior.BehaviorGoals`); the entry may be missing, and is left out like
            entries of ``exclude``. The source ``"actual"`` takes these goals.
        stage_key: key of the stage [..., 1] that an episode was played in, for writers with ``stages``.
        virtual_key: key of a bool [..., 1] that marks virtual transitions; None for no mark.

    Raises:
        ValueError: a number is not whole, not finite or too small, there is no such strategy or source,
            ``goal_sources`` and another ``k`` or ``strategy`` are given, ``n_steps`` is above 1 without
            ``gamma`` or with whole episodes, or ``per`` is neither of its words.
        TypeError: ``exclude`` is a single key, or ``goal_sources`` no mapping.

    Example:
        >>> options = HindsightOptions(k=8, filter_achieved=True)
        >>> options.k, options.strategy
        (8, 'future')
        >>> mixed = HindsightOptions(goal_sources={"future": 2, "actual": 2})
        >>> mixed.k, mixed.sources
        (4, {'future': 2, 'actual': 2})
    """

    k: int = _NotGiven(4)
    strategy: Strategy = "future"
    goal_sources: GoalSources | None = None
    recent_actual: int = 1_000
    recent_achieved: int = 2_000
    per: Per = "transition"
    n_steps: int = 1
    gamma: float | None = None
    filter_achieved: bool = False
    redraw: bool = True
    exclude: Sequence[NestedKey] = ("state",)
    keys: EnvKeys = EnvKeys()
    trajectory_key: NestedKey = ("collector", "traj_ids")
    env_ids_key: NestedKey = "env_ids"
    real_goal_key: NestedKey = "real_desired_goal"
    stage_key: NestedKey = "stage"
    virtual_key: NestedKey | None = "virtual"

    def __post_init__(self) -> None:
        check_whole(k=self.k, least=0)
        recent = {f"recent_{source}": getattr(self, f"recent_{source}") for source in RECENT}
        check_whole(n_steps=self.n_steps, **recent)
        if self.per not in get_args(Per):
            raise ValueError(f"per must be one of {', '.join(get_args(Per))}, got {self.per!r}")
        if self.n_steps > 1 and self.per == "episode":
            raise ValueError(
                f"n_steps={self.n_steps} makes single transitions, which cannot be sampled as sequences: use "
                "per='transition', or compute n-step returns from the sequences that per='episode' samples"
            )
        if self.n_steps > 1 and (self.gamma is None or not 0 < self.gamma <= 1):
            raise ValueError(f"n_steps={self.n_steps} needs the loss's gamma, in (0, 1], got {self.gamma}")
        get_strategy(self.strategy)
        in_root_and_next(self.exclude)
        if self.goal_sources is not None:
            sources = check_goal_sources(self.goal_sources)
            k = sum(sources.values())
            repeated: dict[str, Any] = {}
            if not isinstance(self.k, _NotGiven) and self.k != k:
                repeated["k"] = self.k
            if self.strategy != HindsightOptions.strategy:
                repeated["strategy"] = self.strategy
            if repeated:
                raise ValueError(_twice(self.goal_sources, **repeated))
            object.__setattr__(self, "goal_sources", sources)
            object.__setattr__(self, "k", k)

    @property
    def sources(self) -> dict[Strategy, int]:
        """Number of virtual goals of each transition by source; empty if there are none."""
        if self.goal_sources is not None:
            return dict(self.goal_sources)
        return {self.strategy: int(self.k)} if self.k > 0 else {}

    @property
    def remembered(self) -> dict[str, int]:
        """Number of goals to remember for each source that takes goals of recent episodes."""
        return {name: getattr(self, f"recent_{name}") for name in RECENT if name in self.sources}

    def changed(self, changes: dict[str, Any]) -> HindsightOptions:
        """Returns the options with changes. Goal sources take the place of ``k`` and ``strategy``.

        If goal sources are taken away, ``k`` and ``strategy`` become the defaults, unless they are given.

        Raises:
            TypeError: there is no option of one of these names.
            ValueError: an option is out of range, or ``goal_sources`` comes with ``k`` or ``strategy``.

        Example:
            >>> HindsightOptions(k=8).changed({"strategy": "final"}).strategy
            'final'
        """
        known = [field.name for field in fields(self)]
        for name in changes:
            if name not in known:
                nearest = get_close_matches(name, known, n=1)
                hint = f"; did you mean {nearest[0]!r}?" if nearest else "."
                raise TypeError(f"there is no option {name!r}{hint} The options are {', '.join(known)}")
        sources = changes.get("goal_sources", self.goal_sources)
        repeated = {name: changes[name] for name in ("k", "strategy") if name in changes}
        if sources is not None and repeated:
            raise ValueError(_twice(sources, **repeated))
        if sources is not None or self.goal_sources is not None:  # k and strategy get their defaults
            changes = {"k": HindsightOptions.k, "strategy": HindsightOptions.strategy, **changes}
        return replace(self, **changes)

    def transition_keys(self) -> TransitionKeys:
        """Returns the full keys of the entries that relabeling reads and writes.

        Raises:
            ValueError: ``keys.truncated`` is None.
        """
        if self.keys.truncated is None:
            raise ValueError("relabeling needs a key for truncated, got keys.truncated=None")
        return TransitionKeys(
            achieved=unravel_key(self.keys.achieved_goal),
            next_achieved=under_next(self.keys.achieved_goal),
            goals=(unravel_key(self.keys.desired_goal), under_next(self.keys.desired_goal)),
            reward=under_next(self.keys.reward),
            terminated=under_next(self.keys.terminated),
            truncated=under_next(self.keys.truncated),
            done=under_next(self.keys.done),
            trajectory=unravel_key(self.trajectory_key),
            env_ids=unravel_key(self.env_ids_key),
            real_goal=unravel_key(self.real_goal_key),
            stage=unravel_key(self.stage_key),
        )


def _twice(sources: GoalSources, **repeated: Any) -> str:
    """Returns the message about goal sources that are given together with ``k`` or ``strategy``."""
    assignments = " and ".join(f"{name}={value!r}" for name, value in repeated.items())
    return f"{assignments} and goal_sources={{{sources_name(sources)}}} say the same: give one of them"


def _option(name: str) -> Any:
    """Returns a property that reads and sets an option of a writer or sample unit."""

    def read(part: HindsightBase) -> Any:
        return getattr(part.options, name)

    def change(part: HindsightBase, value: Any) -> None:
        part.options = part.options.changed({name: value})

    return property(read, change)


class HindsightBase:
    """Base of relabeling in a writer and of relabeling while sampling.

    Args:
        reward_fn: maps (achieved, desired) goals to (reward, terminated).
        options: options of relabeling; None for the defaults.

    Keyword Args:
        weights: weights by which goals are drawn; None for equal weights.
        **changes: options that differ from ``options``.

    Attributes:
        options: all options; assign another :class:`~torchrl_her.HindsightOptions` to change them.
        k, strategy, ...: each option by its name, which can also be set here.

    Raises:
        ValueError: an option is out of its range.
        TypeError: an option is unknown.
    """

    k: int
    filter_achieved: bool

    def __init__(
        self,
        reward_fn: RewardFunction,
        options: HindsightOptions | None = None,
        *,
        weights: GoalWeights | None = None,
        **changes: Any,
    ) -> None:
        super().__init__()
        if options is not None and not isinstance(options, HindsightOptions):
            raise TypeError(f"options must be HindsightOptions or None, got {options!r}")
        self.reward_fn, self.weights = reward_fn, weights
        self.options = (options or HindsightOptions()).changed(changes)
        self._time_seen = False  # True once an episode had several steps or a warning was given
        self._compared = False  # whether rewards were compared with the reward function

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.reward_fn!r}, {self.options!r})"

    @property
    def options(self) -> HindsightOptions:
        """The options of relabeling."""
        return self._options

    @options.setter
    def options(self, options: HindsightOptions) -> None:
        self._options = options
        self._keys = options.transition_keys()
        shown = unravel_key(options.keys.observation)
        excluded = [key for key in (*options.exclude, options.real_goal_key) if unravel_key(key) != shown]
        self._exclude = in_root_and_next(excluded)

    def _compare_rewards(self, rows: TensorDictBase) -> None:
        """Warns if the first rows [n] that are written show that the reward function is wrong."""
        if self._compared or self.k == 0:
            return
        self._compared = True
        computed, reward = self._keys.rewards(rows, self.reward_fn)
        differ = ((reward - computed).abs() > LEAST_COST * (1 + computed.abs())).nonzero()
        if len(differ) > 0:
            one, other = (values[differ[0, 0]].item() for values in (computed, reward))
            warnings.warn(
                f"the reward function gives {one:g} where the collected reward is {other:g}, and other ones "
                f"in {len(differ):,} of {len(reward):,} rows; pass the environment's own rule, since "
                "virtual transitions get the rewards of this function (this warning appears once)",
                stacklevel=4,
            )
        if getattr(self.reward_fn, "achieved_reward", None) is not None:
            return
        goals = entry_of(rows, self._keys.next_achieved)
        equal = ask_reward(self.reward_fn, self._keys.after(rows, self.reward_fn), goals)[0].max().item()
        if abs(equal) > LEAST_COST:
            warnings.warn(
                f"goals with a reward of at least 0 count as achieved, but equal goals have {equal:g}; give "
                f"the reward of an achieved goal: EnvReward(..., achieved_reward={equal:g}), or an attribute "
                "of this name of another reward function (this warning appears once)",
                stacklevel=4,
            )

    def _look_at_time(self, lengths: Tensor) -> None:
        """Warns once if the first episodes [E] all have a single step: time may be another dimension."""
        if self._time_seen or self.k == 0:
            return
        several = bool((lengths > 1).any())
        suspicious = not several and len(lengths) >= _SUSPICIOUS
        if suspicious:
            warnings.warn(
                f"all {len(lengths)} episodes have one step: does time run along the last dimension of "
                "batches [N, T]? For storages of two dimensions TorchRL itself transposes them "
                "(this warning appears once)",
                stacklevel=5,
            )
        self._time_seen = several or suspicious


for _field in fields(HindsightOptions):
    setattr(HindsightBase, _field.name, _option(_field.name))
