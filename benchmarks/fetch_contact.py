"""How often exploring moves the block of FetchPush, once the gripper is there (extra robotics).

    python benchmarks/fetch_contact.py

A scripted gripper goes to the block; then each action is what the row of the table says.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import gymnasium
import gymnasium_robotics  # noqa: F401  # registers the environments
import numpy as np
from machine import describe, publish, table

Exploration = Callable[[np.random.Generator], np.ndarray]

WAYS: dict[str, Exploration] = {
    "uniform": lambda rng: rng.uniform(-1, 1, 4),
    "uniform in every second step": lambda rng: rng.uniform(-1, 1, 4) * (rng.random() < 0.5),
    "normal, of 0.1": lambda rng: rng.normal(0, 0.1, 4),
}
_REACHED = 0.05  # m between gripper and block: the first layer's threshold
_STEPS = 50


def moved(env: gymnasium.Env, explore: Exploration, seed: int, rng: np.random.Generator) -> float:
    """How far an episode moves the block, in m."""
    shown, _ = env.reset(seed=seed)
    start, farthest, reached = shown["achieved_goal"].copy(), 0.0, False
    for _ in range(_STEPS):
        way = shown["observation"][6:9]
        reached = reached or bool(np.linalg.norm(way) < _REACHED)
        action = explore(rng) if reached else np.append(10 * way, 0.0) + rng.normal(0, 0.1, 4)
        shown, *_ = env.step(np.clip(action, -1, 1).astype(np.float32))
        farthest = max(farthest, float(np.linalg.norm(shown["achieved_goal"] - start)))
    return farthest


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--episodes", type=int, default=40)
    options = parser.parse_args()
    env, rng = gymnasium.make("FetchPush-v4"), np.random.default_rng(0)
    rows = []
    for name, explore in WAYS.items():
        ways = np.array([moved(env, explore, 1000 + episode, rng) for episode in range(options.episodes)])
        rows.append([name, f"{(ways > 0.01).mean():.0%}", f"{(ways > 0.05).mean():.0%}"])
    header = ["actions at the block", "block moved by 1 cm", "by 5 cm"]
    publish(describe("gymnasium-robotics", "mujoco") + "\n\n" + table(header, rows), None)


if __name__ == "__main__":
    main()
