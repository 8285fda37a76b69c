"""How well virtual goals are achieved, and what critics think of them: greedy episodes that ask for them."""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.envs import Compose, EnvBase

from torchrl_her.behavior import BehaviorGoals
from torchrl_her.replay_buffers.runs.buffer import bounds_of_run
from torchrl_her_recipes.components.assembly import eval_seeds
from torchrl_her_recipes.components.components import Components
from torchrl_her_recipes.runs.curriculum import play_greedily
from torchrl_her_recipes.runs.evaluation import measure_rollout

_TRIES = 8  # rows that are looked at for each goal, since some are real
_NAMES = ("success", "q", "q_bias")


def at_virtual_goals(components: Components, epoch: int) -> dict[str, Tensor]:
    """What greedy episodes of each run show, [R] each, if they are to ask for virtual goals.

    Returns:
        ``virtual_success``, ``virtual_q`` and ``virtual_q_bias``, which are to virtual goals what ``success``
        and so on are to the task's own; NaN for runs without virtual goals, or below the last layer.
    """
    env = components.virtual_env
    if env is None:
        return {}
    if ask_for_virtual_goals(components, env, epoch):
        shown = measure_rollout(components, play_greedily(components, env, epoch))
    else:
        shown = dict.fromkeys(_NAMES, torch.full((components.recipe.run.num_runs,), torch.nan))
    state, runs = components.curriculum, range(components.recipe.run.num_runs)
    below = torch.tensor([state is not None and not state.at_the_top(run) for run in runs])
    return {f"virtual_{name}": shown[name].masked_fill(below, torch.nan) for name in _NAMES if name in shown}


def ask_for_virtual_goals(components: Components, env: EnvBase, epoch: int) -> bool:
    """Lets the next episodes ask for virtual goals, drawn for each run from all that the buffer holds of it.

    Returns:
        Whether all runs have virtual goals.
    """
    asking = _asking(env)
    width = env.observation_spec["observation"].shape[-1]
    number, drawn = asking.memory.capacity, []
    for run, seed in enumerate(eval_seeds(components.recipe, epoch)):
        begin, end = bounds_of_run(components.buffer, run)
        if begin == end:
            return False
        generator = torch.Generator().manual_seed(seed)
        rows = components.buffer.storage[torch.randint(begin, end, (_TRIES * number,), generator=generator)]
        goals = rows.get("desired_goal")[rows.get("virtual").squeeze(-1)]
        if len(goals) == 0:
            return False
        drawn.append(goals[torch.arange(number, device=goals.device) % len(goals)].to("cpu"))
        asking.memory.clear(run)
        if (own := asking.generators[run]) is not None:
            own.manual_seed(seed)
    every = torch.cat(drawn)
    asking.memory.add(every, every.new_zeros(len(every), width))
    return True


def _asking(env: EnvBase) -> BehaviorGoals:
    """The transform of an environment that proposes goals."""
    transform = env.transform
    parts = transform if isinstance(transform, Compose) else [transform]
    return next(own for own in parts if isinstance(own, BehaviorGoals))
