"""The three small worlds: what happens in them step by step, many of them at once, and hindsight on them.

Treasure hunts below go in steps of 10 units, so that place k of 0 to 10 is shown as k / 5 - 1.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.utils import check_env_specs
from torchrl.modules import MLP, EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss, SoftUpdate

from torchrl_her import EnvReward, GoalReward, HERWriter
from torchrl_her_envs.small_worlds import BitFlip, Chain, LatticeGoals, SmallWorld, TreasureHunt

Make = Callable[..., SmallWorld]
WORLDS: dict[str, Make] = {
    "bits": lambda **options: BitFlip(5, **options),
    "bits and a useless action": lambda **options: BitFlip(5, useless_action=True, **options),
    "treasure": lambda **options: TreasureHunt(10, **options),
    "chain": lambda **options: Chain(6, 0.7, **options),
    "chain that resets": lambda **options: Chain(6, 0.7, reset_state=True, **options),
    "chain of layers": lambda **options: Chain(6, 0.7, layers=2, alternating=True, **options),
}
worlds = pytest.mark.parametrize("make", WORLDS.values(), ids=WORLDS)
some_world = st.sampled_from(list(WORLDS.values()))
SHOWN = ("state", "observation", "achieved_goal", "desired_goal")


def act(env: SmallWorld, *actions: int) -> TensorDictBase:
    """One step: the same action in all worlds, or one for each."""
    action = torch.tensor(actions).expand(env.batch_size)
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def put(env: SmallWorld, **values: list[int] | list[list[int]]) -> None:
    state = env.world_state_dict()
    env.load_world_state_dict(
        state | {key: torch.tensor(value).expand_as(state[key]) for key, value in values.items()}
    )


def random_actions(env: SmallWorld, steps: int, *, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(env.num_actions, (steps, *env.batch_size), generator=generator)


def collect(env: SmallWorld, actions: Tensor) -> TensorDictBase:
    """[N, steps] transitions, with episodes that end and begin again, as a collector gets them."""
    steps, now = [], env.reset()
    for action in actions:
        step, now = env.step_and_maybe_reset(now.set("action", action))
        steps.append(step)
    return torch.stack(steps, 1)


def everything(rows: TensorDictBase) -> Tensor:
    keys = [*SHOWN, *(("next", key) for key in (*SHOWN, "reward", "terminated", "truncated", "done"))]
    return torch.cat([rows[key].float() for key in keys], -1)


# Under TorchRL's tools


@worlds
@pytest.mark.parametrize("num_envs", [1, 3])
def test_specs(make: Make, num_envs: int) -> None:
    env = make(num_envs=num_envs)
    check_env_specs(env, seed=0)
    steps = env.rollout(2, break_when_any_done=False)
    for key in (*SHOWN, ("next", "reward")):
        assert steps[key].dtype == torch.float32
    assert torch.equal(steps["state"], torch.cat((steps["observation"], steps["desired_goal"]), -1))
    goals = steps["achieved_goal"].shape[-1]
    assert torch.equal(steps["observation"][..., -goals:], steps["achieved_goal"])


@worlds
def test_entries_do_not_share_memory(make: Make) -> None:
    shown = make(num_envs=2).reset()
    pointers = {shown[key].untyped_storage().data_ptr() for key in SHOWN}
    assert len(pointers) == len(SHOWN)


@worlds
def test_a_collector_gets_whole_episodes(make: Make) -> None:
    env = make(num_envs=2)
    most = env.max_steps
    collector = Collector(env, frames_per_batch=2 * 40, total_frames=2 * 40)
    (steps,) = list(collector)
    collector.shutdown()
    lengths = steps["collector", "traj_ids"].flatten().unique(return_counts=True)[1]
    assert lengths.max() <= most
    for world in steps:
        ids, done = world["collector", "traj_ids"].flatten(), world["next", "done"].flatten()
        assert torch.equal(ids[1:] != ids[:-1], done[:-1])


# Seeds, and each world as if it were alone


@settings(max_examples=15, deadline=None)
@given(some_world, st.integers(1, 6), st.integers(0, 2**64 - 1))
def test_a_batch_equals_single_worlds_and_repeats(make: Make, num_envs: int, seed: int) -> None:
    many, more = make(num_envs=num_envs, seed=seed), make(num_envs=num_envs + 3, seed=seed)
    actions = random_actions(more, 20)
    seen = everything(collect(more, actions))
    assert torch.equal(everything(collect(many, actions[:, :num_envs])), seen[:num_envs])
    single = make(num_envs=1, seed=seed)
    assert torch.equal(everything(collect(single, actions[:, :1])), seen[:1])


@worlds
def test_seeds_give_equal_blocks_each_as_if_alone(make: Make) -> None:
    both = make(num_envs=6, seed=[3, 11])
    actions = random_actions(both, 25)
    seen = everything(collect(both, actions))
    for block, seed in ((slice(0, 3), 3), (slice(3, 6), 11)):
        alone = make(num_envs=3, seed=seed)
        assert torch.equal(everything(collect(alone, actions[:, block])), seen[block])


@worlds
def test_set_seed_starts_over(make: Make) -> None:
    env, fresh = make(num_envs=8, seed=1), make(num_envs=8, seed=5)
    actions = random_actions(env, 30)
    first = collect(env, actions)
    env.set_seed(5)
    again = everything(collect(env, actions))
    assert torch.equal(again, everything(collect(fresh, actions)))
    assert not torch.equal(again, everything(first))


def test_worlds_seeds_and_episodes_differ() -> None:
    starts = []
    for seed in (0, 1):
        env = BitFlip(40, num_envs=5, seed=seed)
        starts += [env.reset()["state"] for _ in range(3)]
    assert len(torch.cat(starts).unique(dim=0)) == 2 * 5 * 3


def test_transitions_differ_from_start_to_start_step_to_step_and_world_to_world() -> None:
    env = Chain(1000, 0.5, num_envs=200, seed=2)
    forward = []
    for _ in range(2):
        env.reset()
        put(env, place=[1] * 500 + [0] * 500)
        places = torch.stack([act(env, 1)["observation"].sum(-1) for _ in range(50)])
        forward.append(places.diff(dim=0) > 0)
    one, two = forward  # [49, 200]
    for a, b in ((one, two), (one[1:], one[:-1]), (one[:, 1:], one[:, :-1])):
        assert 0.46 < (a == b).double().mean() < 0.54  # 9,800 coins: eight standard deviations


def test_starts_do_not_depend_on_how_long_episodes_are() -> None:
    short, long = TreasureHunt(num_envs=4, seed=1, max_steps=2), TreasureHunt(num_envs=4, seed=1)
    for _ in range(3):
        assert torch.equal(short.reset()["state"], long.reset()["state"])
        act(short, 0)


@worlds
def test_torchs_generator_is_left_alone(make: Make) -> None:
    before = torch.get_rng_state()
    collect(make(num_envs=2), random_actions(make(num_envs=2), 9))
    assert torch.equal(before, torch.get_rng_state())


# Partial resets, resuming


@settings(max_examples=15, deadline=None)
@given(some_world, st.lists(st.booleans(), min_size=5, max_size=5))
def test_a_partial_reset_leaves_the_other_worlds_alone(make: Make, which: list[bool]) -> None:
    env, calm = make(num_envs=5), make(num_envs=5)
    mask = torch.tensor(which).unsqueeze(-1)
    env.reset()
    calm.reset()
    after = act(env, 1)
    act(calm, 1)
    before = env.world_state_dict()
    shown = env.reset(after.clone().set("_reset", mask))
    now, others = env.world_state_dict(), ~mask.squeeze(-1)
    assert all(torch.equal(now[key][others], before[key][others]) for key in now)
    assert all(torch.equal(shown[key][others], after[key][others]) for key in SHOWN)
    assert not shown["done"][~others].any()
    assert now["step"].tolist() == [0 if reset else 1 for reset in which]
    assert now["episode"].tolist() == [2 if reset else 1 for reset in which]
    for action in random_actions(env, 3):
        one, same = act(env, *action), act(calm, *action)
        assert all(torch.equal(one[key][others], same[key][others]) for key in SHOWN)


@worlds
def test_resuming_changes_nothing(make: Make) -> None:
    env, other = make(num_envs=4, seed=2), make(num_envs=4, seed=9)
    collect(env, random_actions(env, 9))
    other.reset()
    other.load_world_state_dict(env.world_state_dict())
    actions = random_actions(env, 20, seed=1)
    assert torch.equal(everything(collect(env, actions)), everything(collect(other, actions)))


# Rewards and goals


@settings(max_examples=15, deadline=None)
@given(some_world, st.integers(0, 100))
def test_rewards_are_those_of_the_goals_reached(make: Make, seed: int) -> None:
    env = make(num_envs=6, seed=seed)
    after = collect(env, random_actions(env, 30, seed=seed))["next"]
    goals = after["achieved_goal"], after["desired_goal"]
    assert torch.equal(after["reward"], env.compute_reward(*goals))
    assert torch.equal(after["terminated"], env.compute_terminated(*goals))
    assert torch.equal(after["reward"] == 0, after["terminated"])
    assert torch.equal(after["terminated"], (goals[0] == goals[1]).all(-1, keepdim=True))
    assert torch.equal(after["done"], after["terminated"] | after["truncated"])
    reward, terminated = GoalReward(env.threshold)(*goals)
    assert torch.equal(reward, after["reward"])
    assert torch.equal(terminated, after["terminated"])


@pytest.mark.parametrize(
    "env", [TreasureHunt(), Chain(100, 0.5), BitFlip(100)], ids=["treasure", "chain", "bits"]
)
def test_neighbours_are_told_apart(env: SmallWorld) -> None:
    goal = env.goal_distribution.sample(1000).float()
    other = goal.clone()
    other[:, 0] -= torch.where(goal[:, 0] > 0, 2 * env.threshold, -2 * env.threshold)
    assert env.compute_terminated(goal, goal).all()
    assert not env.compute_terminated(goal, other).any()
    assert (env.compute_reward(goal, other) == -1).all()


def test_rewards_are_broadcast() -> None:
    env = BitFlip(2)
    achieved, desired = torch.zeros(4, 1, 2), torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    reward = env.compute_reward(achieved, desired)
    assert reward.shape == (4, 3, 1)
    assert reward[3].flatten().tolist() == [0.0, -1.0, -1.0]


@worlds
def test_no_episode_starts_at_its_goal(make: Make) -> None:
    shown = make(num_envs=2000).reset()
    assert (shown["achieved_goal"] != shown["desired_goal"]).any(-1).all()


@worlds
def test_goals_that_are_sampled_are_goals_that_occur(make: Make) -> None:
    env = make(num_envs=3000)
    occur = env.reset()["desired_goal"].unique(dim=0)
    sampled = env.goal_distribution.sample(3000, generator=torch.Generator().manual_seed(0)).float()
    assert torch.equal(sampled.unique(dim=0), occur)  # at most 32 of them: none is missed
    assert (occur >= env.goal_distribution.low).all()
    assert (occur <= env.goal_distribution.high).all()


def test_lattices() -> None:
    goals = LatticeGoals([0.0, -1.0], [2.0, 1.0], count=3)
    assert goals.from_uniform(torch.tensor([[0.0, 0.99], [0.34, 0.6]])).tolist() == [[0.0, 1.0], [1.0, 0.0]]
    nearly_one = torch.full((1, 1), 1 - 2**-24, dtype=torch.float32)
    assert LatticeGoals([0.0], [100.0], count=101).from_uniform(nearly_one).item() == 100.0
    half = goals.scaled(0.5, 3.0)
    assert (half.low.tolist(), half.high.tolist()) == ([3.0, 2.5], [4.0, 3.5])
    assert not goals.is_box
    with pytest.raises(ValueError, match=r"low <= high, got low=\[1.0\], high=\[0.0\]"):
        LatticeGoals([1.0], [0.0], count=2)
    with pytest.raises(ValueError, match=r"count must be at least 2 from low=\[0.0\] .* got 1"):
        LatticeGoals([0.0], [1.0], count=1)
    with pytest.raises(ValueError, match="count must be at least 1 .* got 0"):
        LatticeGoals([1.0], [1.0], count=0)


# Bit flipping


def test_bits_are_flipped_one_after_the_other() -> None:
    env = BitFlip(3)
    env.reset()
    put(env, place=[0, 1, 0], goal=[1, 1, 1])
    after = act(env, 2)
    assert after["observation"].tolist() == [[0.0, 1.0, 1.0]]
    assert (after["reward"].item(), after["done"].item()) == (-1.0, False)
    after = act(env, 0)
    assert after["state"].tolist() == [[1.0, 1.0, 1.0, 1.0, 1.0, 1.0]]
    assert (after["reward"].item(), after["terminated"].item(), after["truncated"].item()) == (0, True, False)


def test_a_bit_that_is_flipped_twice_is_as_it_was() -> None:
    env = BitFlip(3)
    env.reset()
    put(env, place=[0, 1, 0], goal=[1, 1, 1])
    act(env, 1)
    after = act(env, 1)
    assert after["observation"].tolist() == [[0.0, 1.0, 0.0]]
    assert not after["done"].item()
    assert act(env, 1)["truncated"].item()  # the third of three steps


def test_success_at_the_last_step_is_terminated_and_truncated() -> None:
    env = BitFlip(2)
    env.reset()
    put(env, place=[0, 0], goal=[1, 1])
    act(env, 0)
    after = act(env, 1)
    assert after["terminated"].item()
    assert after["truncated"].item()


def test_the_useless_action_ends_the_episode_and_says_nothing_of_the_goal() -> None:
    env = BitFlip(4, useless_action=True, num_envs=3)
    assert env.action_spec.space.n == 5
    before = env.reset()
    after = act(env, 4, 0, 4)
    useless = torch.tensor([True, False, True])
    assert torch.equal(after["observation"][useless], before["observation"][useless])
    assert torch.equal(after["desired_goal"], before["desired_goal"])
    assert torch.equal(after["truncated"].squeeze(-1), useless)
    assert torch.equal(after["done"].squeeze(-1), useless | after["terminated"].squeeze(-1))
    assert not after["terminated"][useless].any()
    assert (after["reward"][useless] == -1).all()


@pytest.mark.parametrize("bits", [1, 2, 3, 127])
def test_starts_are_uniform_over_pairs_that_differ(bits: int) -> None:
    shown = BitFlip(bits, num_envs=8000, seed=3).reset()
    start, goal = shown["observation"].long(), shown["desired_goal"].long()
    if bits < 4:  # every pair of different values as often as every other
        value = 2 ** torch.arange(bits)
        pairs = (start @ value * 2**bits + goal @ value).bincount(minlength=4**bits)
        allowed = ~torch.eye(2**bits, dtype=torch.bool).flatten()
        expected = 8000 / allowed.sum()
        assert not pairs[~allowed].any()
        assert ((pairs[allowed] - expected).abs() < 5 * expected.sqrt()).all()
    for share in (start.double().mean(0), goal.double().mean(0)):
        assert ((share - 0.5).abs() < 0.03).all()  # five standard deviations


# Treasure hunt


def test_the_pirate_walks_to_the_treasure() -> None:
    env = TreasureHunt(10)
    env.reset()
    put(env, place=[3], goal=[1])
    steps = [act(env, action) for action in (1, 0, 0, 0)]
    assert [round(after["observation"].item(), 6) for after in steps] == [-0.2, -0.4, -0.6, -0.8]
    assert [after["reward"].item() for after in steps] == [-1, -1, -1, 0]
    assert [after["terminated"].item() for after in steps] == [False, False, False, True]
    assert not any(after["truncated"].item() for after in steps)


@pytest.mark.parametrize(("place", "action"), [(0, 0), (10, 1)])
def test_the_pirate_stays_at_the_ends(place: int, action: int) -> None:
    env = TreasureHunt(10)
    env.reset()
    put(env, place=[place], goal=[5])
    after = [act(env, action) for _ in range(10)]
    assert {one["observation"].item() for one in after} == {place / 5 - 1}
    assert [one["truncated"].item() for one in after] == [False] * 9 + [True]
    assert not any(one["terminated"].item() for one in after)


@pytest.mark.parametrize("step", [1, 4, 100])
def test_the_way_to_the_treasure_is_never_too_long(step: int) -> None:
    env = TreasureHunt(step, num_envs=300, seed=1)
    now = env.reset()
    assert env.max_steps == 100 // step
    found, towards = torch.zeros(300, dtype=torch.bool), now["desired_goal"] > now["observation"]
    for _ in range(env.max_steps):
        found |= act(env, *towards.squeeze(-1).long())["terminated"].squeeze(-1)
    assert found.all()


def test_pirate_and_treasure_are_anywhere_but_at_the_same_place() -> None:
    shown = TreasureHunt(50, num_envs=6000).reset()
    start, goal = ((shown[key].squeeze(-1) + 1).long() for key in ("observation", "desired_goal"))
    pairs = (3 * start + goal).bincount(minlength=9).view(3, 3)
    assert pairs.diagonal().tolist() == [0, 0, 0]
    others = pairs[~torch.eye(3, dtype=torch.bool)]
    assert ((others - 1000).abs() < 160).all()  # five standard deviations


def test_the_whole_line_is_used() -> None:
    shown = TreasureHunt(num_envs=5000).reset()
    for key in ("observation", "desired_goal"):
        places = shown[key].unique()
        assert len(places) == 101
        assert (places[0].item(), places[-1].item()) == (-1.0, 1.0)


# The chain


def closed(after: TensorDictBase) -> int:
    """How many links are closed; they are the first ones."""
    links = after["observation"][0].tolist()
    count = links.count(1.0)
    assert links == [1.0] * count + [-1.0] * (len(links) - count)
    return count


def test_without_chance_actions_do_what_they_say() -> None:
    env = Chain(4, 1.0, max_steps=10)
    assert env.reset()["state"].tolist() == [[-1.0] * 4 + [1.0] * 4]
    steps = [act(env, action) for action in (0, 1, 1, 0, 1, 1, 1)]
    assert [closed(after) for after in steps] == [0, 1, 2, 1, 2, 3, 4]
    assert [after["reward"].item() for after in steps] == [-1.0] * 6 + [0.0]
    assert [after["terminated"].item() for after in steps] == [False] * 6 + [True]


def test_in_the_reset_state_form_every_mistake_leads_to_the_first_place() -> None:
    env = Chain(4, 1.0, reset_state=True)
    env.reset()
    steps = [act(env, action) for action in (1, 1, 0, 1)]
    assert [closed(after) for after in steps] == [1, 2, 0, 1]
    assert [after["truncated"].item() for after in steps] == [False, False, False, True]


@pytest.mark.parametrize("reset_state", [False, True])
def test_forward_arrives_as_often_as_appendix_c_says(reset_state: bool) -> None:
    env = Chain(3, 0.8, reset_state=reset_state, num_envs=8000, seed=4)
    env.reset()
    after = [act(env, 1) for _ in range(3)][-1]
    assert after["truncated"].all()
    arrived = after["terminated"].double().mean().item()
    assert abs(arrived - 0.512) < 0.028  # 0.8**3, within five standard deviations


@settings(max_examples=10, deadline=None)
@given(st.floats(0.05, 0.95), st.booleans(), st.integers(1, 8))
def test_steps_of_the_chain(probability: float, reset_state: bool, place: int) -> None:
    env = Chain(9, probability, reset_state=reset_state, num_envs=1000)
    env.reset()
    links = [1] * place + [0] * (9 - place)
    put(env, place=links)
    act(env, 1)
    places = env.world_state_dict()["place"].sum(-1)
    assert set(places.tolist()) == {place + 1, 0 if reset_state else place - 1}
    assert abs((places == place + 1).double().mean() - probability) < 0.08
    put(env, place=links)
    act(env, 0)
    assert set(env.world_state_dict()["place"].sum(-1).tolist()) == {0 if reset_state else place - 1}


def test_in_an_alternating_chain_odd_places_want_the_other_action() -> None:
    env = Chain(4, 1.0, alternating=True, reset_state=True, max_steps=10)
    env.reset()
    assert [closed(act(env, action)) for action in (1, 1, 1, 0, 1, 0)] == [1, 0, 1, 2, 3, 4]


def test_of_a_chain_of_layers_only_the_last_is_achieved() -> None:
    env = Chain(6, 1.0, layers=3)
    assert env.reset()["desired_goal"].tolist() == [[1.0, 1.0]]
    steps = [act(env, 1) for _ in range(6)]
    assert [after["achieved_goal"][0].tolist() for after in steps] == [[-1.0, -1.0]] * 4 + [
        [1.0, -1.0],
        [1.0, 1.0],
    ]
    assert [after["terminated"].item() for after in steps] == [False] * 5 + [True]


# Hindsight


def relabelled(env: SmallWorld, steps: TensorDictBase, **options: object) -> tuple[TensorDict, TensorDict]:
    """The real and the virtual rows."""
    rule = EnvReward(env.compute_reward, env.compute_terminated)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(5000), writer=HERWriter(rule, k=4, **options), batch_size=32
    )
    buffer.set_rng(torch.Generator().manual_seed(0))
    buffer.extend(steps)
    rows = buffer[:]
    virtual = rows["virtual"].squeeze(-1)
    return rows[~virtual], rows[virtual]


@worlds
def test_virtual_goals_were_reached_in_the_same_episode(make: Make) -> None:
    env = make(num_envs=4)
    steps = collect(env, random_actions(env, 30))
    number = torch.arange(4).unsqueeze(-1) * 100 + torch.cat(
        (torch.zeros(4, 1), steps["next", "done"].squeeze(-1)[:, :-1].cumsum(-1)), -1
    )
    steps["episode"] = number.unsqueeze(-1)
    real, virtual = relabelled(env, steps)
    assert torch.equal(real["next", "reward"].sum(), (real["next", "terminated"].sum() - len(real)).float())
    assert len(virtual) == 4 * len(real)
    assert (virtual["next", "reward"] == 0).any()
    reached: dict[float, list[list[float]]] = {}
    for episode, goal in zip(real["episode"].flatten(), real["next", "achieved_goal"], strict=True):
        reached.setdefault(episode.item(), []).append(goal.tolist())
    for episode, goal in zip(virtual["episode"].flatten(), virtual["desired_goal"], strict=True):
        assert goal.tolist() in reached[episode.item()]
    after = virtual["next"]
    goals = after["achieved_goal"], after["desired_goal"]
    assert torch.equal(after["reward"], env.compute_reward(*goals))
    assert torch.equal(after["terminated"], env.compute_terminated(*goals))


def test_hindsight_always_praises_the_useless_action_and_the_filter_forgets_that() -> None:
    env = BitFlip(5, useless_action=True, num_envs=20)
    steps = collect(env, random_actions(env, 30))

    def praised(**options: object) -> tuple[int, bool]:
        real, virtual = relabelled(env, steps, **options)
        assert (real["action"] == 5).any()
        useless = virtual[virtual["action"] == 5]
        return len(useless), bool((useless["next", "reward"] == 0).all())

    number, all_positive = praised()
    assert number > 50
    assert all_positive
    assert praised(filter_achieved=True)[0] == 0


def test_hindsight_praises_walking_against_the_end_of_the_line() -> None:
    env = TreasureHunt(10)
    now = env.reset()
    put(env, place=[0], goal=[5])
    now.update({"observation": [[-1.0]], "achieved_goal": [[-1.0]], "desired_goal": [[0.0]]})
    rows = []
    for _ in range(10):
        row, now = env.step_and_maybe_reset(now.set("action", torch.tensor([0])))
        rows.append(row)
    steps = torch.stack(rows, 1)
    assert steps["next", "done"].flatten().tolist() == [False] * 9 + [True]
    _, virtual = relabelled(env, steps)
    assert (virtual["next", "reward"] == 0).all()
    assert len(relabelled(env, steps, filter_achieved=True)[1]) == 0


@worlds
def test_torchrls_q_learning_takes_the_actions(make: Make) -> None:
    env = make(num_envs=4)
    width = env.observation_spec["state"].shape[-1]
    net = MLP(in_features=width, out_features=env.num_actions, num_cells=[16])
    actor = QValueActor(
        TensorDictModule(net, ["observation", "desired_goal"], ["action_value"]),
        spec=env.action_spec_unbatched,
    )
    policy = TensorDictSequential(actor, EGreedyModule(env.action_spec_unbatched, eps_init=0.5))
    real, virtual = relabelled(env, env.rollout(40, policy, break_when_any_done=False))
    loss = DQNLoss(actor, action_space=env.action_spec, delay_value=True, double_dqn=True)
    loss.make_value_estimator(gamma=0.98)
    SoftUpdate(loss, eps=0.99)
    value = loss(torch.cat((real, virtual)))["loss"]
    value.backward()
    assert value.isfinite()
    assert all(weight.grad is not None for weight in loss.value_network_params.values(True, True))


# Bad input


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: BitFlip(0), "bits must be a whole number from 1 to 127, got 0"),
        (lambda: BitFlip(128), "bits must be a whole number from 1 to 127, got 128"),
        (lambda: BitFlip(2.5), "bits must be a whole number from 1 to 127, got 2.5"),
        (lambda: BitFlip(True), "bits must be a whole number from 1 to 127, got True"),
        (lambda: TreasureHunt(3), "step must divide 100, so be one of 1, 2, 4, 5, .*, 100; got 3"),
        (lambda: TreasureHunt(0), "step must be a whole number from 1 to 100, got 0"),
        (lambda: Chain(0, 0.5), "length must be a whole number from 1 to 1048575, got 0"),
        (lambda: Chain(6, 0.5, layers=4), "layers must divide length=6, got 4"),
        (lambda: Chain(3, 0.5, layers=4), "layers must be a whole number from 1 to 3, got 4"),
        (lambda: Chain(3, 0.0), r"forward_probability must be in \(0, 1\], got 0.0"),
        (lambda: Chain(3, 1.1), r"forward_probability must be in \(0, 1\], got 1.1"),
        (lambda: Chain(3, float("nan")), r"forward_probability must be in \(0, 1\], got nan"),
        (lambda: BitFlip(3, max_steps=0), "max_steps must be a whole number from 1 to 1048575, got 0"),
        (lambda: BitFlip(3, num_envs=0), "num_envs must be a whole number at least 1, got 0"),
        (lambda: BitFlip(3, num_envs=5, seed=[1, 2]), "5 worlds cannot be shared out among 2 seeds"),
        (lambda: BitFlip(3, seed=[]), "1 worlds cannot be shared out among 0 seeds"),
        (lambda: BitFlip(3, seed=-1), r"a seed must be at least 0 and below 2\*\*64, got -1"),
    ],
)
def test_what_cannot_be_made(make: Callable[[], SmallWorld], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([0, 3], "actions must be from 0 to 2, got 3 in world 1"),
        ([-1, 0], "actions must be from 0 to 2, got -1 in world 0"),
        ([[0], [1]], r"actions must be whole numbers of shape \[2\], got shape \[2, 1\] of torch.int64"),
        ([0.0, 1.0], r"actions must be whole numbers of shape \[2\], got shape \[2\] of torch.float32"),
    ],
)
def test_what_cannot_be_done(action: list[float], message: str) -> None:
    env = BitFlip(3, num_envs=2)
    env.reset()
    with pytest.raises(ValueError, match=message):
        env.step(TensorDict({"action": torch.tensor(action)}, batch_size=[2]))


def test_goals_of_another_width_are_refused() -> None:
    env = BitFlip(3)
    with pytest.raises(ValueError, match=r"goals must be of shape \[..., 3\], got \[7, 1\]"):
        env.compute_reward(torch.zeros(7, 3), torch.zeros(7, 1))
