"""An environment whose achieved goal is a tag: which run, environment, episode and step a state is of.

So each transition tells where it was collected and each virtual goal where it was achieved, and an audit can
compare the two. Lengths of episodes, their ends and the goals that were wanted follow from the tag alone.

In the first states of each episode the goal rests: it is the same in all episodes, like the place of a ball
that nobody has touched yet. So it does not show by itself where one episode ends and another one begins.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

LONGEST = 7  # steps of the longest episode
REST = 2  # states at the beginning of an episode in which the goal rests
# Real goals lie this far from all tags, so that a goal shows whether it is virtual. A goal is achieved closer
# than THRESHOLD, so a state can achieve the real one.
OFFSET, THRESHOLD = 0.25, 0.4
_NEVER = -5.0  # the step of a goal that is not achieved
_LENGTHS = torch.tensor([4, 6, 1, 5, 3, 7, 2])


def lengths_of(env: Tensor, episode: Tensor) -> Tensor:
    """Steps [...] of episodes [...]: from 1 to LONGEST."""
    return _LENGTHS[(3 * env + 4 * episode + episode // 7) % len(_LENGTHS)]


def terminates(env: Tensor, episode: Tensor) -> Tensor:
    """Which episodes [...] end because they achieved their goal. The others are truncated."""
    return ((env + episode) % 3 == 0) & (lengths_of(env, episode) >= REST)


def wanted(run: Tensor, env: Tensor, episode: Tensor) -> Tensor:
    """Real goals [..., 4] of episodes [...]."""
    last = torch.where(terminates(env, episode), lengths_of(env, episode).float(), _NEVER)
    return torch.stack((run.float(), env.float(), episode.float(), last + OFFSET), -1)


def achieved_in(tag: Tensor) -> Tensor:
    """The goals [..., 4] that are achieved in states with these tags [..., 4]."""
    return tag * (tag[..., 3:] >= REST)


def reward_fn(achieved: Tensor, desired: Tensor) -> tuple[Tensor, Tensor]:
    """0 and termination where a goal is achieved, else -1."""
    reached = (achieved - desired).abs().amax(-1, keepdim=True) < THRESHOLD
    return reached.float() - 1, reached


class TaggedEnv(EnvBase):
    """Counts its steps, and shows the count in its observation and as its achieved goal.

    Args:
        env: id of the environment, or of the first of a batch of them.
        num_envs: None for an environment without batch dimension.
        run: what else its goals are tagged with.
    """

    def __init__(self, env: int = 0, num_envs: int | None = None, run: int = 0, **kwargs: Any) -> None:
        super().__init__(device="cpu", batch_size=[] if num_envs is None else [num_envs], **kwargs)
        shape = self.batch_size
        self._env = env + torch.arange(shape.numel()).view(shape)
        self._run = torch.full(shape, run)
        self._episode, self._step_count = torch.full(shape, -1), torch.zeros(shape, dtype=torch.int64)
        point = Unbounded((*shape, 4))
        self.observation_spec = Composite(
            observation=point, achieved_goal=point.clone(), desired_goal=point.clone(), shape=shape
        )
        self.action_spec = Unbounded((*shape, 1))
        self.reward_spec = Unbounded((*shape, 1))
        end = Binary(shape=(*shape, 1), dtype=torch.bool)
        self.done_spec = Composite(done=end, terminated=end.clone(), truncated=end.clone(), shape=shape)

    def _state(self) -> dict[str, Tensor]:
        tag = torch.stack((self._run, self._env, self._episode, self._step_count), -1).float()
        goal = wanted(self._run, self._env, self._episode)
        return {"observation": tag, "achieved_goal": achieved_in(tag), "desired_goal": goal}

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        which = None if tensordict is None else tensordict.get("_reset", None)
        which = torch.ones_like(self._env, dtype=torch.bool) if which is None else which.view(self.batch_size)
        self._episode = self._episode + which
        self._step_count = self._step_count.where(~which, 0)
        return TensorDict(self._state(), self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._step_count = self._step_count + 1
        state = self._state()
        reward, terminated = reward_fn(state["achieved_goal"], state["desired_goal"])
        ended = (self._step_count >= lengths_of(self._env, self._episode)).unsqueeze(-1)
        truncated = ended & ~terminated
        ends = {"reward": reward, "terminated": terminated, "truncated": truncated, "done": ended}
        return TensorDict({**state, **ends}, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random."""


class _Act(torch.nn.Module):
    def forward(self, observation: Tensor) -> Tensor:
        return action_of(observation)


def action_of(tag: Tensor) -> Tensor:
    """The action [..., 1] that :func:`make_policy` takes in a state with this tag [..., 4]."""
    return (tag * torch.tensor([1000.0, 100.0, 10.0, 1.0])).sum(-1, keepdim=True)


def make_policy() -> TensorDictModule:
    """A policy whose action tells the tag of the state."""
    return TensorDictModule(_Act(), in_keys=["observation"], out_keys=["action"])
