"""The curriculum of each task that has one, and how far runs have come in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torchrl.envs import CatTensors, Compose, EnvBase, TransformedEnv

from torchrl_her import Curriculum, CurriculumLayer, CurriculumProgress, StateToObs, ZeroPad
from torchrl_her_envs import Chain, GoalEnv, ThrowingEnv

_STATE = ["observation", "desired_goal"]  # what the state is made of, in this order


def get_curriculum(env: GoalEnv) -> Curriculum:
    """The curriculum that comes with a task: of throwing tasks, and of the chain.

    Raises:
        ValueError: the task has none.

    Example:
        >>> from torchrl_her_envs import Chain
        >>> [layer.name for layer in get_curriculum(Chain(6, 1.0, layers=3)).layers]
        ['part 1', 'part 2', 'part 3']
    """
    if isinstance(env, ThrowingEnv):
        return throwing_curriculum(env)
    if isinstance(env, Chain):
        return chain_curriculum(env)
    raise ValueError(f"{type(env).__name__} has no curriculum: give its layers as curriculum=FILE.yaml")


def chain_curriculum(env: Chain) -> Curriculum:
    """Each part of the chain as a layer: the links of that part are to be closed."""
    links = env.length // env.layers
    return Curriculum(
        [
            CurriculumLayer(
                name=f"part {end // links}",
                observation=range(end),
                achieved_goal=range(end - links, end),
                desired_goal=range(env.length, env.length + links),
                threshold=env.threshold,
            )
            for end in range(links, env.length + 1, links)
        ],
        env.length + links,
    )


def throwing_curriculum(env: ThrowingEnv) -> Curriculum:
    """Two layers: reach the ball; then throw it into the black hole.

    The reach sees the hand or the arm and wants its grip at the ball. The throw also sees the ball,
    at the very place where the goal was before, and wants it in the hole. Goals of the reach lie where
    episodes start, so IBS weights do not apply to them.

    Raises:
        ValueError: a task without a throw is a layer by itself.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> [layer.name for layer in throwing_curriculum(make_env("hand_v1")).layers]
        ['reach', 'throw']
    """
    if not env.task.throws:
        raise ValueError(f"{env.task.name} has no curriculum: it has one layer; choose a throwing task")
    seen = env.effector.observation_size
    ball, goal = [seen, seen + 1], [seen + 4, seen + 5]
    grip = env.effector.grip_index
    layers = [
        CurriculumLayer(
            name="reach",
            observation=range(seen),
            achieved_goal=grip,
            desired_goal=ball,
            threshold=env.world.shown(env.world.ball_radius),
            instructive=False,
        ),
        CurriculumLayer(
            name="throw",
            observation=range(seen + 4),
            achieved_goal=ball,
            desired_goal=goal,
            threshold=env.threshold,
        ),
    ]
    return Curriculum(layers, seen + 6)


def read_curriculum(layers: object, env: GoalEnv) -> Curriculum:
    """A curriculum from plain values, for an environment whose state they index.

    The state is the observation with the desired goal behind it.

    Args:
        layers: a list of mappings with the options of :class:`~torchrl_her.CurriculumLayer`.
        env: tells how wide the state is.

    Raises:
        ValueError: it is no such list, or a layer that cannot be.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> env = make_env("hand_v1")
        >>> full = {"name": "all", "observation": list(range(9)), "achieved_goal": [5, 6]}
        >>> layers = [full | {"desired_goal": [9, 10], "threshold": 0.05}]
        >>> len(read_curriculum(layers, env))
        1
    """
    if not isinstance(layers, Sequence) or isinstance(layers, str):
        raise ValueError(f"curriculum must be a list of layers, got {type(layers).__name__}")
    width = sum(env.observation_spec[key].shape[-1] for key in _STATE)
    return Curriculum([_read_layer(layer) for layer in layers], width)


def _read_layer(options: Any) -> CurriculumLayer:
    try:
        return CurriculumLayer(**options)
    except TypeError as error:  # missing or unknown options, or no options at all
        raise ValueError(f"{options!r} is no layer of a curriculum: {error}") from error


@dataclass
class Climb:
    """The curriculum of some runs, and where they are in it.

    Attributes:
        progress: the layer of each run.
        layer_env: for evaluation at the layers' goals.
    """

    progress: CurriculumProgress
    layer_env: EnvBase

    @property
    def curriculum(self) -> Curriculum:
        """Its layers."""
        return self.progress.curriculum

    def at_the_top(self, run: int) -> bool:
        """Whether a run is in the last layer, which is the full task."""
        return self.progress.layers[run] == len(self.curriculum) - 1


def in_layers(env: EnvBase, progress: CurriculumProgress) -> TransformedEnv:
    """An environment as the layers of its runs see it, with the networks' input."""
    curriculum = progress.curriculum
    transforms = [StateToObs(curriculum, progress), ZeroPad(curriculum, progress)]
    if "state" not in env.observation_spec:
        transforms.insert(0, CatTensors(_STATE, "state", del_keys=False, sort=False))
    return TransformedEnv(env, Compose(*transforms))


def at_the_top(curriculum: Curriculum, runs: int) -> CurriculumProgress:
    """Progress of runs that are all in the last layer: the full task."""
    progress = CurriculumProgress(curriculum, runs=runs)
    for run in range(runs):
        progress.set_layer(run, len(curriculum) - 1)
    return progress
