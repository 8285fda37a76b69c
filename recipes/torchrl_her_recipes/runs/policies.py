"""Trained policies as files: exported from runs, and those that come with the package."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_her.trainers.checkpoint import load_checkpoint
from torchrl_her_recipes.config.plain_files import reason
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.shipped import TRAINED, policy_names
from torchrl_her_recipes.runs.exported.card import PolicyCard
from torchrl_her_recipes.runs.exported.network import load_network
from torchrl_her_recipes.runs.exported.of_run import read_run
from torchrl_her_recipes.runs.exported.onnx_file import SUFFIX, read_onnx
from torchrl_her_recipes.runs.exported.onnx_policy import OnnxPolicy
from torchrl_her_recipes.runs.kept import KeptPolicy

_Made = TypeVar("_Made")


@dataclass(frozen=True)
class TrainedPolicy:
    """A greedy policy, what it expects, and what made it.

    Attributes:
        card: what it reads and writes, its task and its success.
        actor: reads ``observation`` and ``desired_goal``, writes ``action``.
        recipe: of the run; its seed is that of this very policy. Its task may be a harder one.
    """

    card: PolicyCard
    actor: TensorDictModuleBase
    recipe: Recipe

    @property
    def task(self) -> str:
        """That it is for."""
        return self.card.task

    @property
    def success(self) -> float:
        """In 1,000 episodes of its task, with starts and goals that no training has seen."""
        return self.card.success

    @property
    def frames(self) -> int:
        """Environment steps that it was trained for."""
        return self.card.frames


def load_trained(name: str | Path) -> TrainedPolicy:
    """A policy that comes with the package, or one that was exported, with what made it.

    Nothing is imported here, and nothing of the file is executed. A policy's task may name a module, however,
    and its environments can only be made where that module may be imported.

    Args:
        name: of a task, or the path of a .pt or .onnx file.

    Raises:
        ValueError: there is no such policy, or the file is damaged or holds something else.
        ImportError: a .onnx file needs the extra ``onnx``.
    """
    path = _path_of(name)
    if path.suffix == SUFFIX:
        file = read_onnx(path)
        policy = TrainedPolicy(file.card, _named(path, OnnxPolicy, file), file.recipe)
    else:
        policy = _named(path, _policy_of, _read(path))
    return policy


def read_card(name: str | Path) -> PolicyCard:
    """What a policy expects and what made it, without making its network.

    Args:
        name: of a task, or the path of a .pt or .onnx file.

    Raises:
        ValueError: there is no such policy, or the file is damaged or holds something else.
        ImportError: a .onnx file needs the extra ``onnx``.

    Example:
        >>> read_card("robot_v1").expects()
        'observation [15], desired_goal [2] and action [3]'
    """
    path = _path_of(name)
    return read_onnx(path).card if path.suffix == SUFFIX else _named(path, _card_of, _read(path))


def load_policy(name: str | Path, *, run: int | None = None, best: bool = False) -> TensorDictModuleBase:
    """The greedy policy of a task, trained: reads ``observation`` and ``desired_goal``, writes ``action``.

    Nothing is imported for a file, whatever module its task names: it is weights alone. For a run,
    environments of its task are made. A policy of a .onnx file is played by onnxruntime, and cannot be
    trained further.

    Args:
        name: of a task, the path of a .pt or .onnx file that :func:`export_policy` wrote, or the folder of a
            run, or ``policy.pt`` or ``best.pt`` in it.

    Keyword Args:
        run: which one, of several side by side in a folder; the median of them if None.
        best: whether to take the best policy of the folder: that of the evaluation with the best median
            success.

    Raises:
        ValueError: there is no such policy, the file is damaged, ``best`` without the folder of a run, or the
            run's task names a module that must not be imported.
        ImportError: a .onnx file needs the extra ``onnx``.
        OSError: the run has not saved a policy yet.
    """
    kept = KeptPolicy.of(name, best=best)
    if kept is not None:
        return policy_of_run(kept, run)[0].actor
    return load_trained(name).actor


def policy_of_run(kept: KeptPolicy, run: int | None) -> tuple[TrainedPolicy, dict[str, Tensor]]:
    """A policy that a run kept, and its weights; its success is not measured.

    Args:
        kept: the file in the folder of the run.
        run: which one, of several side by side; the median of them if None.

    Raises:
        ValueError: as for :func:`load_policy`.
        OSError: the run has not saved a policy yet.
    """
    found = read_run(kept, run)
    try:
        network = load_network(found.card, found.recipe, found.weights)
    except ValueError as error:
        learner = found.recipe.learner.name
        raise ValueError(
            f"a policy of learner={learner} in {kept.home.path} cannot be exported: {error}"
        ) from error
    return TrainedPolicy(found.card, network, found.recipe), found.weights


def read_weights(name: str | Path) -> dict[str, Tensor]:
    """The weights of a policy's .pt file, or of one that comes with the package.

    Raises:
        ValueError: there is no such policy, or the file is damaged or holds something else.
    """
    return dict(_read(_path_of(name))["actor"])


def _path_of(name: str | Path) -> Path:
    path = TRAINED / f"{name}.pt" if str(name) in policy_names() else Path(name)
    if not path.is_file():
        if path.suffix or len(path.parts) > 1:
            raise ValueError(f"there is no file {path}")
        raise ValueError(f"there is no policy {str(name)!r}; there are {', '.join(policy_names())}")
    return path


def _read(path: Path) -> dict[str, Any]:
    """What a .pt file holds."""
    state = load_checkpoint(path)
    if not isinstance(state, dict) or not {"actor", "recipe"} <= set(state):
        raise ValueError(
            f"{path} is no exported policy: `torchrl-her export RUN` writes one of a run's folder"
        )
    return state


def _named(path: Path, make: Callable[..., _Made], value: object) -> _Made:
    """Makes something of a file's content; what is wrong with it is said in one line that names the file."""
    try:
        return make(value)
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise ValueError(f"{path} is no exported policy: {reason(error)}") from error


def _policy_of(state: dict[str, Any]) -> TrainedPolicy:
    card, recipe = _card_of(state), Recipe.of_file(state["recipe"])
    return TrainedPolicy(card, load_network(card, recipe, state["actor"]), recipe)


def _card_of(state: dict[str, Any]) -> PolicyCard:
    if "card" not in state:
        raise ValueError(
            "an older version wrote it, without a card: train it again, or play it with that version"
        )
    return PolicyCard.from_dict(state["card"])
