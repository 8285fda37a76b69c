"""Evaluates success and values of critics at virtual goals, in greedy episodes that have these goals."""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import EnvBase

from torchrl_her.behavior import BehaviorGoals
from torchrl_her.replay_buffers.runs.buffer import bounds_of_run
from torchrl_her_recipes.components.assembly import eval_seeds
from torchrl_her_recipes.components.components import Components
from torchrl_her_recipes.components.curricula import CurriculumState
from torchrl_her_recipes.runs.curriculum import play_greedily
from torchrl_her_recipes.runs.evaluation import measure

_TRIES = 8  # rows that are drawn per virtual goal, several since some rows are not virtual
_NAMES = ("success", "q", "q_bias")


def at_virtual_goals(components: Components, epoch: int) -> dict[str, Tensor]:
    """Plays greedy episodes with virtual goals, and computes metrics of each run.

    Returns:
        ``virtual_success``, ``virtual_q`` and ``virtual_q_bias``, [R] each: the metrics ``success``, ``q``
        and ``q_bias`` at virtual goals; NaN for runs without virtual goals of the full task.
    """
    env = components.virtual_env
    if env is None:
        return {}
    has_goals = torch.tensor(ask_for_virtual_goals(components, env, epoch))
    played = play_greedily(components, env, epoch)
    # The environment's flag ``is_success`` refers to its own goals, so success must be computed.
    measures = measure(components, played.exclude(("next", "is_success")))
    return {
        f"virtual_{name}": measures[name].masked_fill(~has_goals, torch.nan)
        for name in _NAMES
        if name in measures
    }


def ask_for_virtual_goals(components: Components, env: EnvBase, epoch: int) -> list[bool]:
    """Draws virtual goals from the rows of each run in the buffer, and sets them for the next episodes.

    Returns:
        For each run, whether it has virtual goals of the full task. If not, its episodes have the task's own
        goals.
    """
    asking = next(part for part in env.transform.modules() if isinstance(part, BehaviorGoals))
    number, has_goals = asking.memory.capacity, []
    width, observed = (env.observation_spec[key].shape[-1] for key in ("desired_goal", "observation"))
    every = torch.zeros(components.recipe.run.num_runs, number, width)
    for run, seed in enumerate(eval_seeds(components.recipe.seeds, epoch)):
        goals = _virtual_goals(components.buffer, components.curriculum, run, number, seed)
        has_goals.append(len(goals) > 0)
        if has_goals[-1]:
            every[run] = goals[torch.arange(number) % len(goals)]
        asking.set_active(has_goals[-1], run=run)
        asking.memory.clear(run)
        if (generator := asking.generators[run]) is not None:
            generator.manual_seed(seed)
    asking.memory.add(every.flatten(0, 1), torch.zeros(every[..., 0].numel(), observed))
    return has_goals


def _virtual_goals(
    buffer: TensorDictReplayBuffer, state: CurriculumState | None, run: int, number: int, seed: int
) -> Tensor:
    """Returns up to ``number`` virtual goals [n, g] of the full task, drawn from a run's rows; or none."""
    begin, end = bounds_of_run(buffer, run)
    if begin == end or (state is not None and not state.at_the_top(run)):
        return torch.empty(0, 1)
    generator = torch.Generator().manual_seed(seed)
    rows = buffer.storage[torch.randint(begin, end, (_TRIES * number,), generator=generator)]
    fits = rows.get("virtual").squeeze(-1)
    if state is not None and state.progress.by_episode:
        fits = fits & (rows.get("stage").squeeze(-1) == len(state.curriculum) - 1)
    return rows.get("desired_goal")[fits][:number].to("cpu", torch.float32)
