"""Executes the notebooks in a kernel of their own each; an error in a cell is an error.

python -m site_tools.notebooks [NOTEBOOK …]      (in docs/; what came out is in _build/executed)
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

DOCS = Path(__file__).resolve().parents[1]


def execute(path: Path, target: Path) -> int:
    """Runs one notebook, writes it with its outputs, and returns the number of pictures in it.

    Raises:
      CellExecutionError: a cell raised an error.
    """
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": path.parent}}).execute()
    target.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, target / path.name)
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return sum("image/png" in output.get("data", {}) for output in outputs)


def main(arguments: list[str]) -> int:
    """The command; returns the exit code."""
    paths = [Path(path) for path in arguments] or sorted((DOCS / "notebooks").glob("*.ipynb"))
    failed = False
    for path in paths:
        start = time.perf_counter()
        try:
            pictures = execute(path, DOCS / "_build" / "executed")
        except CellExecutionError as error:
            print(f"{path.name}: {error}", file=sys.stderr)
            failed = True
            continue
        seconds = time.perf_counter() - start
        print(f"{path.name}: every cell ran in {seconds:.0f} s, {pictures} pictures")
        failed |= pictures == 0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
