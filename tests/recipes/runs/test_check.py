"""What a look at a task finds, and what it advises."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_her_recipes import Facts, advice, build, look_at, make_recipe
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.components.first_look import resolved
from torchrl_her_recipes.config.choices.order import AllAtOnce

GOALS = ("observation", "achieved_goal", "desired_goal")
HERE = "tests.recipes.runs.test_check"


class Push(EnvBase):
    """A hand on a line, which pushes a block to the right; a wall ends episodes if there is one.

    Args:
        show_goal: whether the observation contains the desired goal.
        moves: whether the block can be moved.
        arm: how far before the hand the block is pushed.
        cost: of each step, which compute_reward does not know.
        wall: whether episodes terminate where the hand goes below -0.5.
    """

    max_steps = 20

    def __init__(
        self,
        num_envs: int,
        *,
        show_goal: bool = False,
        moves: bool = True,
        arm: float = 0.0,
        cost: float = 0.0,
        wall: bool = False,
    ) -> None:
        super().__init__(batch_size=[num_envs])
        self.show_goal, self.moves, self.arm, self.cost, self.wall = show_goal, moves, arm, cost, wall
        widths = {"observation": 3 + show_goal, "achieved_goal": 1, "desired_goal": 1}
        seen = {key: Unbounded(shape=(num_envs, width)) for key, width in widths.items()}
        self.observation_spec = Composite(seen, shape=self.batch_size)
        self.action_spec = Bounded(-1.0, 1.0, (num_envs, 1))
        self.reward_spec = Unbounded(shape=(num_envs, 1))
        self.rng = torch.Generator()

    def _set_seed(self, seed: int | None) -> None:
        self.rng.manual_seed(seed or 0)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        fresh = torch.rand(3, *self.batch_size, 1, generator=self.rng)
        fresh = torch.stack((fresh[0] - 0.5, fresh[1] + 1.0, fresh[2] + 2.0))  # hand, block, goal
        mask = None if tensordict is None else tensordict.get("_reset", None)
        self.places = fresh if mask is None else torch.where(mask, fresh, self.places)
        return TensorDict(self._shown(), self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        hand, block, goal = self.places
        hand = hand + 0.3 * tensordict["action"]
        if self.moves:
            block = torch.maximum(block, hand + self.arm)
        self.places = torch.stack((hand, block, goal))
        reward = self.compute_reward(block, goal) - self.cost
        ends = (reward == 0) | (hand < -0.5 if self.wall else torch.zeros_like(reward, dtype=torch.bool))
        return TensorDict(
            {**self._shown(), "reward": reward, "done": ends, "terminated": ends}, self.batch_size
        )

    def _shown(self) -> dict[str, Tensor]:
        hand, block, goal = self.places
        seen = [torch.full_like(hand, 7.0), block, hand, goal][: 3 + self.show_goal]
        return {"observation": torch.cat(seen, -1), "achieved_goal": block.clone(), "desired_goal": goal}

    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        return ((achieved_goal - desired_goal).abs() < 0.1).float() - 1.0


def look(**options: Any) -> Facts:
    return look_at(make_recipe(task=f"{HERE}:Push", **{"task.options": options or None}), steps=2_000)


def said(facts: Facts, **options: Any) -> str:
    return "\n".join(advice(facts, make_recipe(task=f"{HERE}:Push", **options)))


def test_a_block_that_lies_still_is_told_and_stages_are_proposed() -> None:
    facts = look()
    assert facts.steps >= 2_000
    assert facts.max_steps == 20
    assert facts.actions == [(-1.0, 1.0)]
    assert 0.02 < facts.moved < 0.5
    assert 0.0 < facts.kept < 0.2
    assert facts.constant == [0]
    assert (facts.disagree, facts.fallen, facts.goal_inside) == (0.0, 0.0, [])
    reach, task = facts.stages
    assert [reach[key] for key in GOALS] == [[0, 2], [2], [1]]
    assert [task[key] for key in GOALS] == [[0, 2, 1], [1], "desired_goal"]
    assert reach["threshold"] == 0.05  # half of the task's, since the hand comes to the block itself
    assert 0.1 <= look(arm=0.08).stages[0]["threshold"] < 0.3  # it can but touch it
    assert "threshold" not in task  # the environment's own
    assert "algo=cher curriculum=stages.yaml" in said(facts, algo="filtered_her")
    assert "entries 2 to 2 of the observation" in said(facts, algo="filtered_her")
    assert "has a curriculum" in said(facts)


def test_a_block_that_lies_still_gets_a_curriculum() -> None:
    recipe = make_recipe(task=f"{HERE}:Push", hidden=8, num_envs=4, seed=3)
    components = build(recipe)
    assert components.recipe.hindsight.algo == "cher"
    assert components.recipe.curriculum.stages == look_at(recipe.replace(seed=0)).stages
    assert components.recipe.order == AllAtOnce(every_stage=True, task_share=1.0)
    assert resolved(components.recipe) == components.recipe
    components.close()


def test_an_algorithm_with_stages_finds_them_and_nothing_else_changes() -> None:
    recipe = make_recipe(task=f"{HERE}:Push", algo="unfiltered_cher", guided_share=0.25)
    found = resolved(recipe)
    assert found.curriculum.stages == resolved(make_recipe(task=f"{HERE}:Push")).curriculum.stages
    assert (found.hindsight.algo, found.curriculum.guided_share) == ("unfiltered_cher", 0.25)
    assert found.order == recipe.order
    given = found.replace(algo="cher", stages=[{"name": "task"}])
    assert resolved(given).curriculum.stages == [{"name": "task"}]


def test_a_cost_of_actions_is_no_obstacle_to_a_curriculum() -> None:
    recipe = resolved(make_recipe(task=f"{HERE}:Push", **{"task.options": {"cost": 0.5}}))
    assert recipe.hindsight.algo == "cher"


@pytest.mark.parametrize(
    "options",
    [
        {"task.options": {"moves": False}},
        {"task.options": {"wall": True}},  # what a failure costs is no reward of a curriculum
        {"algo": "filtered_her"},
        {"demonstrations.file": "some.pt", "demonstrations.episodes": 1},
    ],
)
def test_others_get_none(options: dict[str, Any]) -> None:
    recipe = resolved(make_recipe(task=f"{HERE}:Push", **options))
    assert (recipe.hindsight.algo, recipe.curriculum.stages) == ("filtered_her", None)


def test_what_never_changes_is_told() -> None:
    facts = look(moves=False)
    assert (facts.moved, facts.kept, facts.stages) == (0.0, 0.0, [])
    assert "achieved_goal never changed: does it hold what the goal is about?" in said(facts)


def test_rewards_that_goals_do_not_explain_are_told() -> None:
    facts = look(cost=0.5)
    assert facts.disagree == 1.0
    assert said(facts).startswith("in 100% of the steps, the reward differs from compute_reward")
    seldom = said(replace(facts, disagree=0.001, moved=0.002))
    assert seldom.startswith("in less than 1% of the steps, the reward differs")
    assert "in less than 1% of the episodes" in seldom
    assert "task.options.info_keys=[KEY]" in seldom


def test_a_goal_inside_of_the_observation_is_told() -> None:
    facts = look(show_goal=True)
    assert facts.goal_inside == [3]
    assert "entries 3 to 3 of the observation are the desired goal" in said(facts)


def test_episodes_that_end_without_the_goal_are_told() -> None:
    facts = look(wall=True)
    assert facts.fallen > 0.3
    assert "without the goal" not in said(facts)  # it does not pay
    asked = said(replace(facts, fallen=0.012), failure="environment")
    assert "1.2% of the episodes terminate without the goal" in asked
    assert "failure=never_pays" in asked


def test_what_is_slow_or_easy_or_of_many_scales_is_told() -> None:
    facts = replace(look(), seconds=0.02, achieved=0.8, scales=(1e-3, 10.0), moved=1.0)
    lines = said(facts, normalize=False).splitlines()
    assert [line.split(":")[0].split(",")[0] for line in lines] == [
        "entries of the observation are of very different scales",
        "a step takes 20 ms",
        "random actions achieve 80% of the goals",
    ]
    assert said(replace(facts, seconds=1e-4, achieved=0.1)) == ""
    far = replace(facts, seconds=1e-4, achieved=0.0, shaping=[0.1, 1.0])
    assert said(far) == ""  # the option is one of gymnasium environments
    reach = make_recipe(task="gym:torchrl_her_envs:torchrl_her/HandReach-v0", algo="filtered_her")
    (line,) = advice(far, reach)
    assert line.endswith("near it help (task.options.shaping=[0.1,1.0])")


def test_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["check", f"task={HERE}:Push", "algo=filtered_her", "--steps", "1000"]) == 0
    out = capsys.readouterr().out
    file = next(tmp_path.glob("*_stages.yaml"))
    assert f"curriculum={file.name}" in out
    assert [stage["name"] for stage in yaml.safe_load(file.read_text())] == ["reach", "task"]
    assert "&" not in file.read_text()
    assert main(["check", "task=hand_reach", "--steps", "500"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "no obstacle to learning was found"
    assert main(["check", "task=hand_v1", "--steps", "500"]) == 0
    assert "the task's own curriculum (algo=cher)" in capsys.readouterr().out
