"""Recipes on other devices: tried on an emulated one, and on a GPU where there is one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.overrides import TorchFunctionMode

from torchrl_her import FusedLearner, LossLearner, load_checkpoint
from torchrl_her.trainers import GraphLearner
from torchrl_her_recipes import Components, Recipe, build, cli, load_policy, resume, run
from torchrl_her_recipes.components.devices import Devices, devices_of

from ...emulated import emulated_device
from ...emulated_graphs import emulated_graphs
from ..small import Refused, assert_same, overrides, small, stop_after

CURRICULUM = {
    "task": "hand_v1",
    "algo": "cher_ibs",
    "normalize": True,
    "guided_share": 0.5,
    "window": 4,
    "success_threshold": 0.01,
}
SHORT = {"epoch_frames": 320, "warmup_frames": 80}
# On the CPU the other tests of runs show the same.
ELSEWHERE = pytest.mark.parametrize(
    "device", ["emulated", "cuda", pytest.param("cpu", marks=pytest.mark.full)], indirect=True
)


@pytest.fixture
def name(request: pytest.FixtureRequest, device: torch.device) -> Iterator[str]:
    with emulated_graphs() if request.node.callspec.params["device"] == "emulated" else nullcontext():
        yield device.type


def places(components: Components) -> tuple[set[str], set[str]]:
    """Where the parts of the learner are, and those of the buffer."""
    learner = [*components.loss.parameters(), *components.policy.parameters(), *components.policy.buffers()]
    for state in components.optimizer.state.values():
        learner += [value for value in state.values() if value.ndim]
    rows: TensorDictBase = components.buffer.storage[:]
    replay = {own.device.type for own in rows.values(True, True)}
    return {own.device.type for own in learner}, replay | {components.buffer.sampler.device.type}


@ELSEWHERE
@pytest.mark.parametrize("options", [{"epochs": 1}, CURRICULUM], ids=["filtered_her", "curriculum"])
@pytest.mark.parametrize(("learner", "replay"), [("here", "there"), ("there", "here"), ("there", "there")])
def test_each_part_is_where_it_should_be(
    options: dict[str, Any], learner: str, replay: str, name: str
) -> None:
    at = {"here": "cpu", "there": name}
    devices = {"learner.device": at[learner], "replay.device": at[replay]}
    recipe = small(num_runs=2, **options, **SHORT, **devices)
    components = build(recipe)
    result = run(components, progress=False)
    assert places(components) == ({at[learner]}, {at[replay]})
    assert len(result.rows) == 2 * recipe.run.epochs
    assert components.eval_env.reset()["observation"].device.type == "cpu"


@ELSEWHERE
@pytest.mark.parametrize("learner", ["td3", "sac", "redq", "tqc"])
def test_every_learner(learner: str, name: str) -> None:
    components = build(small(learner=learner, epochs=1, **SHORT, **{"learner.device": name}))
    run(components, progress=False)
    assert places(components) == ({name}, {name})


@ELSEWHERE
@pytest.mark.parametrize(
    "options",
    [{"task": "bit_flip", "task.options": {"bits": 4, "useless_action": True}}, {"task": "treasure_hunt"}],
    ids=["bit_flip", "treasure_hunt"],
)
def test_dqn(name: str, options: dict[str, Any]) -> None:
    components = build(small(epochs=1, **options, **SHORT, **{"learner.device": name}))
    run(components, progress=False)
    assert places(components)[0] == {name}


@ELSEWHERE
def test_a_run_goes_on_in_the_middle_of_an_epoch(
    name: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if name == "cuda":  # where sums have no fixed order otherwise
        torch.use_deterministic_algorithms(True)
        request.addfinalizer(lambda: torch.use_deterministic_algorithms(False))
    options = {**CURRICULUM, **SHORT, "num_runs": 2, "compile": "never", "learner.device": name}
    recipe = small(epochs=2, seed=2, epsilon_start=1.0, **options)  # of which a run comes to the second stage
    whole = run(build(recipe), tmp_path / "whole", progress=False)
    components = build(recipe)
    stop_after(components, 6)
    assert run(components, tmp_path / "parts", progress=False).interrupted
    stages = load_checkpoint(tmp_path / "parts" / "checkpoint.pt")["guide"]["stage"]
    assert 0 in stages.tolist()  # so that guided episodes went on
    again = resume(tmp_path / "parts", progress=False)
    assert [row["success"] for row in again.rows] == [row["success"] for row in whole.rows]
    ends = [load_checkpoint(tmp_path / own / "checkpoint.pt")["loss"] for own in ("whole", "parts")]
    assert_same(*ends)


@ELSEWHERE
def test_policies_are_played_without_the_device(name: str, tmp_path: Path) -> None:
    run(build(small(epochs=1, **{"learner.device": name})), tmp_path / "run", progress=False)
    assert {own.device.type for own in load_policy(tmp_path / "run").parameters()} == {"cpu"}


def test_steps_are_compiled_for_their_device(name: str) -> None:
    for choice in ("auto", "always"):
        learner = build(small(compile=choice, **{"learner.device": name})).learner()
        assert type(learner) is (FusedLearner if name == "cpu" else GraphLearner)
    assert type(build(small(compile="never", **{"learner.device": name})).learner()) is LossLearner
    hard = small(hard_update_interval=5, **{"learner.device": name})
    assert type(build(hard).learner()) is (FusedLearner if name == "cpu" else LossLearner)
    small_steps = build(small(**{"learner.device": "auto"})).learner()
    assert isinstance(small_steps, FusedLearner)


class Waits(TorchFunctionMode):
    """Notes where numbers are read from the device, for which a program has to wait."""

    names = ("__bool__", "__float__", "__int__", "__index__", "item", "tolist", "nonzero", "cpu", "numpy")
    reading = (*(getattr(Tensor, name) for name in names), torch.masked_select, torch.unique, torch.bincount)

    def __init__(self) -> None:
        super().__init__()
        self.found: list[Any] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in self.reading and args[0].device.type == "cuda":
            self.found.append(func)
        return func(*args, **(kwargs or {}))


def test_gradient_steps_do_not_wait_for_the_device() -> None:
    with emulated_device() as there, emulated_graphs():
        trainer = build(small(num_runs=2, algo="her", **{"learner.device": there.type})).trainer()
        trainer.run(400)
        waits = {}
        for steps in (2, 2, 16, 16):  # the first time, kernels are recorded
            with Waits() as own:
                trainer._learn_from([], steps)
            waits[steps] = own.found
        assert len(waits[2]) == len(waits[16]) == 9


def devices_asked_for(recipe: Recipe) -> Devices:
    return devices_of(recipe.learner, recipe.replay, recipe.run.num_runs)


def test_the_replay_is_where_the_learner_is_if_nothing_else_is_asked_for(name: str) -> None:
    assert {own.type for own in devices_asked_for(small(**{"learner.device": name}))} == {name}


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_auto_is_the_cpu_where_there_is_no_gpu() -> None:
    large = small(num_runs=50, hidden=256, **{"learner.device": "auto"})
    assert {own.type for own in devices_asked_for(large)} == {"cpu"}


def test_what_auto_took_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = overrides(epochs=1, folder=tmp_path / "run")
    assert cli.main(["train", *options, "learner.device=auto"]) == 0
    assert "learner.device=auto: cpu\n" in capsys.readouterr().out


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize(
    ("option", "line"),
    [
        ("learner.device=cuda", "torchrl-her: learner.device=cuda is not available: "),
        ("replay.device=cuda:3", "torchrl-her: replay.device=cuda:3 is not available: "),
        ("learner.device=gpu", "torchrl-her: learner.device must be auto, cpu, or a device such as cuda or "),
        ("replay.device=auto", "torchrl-her: replay.device must be learner, cpu, or a device such as cuda "),
        ("learner.device=meta", "torchrl-her: learner.device=meta is not available: "),
    ],
)
def test_what_is_not_there_is_said_in_a_line(
    option: str, line: str, tmp_path: Path, refused: Refused
) -> None:
    assert refused("train", option, f"folder={tmp_path / 'run'}").startswith(line)
