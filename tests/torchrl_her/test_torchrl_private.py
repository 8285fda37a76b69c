"""Private names of TorchRL: each is still there, means what it did, and is read in one module alone."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler, RandomSampler, SamplerEnsemble
from torchrl.data.replay_buffers.writers import ImmutableDatasetWriter

import torchrl_her_envs
import torchrl_her_recipes
from torchrl_her import GoalReward, HERSampleUnit, torchrl_private
from torchrl_her_envs import make_env

PACKAGES = [Path(module.__path__[0]) for module in (torchrl_her_envs, torchrl_her_recipes)]
HERE = Path(torchrl_private.__file__)


def attributes(path: Path) -> set[str]:
    """Names of attributes that a file reads or writes, but for those of ``self``."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute) and not (
            isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
        ):
            names.add(node.attr)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and "attr" in node.func.id:
            names |= {each.value for each in node.args[1:2] if isinstance(each, ast.Constant)}
    return names


def test_no_other_module_reads_them() -> None:
    private = {name for name in attributes(HERE) if name.startswith("_")}
    files = [path for package in (HERE.parent, *PACKAGES) for path in package.rglob("*.py") if path != HERE]
    assert len(private) > 10
    assert {str(path): both for path in files if (both := attributes(path) & private)} == {}


@pytest.fixture
def buffer() -> TensorDictReplayBuffer:
    """Of four rows, three of them written."""
    unit = HERSampleUnit(GoalReward(0.1))
    made = TensorDictReplayBuffer(storage=LazyTensorStorage(4), sample_unit=unit, collate_fn=unit.relabel)
    made.extend(TensorDict({"x": torch.arange(3)}, [3]))
    return made


def test_what_a_storage_tells(buffer: TensorDictReplayBuffer) -> None:
    storage = buffer.storage
    assert torchrl_private.buffers_of(storage) == [buffer]
    assert torchrl_private.last_written(storage) == 2
    assert not torchrl_private.is_full(storage)
    assert torchrl_private.whole_of(storage)["x"].tolist()[:3] == [0, 1, 2]
    before = torchrl_private.revision_of(storage)
    buffer.extend(TensorDict({"x": torch.arange(1)}, [1]))
    written = torchrl_private.revision_of(storage)
    torchrl_private.count_a_write(storage)
    assert before < written < torchrl_private.revision_of(storage)
    assert torchrl_private.is_full(storage)
    torchrl_private.set_length(storage, 2)
    torchrl_private.set_last_written(storage, 1)
    assert (len(storage), torchrl_private.last_written(storage)) == (2, 1)


def test_what_the_other_parts_of_a_buffer_tell(buffer: TensorDictReplayBuffer) -> None:
    generator = torch.Generator()
    buffer.set_rng(generator)
    assert torchrl_private.generator_of(buffer.storage) is generator
    assert torchrl_private.generator_of(buffer.sampler) is generator
    unit = torchrl_private.unit_of(buffer)
    assert isinstance(unit, HERSampleUnit)
    assert torchrl_private.functions_on_batches(buffer) == [unit.relabel]
    assert torchrl_private.next_row(buffer.writer) == 3
    assert torchrl_private.next_row(ImmutableDatasetWriter()) is None
    parts = [RandomSampler(), PrioritizedSampler(8, 0.6, 0.4)]
    assert [torchrl_private.capacity_of(part) for part in parts] == [0, 8]
    assert list(torchrl_private.samplers_in(SamplerEnsemble(*parts))) == parts


def test_with_what_a_collector_goes_on() -> None:
    collector = Collector(make_env("hand_v0", num_envs=2, seed=0), frames_per_batch=4, total_frames=-1)
    collector.next()
    carrier = torchrl_private.carrier_of(collector)
    assert carrier is not None
    assert carrier.batch_size == (2,)
    other = carrier.clone()
    torchrl_private.set_carrier(collector, other)
    assert torchrl_private.carrier_of(collector) is other
    before = collector.state_dict()["traj_pool"]
    torchrl_private.set_next_ids(collector, {**before, "traj_id": before["traj_id"] + 7})
    assert collector.state_dict()["traj_pool"] != before
    collector.shutdown()


def test_keyword_arguments_of_a_module() -> None:
    plain = TensorDictModule(torch.nn.Linear(1, 1), in_keys=["x"], out_keys=["y"])
    named = TensorDictModule(torch.add, in_keys={"x": "input", "y": "other"}, out_keys=["z"])
    assert not torchrl_private.has_keyword_arguments(plain)
    assert torchrl_private.has_keyword_arguments(named)
