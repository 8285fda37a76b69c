"""What is measured at the end of an epoch."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from torchrl_her_recipes import Components, build
from torchrl_her_recipes.runs.curriculum import play_greedily
from torchrl_her_recipes.runs.evaluation import measure

from ..small import small


def measured(components: Components) -> dict[str, torch.Tensor]:
    return measure(components, play_greedily(components, components.eval_env, 0))


def set_last_biases(components: Components, change: Any) -> None:
    """Changes the last layers of the critics that the loss trains."""
    loss = components.loss
    params = getattr(loss, "qvalue_network_params", None)
    params = loss.value_network_params if params is None else params
    bias = params["module", "rest", "2", "bias"].data
    bias.add_(torch.tensor(change).view(-1, *[1] * (bias.ndim - 1)).expand_as(bias))


@pytest.mark.parametrize(
    ("options", "change", "expected"),
    [
        ({"learner": "ddpg"}, [-1.0], [-1.0]),
        ({"learner": "ddpg", "num_runs": 2}, [-1.0, -2.0], [-1.0, -2.0]),
        ({"learner": "td3"}, [-1.0, -1.0], [-1.0]),
        ({"learner": "sac"}, [-1.0, -1.0], [-1.0]),
        ({"learner": "tqc"}, [-1.0, -1.0], [-1.0]),
        ({"learner": "redq", "critics": 4}, [-1.0, -2.0, -3.0, -2.0], [-2.0]),
    ],
)
def test_q_is_that_of_the_critics_that_are_trained(
    options: dict[str, Any], change: list[float], expected: list[float]
) -> None:
    components = build(small(task="hand_v0", **options))
    before = measured(components)
    set_last_biases(components, change)
    after = measured(components)
    for name in ("q", "q_bias"):
        torch.testing.assert_close(after[name] - before[name], torch.tensor(expected))


@pytest.mark.parametrize("learner", ["td3", "sac"])
def test_q_is_the_lesser_one_of_two_critics(learner: str) -> None:
    components = build(small(task="hand_v0", learner=learner))
    before = measured(components)
    set_last_biases(components, [0.0, 100.0])  # the second one is never the lesser one any more
    first = measured(components)["q"]
    set_last_biases(components, [100.0, -100.0])  # and now the first one
    second = measured(components)["q"]
    assert -1e-3 <= float(first - before["q"]) < 50.0
    assert -1e-3 <= float(second - before["q"]) < 50.0
    assert float(first) != float(second)


def test_q_is_not_logged_if_nobody_knows_it() -> None:
    components = build(small(task="hand_v0"))
    components.loss = torch.nn.Module()  # type: ignore[assignment]
    components.loss.tensor_keys = None
    assert not {"q", "q_bias"} & measured(components).keys()
