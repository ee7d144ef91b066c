"""Runs the notebooks anew and stores what they print and draw: `make notebooks`."""

from __future__ import annotations

from pathlib import Path

import nbformat
from jupyter_client.kernelspec import KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient

HERE = Path(__file__).parent
PYTHON = {"name": "python3", "display_name": "Python 3", "language": "python"}
TIMEOUT_S = 300


def executed(path: Path) -> nbformat.NotebookNode:
    """Run a notebook from its folder, in a fresh kernel of this very Python, whatever kernels the user has installed.

    Raises nbclient.exceptions.CellExecutionError where a cell fails.
    """
    notebook = nbformat.read(path, as_version=4)
    kernel = AsyncKernelManager(kernel_name="python3", kernel_spec_manager=KernelSpecManager(kernel_dirs=[]))
    where = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, km=kernel, timeout=TIMEOUT_S, record_timing=False, resources=where).execute(
        cleanup_kc=True
    )
    notebook.metadata = nbformat.from_dict({"kernelspec": PYTHON})  # nothing of this machine
    return notebook


if __name__ == "__main__":
    for each in sorted(HERE.glob("*.ipynb")):
        nbformat.write(executed(each), each)
