"""Exploration guided by the policy of the layer below, which plays the beginning of some episodes."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from torchrl_her.curriculum.layers import Curriculum, CurriculumLayer
from torchrl_her.curriculum.transforms import take_columns


class GuidedExploration(TensorDictModuleBase):
    """Lets the policy that has learned a layer begin some of the next layer's episodes.

    When a layer begins, nothing in its buffer was achieved yet, and a policy that learns of failure alone
    soon forgets what it could do: a gripper no longer reaches the block that it should push. In a share of
    the episodes, a copy of the policy that had learned the layer below acts until that layer's goal is
    achieved, and then the present policy. That is the self-guided exploration of Luo et al., Relay Hindsight
    Experience Replay, 2022 (arXiv 2208.00843), here with the layers one after another.

    With ``per="step"`` it is drawn anew in each step whether that copy acts, wherever that layer's goal is
    not achieved: it also goes back to what it has lost. That is how the paper does it.

    Where each episode has a layer of its own (``layer_key``), it is as in that paper: the policy itself
    acts, as it would in the first layer, until that layer's goal is achieved, then as in the next one, up to
    the episode's own layer.

    Put it behind the policy and before noise, and an InitTracker of TorchRL's into the environment. The
    environments of R runs are R equal blocks of the batch, in the order of the runs. Under
    ``set_exploration_type(ExplorationType.DETERMINISTIC)`` it does nothing.

    Args:
        policy: that learns; it reads the network's input alone. It is copied.
        curriculum: the layers.

    Keyword Args:
        share: fraction of episodes that are guided; of those above the first layer, if episodes have layers.
        per: whether guidance is drawn for each ``"episode"`` or for each ``"step"``.
        runs: R; the weights of R runs are stacked, along the first dimension of each parameter.
        generators: generators, one for each run, or None for torch's own.
        layer_key: key of the layer [..., 1] that each episode is played in; None if runs have layers.
        state_key, input_key, action_key, init_key: keys of the state vector, which is read, of what the
            policy reads and writes, and of the flag at the beginning of an episode.

    Attributes:
        layer: [R], which layer's policy begins a run's episodes; -1 as long as there is none. It does not
            matter if episodes have layers.
        guided: [B, 1], the layer as in which it acts in each environment at the moment; -1 where it does not.
            None before the first step.

    Raises:
        ValueError: the share is outside of [0, 1], or ``per`` is neither of the two.

    Example:
        >>> from tensordict.nn import TensorDictModule, TensorDictSequential
        >>> from torchrl_her import CurriculumLayer, make_actor
        >>> near, far = (
        ...     CurriculumLayer(
        ...         name=name, observation=[0, 1], achieved_goal=[place], desired_goal=[2], threshold=0.5
        ...     )
        ...     for place, name in enumerate(("near", "far"))
        ... )
        >>> actor = make_actor([3], 1, in_keys=["input"])
        >>> guide = GuidedExploration(actor, Curriculum([near, far], 3), share=1.0)
        >>> policy = TensorDictSequential(actor, guide)
        >>> guide.follow(actor, 0)  # the first layer was learned
        >>> _ = [weight.data.zero_() for weight in actor.parameters()]  # what is learned then
        >>> state = torch.tensor([[1.0, 0.0, 3.0], [3.0, 0.0, 3.0]])  # the second one is near
        >>> begun = torch.ones(2, 1, dtype=torch.bool)
        >>> rows = TensorDict({"state": state, "input": state, "is_init": begun}, [2])
        >>> (policy(rows)["action"] != 0).tolist()
        [[True], [False]]
    """

    layer: Tensor

    def __init__(
        self,
        policy: TensorDictModuleBase,
        curriculum: Curriculum,
        *,
        share: float = 0.5,
        per: Literal["episode", "step"] = "episode",
        runs: int = 1,
        generators: Sequence[torch.Generator] | None = None,
        layer_key: NestedKey | None = None,
        state_key: NestedKey = "state",
        input_key: NestedKey = "input",
        action_key: NestedKey = "action",
        init_key: NestedKey = "is_init",
    ) -> None:
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"share must be in [0, 1], got {share}")
        if per not in ("episode", "step"):
            raise ValueError(f"per must be episode or step, got {per!r}")
        super().__init__()
        self.in_keys, self.out_keys = [action_key, state_key, init_key], [action_key]
        self.layer_key, self.input_key = layer_key, input_key
        if layer_key is None:
            self.module = deepcopy(policy).requires_grad_(False)
        else:
            self.in_keys.append(layer_key)
            self._policy = (policy,)  # not a submodule: its weights are copies of the policy's earlier ones
        self.curriculum, self.share, self.per = curriculum, share, per
        self.generators = [None] * runs if generators is None else list(generators)
        self.register_buffer("layer", torch.full((runs,), -1))
        self.guided: Tensor | None = None
        # For each layer: its inputs, its achieved and its desired goal, in the state with a zero appended.
        self._columns = torch.tensor([self._columns_of(layer) for layer in curriculum.layers])
        # An episode is guided up to the layer below its own, so the last one's threshold is not needed.
        self._squares = torch.tensor([(layer.threshold or 0.0) ** 2 for layer in curriculum.layers])

    @property
    def guide(self) -> TensorDictModuleBase:
        """The policy that begins episodes."""
        return self.module if self.layer_key is None else self._policy[0]

    @torch.no_grad()
    def follow(self, policy: TensorDictModuleBase, layer: int, *, run: int = 0) -> None:
        """Copies the current weights of a run that has learned a layer into the guiding policy.

        Args:
            policy: like the one that this was made with.
            layer: index of the layer.

        Keyword Args:
            run: index of the run.
        """
        runs = len(self.generators)
        learned = policy.state_dict()
        for name, tensor in self.module.state_dict().items():
            tensor.chunk(runs)[run].copy_(learned[name].chunk(runs)[run])
        self.layer[run] = layer

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the actions of the environments that are guided.

        Raises:
            KeyError: an entry is missing.
            ValueError: the batch cannot be cut into R equal blocks.
        """
        by_run = self.layer_key is None
        if exploration_type() not in (ExplorationType.RANDOM, None) or (
            by_run and max(self.layer.tolist()) < 0
        ):
            return tensordict
        action_key, state_key, init_key = self.in_keys[:3]
        state, begun = tensordict.get(state_key), tensordict.get(init_key)
        runs = len(self.generators)
        if len(state) % runs:
            raise ValueError(f"{len(state)} rows cannot be shared out among {runs} runs")
        top = None if by_run else tensordict.get(self.layer_key).view(begun.shape)
        guided = self._begin(torch.ones_like(begun) if self.per == "step" else begun, top)
        if not bool((guided >= 0).any()):
            return tensordict
        seen, achieved, desired = self._look(state, guided)
        squares = self._squares.to(state)[guided.clamp(min=0)].view(achieved.shape[:-1])
        there = ((achieved - desired).square().sum(-1) < squares).view(guided.shape)
        after = torch.full_like(guided, -1) if top is None else torch.where(guided + 1 < top, guided + 1, -1)
        guided.copy_(torch.where(there & (guided >= 0), after, guided))
        if top is not None and bool((there & (guided >= 0)).any()):
            seen, *_ = self._look(state, guided)  # some act as in the next layer from now on
        rows = TensorDict({self.input_key: seen}, tensordict.batch_size)
        policy_action = tensordict.get(action_key)
        acts = guided >= 0 if policy_action.ndim == guided.ndim else (guided >= 0).squeeze(-1)
        # Greedy: whether it is called depends on other runs, so it must not draw numbers for this one.
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            action = self.guide(rows).get(action_key)
        return tensordict.set(action_key, torch.where(acts, action, policy_action))

    def _begin(self, begun: Tensor, top: Tensor | None) -> Tensor:
        """Draws which of the episodes that begin are guided; episodes under way stay as they are."""
        known = self.guided is not None and self.guided.dtype == torch.int64  # older states have flags here
        if self.guided is None or not known or self.guided.shape != begun.shape:
            self.guided = torch.full(begun.shape, -1, device=begun.device)
        self.guided = self.guided.to(begun.device)  # the tensor may have been loaded from a checkpoint
        runs = len(self.generators)
        tops = [None] * runs if top is None else list(top.chunk(runs))
        blocks = zip(self.guided.chunk(runs), begun.chunk(runs), tops, strict=True)
        for (guided, new, episode_layer), layer, generator in zip(
            blocks, self.layer.tolist(), self.generators, strict=True
        ):
            first = layer if episode_layer is None else 0
            if first >= 0 and bool(new.any()):  # without a start, a run draws nothing
                drawn = torch.rand(new.shape, generator=generator, device=new.device) < self.share
                drawn = drawn if episode_layer is None else drawn & (episode_layer > 0)
                guided.copy_(torch.where(new, torch.where(drawn, first, -1), guided))
        return self.guided

    def _look(self, state: Tensor, layer: Tensor) -> tuple[Tensor, ...]:
        """Returns the network's input, the achieved and the desired goal by the layer of each row."""
        index = self._columns.to(state.device)[layer.flatten().clamp(min=0)]
        entries = take_columns(self.curriculum.extend(state), index)
        goal = self.curriculum.goal_width
        return entries.split([self.curriculum.input_width, goal, goal], -1)

    def _columns_of(self, layer: CurriculumLayer) -> list[int]:
        shown = [*layer.observation, *layer.desired_goal]
        zeros = [self.curriculum.state_width] * (self.curriculum.input_width - len(shown))
        return [*shown, *zeros, *layer.achieved_goal, *layer.desired_goal]
