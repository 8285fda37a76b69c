"""Modules of users: what they register is known, here and in the worker processes of studies."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from torchrl_her_recipes import LEARNERS, cli
from torchrl_her_recipes.config import imports
from torchrl_her_recipes.config.imports import import_modules, imported_modules
from torchrl_her_recipes.studies.jobs import Job, Outcome
from torchrl_her_recipes.studies.workers import LocalWorkers

from ..small import overrides, small
from ..studies.forked_worker import fork_workers

MODULE = '''
from dataclasses import dataclass
from torchrl_her_recipes import LEARNERS, option
from torchrl_her_recipes.config.choices.learners import TD3Config

@LEARNERS.register
@dataclass(frozen=True, kw_only=True)
class OwnConfig(TD3Config):
    """TD3 again."""
    name = "own_td3"
    stacks = False
    patience: float = option(1.0, "an option of this learner", above=0)
'''


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The name of a module in the current folder, which registers a learner."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(imports, "_imported", [])
    Path("own_learner.py").write_text(MODULE)
    yield "own_learner"
    LEARNERS.pop("own_td3", None)
    sys.modules.pop("own_learner", None)


@pytest.mark.long
def test_the_command_line_imports_before_it_reads_the_command(
    own: str, capsys: pytest.CaptureFixture[str]
) -> None:
    train = ["train", "learner=own_td3", "patience=2", *overrides(epochs=1, folder="out")]
    assert cli.main(train) == 2
    assert "no option 'patience'" in capsys.readouterr().err
    assert cli.main(["--import", own, *train]) == 0
    assert "(metrics.csv, checkpoint.pt)" in capsys.readouterr().out
    assert cli.main(["--import", own, "list"]) == 0
    assert "TD3 again" in capsys.readouterr().out


def test_worker_processes_of_studies_import_them_too(
    own: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fork_workers(monkeypatch)
    import_modules([own, own])
    assert imported_modules() == [own]
    recipe = small(learner="own_td3", patience=2.0, epochs=1)
    job = Job(label="own", recipe=recipe, folder=tmp_path / "own")
    assert Job.from_plain(job.to_plain()) == job
    with closing(LocalWorkers(1)) as workers:
        assert workers.run(job) == Outcome()
    assert (job.folder / "metrics.csv").exists()
    Path("own_learner.py").unlink()
    with closing(LocalWorkers(1)) as workers:
        assert workers.run(job).error.startswith("ValueError: there is no module 'own_learner'")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import no_such_package", "'broken' cannot be imported: No module named 'no_such_package'"),
        ("x = (", "'broken' cannot be imported: '.' was never closed"),
        ("raise ValueError('no')", "'broken' cannot be imported: no"),
    ],
)
def test_what_cannot_be_imported_is_named(
    text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    Path("broken.py").write_text(text)
    with pytest.raises(ValueError, match=message):
        import_modules(["broken"])
    assert "broken" not in imported_modules()


def test_files_here_do_not_hide_installed_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(imports, "_imported", [])
    Path("fractions.py").write_text("raise RuntimeError")
    monkeypatch.delitem(sys.modules, "fractions", raising=False)
    import_modules(["fractions"])
    assert imported_modules() == ["fractions"]
