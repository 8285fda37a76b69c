"""The shares of greedy, noisy and uniform actions, their schedule, and where exploring happens at all."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_her import DecayingEpsilon, make_actor
from torchrl_her.modules import DecayingEpsilonGreedy, explore, explore_actions
from torchrl_her_envs import make_env

ROWS = 100_000  # a share has a standard deviation of at most 0.0016: all bounds below are six of them
LOW, HIGH = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 10.0])
GREEDY = torch.tensor([0.5, 4.0])


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def explored(epsilon: float, **options: float) -> Tensor:
    return explore(GREEDY.expand(ROWS, 2), LOW, HIGH, epsilon, generator=seeded(), **options)


def share(rows: Tensor) -> float:
    return rows.float().mean().item()


@pytest.mark.parametrize("epsilon", [0.1, 0.5, 1.0])
def test_shares(epsilon: float) -> None:
    greedy = (explored(epsilon) == GREEDY).all(-1)
    assert share(greedy) == pytest.approx(1.0 - epsilon, abs=0.01)
    without_noise = (explored(epsilon, noise=0.0) == GREEDY).all(-1)  # what still differs is uniform
    assert share(~without_noise) == pytest.approx(0.2 * epsilon, abs=0.01)


def test_a_row_explores_as_a_whole() -> None:
    same = explored(0.5) == GREEDY
    assert torch.equal(same[:, 0], same[:, 1])


def test_noise_is_a_twentieth_of_the_range() -> None:
    noise = explored(1.0, uniform_share=0.0) - GREEDY
    assert noise.mean(0).tolist() == pytest.approx([0.0, 0.0], abs=0.01)
    assert noise.std(0).tolist() == pytest.approx([0.1, 0.5], rel=0.02)  # of ranges of 2 and 10
    assert (noise.abs() > 1e-3).float().mean() > 0.95  # noise on every coordinate


def test_uniform_actions_fill_the_range() -> None:
    action = explored(1.0, uniform_share=1.0)
    assert action.mean(0).tolist() == pytest.approx([0.0, 5.0], abs=0.06)
    assert action.std(0).tolist() == pytest.approx([2 / math.sqrt(12), 10 / math.sqrt(12)], rel=0.02)
    assert action.amin(0).tolist() == pytest.approx([-1.0, 0.0], abs=0.01)
    assert action.amax(0).tolist() == pytest.approx([1.0, 10.0], abs=0.01)
    correlation = torch.corrcoef(action.T)[0, 1].item()
    assert correlation == pytest.approx(0.0, abs=0.02)


@settings(max_examples=50, deadline=None)
@given(
    st.floats(0.0, 1.0), st.floats(0.0, 2.0), st.floats(0.0, 1.0), st.floats(-1.0, 1.0), st.integers(0, 2**31)
)
def test_no_action_is_out_of_bounds(
    epsilon: float, noise: float, part: float, greedy: float, seed: int
) -> None:
    actions = torch.full((3, 5, 2), greedy).clamp(LOW, HIGH)
    action = explore(actions, LOW, HIGH, epsilon, noise=noise, uniform_share=part, generator=seeded(seed))
    assert action.shape == (3, 5, 2)
    assert ((action >= LOW) & (action <= HIGH)).all()


def test_each_row_may_have_an_epsilon_of_its_own() -> None:
    epsilon = torch.tensor([0.0, 1.0]).view(2, 1, 1)
    action = explore(GREEDY.expand(2, 1000, 2), LOW, HIGH, epsilon, generator=seeded())
    assert [share((rows == GREEDY).all(-1)) for rows in action] == [1.0, 0.0]


# The module


def make_module(**options: object) -> DecayingEpsilon:
    return DecayingEpsilon(-torch.ones(3), torch.ones(3), generators=[seeded()], **options)


def zeros(n: int = 1000) -> TensorDict:
    return TensorDict({"action": torch.zeros(n, 3)}, batch_size=[n])


def test_epsilon_decays_down_to_its_end() -> None:
    module, values = make_module(start=0.8, decay=0.5, end=0.15), []
    for _ in range(4):
        values.append(module.epsilon.item())
        module.step()
    assert values == pytest.approx([0.8, 0.4, 0.2, 0.15])
    assert module.epsilon.item() == 0.15


def test_the_schedule_of_appendix_b() -> None:
    module = make_module()
    module.step()
    assert module.epsilon.item() == pytest.approx(0.95)
    for _ in range(57):
        module.step()
    assert module.epsilon.item() == pytest.approx(0.95**58)  # 0.05103
    module.step()
    assert module.epsilon.item() == 0.05  # 0.95 ** 59 is 0.04848


def test_epsilon_starts_again() -> None:
    module = make_module(start=0.8, decay=0.5)
    module.step()
    module.restart()
    assert module.epsilon.item() == 0.8
    module.restart(0.3)
    assert module.epsilon.item() == pytest.approx(0.3)
    module.step()
    assert module.epsilon.item() == pytest.approx(0.15)


def test_state_holds_epsilon() -> None:
    module, other = make_module(), make_module()
    module.step()
    other.load_state_dict(module.state_dict())
    assert other.epsilon.item() == pytest.approx(0.95)
    assert module.epsilon.data_ptr() != other.epsilon.data_ptr()


@pytest.mark.parametrize("kind", [ExplorationType.DETERMINISTIC, ExplorationType.MODE, ExplorationType.MEAN])
def test_greedy_where_no_exploring_is_asked_for(kind: ExplorationType) -> None:
    module = make_module(start=1.0)
    before = module.generators[0].get_state()
    with set_exploration_type(kind):
        assert (module(zeros())["action"] == 0).all()
    assert torch.equal(module.generators[0].get_state(), before)  # evaluation leaves training as it is


def test_options_reach_the_actions() -> None:
    with set_exploration_type(ExplorationType.RANDOM):
        still = make_module(start=1.0, noise=0.0, uniform_share=0.0)(zeros())
        wide = make_module(start=1.0, noise=0.0, uniform_share=1.0)(zeros())
    assert (still["action"] == 0).all()
    assert wide["action"].std().item() == pytest.approx(1 / math.sqrt(3), rel=0.05)


def test_a_key_of_ones_own() -> None:
    key = ("agent", "action")
    module = DecayingEpsilon(-torch.ones(3), torch.ones(3), action_key=key)
    with set_exploration_type(ExplorationType.RANDOM):
        out = module(TensorDict({"agent": {"action": torch.zeros(10, 3)}}, batch_size=[10]))
    assert (out[key] != 0).all()


def test_each_run_explores_as_it_would_alone() -> None:
    bounds = -torch.ones(3), torch.ones(3)
    both = DecayingEpsilon(*bounds, generators=[seeded(1), seeded(2)])
    singles = [DecayingEpsilon(*bounds, generators=[seeded(seed)]) for seed in (1, 2)]
    both.epsilon.copy_(torch.tensor([0.9, 0.3]))
    singles[0].restart(0.9)
    singles[1].restart(0.3)
    with set_exploration_type(ExplorationType.RANDOM):
        together = both(zeros(40))["action"]
        apart = [single(zeros(20))["action"] for single in singles]
    assert torch.equal(together, torch.cat(apart))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": 1.5}, r"0 <= end <= start <= 1, got start=1.5, end=0.05"),
        ({"start": 0.1, "end": 0.2}, r"got start=0.1, end=0.2"),
        ({"end": -0.1}, r"got start=1.0, end=-0.1"),
        ({"start": math.nan}, r"got start=nan"),
        ({"decay": 0.0}, r"decay must be in \(0, 1\], got 0.0"),
        ({"decay": 1.1}, r"decay must be in \(0, 1\], got 1.1"),
        ({"noise": -0.1}, "noise must be at least 0 and finite, got -0.1"),
        ({"noise": math.inf}, "noise must be at least 0 and finite, got inf"),
        ({"noise": math.nan}, "noise must be at least 0 and finite, got nan"),
        ({"uniform_share": 1.5}, r"uniform_share must be in \[0, 1\], got 1.5"),
    ],
)
def test_bad_options_are_named(options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_module(**options)


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        ([0.0, 0.0], [1.0, math.inf], "high must be finite, got inf in it"),
        ([0.0, math.nan], [1.0, 1.0], "low must be finite, got nan in it"),
        ([0.0, 2.0], [1.0, 1.0], "low must be at most high=1.0, got 2.0"),
    ],
)
def test_bounds_without_actions_between_them_are_named(
    low: list[float], high: list[float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        DecayingEpsilon(torch.tensor(low), torch.tensor(high))


def test_behind_an_actor_in_a_collector() -> None:
    env = make_env("hand_reach", num_envs=20, seed=0)
    actor, module = make_actor((5, 2), 3), make_module(start=0.5)
    policy = TensorDictSequential(actor, module)
    collector = Collector(
        env, policy, frames_per_batch=400, total_frames=-1, auto_register_policy_transforms=False
    )

    def share_of_greedy_actions() -> float:
        batch = collector.next()
        greedy = actor(batch.select("observation", "desired_goal"))["action"]
        return share(torch.isclose(batch["action"], greedy, atol=1e-6).all(-1))

    assert share_of_greedy_actions() == pytest.approx(0.5, abs=0.15)  # six standard deviations of 400 rows
    module.restart(0.0)
    assert share_of_greedy_actions() == 1.0
    collector.shutdown()


# A finite number of actions


def test_counted_actions_explore_with_probability_epsilon() -> None:
    greedy = torch.full((20_000,), 2)
    actions = explore_actions(greedy, 4, 0.4, generator=torch.Generator().manual_seed(0))
    assert float((actions != 2).float().mean()) == pytest.approx(0.4 * 3 / 4, abs=0.01)
    assert actions.unique().tolist() == [0, 1, 2, 3]


def test_counted_actions_of_each_run_come_from_its_own_generator() -> None:
    def explored(seeds: list[int]) -> torch.Tensor:
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        exploration = DecayingEpsilonGreedy(50, start=1.0, generators=generators)
        return exploration(
            TensorDict({"action": torch.zeros(6 * len(seeds), dtype=torch.int64)}, [6 * len(seeds)])
        )["action"]

    assert torch.equal(explored([3, 5]), torch.cat([explored([3]), explored([5])]))


def test_no_actions_are_refused() -> None:
    with pytest.raises(ValueError, match="actions must be at least 1, got 0"):
        DecayingEpsilonGreedy(0)


@pytest.mark.parametrize("start", [5.0, -1.0, math.nan])
def test_epsilon_cannot_start_outside_of_0_to_1(start: float) -> None:
    with pytest.raises(ValueError, match=r"epsilon must be in \[0, 1\], got"):
        DecayingEpsilonGreedy(2).restart(start)


def test_rows_must_be_equal_blocks() -> None:
    exploration = DecayingEpsilonGreedy(2, generators=[torch.Generator() for _ in range(2)])
    with pytest.raises(ValueError, match="number of rows must be a multiple of runs=2, got 5"):
        exploration(TensorDict({"action": torch.zeros(5, dtype=torch.int64)}, [5]))


@pytest.mark.parametrize("dtype", [torch.bool, torch.int64])  # int64 is the type of TorchRL's OneHot
def test_one_hot_actions_are_refused(dtype: torch.dtype) -> None:
    with pytest.raises(ValueError, match=f"whole numbers .categorical., got {dtype}"):
        DecayingEpsilonGreedy(4)(TensorDict({"action": torch.eye(4).to(dtype)}, [4]))


def test_the_counted_action_of_a_single_environment_explores() -> None:
    explored = DecayingEpsilonGreedy(4, start=1.0)(TensorDict({"action": torch.tensor(2)}))["action"]
    assert explored.shape == ()
    assert 0 <= int(explored) < 4
