"""Runs the notebooks in ``notebooks`` and writes them back with what they show.

Run it as ``python docs/make_notebooks.py``; with one or several names, it runs only these. Of what a cell
shows, text and pictures are kept, and nothing that says on which machine or when it ran. Needs the extra
``notebooks``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import nbformat
from jupyter_client import KernelManager
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parent / "notebooks"
MOST_SECONDS = 300  # for a cell
_SHOWN = ("image/png", "text/plain")  # what is kept of what a cell shows, the first of these that there is


def execute(paths: Sequence[Path], folder: Path) -> Iterator[Any]:
    """Notebooks, run one after the other as when a user runs them.

    They share a kernel, as imports take longer than most cells, but no names.

    Args:
        paths: of the notebooks.
        folder: that the kernel works in.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell raises an error.
    """
    manager = KernelManager(kernel_name="python3")
    manager.start_kernel(cwd=str(folder))
    try:
        for path in paths:
            notebook = nbformat.read(path, as_version=4)
            forget = nbformat.v4.new_code_cell("%reset -f")
            notebook.cells.insert(0, forget)
            client = NotebookClient(notebook, timeout=MOST_SECONDS, km=manager, coalesce_streams=True)
            client.execute()
            client.kc.stop_channels()
            notebook.cells.remove(forget)
            yield cleaned(notebook)
    finally:
        manager.shutdown_kernel(now=True)


def cleaned(notebook: Any) -> Any:
    """The same notebook without times, counts of executions and what is shown in other forms."""
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for cell in notebook.cells:
        cell.metadata = {}
        if cell.cell_type == "code":
            cell.execution_count = None
            cell.outputs = [_cleaned(output) for output in cell.outputs if output.get("name") != "stderr"]
    return notebook


def _cleaned(output: Any) -> Any:
    if "data" in output:
        kind = next(kind for kind in _SHOWN if kind in output.data)
        output.data = {kind: output.data[kind]}
        output.metadata = {}
    if "execution_count" in output:
        output.execution_count = None
    return output


def main() -> None:
    parser = argparse.ArgumentParser(description="Run the notebooks, and write them with what they show.")
    parser.add_argument("names", nargs="*", help="some of them (default: all)")
    parser.add_argument("--out", type=Path, default=NOTEBOOKS, help="where they go (default: in their place)")
    arguments = parser.parse_args()
    paths = [
        path for path in sorted(NOTEBOOKS.glob("*.ipynb")) if path.stem in (arguments.names or path.stem)
    ]
    with TemporaryDirectory() as folder:  # for the files that notebooks write
        for path, done in zip(paths, execute(paths, Path(folder)), strict=True):
            out = arguments.out / path.name
            out.write_text(nbformat.writes(done) + "\n")
            print(f"{out}: {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
