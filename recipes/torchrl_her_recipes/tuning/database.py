"""The database of a search: SQLite, which several processes may write to and which survives their death.

Optuna's file of journal lines would be the other choice. A process that is killed in the middle of a line
leaves it broken for good there, where SQLite takes the half of a transaction back.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import optuna
from optuna.exceptions import OptunaError
from optuna.pruners import BasePruner
from optuna.samplers import BaseSampler
from optuna.storages import RDBStorage
from optuna.study import Study
from sqlalchemy.exc import SQLAlchemyError

from torchrl_her.files.writing import written

_NAME = "search"
_PATIENCE = 60  # seconds that a process waits for others to write


def create_database(path: Path, first: dict[str, Any] | None) -> None:
    """Makes a database, if there is none. It appears as a whole: making it takes several transactions.

    Args:
        path: of the database.
        first: the values that the first trial is to have, if any.
    """
    if path.exists():
        return
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    with written(path) as part:
        part.unlink(missing_ok=True)
        storage = _storage(part)
        study = optuna.create_study(storage=storage, study_name=_NAME, direction="maximize")
        if first is not None:
            study.enqueue_trial(first)
        storage.engine.dispose()


@contextmanager
def load_study(
    path: Path, *, sampler: BaseSampler | None = None, pruner: BasePruner | None = None
) -> Iterator[Study]:
    """The study in a database, which is closed in the end.

    Raises:
        ValueError: the file is not the database of a search.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        storage = _storage(path, skip_table_creation=True)
        study = optuna.load_study(study_name=_NAME, storage=storage, sampler=sampler, pruner=pruner)
    except (SQLAlchemyError, OptunaError, KeyError, RuntimeError, AssertionError) as error:
        cause = error.__cause__ or error
        why = str(getattr(cause, "orig", cause)).splitlines()[0]
        raise ValueError(f"{path} is not the database of a search: {why}") from error
    try:
        yield study
    finally:
        storage.remove_session()
        storage.engine.dispose()


def _storage(path: Path, **options: Any) -> RDBStorage:
    def connect() -> sqlite3.Connection:
        return sqlite3.connect(path, timeout=_PATIENCE, check_same_thread=False)

    # Not by the address, in which some letters of a path would mean something else.
    return RDBStorage("sqlite:///search.db", engine_kwargs={"creator": connect}, **options)
