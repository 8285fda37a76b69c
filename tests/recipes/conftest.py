"""What tests of the command line share."""

from __future__ import annotations

import pytest

from torchrl_her_recipes.cli import main

from .small import Refused


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Refused:
    """``refused("train", "seed=x")`` is the one line of a command that ends with exit code 2."""

    def call(*command: str) -> str:
        capsys.readouterr()
        assert main([*command]) == 2, command
        said = capsys.readouterr().err
        assert said.startswith("torchrl-her: ")
        assert said.count("\n") == 1, said
        return said

    return call
