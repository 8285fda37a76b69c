"""Measures environment steps a second, compared with the same task as an ordinary gymnasium environment.

    python benchmarks/env_speed.py --out env_speed.md

All contenders run in one process on one core, take random actions that were drawn before, and reset
environments whose episode ends. The ordinary environment (``peers/env.py``, the "peer") has a pymunk space
of its own. It is timed three times: as ``gymnasium.make_vec`` makes it; in a ``SyncVectorEnv`` without
wrappers and copies, which is fastest; and as TorchRL batches it, in a ``SerialEnv`` of ``GymWrapper``. Our
tasks are timed in TorchRL's form (``make_env``) and in gymnasium's (``make_vec``). A second table has single
environments in gymnasium's form. Before anything is timed, paths of our environments and of the peer are
compared. For this comparison, the peer finds contacts in our order and forgets them after each step
(``exact=True``), which is slower.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import SyncVectorEnv, VectorEnv
from machine import CLOCKS, describe, medians, one_core, publish, table
from peers.env import PeerEnv
from tensordict import TensorDict
from torchrl.envs import EnvBase, GymWrapper, SerialEnv

from torchrl_her_envs import TASKS, ThrowingEnv, get_task, gym_id, make_env

OURS, MADE, BARE, SERIAL = "this", "gymnasium.make_vec", "bare SyncVectorEnv", "SerialEnv"
OURS_VECTOR = "this, make_vec"
OURS_SINGLE, SINGLE, BARE_SINGLE = "this", "gymnasium.make", "bare"
PACKAGES = ("torch", "torchrl", "pymunk", "gymnasium")
PEER_ID = "torchrl_her_benchmarks/Peer-v0"
HAND_TASKS = [name for name, task in TASKS.items() if task.effector == "hand" and task.throws]
WORLDS = (1, 16, 64, 256, 1024)
ACTIONS = 64  # number of batches of actions, which steps take in turns
CHECKED = (
    1,
    32,
)  # numbers of environments whose paths are compared: few use plain numbers, many use arrays
SAME = 1e-9  # largest difference of two paths that count as equal, in observed coordinates

Step = Callable[[], object]


# The contenders: functions that take one step in all their environments


def stepper(env: EnvBase) -> Step:
    """Returns a function that takes a step, with resets, in a TorchRL environment, as collectors do."""
    actions = [env.full_action_spec.rand()["action"] for _ in range(ACTIONS)]
    now, count = env.reset(), 0

    def step() -> None:
        nonlocal now, count
        _, now = env.step_and_maybe_reset(now.set("action", actions[count % ACTIONS]))
        count += 1

    return step


def ours(task: str, worlds: int) -> Step:
    return stepper(make_env(task, num_envs=worlds))


def serial_peer(task: str, worlds: int) -> Step:
    return stepper(SerialEnv(worlds, lambda: GymWrapper(PeerEnv(get_task(task)))))


def our_vector(task: str, worlds: int) -> Step:
    return vector_stepper(gymnasium.make_vec(gym_id(get_task(task)), worlds))


def made_peer(task: str, worlds: int) -> Step:
    return vector_stepper(gymnasium.make_vec(PEER_ID, worlds, vectorization_mode="sync", task=get_task(task)))


def bare_peer(task: str, worlds: int) -> Step:
    # faster without copies of observations, which are needed only by users who keep observations
    return vector_stepper(SyncVectorEnv([lambda: PeerEnv(get_task(task))] * worlds, copy=False))


def vector_stepper(env: VectorEnv) -> Step:
    """Returns a function that takes a step, with resets, in a gymnasium vector environment."""
    worlds = env.num_envs
    generator = np.random.default_rng(0)
    actions = generator.uniform(-1.0, 1.0, (ACTIONS, worlds, 3)).astype(np.float32)
    env.reset(seed=0)
    count = 0

    def step() -> None:
        nonlocal count
        env.step(actions[count % ACTIONS])
        count += 1

    return step


def single_stepper(env: gymnasium.Env) -> Step:
    """Returns a function that takes a step, with resets, in a single gymnasium environment."""
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (ACTIONS, 3)).astype(np.float32)
    env.reset(seed=0)
    count = 0

    def step() -> None:
        nonlocal count
        _, _, terminated, truncated, _ = env.step(actions[count % ACTIONS])
        if terminated or truncated:
            env.reset()
        count += 1

    return step


CONTENDERS: dict[str, Callable[[str, int], Step]] = {
    OURS: ours,
    OURS_VECTOR: our_vector,
    MADE: made_peer,
    BARE: bare_peer,
    SERIAL: serial_peer,
}
SINGLES: dict[str, Callable[[str], gymnasium.Env]] = {
    OURS_SINGLE: lambda task: gymnasium.make(gym_id(get_task(task))),
    SINGLE: lambda task: gymnasium.make(PEER_ID, task=get_task(task)),
    BARE_SINGLE: lambda task: PeerEnv(get_task(task)),
}
PEERS = [MADE, BARE, SERIAL]
gymnasium.register(PEER_ID, entry_point=PeerEnv)


# Comparison of paths


def largest_difference(task: str, *, worlds: int, steps: int = 200) -> float:
    """Returns the largest difference of observations, rewards and ends between our environments and peers.

    At least half of the balls start in flight, so that they bounce; random actions catch and throw some.
    """
    env = make_env(task, num_envs=worlds, dtype=torch.float64)
    env.reset()
    put_into_flight(env, (worlds + 1) // 2)
    peers = [placed_peer(task, env, k) for k in range(worlds)]
    worst = 0.0
    for _ in range(steps):
        action = 2.0 * torch.rand(worlds, 3, dtype=torch.float64) - 1.0
        after = env.step(TensorDict({"action": action}, batch_size=[worlds]))["next"]
        for k, peer in enumerate(peers):
            seen, reward, terminated, _, _ = peer.step(action[k].numpy())
            theirs = np.concatenate([seen["observation"], seen["desired_goal"], [reward, terminated]])
            mine = torch.cat([after["state"][k], after["reward"][k], after["terminated"][k]])
            worst = max(worst, float(np.abs(theirs - mine.numpy()).max()))
    return worst


def put_into_flight(env: ThrowingEnv, count: int) -> None:
    """Sets the balls of the first ``count`` environments flying."""
    state = env.world_state_dict()
    state["ball"][:count] = 0.2 + torch.rand(count, 2) * torch.tensor([2.4, 5.4], dtype=torch.float64)
    state["ball_velocity"][:count] = 20.0 * torch.rand(count, 2, dtype=torch.float64) - 10.0
    state["free"][:count] = True
    state["held"][:count] = state["closed"][:count] = False
    env.load_world_state_dict(state)


def placed_peer(task: str, env: ThrowingEnv, k: int) -> PeerEnv:
    """Makes a peer in the state of our environment k."""
    peer = PeerEnv(get_task(task), env.world, dtype=np.float64, exact=True)
    state: dict[str, Any] = {name: value[k].tolist() for name, value in env.world_state_dict().items()}
    peer.place(
        hand=state["grip"],
        hand_velocity=state["grip_velocity"],
        ball=state["ball"],
        ball_velocity=state["ball_velocity"],
        goal=state["goal"],
        held=state["held"],
    )
    return peer


# Timing


def steps_per_second(step: Step, worlds: int, seconds: float) -> float:
    """Measures environment steps a second, over about ``seconds`` seconds."""
    taken, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        step()
        taken += 1
    return worlds * taken / (time.perf_counter() - start)


def measure(
    steps: dict[str, Step], worlds: int, *, repeats: int, seconds: float, clock: str
) -> dict[str, float]:
    """Measures each contender's median speed; they take turns, so a busy machine slows all of them alike."""
    # Steps for half a second warm up, spread ends of episodes, and give the number of steps to time.
    counts = {name: steps_per_second(step, 1, 0.5) * seconds for name, step in steps.items()}

    def run(step: Step, count: int) -> int:
        for _ in range(count):
            step()
        return count * worlds

    work = {name: partial(run, step, max(1, int(counts[name]))) for name, step in steps.items()}
    return {name: 1.0 / each for name, each in medians(work, repeats=repeats, clock=clock).items()}


# Report


def batches(rows: dict[int, dict[str, float]]) -> str:
    header = ["environments", *(f"over {name}" for name in PEERS), "make_vec over make_env", "this, steps/s"]
    lines = [
        [
            f"{worlds:,}",
            *(f"{speed[OURS] / speed[name]:.2f}x" for name in PEERS),
            f"{speed[OURS_VECTOR] / speed[OURS]:.2f}x",
            f"{speed[OURS]:,.0f}",
        ]
        for worlds, speed in rows.items()
    ]
    return table(header, lines)


def singles(speed: dict[str, float]) -> str:
    peers = [SINGLE, BARE_SINGLE]
    line = [*(f"{speed[OURS_SINGLE] / speed[name]:.2f}x" for name in peers), f"{speed[OURS_SINGLE]:,.0f}"]
    return table([*(f"over the peer, {name}" for name in peers), "this, steps/s"], [line])


def report(task: str, parts: Sequence[str], difference: float, *, repeats: int, clock: str) -> str:
    timed = "" if clock == "wall" else " Times are those that the process had the core."
    return "\n\n".join(
        [
            f"Environment steps a second of `{task}` with random actions and automatic resets; medians of "
            f"{repeats} runs taken in turns. Same starts and actions gave paths at most {difference:.0e} "
            f"apart, for {' and '.join(map(str, CHECKED))} environments, beside a peer that finds contacts "
            f"in our order and forgets them after each step (`exact=True`). The peer that is timed does "
            f"neither, which is cheaper (`exact=False`): its bounces may differ.{timed}",
            f"{describe(*PACKAGES)}.",
            *parts,
        ]
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--task", default="hand_v1", choices=HAND_TASKS)
    parser.add_argument("--worlds", type=int, nargs="*", default=WORLDS, help="numbers of worlds")
    parser.add_argument("--repeats", type=int, default=7, help="timed runs of each")
    parser.add_argument("--seconds", type=float, default=0.3, help="length of a timed run")
    parser.add_argument(
        "--clock", choices=CLOCKS, default="wall", help="cpu leaves out what other work takes"
    )
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    timing = {"repeats": options.repeats, "seconds": options.seconds, "clock": options.clock}
    with one_core():
        torch.set_num_threads(1)
        torch.manual_seed(0)
        difference = max(largest_difference(options.task, worlds=worlds) for worlds in CHECKED)
        if difference > SAME:
            raise RuntimeError(
                f"paths of {options.task} in our environment and the peer differ by {difference:.1e}"
            )
        rows = {
            worlds: measure(
                {name: make(options.task, worlds) for name, make in CONTENDERS.items()}, worlds, **timing
            )
            for worlds in options.worlds
        }
        single = {name: single_stepper(make(options.task)) for name, make in SINGLES.items()}
        parts = [batches(rows), "A single environment:", singles(measure(single, 1, **timing))]
    publish(
        report(options.task, parts, difference, repeats=options.repeats, clock=options.clock), options.out
    )


if __name__ == "__main__":
    main()
