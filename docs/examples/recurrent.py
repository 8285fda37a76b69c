"""A policy with a memory reaches a ball that it sees in the first three steps only.

Run it with ``python docs/examples/recurrent.py``; ``--memoryless`` puts a layer without memory in the place
of the recurrent one. ``docs/recurrent.md`` explains it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Composite, LazyTensorStorage, SliceSampler, TensorDictReplayBuffer, Unbounded
from torchrl.envs import (
    Compose,
    EnvBase,
    InitTracker,
    StepCounter,
    TensorDictPrimer,
    Transform,
    TransformedEnv,
)
from torchrl.modules import MLP, AdditiveGaussianModule, GRUModule, ValueOperator, set_recurrent_mode
from torchrl.objectives import SoftUpdate

from torchrl_her import EnvReward, HERWriter, evaluate, make_ddpg_loss, success
from torchrl_her.objectives import ActorTerms
from torchrl_her_envs import make_env

SHOWN = 3  # steps of an episode in which the goal is seen
STEPS = 20  # of an episode, at most; on its straight way the hand takes 18 to the ball that is farthest away
WIDTH = 64  # of the layers


class ShowGoal(Transform):
    """Writes ``seen``: the goal while it is shown and zeros from then on, and whether it is shown.

    It works in the environment, for acting, and on sampled batches, for learning. So a virtual goal, which
    is known only then, is hidden in the same steps as a real one.
    """

    def _call(self, step: TensorDictBase) -> TensorDictBase:
        shown = (step["step_count"] < SHOWN).to(step["desired_goal"].dtype)
        return step.set("seen", torch.cat((shown * step["desired_goal"], shown), -1))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def forward(self, batch: TensorDictBase) -> TensorDictBase:
        """The same for a sampled batch, in which each step has the following one under ``next``."""
        self._call(batch["next"])
        return self._call(batch)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        *batch, width = observation_spec["desired_goal"].shape
        observation_spec["seen"] = Unbounded((*batch, width + 1))
        return observation_spec


def make_task(num_envs: int, *, seed: int) -> TransformedEnv:
    """``hand_reach`` with a time limit, what is seen of the goal, and an empty memory at the start."""
    task = make_env("hand_reach", num_envs=num_envs, seed=seed)
    memory = TensorDictPrimer(memory=Unbounded((1, WIDTH)), expand_specs=True)
    return TransformedEnv(task, Compose(InitTracker(), StepCounter(STEPS), ShowGoal(), memory))


def make_networks(env: EnvBase, *, recurrent: bool) -> tuple[TensorDictSequential, ValueOperator]:
    """The actor, which has a GRU or a layer without memory, and a critic that is always shown the goal."""
    first = MLP(out_features=WIDTH, num_cells=[WIDTH], activation_class=nn.ReLU, activate_last_layer=True)
    if recurrent:
        keys = {"in_keys": ["features", "memory", "is_init"], "out_keys": ["recalled", ("next", "memory")]}
        middle = GRUModule(input_size=WIDTH, hidden_size=WIDTH, **keys)
        middle.gru.bias_hh_l0.data[WIDTH : 2 * WIDTH] += 1.0  # at first it keeps most of what it remembers
    else:
        layer = nn.Sequential(nn.Linear(WIDTH, WIDTH), nn.ReLU())
        middle = TensorDictModule(layer, in_keys=["features"], out_keys=["recalled"])
    tanh = {"activation_class": nn.Tanh, "activate_last_layer": True}
    last = MLP(in_features=2 * WIDTH, out_features=3, num_cells=[], **tanh)
    nn.init.uniform_(last[0].weight, -3e-3, 3e-3)  # keeps early actions off the ends of tanh
    actor = TensorDictSequential(
        TensorDictModule(first, in_keys=["observation", "seen"], out_keys=["features"]),
        middle,
        TensorDictModule(last, in_keys=["features", "recalled"], out_keys=["action"]),
    )
    net = MLP(out_features=1, num_cells=[WIDTH, WIDTH, WIDTH], activation_class=nn.ReLU)
    critic = ValueOperator(net, in_keys=["observation", "desired_goal", "action"])
    with torch.no_grad():
        critic(actor(env.reset()))  # initializes the lazy layers
    return actor, critic


def make_buffer(env: EnvBase) -> TensorDictReplayBuffer:
    """Stores whole episodes, real and virtual; samples 32 of them, each from its first step."""
    sampler = SliceSampler(
        slice_len=STEPS, traj_key=("collector", "traj_ids"), strict_length=False, cache_values=True
    )
    writer = HERWriter(
        EnvReward.of(env),
        per="episode",
        k=4,
        filter_achieved=True,
        exclude=("state", "seen", "memory", "features", "recalled"),  # they belong to the real goal
    )
    storage = LazyTensorStorage(500_000)
    buffer = TensorDictReplayBuffer(storage=storage, sampler=sampler, writer=writer, batch_size=32 * STEPS)
    buffer.append_transform(ShowGoal())
    return buffer


def remember_first_steps(batch: TensorDictBase, actor: TensorDictSequential) -> None:
    """Lets the steps that follow be a sequence, too: it begins with what is remembered of the first step.

    The loss runs the actor along the episodes' steps, and along the next ones for the targets. The memory
    that was collected is of no use there: it belongs to older weights and, in a virtual episode, to another
    goal.
    """
    first = batch["is_init"].squeeze(-1)
    with torch.no_grad(), set_recurrent_mode(False):
        memory = actor(batch[first])["next", "memory"]
    batch["next", "is_init"] = batch["is_init"]
    batch["next", "memory"] = memory.new_zeros(len(batch), 1, WIDTH)
    batch["next", "memory"][first] = memory


def train(
    *, recurrent: bool, seed: int, frames: int = 96_000, every: int = 6_400
) -> Iterator[dict[str, float]]:
    """Trains, and yields what 100 greedy episodes show after every so many frames."""
    torch.manual_seed(seed)
    env, test_env = make_task(64, seed=seed), make_task(100, seed=1_000_000 + seed)
    actor, critic = make_networks(env, recurrent=recurrent)
    buffer = make_buffer(env)
    noise = AdditiveGaussianModule(env.action_spec, sigma_init=0.3, annealing_num_steps=frames)
    policy = TensorDictSequential(actor, noise)
    loss = make_ddpg_loss(actor, critic, terms=ActorTerms(action_penalty=0.3))
    target = SoftUpdate(loss, tau=0.02)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    collector = Collector(env, policy, frames_per_batch=64 * 10, total_frames=frames)
    seen = 0
    for batch in collector:
        buffer.extend(batch)
        noise.step(batch.numel())
        for _ in range(16 if len(buffer) > 0 else 0):
            episodes = buffer.sample()
            if recurrent:
                remember_first_steps(episodes, actor)
            with set_recurrent_mode(True):  # along whole episodes, not step by step
                losses = loss(episodes)
            (losses["loss_value"] + losses["loss_actor"]).backward()
            optimizer.step()
            optimizer.zero_grad()
            target.step()
        seen += batch.numel()
        if seen % every == 0:
            played = evaluate(test_env, actor, max_steps=STEPS)
            steps = played["next", "done"].int().argmax(1) + 1.0
            yield {
                "epoch": seen // every,
                "frames": seen,
                "success": success(played).float().mean().item(),
                "steps": steps.mean().item(),
            }


if __name__ == "__main__":
    torch.set_num_threads(1)
    for row in train(recurrent="--memoryless" not in sys.argv, seed=0):
        print("{frames:6} frames: success {success:.2f}, steps {steps:4.1f}".format(**row), flush=True)
