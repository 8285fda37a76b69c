"""The benchmarks of training: all libraries do the work that the recipe says, and are timed alike."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from torchrl_her_envs import make_env
from torchrl_her_recipes import Recipe, load_preset, make_recipe

pytest.importorskip("stable_baselines3")

PEERS = {
    "Ours": "peers.ours",
    "OursTD3": "peers.ours",
    "TorchRLPieces": "peers.ours",
    "SB3DDPG": "peers.sb3",
    "SB3TD3": "peers.sb3",
}
BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(autouse=True)
def _benchmarks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)


@pytest.fixture
def machine() -> ModuleType:
    return import_module("machine")


def recipe(**options: Any) -> Recipe:
    """Rounds of 40 frames and 10 gradient steps."""
    base = {"task": "hand_v1", "algo": "her", "hidden": 24, "batch_size": 16, "buffer_size": 2_000}
    sizes = {"num_envs": 4, "steps_per_batch": 10, "frames_per_update": 4, "epoch_frames": 40, "episodes": 2}
    return make_recipe({**load_preset("throwing"), **base, **sizes}, **options)


def make_peer(name: str) -> Any:
    return getattr(import_module(PEERS[name]), name)(recipe())


@pytest.mark.parametrize("name", PEERS)
def test_a_peer_does_the_work_that_it_is_asked_for(name: str) -> None:
    peer = make_peer(name)
    peer.fill(240)
    assert peer.updates == 0
    assert peer.gradient_steps(10) == 10
    assert peer.loop(80) == 80
    assert peer.updates == 10 + 2 * 10


def weights(shapes: Iterable[Iterable[int]]) -> list[tuple[int, ...]]:
    """The matrices among parameters, without a dimension of runs, whichever way they multiply."""
    last = [tuple(sorted(tuple(own)[-2:])) for own in shapes]
    return [own for own in last if len(own) == 2 and 1 not in own]


# 9 numbers are observed, and 2 of a goal: of the desired one, and elsewhere of the achieved one, too.
@pytest.mark.parametrize(("name", "inputs"), [("Ours", 11), ("SB3DDPG", 13), ("SB3TD3", 13)])
def test_actors_are_as_deep_and_wide(name: str, inputs: int) -> None:
    peer = make_peer(name)
    actor = peer.trainer.collector.policy if name == "Ours" else peer.model.policy.actor
    shapes = [own.shape for own in actor.parameters()]
    assert weights(shapes) == [(inputs, 24), (24, 24), (24, 24), (3, 24)]


SBX = """
import json, sys

folder, recipe = sys.argv[1:]
sys.path.insert(0, folder)

from peers.sbx_td3 import SBXTD3
from torchrl_her_recipes import Recipe

peer = SBXTD3(Recipe.from_dict(json.loads(recipe)))
peer.fill(240)
done = [peer.updates, peer.gradient_steps(10), peer.loop(80), peer.updates]
layers = peer.model.policy.actor_state.params["params"].values()
print(json.dumps({"done": done, "shapes": [own.shape for stage in stages for own in stage.values()]}))
"""


@pytest.mark.full
@pytest.mark.skipif(find_spec("sbx") is None, reason="SBX is not installed: pip install '.[bench]'")
def test_sbx() -> None:
    """In a process of its own: one that has used JAX can no longer be forked without a warning."""
    command = [sys.executable, "-c", SBX, str(BENCHMARKS), json.dumps(recipe().to_dict())]
    child = subprocess.run(command, capture_output=True, text=True, check=True)
    told = json.loads(child.stdout.splitlines()[-1])
    assert told["done"] == [0, 10, 80, 10 + 2 * 10]
    assert weights(told["shapes"]) == [(13, 24), (24, 24), (24, 24), (3, 24)]


def test_rounds_have_whole_gradient_steps() -> None:
    baselines = import_module("peers.baselines")
    assert baselines.rounds(recipe()) == {"train_freq": (10, "step"), "gradient_steps": 10}
    with pytest.raises(ValueError, match=r"gradient steps in a round must be a whole number, got 13\.3"):
        baselines.rounds(recipe(frames_per_update=3))


def test_the_others_relabel_with_our_rewards() -> None:
    env = import_module("peers.baselines").RelabelingEnv(make_env("hand_v1", num_envs=1).task)
    achieved = torch.zeros(200, 2)
    desired = torch.linspace(0.0, 0.5, 200).unsqueeze(-1) * torch.tensor([0.6, 0.8])
    own = make_env("hand_v1", num_envs=1).compute_reward(achieved, desired).flatten()
    theirs = env.compute_reward(achieved.numpy(), desired.numpy(), None)
    assert set(theirs) == {-1.0, 0.0}
    np.testing.assert_array_equal(theirs, own.numpy())


def test_contenders_take_turns_after_a_warm_up(machine: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    now, order = [0.0], []

    def worker(name: str, seconds: list[float], pieces: int) -> Any:
        def work() -> int:
            order.append(name)
            now[0] += seconds.pop(0)
            return pieces

        return work

    monkeypatch.setitem(machine.CLOCKS, "wall", lambda: now[0])
    contenders = {"a": worker("a", [90.0, 4.0, 2.0, 8.0], 2), "b": worker("b", [90.0, 5.0, 6.0, 1.0], 1)}
    assert machine.medians(contenders, repeats=3, warm_up=1) == {"a": 2.0, "b": 5.0}
    assert "".join(order) == "abababab"


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system has no affinity of threads")
def test_all_threads_stay_on_one_core(machine: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("XLA_FLAGS", "JAX_PLATFORMS"):
        monkeypatch.setenv(name, os.environ.get(name, ""))  # as before, afterwards
    before, leave = os.sched_getaffinity(0), threading.Event()
    other = threading.Thread(target=leave.wait)
    other.start()
    try:
        with machine.one_core():
            assert os.sched_getaffinity(0) == {max(before)}
            assert os.sched_getaffinity(other.native_id) == {max(before)}
        assert os.sched_getaffinity(other.native_id) == before
    finally:
        leave.set()
        other.join()
