"""Every part on another device: nothing is in the wrong place, and the numbers are those of the CPU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import DeviceCastTransform

from torchrl_her import (
    Curriculum,
    CurriculumProgress,
    CurriculumStage,
    DecayingEpsilon,
    GoalGrid,
    GoalReward,
    GoalWeights,
    GuidedExploration,
    HERSampleUnit,
    HERWriter,
    Instructiveness,
    LossLearner,
    Trainer,
    ZeroPad,
    box_target,
    make_actor,
    make_critic,
    make_ddpg_loss,
    make_target_updater,
    success,
)
from torchrl_her.goals import (
    KernelInstructiveness,
    NetworkNovelty,
    RareGoals,
    log_kernel_density,
    log_neighbor_density,
    sampled_target,
)
from torchrl_her.goals.grid import kl_divergence
from torchrl_her.modules import (
    DecayingEpsilonGreedy,
    NetworkShape,
    NormalizeBatch,
    NormalizedPolicy,
    PolicyAverage,
    RunningNorm,
)
from torchrl_her.replay_buffers import PackedStorage, RunsPrioritizedSampler, RunsSampler, empty_run
from torchrl_her.trainers import buffer_state_dict, load_buffer_state_dict
from torchrl_her.trainers.metrics import discounted_return, final_distance

from .ddpg_data import batch as random_rows
from .her_data import make_batch

CPU = torch.device("cpu")
Generators = Callable[[int], torch.Generator]


def check(value: Any, device: torch.device) -> None:
    """All tensors of a tensordict, or one tensor, are on the device."""
    if isinstance(value, TensorDictBase):
        assert {entry.device for entry in value.values(True, True)} == {device}
    else:
        assert value.device == device


def collected(*lengths: list[int]) -> TensorDict:
    return make_batch(list(lengths) or [[5, 6], [4, 7]])


def instructive() -> Instructiveness:
    grid = GoalGrid((0.0, -1.0), (3000.0, 1.0), (4, 4), warn=False)
    return Instructiveness(grid, lambda sigma: box_target(grid, (0.0, -1.0), (3000.0, 1.0), sigma), sigma=9.0)


WEIGHTS: dict[str, Callable[[], GoalWeights]] = {
    "IBS": instructive,
    "kernel IBS": lambda: KernelInstructiveness(
        torch.tensor([[0.0, 0.0], [9.0, 0.0]]), sigma=9.0, samples=20
    ),
    "rare": lambda: RareGoals(memory=40, samples=20),
    "rare by neighbors": lambda: RareGoals(estimator="neighbors", k=2, memory=40, samples=20),
    "novel": lambda: NetworkNovelty(hidden=8, features=4),
}

WAYS: dict[str, dict[str, Any]] = {
    "HER": {"k": 3},
    "filter": {"k": 3, "filter_achieved": True},
    "sources": {"goal_sources": {"future": 2, "actual": 1, "achieved": 1}},
    "n steps": {"k": 3, "n_steps": 3, "gamma": 0.9},
}


@pytest.mark.parametrize("rows_at", ["cpu", "device"])
@pytest.mark.parametrize("storage_at", ["cpu", "device"])
@pytest.mark.parametrize("way", [*WAYS, "whole episodes", *WEIGHTS])
def test_the_writer_works_where_the_rows_are(
    way: str, rows_at: str, storage_at: str, device: torch.device, make_generator: Generators
) -> None:
    rows = collected().to(device if rows_at == "device" else CPU)
    place = device if storage_at == "device" else CPU
    options = {**WAYS, "whole episodes": {"k": 3, "per": "episode"}}.get(way, {"k": 3})
    generator = make_generator(0) if rows_at == "device" else torch.Generator()
    writer = HERWriter(
        GoalReward(0.1),
        generators=[generator],
        weights=WEIGHTS[way]() if way in WEIGHTS else None,
        **options,
    )
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(300, device=place), writer=writer, batch_size=8)
    buffer.extend(rows)
    check(buffer.storage[:], place)
    check(buffer.sample(), place)
    virtual = buffer.storage[:]["virtual"].squeeze(-1)
    assert len(buffer) - int(virtual.sum()) == rows.numel()
    assert int(virtual.sum()) == writer.totals.virtual > 0


@pytest.mark.parametrize("way", [*WAYS, *WEIGHTS])
@pytest.mark.parametrize("storage_at", ["cpu", "device"])
def test_the_sample_unit_works_where_the_storage_is(
    way: str, storage_at: str, device: torch.device, make_generator: Generators
) -> None:
    place = device if storage_at == "device" else CPU
    unit = HERSampleUnit(
        GoalReward(0.1),
        generator=make_generator(0) if storage_at == "device" else torch.Generator(),
        weights=WEIGHTS[way]() if way in WEIGHTS else None,
        **WAYS.get(way, {"k": 3}),
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(300, device=place),
        batch_size=64,
        sample_unit=unit,
        transform=unit.relabel,
    )
    rows = collected()
    buffer.extend(rows.reshape(-1).exclude("state"))
    sampled = buffer.sample()
    check(sampled, place)
    assert (sampled["desired_goal"][:, 0] != -7.0).any()


@pytest.mark.parametrize("prioritized", [False, True])
@pytest.mark.parametrize("rows_at", ["cpu", "device"])
def test_buffers_of_several_runs(
    prioritized: bool, rows_at: str, device: torch.device, make_generator: Generators
) -> None:
    here = [make_generator(run) for run in range(2)]
    sources = here if rows_at == "device" else [torch.Generator(), torch.Generator()]
    sampler = (
        RunsPrioritizedSampler(200, alpha=0.6, beta=0.4, runs=2, generators=here, device=device)
        if prioritized
        else RunsSampler(200, runs=2, generators=here, device=device)
    )
    writer = HERWriter(
        GoalReward(0.1),
        k=3,
        filter_achieved=True,
        runs=2,
        generators=sources,
        weights=[instructive(), instructive()],
    )
    buffer = TensorDictReplayBuffer(
        storage=PackedStorage(400, device=device),
        sampler=sampler,
        writer=writer,
        batch_size=16,
        priority_key="td_error",
    )
    rows = collected([5, 6], [4, 7], [5, 5], [6, 6])
    buffer.extend(rows.to(device) if rows_at == "device" else rows)
    sampled = buffer.sample()
    check(sampled, device)
    if prioritized:
        sampled["td_error"] = torch.rand(16, device=device)
        buffer.update_tensordict_priority(sampled)
        check(buffer.sample(), device)
    assert buffer.storage.packed is not None
    state = buffer_state_dict(buffer)
    before = buffer.storage[:].clone()
    for run in range(2):
        empty_run(buffer, run)
    load_buffer_state_dict(buffer, state)
    assert bool((buffer.storage[:] == before).all())
    check(buffer.sample(), device)


def test_targets_of_goals(device: torch.device) -> None:
    grid = GoalGrid((0.0,), (1.0,), (4,), warn=False)
    goals = torch.rand(50, 1)
    cells = grid.cell(goals.to(device))
    check(cells, device)
    assert cells.tolist() == grid.cell(goals).tolist()
    target = sampled_target(grid, goals.to(device), 0.1)
    torch.testing.assert_close(target.cpu(), sampled_target(grid, goals, 0.1))
    q = torch.full((4,), 0.25, device=device)
    assert float(kl_divergence(q, target.to(device))) > 0


def test_densities_of_goals(device: torch.device) -> None:
    points, samples = torch.rand(5, 3, 4), torch.rand(20, 4)
    here, there = (points, samples), (points.to(device), samples.to(device))
    for found, expected in (
        (log_kernel_density(*there, torch.full((4,), 0.2)), log_kernel_density(*here, 0.2)),
        (log_neighbor_density(*there, 3), log_neighbor_density(*here, 3)),
    ):
        check(found, device)
        torch.testing.assert_close(found.cpu(), expected)


@pytest.mark.parametrize("name", WEIGHTS)
def test_weights_follow_the_goals(name: str, device: torch.device) -> None:
    weights, goals = WEIGHTS[name](), torch.rand(30, 2) * torch.tensor([3000.0, 1.0])
    elsewhere = WEIGHTS[name]()
    for _ in range(2):
        weights.update(goals.to(device))
        elsewhere.update(goals)
    weight = weights(goals.to(device))
    check(weight, device)
    close = {"atol": 1e-4, "rtol": 1e-3}
    torch.testing.assert_close(weight.cpu(), elsewhere(goals), **close)
    if isinstance(weights, KernelInstructiveness):
        assert weights.divergence > 0
    again = WEIGHTS[name]()
    again.load_state_dict(weights.state_dict())
    torch.testing.assert_close(again(goals.to(device)), weight)
    for own in (weights, again, elsewhere):  # they go on at another place, too
        own.update(goals)
        check(own(goals), CPU)
    torch.testing.assert_close(weights(goals), elsewhere(goals), **close)
    torch.testing.assert_close(again(goals), elsewhere(goals), **close)


REACH = CurriculumStage(name="reach", observation=[0], achieved_goal=[0], desired_goal=[1], threshold=0.5)
MOVE = CurriculumStage(name="move", observation=[0, 1], achieved_goal=[1], desired_goal=[2], threshold=0.5)


def test_stages_of_several_runs(device: torch.device, make_generator: Generators) -> None:
    curriculum = Curriculum([REACH, MOVE], 3)
    progress = CurriculumProgress(curriculum, runs=2)
    rows = TensorDict({"observation": torch.rand(4, 2), "desired_goal": torch.rand(4, 1)}, [4])
    for stage in range(2):  # of the second run: the same as the first one's, and another
        progress.set_stage(1, stage)
        pad = ZeroPad(curriculum, progress)
        seen = pad(rows.to(device))["input"]
        check(seen, device)
        assert seen.tolist() == pad(rows.clone())["input"].tolist()
    actor = make_actor([3], 1, in_keys=["input"], runs=2).to(device)
    guide = GuidedExploration(
        actor, curriculum, runs=2, share=1.0, generators=[make_generator(0), make_generator(1)]
    ).to(device)
    guide.follow(actor, 0, run=1)
    shown = TensorDict(
        {
            "state": torch.tensor([[0.0, 9.0, 0.0]] * 4),
            "is_init": torch.ones(4, 1, dtype=torch.bool),
            "action": torch.full((4, 1), 5.0),
        },
        [4],
    )
    action = guide(shown.to(device))["action"]
    check(action, device)
    assert (action == 5.0).flatten().tolist() == [True, True, False, False]


def test_exploration(device: torch.device, make_generator: Generators) -> None:
    generators = [make_generator(0), make_generator(1)]
    ends = torch.ones(3, device=device)
    exploring = DecayingEpsilon(-ends, ends, generators=generators).to(device)
    rows = TensorDict({"action": torch.zeros(4, 3)}, [4]).to(device)
    check(exploring(rows.clone())["action"], device)
    exploring.step()
    exploring.restart(0.5, run=1)
    choosing = DecayingEpsilonGreedy(3, generators=generators).to(device)
    check(choosing(TensorDict({"action": torch.tensor([1, 2])}, [2]).to(device))["action"], device)


def test_normalization_and_averages(device: torch.device) -> None:
    rows = random_rows()
    widths = {"observation": 4, "desired_goal": 2}
    elsewhere = RunningNorm(widths)
    norm = RunningNorm(widths).to(device)
    policy = NormalizedPolicy(make_actor((4, 2), 3).to(device), norm)
    average = PolicyAverage(policy)
    for each, own in ((norm, rows.to(device)), (elsewhere, rows), (norm, rows), (elsewhere, rows)):
        each.update(own)  # from the CPU, too, where environments are
    normal = NormalizeBatch(norm)(rows.to(device))
    check(normal, device)
    torch.testing.assert_close(
        normal["observation"].cpu(), NormalizeBatch(elsewhere)(rows.clone())["observation"]
    )
    average.follow(3)
    check(average.module(rows.to(device))["action"], device)
    for parameter in [*average.module.parameters(), *average.module.buffers()]:
        check(parameter, device)


def networks() -> tuple[TensorDictModuleBase, TensorDictModuleBase]:
    shape = NetworkShape(norm="layer")
    return make_actor((4, 2), 3, shape=shape), make_critic((4, 2), 3, shape=shape)


def test_steps_on_a_device_are_those_of_the_cpu(device: torch.device) -> None:
    actor, critic = networks()
    rows = random_rows(64)
    found = []
    for place in (CPU, device):
        own = networks()
        for network, weights in zip(own, (actor, critic), strict=True):
            network.load_state_dict(weights.state_dict())
        loss = make_ddpg_loss(*(network.to(place) for network in own))
        learner = LossLearner(
            loss, torch.optim.Adam(loss.parameters()), make_target_updater(loss, tau=0.1, hard_interval=0)
        )
        learner.update(rows.to(place), 2)
        found.append(nn.utils.parameters_to_vector([p.detach().cpu() for p in loss.parameters()]))
    torch.testing.assert_close(found[0], found[1], atol=1e-5, rtol=1e-4)


class Played:
    """A collector that gives batches which were played before."""

    def __init__(self, batches: list[TensorDict]) -> None:
        self.batches = iter(batches)

    def next(self) -> TensorDict:
        return next(self.batches)

    def reset(self) -> None:
        """Nothing goes on."""


def played(device: torch.device) -> TensorDict:
    """Transitions [8, 10] of two runs, in a batch that does not say where it is."""
    rows = collected(*[[5, 5]] * 8)
    for part in (rows, rows["next"]):
        part["observation"] = torch.rand(8, 10, 4)
    rows["action"] = torch.rand(8, 10, 3)
    return rows.to(device).clear_device_()


@pytest.mark.parametrize("rows_at", ["cpu", "device"])
@pytest.mark.parametrize("storage_at", ["cpu", "device"])
def test_the_loop(rows_at: str, storage_at: str, device: torch.device, make_generator: Generators) -> None:
    place = device if storage_at == "device" else CPU
    at = {"cpu": [torch.Generator(), torch.Generator()], "device": [make_generator(0), make_generator(1)]}
    # A cast to the learner's device casts what is written to the storage's.
    writes_at = "cpu" if storage_at == "cpu" else rows_at
    writer = HERWriter(GoalReward(0.1), k=2, runs=2, generators=at[writes_at], exclude=("state",))
    sampler = RunsPrioritizedSampler(
        400, alpha=0.6, beta=0.4, runs=2, generators=at[storage_at], device=place
    )
    buffer = TensorDictReplayBuffer(
        storage=PackedStorage(800, device=place), sampler=sampler, writer=writer, priority_key="td_error"
    )
    if storage_at == "cpu":
        buffer.append_transform(DeviceCastTransform(device))
    actor, critic = make_actor((4, 2), 3, runs=2).to(device), make_critic((4, 2), 3, runs=2).to(device)
    loss = make_ddpg_loss(actor, critic, reduction="none")
    trainer = Trainer(
        collector=Played([played(device if rows_at == "device" else CPU) for _ in range(2)]),  # type: ignore[arg-type]
        buffer=buffer,
        learner=LossLearner(
            loss,
            torch.optim.Adam(loss.parameters()),
            make_target_updater(loss, tau=0.1, hard_interval=0),
            runs=2,
        ),
        runs=2,
        epoch_frames=80,
        frames_per_update=20.0,
        batch_size=16,
        average=PolicyAverage(actor, runs=2),
    )
    measured = trainer.epoch()
    assert trainer.updates == 4
    for value in measured.values():
        check(value, device)
        assert bool(value.isfinite().all())
    for parameter in loss.parameters():
        check(parameter, device)


def test_metrics(device: torch.device) -> None:
    rollout = collected([6], [6]).to(device)
    rollout["next", "reward"] = rollout["next", "reward"].float()
    for value in (
        success(rollout),
        discounted_return(rollout, 0.9, tail_reward=-1.0),
        final_distance(rollout),
    ):
        check(value, device)
