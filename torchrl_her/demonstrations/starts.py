"""Episodes that start at states of demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from torchrl_her.demonstrations.dataset import Demonstrations
from torchrl_her.demonstrations.walk import WalkBack
from torchrl_her.modules.noise import generator_states, set_generator_states


class DemonstrationStarts(Transform):
    """Starts a fraction of the episodes at states of demonstrations, with the goals of the demonstrations.

    At first these episodes start a few steps before the end of a demonstration, so that the goal is near. If
    enough of them achieve their goal, starts move back, see :class:`~torchrl_her.demonstrations.WalkBack`.
    The episodes have the usual number of steps. All others start as the environment starts them.

    The environment below must have a method ``start_at(states, which)``, as this library's throwing and toy
    tasks have (:meth:`torchrl_her_envs.BatchedEnv.start_at`). Put this transform first, directly around that
    environment. If a later transform changes what ends an episode, as :class:`~torchrl_her.StateToObs`
    does, put the transform that :meth:`outcomes` returns after that one.

    The environments of R runs are R equal blocks of the batch. Each run has its own random numbers, and
    its starts move back independently. Both are part of the ``state_dict``.

    Args:
        demonstrations: demonstrations with physical states, for all runs, or a list of R, one for each run.
            Only episodes that achieve their goal are used.

    Keyword Args:
        share: fraction of the episodes that start at demonstrations.
        runs: R, the number of independent runs.
        generators: generators, one for each run, or None for torch's own.
        **walk: options of :class:`~torchrl_her.demonstrations.WalkBack`: ``width``, ``stride``,
            ``threshold`` and ``samples``.

    Attributes:
        walk: the :class:`WalkBack`, with each run's distance of starts from the end of a demonstration.

    Raises:
        ValueError: the share is outside of [0, 1], there are no states, or no demonstration achieves its
            goal; when used, the environment cannot be started at a state, or the batch is not R equal blocks.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_her_envs import make_controller, make_env
        >>> from torchrl_her.demonstrations import demonstrate
        >>> env = make_env("hand_v1", num_envs=8, seed=0)
        >>> shown = demonstrate(env, make_controller(env), max_steps=50)
        >>> starts = DemonstrationStarts(shown, share=1.0)
        >>> _ = TransformedEnv(env, starts).reset()
        >>> bool(env.worlds.free.all())  # all balls fly already
        True
    """

    def __init__(
        self,
        demonstrations: Demonstrations | Sequence[Demonstrations],
        *,
        share: float = 0.5,
        runs: int = 1,
        generators: Sequence[torch.Generator] | None = None,
        **walk: Any,
    ) -> None:
        super().__init__()
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"share must be in [0, 1], got {share}")
        single = isinstance(demonstrations, Demonstrations)
        per_run = [demonstrations] * runs if isinstance(demonstrations, Demonstrations) else demonstrations
        for name, given in (("demonstrations", per_run), ("generators", generators)):
            if given is not None and len(given) != runs:
                raise ValueError(f"runs={runs} needs as many {name}, got {len(given)}")
        first = usable(per_run[0])
        self._shown = [first if single else usable(demos) for demos in per_run]
        self.share, self.runs = share, runs
        self._generators = [None] * runs if generators is None else list(generators)
        self.walk = WalkBack([int(demos.lengths.max()) for demos in self._shown], **walk)
        self._back: Tensor | None = None  # [N], steps from an episode's start to its demonstration's end
        self._asks_elsewhere = False

    def show(self, demonstrations: Demonstrations, *, run: int = 0) -> None:
        """Gives a run other demonstrations, for example for a new stage; starts are near their ends again."""
        self._shown[run] = usable(demonstrations)
        self.walk.restart(run, int(self._shown[run].lengths.max()))

    def outcomes(self) -> Transform:
        """Returns a transform that counts how episodes end, in place of this one."""
        self._asks_elsewhere = True
        return _Outcomes(self)

    def note(self, after: TensorDictBase) -> None:
        """Counts the successes of episodes that started at a demonstration and have ended.

        Args:
            after: [N], a step's ``next``.
        """
        if self._back is None:
            return
        over = after.get("done").flatten() & (self._back > 0)
        if not bool(over.any()):
            return
        achieved = after.get("terminated").flatten()
        for run, (successes, ended) in enumerate(
            zip(achieved.chunk(self.runs), over.chunk(self.runs), strict=True)
        ):
            self.walk.record(run, successes[ended].tolist())
        self._back[over] = 0

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if not self._asks_elsewhere:
            self.note(next_tensordict)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        env = self._environment()
        count = tensordict_reset.batch_size.numel()
        if count % self.runs:
            raise ValueError(f"a batch must have a multiple of runs={self.runs} environments, got {count}")
        mask = tensordict.get("_reset", None)
        begun = torch.ones(count, dtype=torch.bool) if mask is None else mask.flatten()
        if self._back is None or len(self._back) != count:
            self._back = torch.zeros(count, dtype=torch.int64)
        self._back[begun] = 0
        which, states = self._draw(begun)
        if len(which) == 0:
            return tensordict_reset
        return tensordict_reset.update(env.start_at(states, which))

    def _draw(self, begun: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Draws which of the environments [N] start at demonstrations, and their states."""
        assert self._back is not None
        envs_per_run = len(begun) // self.runs
        chosen: list[Tensor] = []
        parts: list[dict[str, Tensor]] = []
        for run, (run_begun, generator) in enumerate(
            zip(begun.chunk(self.runs), self._generators, strict=True)
        ):
            new = run_begun.nonzero().flatten()
            if len(new) == 0:
                continue  # a run without resets draws no numbers, so runs do not depend on each other
            u = torch.rand(len(new), 3, generator=generator, dtype=torch.float64)
            started = u[:, 0] < self.share
            demonstrations, (least, most) = self._shown[run], self.walk.window(run)
            u = u[started]
            episode = (u[:, 1] * len(demonstrations)).long()
            back = least + (u[:, 2] * (most - least + 1)).long()
            lengths = demonstrations.lengths[episode]
            back = torch.minimum(back, lengths)
            rows = demonstrations.begins[episode] + lengths - back
            which = new[started] + run * envs_per_run
            self._back[which] = back
            chosen.append(which)
            parts.append({name: entry[rows] for name, entry in (demonstrations.states or {}).items()})
        if not chosen:
            return torch.empty(0, dtype=torch.int64), {}
        return torch.cat(chosen), {name: torch.cat([part[name] for part in parts]) for name in parts[0]}

    def _environment(self) -> Any:
        """Finds the environment below that can start at a given state; raises if there is none."""
        env: Any = self.container
        while env is not None and not callable(getattr(type(env), "start_at", None)):
            below = getattr(env, "base_env", None)
            if below is None:
                name = getattr(env, "task_name", type(env).__name__)
                raise ValueError(
                    f"{name} cannot be started at states of demonstrations: it has no method start_at, as "
                    "the throwing and toy tasks have"
                )
            env = below
        return env

    # State of the transform, which collectors include in their state_dict

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the state of :attr:`walk`, of the open episodes, and of the generators."""
        return {
            "walk": self.walk.state_dict(),
            "back": None if self._back is None else self._back.clone(),
            "generators": generator_states(self._generators),
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores the state that :meth:`get_extra_state` returned."""
        self.walk.load_state_dict(state["walk"])
        self._back = None if state["back"] is None else state["back"].clone()
        set_generator_states(self._generators, state["generators"])


class _Outcomes(Transform):
    """Passes the ends of episodes to :class:`DemonstrationStarts`."""

    def __init__(self, starts: DemonstrationStarts) -> None:
        super().__init__()
        self.__dict__["starts"] = starts  # not registered as a submodule: the environment already has it

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.starts.note(next_tensordict)
        return next_tensordict


def usable(demonstrations: Demonstrations) -> Demonstrations:
    """Selects the demonstrations that have physical states and achieve their goal.

    Raises:
        ValueError: there are no such demonstrations.
    """
    if not demonstrations.states:
        raise ValueError(
            f"demonstrations of {demonstrations.task} hold no physical states that episodes could start at"
        )
    good = demonstrations.achieved.nonzero().flatten()
    if len(good) == 0:
        raise ValueError(
            f"none of {len(demonstrations)} demonstrations of {demonstrations.task} achieves its goal, "
            "so no episode can start near it"
        )
    return demonstrations.select(good)
