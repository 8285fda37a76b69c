"""Guided exploration: the policy of the previous stage plays the beginning of some episodes."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from torchrl_her.curriculum.relay import Relay
from torchrl_her.curriculum.stages import Curriculum


class GuidedExploration(TensorDictModuleBase):
    """Lets the policy that has learned a stage begin some of the next stage's episodes.

    When a stage begins, its buffer has no episode that achieved its goal, and a policy that learns from
    failures alone soon forgets what it could do: a gripper no longer reaches the block that it should push.
    In a share of the episodes, a copy of the policy that had learned the previous stage acts until the goal
    of that stage is achieved. Then the present policy acts. This is the self-guided exploration of Luo et
    al., Relay Hindsight Experience Replay, 2022 (arXiv 2208.00843), here with one stage after another.

    With ``per="step"``, as in the paper, whether the copy acts is drawn in each step in which the goal of the
    previous stage is not achieved. So the copy also acts when that goal was achieved and then lost.

    If each episode has its own stage (``stage_key``), the present policy itself guides, as in the paper: it
    acts as in the first stage until the goal of that stage is achieved, then as in the next stage, up to the
    episode's own stage. With ``per="step"`` each step finds the last stage whose goal is achieved, and the
    policy acts as in the next one. So the goal of a stage must include all that the next stage requires.

    Put it after the policy and before noise. The environment must have TorchRL's ``InitTracker``. The
    environments of R runs are R equal blocks of the batch, in the order of the runs. Under
    ``set_exploration_type(ExplorationType.DETERMINISTIC)`` it does nothing.

    Args:
        policy: the policy that is trained. Its only input is the network's input.
        curriculum: the stages.

    Keyword Args:
        share: fraction of episodes, or of steps, that are guided. Episodes in the first stage do not count.
        decay: factor by which the share shrinks in each :meth:`step`. Guidance teaches what the next stage
            begins with, and then keeps the policy from its own way there, such as a run-up.
        per: whether guidance is drawn for each ``"episode"`` or for each ``"step"``.
        runs: R; the weights of R runs are stacked, along the first dimension of each parameter.
        generators: generators, one for each run, or None for torch's own.
        stage_key: key of the stage [..., 1] that each episode is played in; None if runs have stages.
        state_key, action_key, init_key: keys of the state vector, of the action, and of the flag at the
            beginning of an episode.

    Attributes:
        share: the present fraction of episodes, or of steps.
        stage: [R], the stage whose policy begins a run's episodes; -1 while there is none. Not used if
            episodes have stages of their own.
        guided: [B, 1], the stage whose policy now acts in each environment; -1 where the guide does not act.
            None before the first step.

    Raises:
        ValueError: the share is outside of [0, 1], the decay outside of (0, 1], or ``per`` is neither
            ``"episode"`` nor ``"step"``.

    Example:
        >>> from tensordict.nn import TensorDictModule, TensorDictSequential
        >>> from torchrl_her import CurriculumStage, make_actor
        >>> stages = [
        ...     CurriculumStage(name=n, observation=[0, 1], achieved_goal=[i], desired_goal=[2], threshold=1)
        ...     for i, n in enumerate(("near", "far"))
        ... ]
        >>> actor = make_actor([3], 1, in_keys=["input"])
        >>> guide = GuidedExploration(actor, Curriculum(stages, 3), share=1.0)
        >>> policy = TensorDictSequential(actor, guide)
        >>> guide.follow(actor, 0)  # the policy has learned the first stage
        >>> _ = [weight.data.zero_() for weight in actor.parameters()]  # the policy forgets
        >>> state = torch.tensor([[1.0, 0.0, 3.0], [3.0, 0.0, 3.0]])  # the second row has achieved "near"
        >>> begun = torch.ones(2, 1, dtype=torch.bool)
        >>> rows = TensorDict({"state": state, "input": state, "is_init": begun}, [2])
        >>> (policy(rows)["action"] != 0).tolist()
        [[True], [False]]
    """

    stage: Tensor
    share: Tensor

    def __init__(
        self,
        policy: TensorDictModuleBase,
        curriculum: Curriculum,
        *,
        share: float = 0.5,
        decay: float = 1.0,
        per: Literal["episode", "step"] = "episode",
        runs: int = 1,
        generators: Sequence[torch.Generator] | None = None,
        stage_key: NestedKey | None = None,
        state_key: NestedKey = "state",
        action_key: NestedKey = "action",
        init_key: NestedKey = "is_init",
    ) -> None:
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"share must be in [0, 1], got {share}")
        if not 0.0 < decay <= 1.0:
            raise ValueError(f"decay must be in (0, 1], got {decay}")
        if per not in ("episode", "step"):
            raise ValueError(f"per must be episode or step, got {per!r}")
        super().__init__()
        self.in_keys, self.out_keys = [action_key, state_key, init_key], [action_key]
        self.stage_key = stage_key
        if stage_key is None:
            self.module = deepcopy(policy).requires_grad_(False)
        else:
            self.in_keys.append(stage_key)
            self._policy = (policy,)  # in a tuple, since a submodule's weights would be registered twice
        self.relay, self.decay, self.per = Relay(curriculum), decay, per
        self.generators = [None] * runs if generators is None else list(generators)
        self.register_buffer("stage", torch.full((runs,), -1))
        self.register_buffer("share", torch.tensor(share, dtype=torch.float64))
        self.guided: Tensor | None = None

    @property
    def guide(self) -> TensorDictModuleBase:
        """The policy that begins episodes."""
        return self.module if self.stage_key is None else self._policy[0]

    def step(self) -> None:
        """Multiplies the share by ``decay``; to be called at the end of each epoch."""
        self.share.mul_(self.decay)

    @torch.no_grad()
    def follow(self, policy: TensorDictModuleBase, stage: int, *, run: int = 0) -> None:
        """Copies the current weights of a run that has learned a stage into the guiding policy.

        Args:
            policy: policy with the same networks as the one given at construction.
            stage: index of the stage.

        Keyword Args:
            run: index of the run.
        """
        runs = len(self.generators)
        learned = policy.state_dict()
        for name, tensor in self.module.state_dict().items():
            # A single run's networks may have numbers without a dimension.
            mine, new = (torch.atleast_1d(each).chunk(runs)[run] for each in (tensor, learned[name]))
            mine.copy_(new)
        self.stage[run] = stage

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the actions of the environments that are guided.

        Raises:
            KeyError: an entry is missing.
            ValueError: the batch cannot be cut into R equal blocks.
        """
        by_run = self.stage_key is None
        if exploration_type() not in (ExplorationType.RANDOM, None) or (
            by_run and max(self.stage.tolist()) < 0
        ):
            return tensordict
        action_key, state_key, init_key = self.in_keys[:3]
        state, begun = tensordict.get(state_key), tensordict.get(init_key)
        runs = len(self.generators)
        if len(state) % runs:
            raise ValueError(f"the number of rows must be a multiple of runs={runs}, got {len(state)}")
        top = None if by_run else tensordict.get(self.stage_key).view(begun.shape)
        guided = self._begin(torch.ones_like(begun) if self.per == "step" else begun, top)
        if not bool((guided >= 0).any()):
            return tensordict
        acting, after = guided >= 0, guided + 1
        if self.per == "step" and top is not None:  # an achieved goal may have been lost again
            after = self.relay.stage(state).view(after.shape)
        else:
            acting &= self.relay.achieved(state).gather(-1, guided.clamp(min=0))
        guided.copy_(torch.where(acting, -1 if top is None else torch.where(after < top, after, -1), guided))
        inputs = self.relay.inputs(state, guided.squeeze(-1).clamp(min=0))
        rows = TensorDict({self.guide.in_keys[0]: inputs}, tensordict.batch_size)
        policy_action = tensordict.get(action_key)
        acts = guided >= 0 if policy_action.ndim == guided.ndim else (guided >= 0).squeeze(-1)
        # The guide is greedy: it is called for all runs if one is guided, and must use no random numbers.
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            action = self.guide(rows).get(action_key)
        return tensordict.set(action_key, torch.where(acts, action, policy_action))

    def _begin(self, begun: Tensor, top: Tensor | None) -> Tensor:
        """Draws which of the episodes that begin are guided; episodes under way stay as they are."""
        if self.guided is None or self.guided.shape != begun.shape:
            self.guided = torch.full(begun.shape, -1, device=begun.device)
        self.guided = self.guided.to(begun.device)  # the tensor may have been loaded from a checkpoint
        runs = len(self.generators)
        tops = [None] * runs if top is None else list(top.chunk(runs))
        blocks = zip(self.guided.chunk(runs), begun.chunk(runs), tops, strict=True)
        for (guided, new, episode_stage), stage, generator in zip(
            blocks, self.stage.tolist(), self.generators, strict=True
        ):
            first = stage if episode_stage is None else 0
            if first >= 0 and bool(new.any()):  # runs without new episodes draw nothing
                drawn = torch.rand(new.shape, generator=generator, device=new.device) < self.share
                drawn = drawn if episode_stage is None else drawn & (episode_stage > 0)
                guided.copy_(torch.where(new, torch.where(drawn, first, -1), guided))
        return self.guided
