"""Transforms for curricula: they show an environment as a stage sees it, and build the network's input."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import dispatch
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from torchrl_her.checks import check_blocks, entry_of
from torchrl_her.curriculum.orders import EpisodeStages
from torchrl_her.curriculum.stages import Curriculum, CurriculumProgress
from torchrl_her.env_keys import PROPOSED, EnvKeys
from torchrl_her.goals.rewards import RewardFunction, is_achieved
from torchrl_her.replay_buffers.keys import device_of


def take_columns(rows: Tensor, index: Tensor) -> Tensor:
    """Selects n columns of rows; ``index`` [B, n] has the columns for each of B equal blocks of rows."""
    if len(index) == 1:
        return rows.index_select(-1, index[0])
    blocks = rows.reshape(len(index), -1, rows.shape[-1])
    columns = blocks.gather(-1, index.unsqueeze(1).expand(-1, blocks.shape[1], -1))
    return columns.view(*rows.shape[:-1], index.shape[-1])


class _StageTransform(Transform):
    """Transform that depends on the stages that the runs are in at present."""

    def __init__(
        self,
        curriculum: Curriculum,
        progress: CurriculumProgress,
        run: int | None,
        in_keys: list[NestedKey],
        out_keys: list[NestedKey],
        stage_key: NestedKey,
    ) -> None:
        if progress.curriculum is not curriculum:
            raise ValueError("progress must have the same curriculum object as this transform")
        if run is not None and not 0 <= run < progress.runs:
            raise ValueError(f"run must be None or in [0, {progress.runs - 1}], got {run}")
        super().__init__(in_keys=in_keys, out_keys=out_keys)
        self.curriculum, self.progress, self.run = curriculum, progress, run
        self.stage_key = unravel_key(stage_key)
        self._table: tuple[Any, Any] = (None, None)  # cache: stages and device, and their table of columns
        self._shown_in: tuple[int, ...] | None = None  # stages of all runs in the last step or reset

    def _stages(self) -> tuple[int, ...]:
        """Returns the stage of each block of rows; a single one if all runs are in the same stage."""
        stages = self.progress.stages
        if self.run is not None:
            return stages[self.run : self.run + 1]
        return stages[:1] if stages.count(stages[0]) == len(stages) else stages

    def _rows_stages(self, tensordict: TensorDictBase) -> Tensor | None:
        """Returns the stage [...] in which each row was played; None if each run has one stage."""
        if not self.progress.by_episode:
            return None
        return self._get(tensordict, self.stage_key, 1).squeeze(-1)

    def _columns(self, columns: Tensor, rows: Tensor | None, device: torch.device) -> Tensor:
        """Selects columns [B, n] for B blocks or B rows from a table with the columns of each stage."""
        stages = self._stages() if rows is None else tuple(range(len(self.curriculum)))
        made_for = stages, device
        if self._table[0] != made_for:
            self._table = made_for, columns[list(stages)].to(device)
        return self._table[1] if rows is None else self._table[1][rows.flatten()]

    def _check_blocks(self, shape: torch.Size) -> None:
        """Raises if a batch of ``shape`` [..., width] is not one equal block for each run."""
        check_blocks(shape[:-1], self.progress.runs if self.run is None else 1)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if self._shown_in is None:  # first reset only: later ones may reset a part of the rows
            self._shown_in = self.progress.stages
        return self._call(tensordict_reset)

    def _show_again(self, root: TensorDictBase) -> Tensor | None:
        """Recomputes the observations before a step if stages have changed since the last one.

        Returns:
            Mask [...] of the rows whose observations changed; None if no stage has changed.
        """
        stages = self.progress.stages
        changed, self._shown_in = self._shown_in not in (None, stages), stages
        if not changed or any(root.get(key, None) is None for key in self.out_keys):
            return None
        again = self._call(root.select(*self.in_keys, strict=False))
        differs = torch.zeros(root.shape, dtype=torch.bool, device=device_of(root))
        for key in self.out_keys:
            entry, new = root.get(key), again.get(key)
            differs |= (entry != new).any(-1)
            entry.copy_(new)  # in place, since the collector keeps this tensor but not this TensorDict
        return differs

    def _get(self, tensordict: TensorDictBase, key: NestedKey, width: int) -> Tensor:
        """Returns an entry; raises an error if it is missing or does not have the given width."""
        entry = entry_of(tensordict, key, by=type(self).__name__)
        if entry.shape[-1] != width:
            raise ValueError(f"the curriculum needs {key!r} of width {width}, got {entry.shape[-1]}")
        return entry

    def _seen(self, spec: Composite, key: NestedKey, width: int) -> TensorSpec:
        """Returns the spec of an entry; raises an error if it is missing or has another width."""
        if key not in spec.keys(True, True):
            raise KeyError(
                f"{type(self).__name__} needs the observation {key!r}, got {list(spec.keys(True, True))}"
            )
        if spec[key].shape[-1] != width:
            raise ValueError(f"the curriculum needs {key!r} of width {width}, got {spec[key].shape[-1]}")
        self._check_blocks(spec[key].shape)
        return spec[key]


class StateToObs(_StageTransform):
    """Shows an environment as each run's stage sees it: observation, goals, reward and ends.

    ``observation`` always has the width of the last stage: the entries of the present stage, then zeros.

    The last stage is the environment's own task: its reward and its ends stay as they are. In the stages
    below, ``next`` gets reward and ``terminated`` of the stage's ``reward_fn``: 0 and True where the goal is
    nearer than the stage's threshold, -1 and False elsewhere (always False if the goal has to be held, that
    is, if the stage has ``terminates=False``). ``done`` becomes ``terminated | truncated``.
    ``truncated`` stays as it was, so the environment must set it at its time limit even if its own goal is
    achieved.

    If the environment terminates an episode by itself, the stage's episode continues, provided that the
    environment can be stepped further. Gymnasium's cannot (``continues_after_termination=False``). Then the
    stage's episode ends, too. It is ``truncated`` unless the stage's goal was achieved in that step: the end
    says nothing about the stage's goal, so the critic must bootstrap there.

    The environments of R runs are R equal blocks of the batch's first dimension, in the order of the runs.
    Put the transform around a ParallelEnv and not inside of its workers: workers hold copies of ``progress``
    and would stay in the stages in which they were started.

    Change stages between episodes, and reset the collector. If a stage changes in mid-episode, the next step
    has the new stage's observations before and after the action, and the episode is truncated there (or just
    done, if there is no key for ``truncated``). The action of that step was chosen in the old stage. This
    works only if the environment is on the policy's device: it then shares the collector's tensors.

    GymWrapper renames an entry ``state`` of a dict to ``observation``; a RenameTransform before this one
    undoes it.

    The transform is for environments only. In a replay buffer it would bring the real goal back into
    transitions that were relabeled.

    Args:
        curriculum: the stages.
        progress: the stage of each run; looked up in every call.

    Keyword Args:
        state_key: the state vector, which is read.
        keys: keys of the entries that are written. The flag ``truncated`` is read; its key is None if the
            environment has no time limit (a StepCounter after this transform may add one).
        stage_key: key under which the stage of each row is written, [..., 1] of int64, if episodes have
            stages of their own (:class:`~torchrl_her.curriculum.EpisodeStages`).
        continues_after_termination: whether the environment can be stepped further after it terminated an
            episode; if not, ``truncated`` is written, too.

    Raises:
        ValueError: ``progress`` belongs to another curriculum, or ``continues_after_termination`` is False
            without a key for ``truncated``; when used, the state has another width, or the batch is
            not R equal blocks.
        KeyError: when used, the environment lacks the state or a flag.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_her import CurriculumStage
        >>> from torchrl_her_envs import make_env
        >>> hand, ball = [0, 1, 2, 3, 4], [5, 6]
        >>> reach = CurriculumStage(
        ...     name="reach", observation=hand, achieved_goal=[0, 1], desired_goal=ball, threshold=0.06
        ... )
        >>> throw = CurriculumStage(
        ...     name="throw", observation=range(9), achieved_goal=ball, desired_goal=[9, 10], threshold=0.1
        ... )
        >>> curriculum = Curriculum([reach, throw], 11)
        >>> progress = CurriculumProgress(curriculum, runs=2)
        >>> env = TransformedEnv(make_env("hand_v1", num_envs=4), StateToObs(curriculum, progress))
        >>> progress.set_stage(1, 1)
        >>> (env.reset()["observation"][:, 5:7] != 0).any(-1).tolist()  # which environments see the ball
        [False, False, True, True]
    """

    def __init__(
        self,
        curriculum: Curriculum,
        progress: CurriculumProgress,
        *,
        state_key: NestedKey = "state",
        keys: EnvKeys = EnvKeys(),
        stage_key: NestedKey = "stage",
        continues_after_termination: bool = True,
    ) -> None:
        keys.check_ends(continues_after_termination=continues_after_termination)
        out_keys = [keys.observation, keys.achieved_goal, keys.desired_goal]
        super().__init__(curriculum, progress, None, [state_key], out_keys, stage_key)
        self.keys, self.continues_after_termination = keys, continues_after_termination
        goal = curriculum.goal_width
        self._widths = [curriculum.observation_width, goal, goal]

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._observe(next_tensordict)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if self.progress.by_episode:
            tensordict_reset.set(self.stage_key, self._draw(tensordict, tensordict_reset))
        return super()._reset(tensordict, tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self.progress.by_episode:
            next_tensordict.set(self.stage_key, self._get(tensordict, self.stage_key, 1))
        cut = self._show_again(tensordict)
        self._observe(next_tensordict)
        self._judge(next_tensordict)
        if cut is not None:
            done = next_tensordict.get(self.keys.done)
            cut = cut.unsqueeze(-1) & ~done
            next_tensordict.set(self.keys.done, done | cut)
            if self.keys.truncated is not None:
                next_tensordict.set(self.keys.truncated, next_tensordict.get(self.keys.truncated) | cut)
        return next_tensordict

    def _judge(self, tensordict: TensorDictBase) -> None:
        """Sets the rewards and ends of rows in stages below the last, by the rules of their stages."""
        *below, last = range(len(self.curriculum))
        present, achieved = self._stages(), tensordict.get(self.out_keys[1])
        rows = self._rows_stages(tensordict)
        if rows is None:
            below = sorted(set(present) - {last})
            if len(present) > 1 and below:
                blocks = torch.tensor(present, device=achieved.device)
                rows = blocks.repeat_interleave(len(achieved) // len(blocks))
                rows = rows.view(-1, *[1] * (achieved.ndim - 2)).expand(achieved.shape[:-1])
        if not below:
            return
        reward, ended = tensordict.get(self.keys.reward), tensordict.get(self.keys.terminated)
        terminated = ended
        for stage in below:
            rule = cast(RewardFunction, self.curriculum.stages[stage].reward_fn)
            result = rule(achieved, tensordict.get(self.out_keys[2]))
            if rows is None:
                reward, terminated = result[0].to(reward.dtype), result[1]
            else:
                in_stage = (rows == stage).unsqueeze(-1)
                reward = torch.where(in_stage, result[0].to(reward.dtype), reward)
                terminated = torch.where(in_stage, result[1], terminated)
        done = terminated.clone()
        if self.keys.truncated is not None:
            truncated = tensordict.get(self.keys.truncated)
            if not self.continues_after_termination:
                truncated = truncated | (ended & ~terminated)
                tensordict.set(self.keys.truncated, truncated)
            done |= truncated
        tensordict.set(self.keys.reward, reward)
        tensordict.set(self.keys.terminated, terminated)
        tensordict.set(self.keys.done, done)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Raises a RuntimeError: sampled transitions would lose their virtual goals."""
        raise RuntimeError(
            "StateToObs is for environments: in a replay buffer it would put real goals into virtual rows"
        )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        state_spec = self._seen(observation_spec, self.in_keys[0], self.curriculum.state_width)
        for key, width in zip(self.out_keys, self._widths, strict=True):
            shape = (*state_spec.shape[:-1], width)
            observation_spec[key] = Unbounded(shape=shape, dtype=state_spec.dtype, device=state_spec.device)
        if self.progress.by_episode:
            observation_spec[self.stage_key] = Bounded(
                low=0,
                high=len(self.curriculum) - 1,
                shape=(*state_spec.shape[:-1], 1),
                dtype=torch.int64,
                device=state_spec.device,
            )
        return observation_spec

    def transform_done_spec(self, done_spec: Composite) -> Composite:
        known = list(done_spec.keys(True, True))
        for key in (self.keys.terminated, self.keys.truncated, self.keys.done):
            if key is not None and key not in known:
                raise KeyError(f"StateToObs needs the flag {key!r} of the environment, got {known}")
        return done_spec

    def _draw(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> Tensor:
        """Draws the stages [..., 1] of rows whose episode begins; TorchRL keeps the other rows."""
        assert isinstance(self.progress, EpisodeStages)
        state, mask = tensordict_reset.get(self.in_keys[0]), tensordict.get("_reset", None)
        self._check_blocks(state.shape)
        shape = (*state.shape[:-1], 1)
        begins = (
            torch.ones(shape, dtype=torch.bool, device=state.device) if mask is None else mask.view(shape)
        )
        drawn = self.progress.draw(begins.reshape(self.progress.runs, -1).sum(1).tolist())
        stages = torch.zeros(shape, dtype=torch.int64, device=state.device)
        return stages.masked_scatter(begins, drawn.to(state.device))

    def _observe(self, tensordict: TensorDictBase) -> None:
        """Sets the observations and goals of each row's stage."""
        state = self._get(tensordict, self.in_keys[0], self.curriculum.state_width)
        index = self._columns(self.curriculum.state_index, self._rows_stages(tensordict), state.device)
        entries = take_columns(self.curriculum.extend(state), index).split(self._widths, -1)
        for key, entry in zip(self.out_keys, entries, strict=True):
            tensordict.set(key, entry)


class StageOutcomes(Transform):
    """Counts successes by stage for :class:`~torchrl_her.curriculum.EpisodeStages`, as episodes end.

    Put it after all transforms that decide where episodes end. Episodes whose goal was proposed
    (:class:`~torchrl_her.behavior.BehaviorGoals`) do not count, since their success says little about the
    stage's own goals.

    Args:
        progress: progress that counts the outcomes.

    Keyword Args:
        reward_fn: decides which goals are achieved in the last stage, where achieving a goal need not
            terminate; see :func:`~torchrl_her.goals.is_achieved`.
        keys: keys of the reward and the flag ``done``, which are read.
        stage_key: key of the stage, which is read.
    """

    def __init__(
        self,
        progress: EpisodeStages,
        *,
        reward_fn: RewardFunction | None = None,
        keys: EnvKeys = EnvKeys(),
        stage_key: NestedKey = "stage",
    ) -> None:
        super().__init__()
        self.progress, self.stage_key = progress, stage_key
        self.reward_fn, self.keys = reward_fn, keys
        stages = progress.curriculum.stages
        self._least = torch.tensor([stage.rewards[1] for stage in stages], dtype=torch.float64)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        done, proposed = next_tensordict.get(self.keys.done), tensordict.get(PROPOSED, None)
        ended = done if proposed is None else done & ~proposed
        if bool(ended.any()):
            stage, runs = tensordict.get(self.stage_key), self.progress.runs
            stages = len(self.progress.curriculum)
            reward = next_tensordict.get(self.keys.reward)
            met = is_achieved(next_tensordict, self.reward_fn)
            below = reward >= self._least.to(reward)[stage]
            met = torch.where(stage == stages - 1, met.view_as(stage), below)
            achieved = ended & met
            place = stage.reshape(runs, -1) + stages * torch.arange(runs, device=stage.device).unsqueeze(1)
            counts = [
                place[flags.reshape(runs, -1)].bincount(minlength=stages * runs).view(runs, stages)
                for flags in (ended, achieved)
            ]
            self.progress.record_episodes(*(count.cpu() for count in counts))
        return next_tensordict


class ZeroPad(_StageTransform):
    """Builds the network's input: [the stage's n observation entries | desired goal | zeros].

    Put it where the goal is final: for acting, after :class:`~torchrl_her.StateToObs` in the environment; for
    learning, in the replay buffer, where it works on sampled transitions after they were relabeled. The input
    should not be stored: name it in ``HERWriter(exclude=("state", "input"))``. If it was stored nevertheless,
    this transform replaces it.

    As a module or in a replay buffer, it also writes the input of ``next``, if there is one.

    Args:
        curriculum: the stages.
        progress: the stage of each run; looked up in every call.

    Keyword Args:
        run: the run that all transitions belong to, in batches of any shape; None if the first
            dimension is R equal blocks, in the order of the runs.
        keys: keys of observation and desired goal, which are read.
        input_key: key of the network's input, which is written.
        stage_key: key of the stage [..., 1] of each row, if episodes have stages of their own
            (:class:`~torchrl_her.curriculum.EpisodeStages`).

    Raises:
        ValueError: ``progress`` belongs to another curriculum, or there is no such run; when used, an entry
            has another width, or the batch is not R equal blocks.
        KeyError: when used, an entry is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_her import CurriculumStage
        >>> stages = [
        ...     CurriculumStage(
        ...         name="one", observation=[0], achieved_goal=[0], desired_goal=[1], threshold=1.0
        ...     ),
        ...     CurriculumStage(
        ...         name="two", observation=[0, 1], achieved_goal=[1], desired_goal=[2], threshold=1.0
        ...     ),
        ... ]
        >>> curriculum = Curriculum(stages, 3)
        >>> pad = ZeroPad(curriculum, CurriculumProgress(curriculum))
        >>> rows = TensorDict(
        ...     {"observation": torch.tensor([[5.0, 0.0]]), "desired_goal": torch.tensor([[7.0]])}, [1]
        ... )
        >>> pad(rows)["input"].tolist()
        [[5.0, 7.0, 0.0]]
    """

    def __init__(
        self,
        curriculum: Curriculum,
        progress: CurriculumProgress,
        *,
        run: int | None = None,
        keys: EnvKeys = EnvKeys(),
        input_key: NestedKey = "input",
        stage_key: NestedKey = "stage",
    ) -> None:
        in_keys: list[NestedKey] = [keys.observation, keys.desired_goal]
        if progress.by_episode:
            in_keys.append(stage_key)
        super().__init__(curriculum, progress, run, in_keys, [input_key], stage_key)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._set_input(next_tensordict, self._rows_stages(next_tensordict))

    def _set_input(self, tensordict: TensorDictBase, stage: Tensor | None) -> TensorDictBase:
        observation = self._get(tensordict, self.in_keys[0], self.curriculum.observation_width)
        goal = self._get(tensordict, self.in_keys[1], self.curriculum.goal_width)
        return tensordict.set(self.out_keys[0], self._pad(observation, goal, stage))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._show_again(tensordict)
        return self._call(next_tensordict)

    @dispatch(source="in_keys", dest="out_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sets the input in the root and, where there is one, in ``next``."""
        stage = self._rows_stages(tensordict)  # an episode stays in its stage, so next has the same
        self._set_input(tensordict, stage)
        after = tensordict.get("next", None)
        if after is not None:
            self._set_input(after, stage)
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        widths = (self.curriculum.observation_width, self.curriculum.goal_width)
        for key, width in zip(self.in_keys, widths, strict=False):
            spec = self._seen(observation_spec, key, width)
        shape = (*spec.shape[:-1], self.curriculum.input_width)
        observation_spec[self.out_keys[0]] = Unbounded(shape=shape, dtype=spec.dtype, device=spec.device)
        return observation_spec

    def _pad(self, observation: Tensor, goal: Tensor, stage: Tensor | None) -> Tensor:
        if stage is None:
            self._check_blocks(observation.shape)
            if len(stages := self._stages()) == 1:  # slicing takes a fraction of the time of indexing
                size = len(self.curriculum.stages[stages[0]].observation)
                unused = observation.new_zeros(*observation.shape[:-1], observation.shape[-1] - size)
                return torch.cat((observation[..., :size], goal, unused), -1)
        zero = observation.new_zeros(*observation.shape[:-1], 1)
        index = self._columns(self.curriculum.input_index, stage, observation.device)
        return take_columns(torch.cat((observation, goal, zero), -1), index)
