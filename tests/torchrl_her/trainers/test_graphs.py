"""Gradient steps as CUDA graphs, on an emulated device: the numbers of the steps without them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded
from torchrl.objectives import LossModule

from torchrl_her import make_actor, make_critic, make_ddpg_loss, make_target_updater
from torchrl_her.modules import make_stochastic_actor
from torchrl_her.objectives import Targets, make_sac_loss, make_td3_loss, make_tqc_loss
from torchrl_her.trainers import GraphLearner, LossLearner, RunsAdam, why_not_recorded

from ...emulated import DEVICE, emulated_device
from ...emulated_graphs import CapturingError, Graph, emulated_graphs

RUNS, BATCH = 3, 8
NOISY = (make_td3_loss, make_sac_loss, make_tqc_loss)


@pytest.fixture(params=["emulated", "cuda"])
def graphs(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[type[Graph]]:
    """Counts how often a graph is launched, emulated and, where there is one, on a GPU."""
    if request.param == "emulated":
        with emulated_device(), emulated_graphs() as own:
            yield own
    elif not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    else:
        monkeypatch.setattr(torch.cuda, "CUDAGraph", Counted)
        Counted.launched = 0
        yield Counted


class Counted(torch.cuda.CUDAGraph):  # type: ignore[misc]
    launched = 0

    def replay(self) -> None:
        Counted.launched += 1
        super().replay()


@pytest.fixture
def emulation() -> Iterator[None]:
    with emulated_device(), emulated_graphs():
        yield


def parts(
    runs: int, make: Callable[..., LossModule] = make_ddpg_loss, device: Any = DEVICE
) -> dict[str, Any]:
    """A loss, its optimizer and its targets, always with the same weights and random numbers."""
    torch.manual_seed(0)
    spec = Bounded(-1.0, 1.0, (3,))  # on the CPU, as that of an environment
    outputs = 5 if make is make_tqc_loss else 1
    stochastic = make in (make_sac_loss, make_tqc_loss)
    actor = make_stochastic_actor((4, 2), spec, runs=runs) if stochastic else make_actor((4, 2), 3, runs=runs)
    critic = make_critic((4, 2), 3, runs=runs, outputs=outputs)
    options: dict[str, Any] = {
        "reduction": "none" if runs > 1 else "mean",
        "targets": Targets(gamma=0.9, reward_range=None if stochastic else (-1.0, 0.0)),
    }
    generators = [torch.Generator(device).manual_seed(run) for run in range(runs)]
    if stochastic:
        actor.generators = generators
    elif make is make_td3_loss:
        options |= {"generators": generators, "action_spec": spec.to(device)}
    loss = make(actor.to(device), critic.to(device), **options).to(device)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    target = make_target_updater(loss, tau=0.1, hard_interval=0)
    return {"loss": loss, "optimizer": optimizer, "target": target, "runs": runs}


def pair(
    runs: int = RUNS, *, optimizer: type[torch.optim.Adam] = torch.optim.Adam, **options: Any
) -> tuple[LossLearner, GraphLearner]:
    """A learner without graphs and one with, from the same parts."""
    own, other = parts(runs), parts(runs)
    if optimizer is RunsAdam:
        for each in (own, other):
            each["optimizer"] = RunsAdam(each["loss"], lr=1e-2, runs=runs)
    plain = LossLearner(**own)
    plain.optimizer.param_groups[0]["capturable"] = True  # which rounds otherwise
    return plain, GraphLearner(**other, compile=False, **options)


def rows(seed: int, steps: int, runs: int = RUNS, device: Any = DEVICE) -> TensorDictBase:
    source = torch.Generator("cpu").manual_seed(seed)

    def draw(*width: int) -> Tensor:
        return torch.rand(runs, steps * BATCH, *width, generator=source)

    after = {"observation": draw(4), "desired_goal": draw(2), "reward": -draw(1).round()}
    ends = {name: draw(1) > 0.8 for name in ("done", "terminated")}
    now = {"observation": draw(4), "desired_goal": draw(2), "action": draw(3), "priority_weight": draw()}
    out = TensorDict({**now, "next": {**after, **ends}}, [runs, steps * BATCH])
    return (out if runs > 1 else out[0]).to(device)


def assert_same_weights(one: LossLearner, other: LossLearner) -> None:
    entries = zip(one.loss.state_dict().values(), other.loss.state_dict().values(), strict=True)
    for expected, got in entries:
        torch.testing.assert_close(got, expected)


@pytest.mark.parametrize("runs", [1, RUNS])
def test_launched_steps_are_those_without_a_graph(graphs: type[Graph], runs: int) -> None:
    here, there = pair(runs, steps_per_graph=3)
    for number in range(5):
        one, other = (rows(number, 4, runs) for _ in range(2))
        expected, got = here.update(one, 4), there.update(other, 4)
        assert {key: value.shape for key, value in got.items()} == {
            "loss_actor": (4, runs),
            "loss_value": (4, runs),
        }
        for key, value in expected.items():
            torch.testing.assert_close(got[key], value)
        torch.testing.assert_close(other["td_error"], one["td_error"])
    assert graphs.launched == 2 * 4  # those of 3 steps and of 1, but for the first time
    assert_same_weights(here, there)


def test_runs_that_are_idle_stay_as_they_are(graphs: type[Graph]) -> None:
    here, there = pair(optimizer=RunsAdam)
    for number, idle in enumerate([[1], [], [], [], [0, 2], []]):
        here.update(rows(number, 2), 2, idle=idle)
        there.update(rows(number, 2), 2, idle=idle)
    assert graphs.launched == 3
    assert_same_weights(here, there)


def test_another_learning_rate_is_recorded_anew(graphs: type[Graph]) -> None:
    here, there = pair()
    for number in range(8):
        for learner in (here, there):
            learner.optimizer.param_groups[0]["lr"] = 1e-2 if number < 4 else 1e-3
            learner.update(rows(number, 1))
    assert graphs.launched == 6
    assert_same_weights(here, there)


@pytest.mark.parametrize("make", NOISY)
def test_random_numbers_go_on_in_graphs(graphs: type[Graph], make: Callable[..., LossModule]) -> None:
    here, there = LossLearner(**parts(RUNS, make)), GraphLearner(**parts(RUNS, make), compile=False)
    here.optimizer.param_groups[0]["capturable"] = True
    for number in range(4):
        expected, got = here.update(rows(number, 2), 2), there.update(rows(number, 2), 2)
        for key, value in expected.items():
            torch.testing.assert_close(got[key], value)
    assert graphs.launched == 3
    assert_same_weights(here, there)


@pytest.mark.usefixtures("emulation")  # a GPU would not recover from it
def test_steps_that_wait_for_a_number_are_refused() -> None:
    learner = GraphLearner(**parts(1), compile=False)
    step = learner._step

    def waits(batch: TensorDictBase) -> Any:
        assert float(batch["next", "reward"].sum()) <= 0
        return step(batch)

    learner._step = waits
    learner.update(rows(0, 1, 1))
    with pytest.raises(
        RuntimeError, match=r"recorded as a CUDA graph: operation not permitted .*compile=never"
    ):
        learner.update(rows(1, 1, 1))


@pytest.mark.usefixtures("emulation")
def test_what_cannot_be_recorded_is_one_line() -> None:
    own = parts(1)
    assert why_not_recorded(own["loss"], own["target"]) is None
    own["target"] = make_target_updater(own["loss"], tau=0.0, hard_interval=5)
    with pytest.raises(ValueError, match="recorded: targets that are copied in some steps only, by a HardUp"):
        GraphLearner(**own)
    with pytest.raises(ValueError, match="cannot be recorded: networks on cpu; use LossLearner"):
        GraphLearner(**parts(1, device="cpu"))


@pytest.mark.usefixtures("emulation")
def test_the_emulation_refuses_to_wait_and_leaves_what_was_there() -> None:
    value = torch.ones(2)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        value.mul_(2)
    assert value.tolist() == [1, 1]
    graph.replay()
    assert value.tolist() == [2, 2]
    with pytest.raises(CapturingError, match="a number is read"), torch.cuda.graph(graph):
        float(value.sum())
    with pytest.raises(CapturingError, match="was not registered"), torch.cuda.graph(graph):
        value.normal_(generator=torch.Generator("cpu"))


@pytest.mark.usefixtures("emulation")
def test_recorded_rows_lie_in_memory_as_those_that_were_compiled_for() -> None:
    _, learner = pair()
    seen, step = [], learner._step

    def spy(batch: TensorDictBase) -> dict[str, Tensor]:
        seen.append([value.stride() for value in batch.values(True, True)])
        return step(batch)

    learner._step = spy
    for number in range(2):  # called directly, then recorded
        learner.update(rows(number, 2)[:, ::2], 1)  # a slice, like the part of an update
    assert seen[0] == seen[1]


@pytest.mark.full
def test_compiled_steps_have_the_same_numbers() -> None:
    here, compiled = (LossLearner(**parts(RUNS, device="cpu")) for _ in range(2))
    compiled._update = torch.compile(compiled._update, backend="aot_eager")  # type: ignore[method-assign]
    for number in range(3):
        one, other = (rows(number, 2, device="cpu") for _ in range(2))
        expected, got = here.update(one, 2), compiled.update(other, 2)
        for key, value in expected.items():
            torch.testing.assert_close(got[key], value)
