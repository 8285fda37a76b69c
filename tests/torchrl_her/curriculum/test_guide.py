"""Guided exploration: whose policy acts, where, and until when."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_her import (
    Curriculum,
    CurriculumProgress,
    CurriculumStage,
    GuidedExploration,
    StateToObs,
    ZeroPad,
    make_actor,
)
from torchrl_her_envs import make_env

# The state is [own place, block, wanted place]; the first stage wants the block to be reached.
REACH = CurriculumStage(name="reach", observation=[0], achieved_goal=[0], desired_goal=[1], threshold=0.5)
MOVE = CurriculumStage(name="move", observation=[0, 1], achieved_goal=[1], desired_goal=[2], threshold=0.5)
CURRICULUM = Curriculum([REACH, MOVE], 3)


class Scaled(nn.Module):
    """Acts by what it sees first and last of its input, times a weight of each run."""

    def __init__(self, *weights: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor(weights))

    def forward(self, seen: Tensor) -> Tensor:
        weight = self.weight.repeat_interleave(len(seen) // len(self.weight))
        return weight.unsqueeze(-1) * (seen[:, :1] + 10.0 * seen[:, 1:2] + 100.0 * seen[:, 2:])


def policy(*weights: float) -> TensorDictModule:
    return TensorDictModule(Scaled(*weights), in_keys=["input"], out_keys=["action"])


def rows(state: list[list[float]], *, begun: bool | list[bool] = True) -> TensorDict:
    flags = torch.tensor(begun).expand(len(state)).unsqueeze(-1)
    return TensorDict(
        {
            "state": torch.tensor(state),
            "is_init": flags,
            "action": torch.full((len(state), 1), -1.0),
        },
        [len(state)],
    )


def acts(guide: GuidedExploration, *args: object, **options: object) -> list[float]:
    return guide(rows(*args, **options))["action"].flatten().tolist()  # type: ignore[arg-type]


@pytest.fixture
def guide() -> GuidedExploration:
    made = GuidedExploration(policy(1.0), CURRICULUM, share=1.0)
    made.follow(policy(2.0), 0)
    return made


def test_it_sees_what_the_stage_below_sees(guide: GuidedExploration) -> None:
    # [own place, block, 0], times the weight that was learned
    assert acts(guide, [[3.0, 5.0, 7.0]]) == [2.0 * (3.0 + 50.0)]


def test_it_acts_until_the_goal_below_is_achieved_and_not_again(guide: GuidedExploration) -> None:
    assert acts(guide, [[3.0, 5.0, 7.0], [0.0, 0.5, 0.0]]) == [106.0, 10.0]  # at 0.5 it is not achieved
    assert acts(guide, [[4.6, 5.0, 7.0], [0.0, 1.0, 0.0]], begun=False) == [-1.0, 20.0]
    assert acts(guide, [[0.0, 5.0, 7.0], [0.0, 1.0, 0.0]], begun=False) == [-1.0, 20.0]
    assert acts(guide, [[0.0, 5.0, 7.0], [0.0, 1.0, 0.0]], begun=[True, False]) == [100.0, 20.0]


def test_by_the_step_it_acts_wherever_the_goal_below_is_not_achieved() -> None:
    guide = GuidedExploration(policy(1.0), CURRICULUM, share=1.0, per="step")
    guide.follow(policy(2.0), 0)
    assert acts(guide, [[3.0, 5.0, 7.0], [0.0, 0.4, 0.0]], begun=False) == [106.0, -1.0]
    assert acts(guide, [[4.6, 5.0, 7.0], [0.0, 1.0, 0.0]], begun=False) == [-1.0, 20.0]
    guide.share.fill_(0.5)
    acted = torch.tensor([acts(guide, [[3.0, 5.0, 7.0]] * 40, begun=False) for _ in range(10)]) > 0
    assert 0.4 < acted.double().mean() < 0.6
    assert not acted.all(0).any()  # in no environment always


def test_its_share_shrinks_with_each_epoch() -> None:
    guide = GuidedExploration(policy(1.0), CURRICULUM, share=0.8, decay=0.5, per="step")
    guide.follow(policy(2.0), 0)
    guide.step()
    guide.step()
    acted = torch.tensor(acts(guide, [[3.0, 5.0, 7.0]] * 1000)) > 0
    assert float(guide.share) == 0.2
    assert 0.15 < acted.double().mean() < 0.25


def test_without_a_stage_below_it_does_nothing() -> None:
    guide = GuidedExploration(policy(1.0), CURRICULUM, share=1.0)
    assert acts(guide, [[3.0, 5.0, 7.0]]) == [-1.0]
    assert guide.guided is None


def test_greedy_episodes_are_not_guided(guide: GuidedExploration) -> None:
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert acts(guide, [[3.0, 5.0, 7.0]]) == [-1.0]


def test_it_follows_a_copy(guide: GuidedExploration) -> None:
    learning = policy(4.0)
    guide.follow(learning, 0)
    learning.module.weight.data.zero_()
    assert acts(guide, [[3.0, 5.0, 7.0]]) == [4.0 * 53.0]
    assert not any(weight.requires_grad for weight in guide.parameters())


def test_a_weight_may_have_no_dimension() -> None:
    learning = policy(1.0)
    learning.module.scale = nn.Parameter(torch.tensor(2.0))
    guide = GuidedExploration(learning, CURRICULUM)
    learning.module.scale.data.fill_(5.0)
    guide.follow(learning, 0)
    assert guide.module.state_dict()["module.scale"].item() == 5.0


def test_runs_are_guided_by_what_they_have_learned_themselves() -> None:
    guide = GuidedExploration(policy(1.0, 1.0, 1.0), CURRICULUM, share=1.0, runs=3)
    guide.follow(policy(5.0, 6.0, 7.0), 0, run=2)
    assert acts(guide, [[3.0, 5.0, 7.0]] * 6) == [-1.0] * 4 + [7.0 * 53.0] * 2
    guide.follow(policy(5.0, 6.0, 7.0), 0, run=0)
    assert acts(guide, [[3.0, 5.0, 7.0]] * 6) == [5.0 * 53.0] * 2 + [-1.0] * 2 + [7.0 * 53.0] * 2
    with pytest.raises(ValueError, match="number of rows must be a multiple of runs=3, got 4"):
        acts(guide, [[3.0, 5.0, 7.0]] * 4)


def test_runs_beside_others_draw_as_they_would_alone() -> None:
    def drawn(seeds: list[int]) -> Tensor:
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        guide = GuidedExploration(
            policy(*[1.0] * len(seeds)), CURRICULUM, runs=len(seeds), generators=generators
        )
        for run in range(len(seeds)):
            guide.follow(policy(*[1.0] * len(seeds)), 0, run=run)
        states = [[3.0, 5.0, 7.0]] * (20 * len(seeds))
        return torch.tensor([acts(guide, states) for _ in range(3)]).view(3, len(seeds), 20)

    both = drawn([1, 2])
    assert torch.equal(both[:, 1], drawn([2])[:, 0])
    assert not torch.equal(both[:, 0], both[:, 1])
    assert 0.3 < (both > 0).double().mean() < 0.7


def test_a_run_without_a_stage_below_draws_nothing() -> None:
    generators = [torch.Generator().manual_seed(seed) for seed in range(2)]
    before = [generator.get_state() for generator in generators]
    guide = GuidedExploration(policy(1.0, 1.0), CURRICULUM, runs=2, generators=generators)
    guide.follow(policy(1.0, 1.0), 0, run=1)
    acts(guide, [[3.0, 5.0, 7.0]] * 8)
    assert torch.equal(generators[0].get_state(), before[0])
    assert not torch.equal(generators[1].get_state(), before[1])


# Where episodes have stages of their own, the policy itself acts, as in one stage after the other.
HOLD = CurriculumStage(name="hold", observation=[0, 1], achieved_goal=[0], desired_goal=[2], threshold=0.5)
THREE = Curriculum([REACH, MOVE, HOLD], 3)


def in_stages(
    guide: GuidedExploration, stages: list[int], state: list[list[float]], **options: object
) -> list[float]:
    seen = rows(state, **options)  # type: ignore[arg-type]
    seen["stage"] = torch.tensor(stages).unsqueeze(-1)
    return guide(seen)["action"].flatten().tolist()


def test_episodes_above_the_first_stage_are_begun_as_in_it() -> None:
    own = policy(2.0)
    guide = GuidedExploration(own, CURRICULUM, share=1.0, stage_key="stage")
    assert in_stages(guide, [1, 0], [[3.0, 5.0, 7.0]] * 2) == [2.0 * 53.0, -1.0]
    own.module.weight.data.fill_(3.0)  # it has learned meanwhile
    assert in_stages(guide, [1, 0], [[3.0, 5.0, 7.0]] * 2, begun=False) == [3.0 * 53.0, -1.0]
    assert in_stages(guide, [1, 0], [[5.0, 5.0, 7.0]] * 2, begun=False) == [-1.0, -1.0]  # reached
    assert in_stages(guide, [1, 0], [[3.0, 5.0, 7.0]] * 2, begun=False) == [-1.0, -1.0]
    assert list(guide.parameters()) == []


def test_stage_after_stage_up_to_the_episodes_own() -> None:
    guide = GuidedExploration(policy(1.0), THREE, share=1.0, stage_key="stage")
    assert in_stages(guide, [2, 1], [[3.0, 5.0, 7.0]] * 2) == [53.0, 53.0]  # sees [own place, block, 0]
    # Both have reached the block: one goes on as in the second stage, which sees the wanted place, too.
    assert in_stages(guide, [2, 1], [[5.0, 5.0, 7.0]] * 2, begun=False) == [5.0 + 50.0 + 700.0, -1.0]
    assert in_stages(guide, [2, 1], [[5.0, 7.0, 7.0]] * 2, begun=False) == [-1.0, -1.0]
    assert guide.guided is not None
    assert guide.guided.flatten().tolist() == [-1, -1]


def test_by_the_step_the_last_achieved_goal_says_which_stage_acts() -> None:
    guide = GuidedExploration(policy(1.0), THREE, share=1.0, per="step", stage_key="stage")
    reach, move = 5.0 + 70.0, 5.0 + 70.0 + 900.0  # see [own place, block, 0] and [own place, block, place]
    away, at_block, moved = [5.0, 7.0, 9.0], [7.0, 7.0, 9.0], [5.0, 9.0, 9.0]
    states, stages = [away, at_block, moved, away, at_block], [2, 2, 2, 1, 1]
    assert in_stages(guide, stages, states, begun=False) == [reach, move + 2.0, -1.0, reach, -1.0]
    assert in_stages(guide, [2], [away], begun=False) == [reach]  # the block was lost again


def test_a_share_of_the_episodes_above_is_begun() -> None:
    guide = GuidedExploration(
        policy(1.0),
        CURRICULUM,
        share=0.3,
        stage_key="stage",
        generators=[torch.Generator().manual_seed(0)],
    )
    begun = in_stages(guide, [1] * 1000 + [0] * 10, [[3.0, 5.0, 7.0]] * 1010)
    assert begun[:1000].count(53.0) == pytest.approx(300, abs=50)
    assert begun[1000:] == [-1.0] * 10


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_impossible_shares_are_refused(share: float) -> None:
    with pytest.raises(ValueError, match=r"share must be in \[0, 1\], got"):
        GuidedExploration(policy(1.0), CURRICULUM, share=share)


@pytest.mark.parametrize("decay", [0.0, 1.1])
def test_impossible_decays_are_refused(decay: float) -> None:
    with pytest.raises(ValueError, match=rf"decay must be in \(0, 1\], got {decay}"):
        GuidedExploration(policy(1.0), CURRICULUM, decay=decay)


@pytest.fixture
def collected() -> Iterator[TensorDict]:
    env = make_env("hand_v1", num_envs=6, seed=1)
    curriculum = Curriculum([CurriculumStage(**stage) for stage in env.stages()], 11)
    progress = CurriculumProgress(curriculum)
    progress.set_stage(0, 1)
    shown = TransformedEnv(
        env, Compose(StateToObs(curriculum, progress), ZeroPad(curriculum, progress), InitTracker())
    )
    actor = make_actor([curriculum.input_width], 3, in_keys=["input"])
    guide = GuidedExploration(actor, curriculum, share=1.0)
    guide.follow(actor, 0)
    for weight in actor.parameters():
        weight.data.zero_()
    collector = Collector(shown, TensorDictSequential(actor, guide), frames_per_batch=6 * 60, total_frames=-1)
    yield next(iter(collector))
    collector.shutdown()


def test_a_collector_begins_episode_after_episode_with_it(collected: TensorDict) -> None:
    guided = (collected["action"] != 0).any(-1)
    near = (collected["state"][..., :2] - collected["state"][..., 5:7]).norm(dim=-1)
    threshold = make_env("hand_v1", num_envs=1).stages()[0]["threshold"]
    begun = collected["is_init"].squeeze(-1)
    assert begun.sum() > 6  # more than one episode each
    for env in range(6):
        for start in begun[env].nonzero().flatten().tolist():
            ends = begun[env, start + 1 :].nonzero().flatten()
            stop = start + 1 + int(ends[0]) if len(ends) else 60
            reached = (near[env, start:stop] < threshold).nonzero().flatten()
            first = int(reached[0]) if len(reached) else stop - start
            assert guided[env, start:stop].tolist() == [True] * first + [False] * (stop - start - first)
