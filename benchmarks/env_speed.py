"""Environment steps a second, beside the same world as an ordinary gymnasium environment.

    python benchmarks/env_speed.py --out env_speed.md

All of them run in one process with one thread, take random actions that were drawn before, and reset worlds
whose episode ends. The peer (``peer_env.py``) has a pymunk space for each world. It is timed as gymnasium
makes it, by ``gymnasium.make_vec``; where it is fastest, bare and without copies in a ``SyncVectorEnv``; and
as TorchRL batches such environments, in a ``SerialEnv`` of ``GymWrapper``. Before anything is timed, paths
of both are compared.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import SyncVectorEnv, VectorEnv
from machine import describe
from peer_env import PeerEnv
from tensordict import TensorDict
from torchrl.envs import EnvBase, GymWrapper, SerialEnv

from torchrl_her_envs import TASKS, ThrowingEnv, get_task, make_env

OURS, MADE, BARE, SERIAL = "this", "gymnasium.make_vec", "bare SyncVectorEnv", "SerialEnv"
PACKAGES = ("torch", "torchrl", "pymunk", "gymnasium")
PEER_ID = "torchrl_her_benchmarks/Peer-v0"
HAND_TASKS = [name for name, task in TASKS.items() if task.effector == "hand" and task.throws]
WORLDS = (1, 16, 64, 256, 1024)
ACTIONS = 64  # batches of them, taken in turns
SAME = 1e-9  # how far apart the paths of a world may be, in shown coordinates

Step = Callable[[], object]


# The contenders: each is a function that takes one step in all of its worlds


def stepper(env: EnvBase) -> Step:
    """Steps and automatic resets of a TorchRL environment, as a collector takes them."""
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


def made_peer(task: str, worlds: int) -> Step:
    return vector_stepper(gymnasium.make_vec(PEER_ID, worlds, vectorization_mode="sync", task=get_task(task)))


def bare_peer(task: str, worlds: int) -> Step:
    # not copying observations is faster, and no disadvantage to those who use them at once
    return vector_stepper(SyncVectorEnv([lambda: PeerEnv(get_task(task))] * worlds, copy=False))


def vector_stepper(env: VectorEnv) -> Step:
    """Steps and automatic resets of a gymnasium vector environment."""
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


CONTENDERS: dict[str, Callable[[str, int], Step]] = {
    OURS: ours,
    MADE: made_peer,
    BARE: bare_peer,
    SERIAL: serial_peer,
}


PEERS = [name for name in CONTENDERS if name != OURS]
gymnasium.register(PEER_ID, entry_point=PeerEnv)


# Do they do the same?


def largest_difference(task: str, *, worlds: int = 32, steps: int = 200) -> float:
    """The largest difference between our worlds and as many peers, over all steps and all that is seen.

    Half of the balls start in flight, so that they bounce; random actions catch and throw some of them.
    """
    env = make_env(task, num_envs=worlds, dtype=torch.float64)
    env.reset()
    put_into_flight(env, worlds // 2)
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
    """Throws the balls of the first worlds."""
    state = env.world_state_dict()
    state["ball"][:count] = 0.2 + torch.rand(count, 2) * torch.tensor([2.4, 5.4], dtype=torch.float64)
    state["ball_velocity"][:count] = 20.0 * torch.rand(count, 2, dtype=torch.float64) - 10.0
    state["free"][:count] = True
    state["held"][:count] = state["closed"][:count] = False
    env.load_world_state_dict(state)


def placed_peer(task: str, env: ThrowingEnv, k: int) -> PeerEnv:
    """A peer in the state of our world k."""
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
    """Worlds stepped in a second, over about so many seconds."""
    taken, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        step()
        taken += 1
    return worlds * taken / (time.perf_counter() - start)


def measure(task: str, worlds: int, *, repeats: int, seconds: float) -> dict[str, float]:
    """The median speed of each contender, taken in turns so that a busy machine slows all of them alike."""
    steps = {name: make(task, worlds) for name, make in CONTENDERS.items()}
    for step in steps.values():
        steps_per_second(step, worlds, seconds / 2)  # warms up, and spreads the ends of the episodes
    speeds: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(repeats):
        for name, step in steps.items():
            speeds[name].append(steps_per_second(step, worlds, seconds))
    return {name: statistics.median(values) for name, values in speeds.items()}


# Report


def report(task: str, rows: dict[int, dict[str, float]], difference: float, repeats: int) -> str:
    lines = [
        f"Environment steps a second of `{task}` with random actions and automatic resets; medians of "
        f"{repeats} runs taken in turns. Same starts and actions gave paths at most {difference:.0e} apart.",
        "",
        f"{describe(*PACKAGES)}.",
        "",
        "| worlds | " + " | ".join(f"over {name}" for name in PEERS) + " | this, steps/s |",
        "| ---: |" + " ---: |" * (len(PEERS) + 1),
    ]
    for worlds, speed in rows.items():
        ratios = " | ".join(f"{speed[OURS] / speed[name]:.1f}x" for name in PEERS)
        lines.append(f"| {worlds:,} | {ratios} | {speed[OURS]:,.0f} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--task", default="hand_v1", choices=HAND_TASKS)
    parser.add_argument("--worlds", type=int, nargs="+", default=WORLDS, help="numbers of worlds")
    parser.add_argument("--repeats", type=int, default=7, help="timed runs of each")
    parser.add_argument("--seconds", type=float, default=0.3, help="length of a timed run")
    parser.add_argument("--out", type=Path, help="a Markdown file to write the table to, too")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    difference = largest_difference(options.task)
    if difference > SAME:
        raise RuntimeError(f"the peer is another world: paths of {options.task} differ by {difference:.1e}")
    rows = {
        worlds: measure(options.task, worlds, repeats=options.repeats, seconds=options.seconds)
        for worlds in options.worlds
    }
    table = report(options.task, rows, difference, options.repeats)
    print(table)
    if options.out is not None:
        options.out.write_text(table + "\n")


if __name__ == "__main__":
    main()
