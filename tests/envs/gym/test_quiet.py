"""What is printed while environments are made."""

from __future__ import annotations

import os

import pytest

from torchrl_her_envs import make_gym_env


@pytest.mark.parametrize("parallel", [False, True])
def test_lines_of_simulators_are_left_out_and_those_of_python_are_not(
    parallel: bool, capfd: pytest.CaptureFixture[str]
) -> None:
    make_gym_env("tests.envs.gym.loud:tests/Loud-v0", num_envs=2, parallel=parallel).close()
    os.write(1, b"afterwards\n")
    printed = capfd.readouterr().out.splitlines()
    assert set(printed) == {"the user's own line", "afterwards"}
    assert len(printed) >= 4  # one for each environment and for the one that is tried
