"""Every notebook runs and asserts its own numbers; committed are its outputs, and no traces of a machine.

By default the longest cells have smaller settings, the same assertions though, notebooks share a kernel that has
imported the packages, and notebook 9 calls its commands in that process; `-m slow` runs what the reader sees, each
notebook in a kernel of its own and each command in a process of its own.
"""

from __future__ import annotations

import asyncio
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:  # deferred: they take more than a second to load, in every process that collects tests
    from jupyter_client import AsyncKernelManager
    from nbformat import NotebookNode

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LARGEST = 1_000_000  # bytes of one notebook; a forge shows larger ones slowly or not at all
HANGS = 600  # [s] after which a cell is given up; how long they may take is for the benchmark
SMALLER = {  # notebook -> what the reader sees, and what runs instead of it
    "2": [("figure_2(5_000)", "figure_2(5_000, runs=(4, 12, 20))")],
    "3": [
        ("tolerance=1e-4", "tolerance=1e-2"),
        ("(50_000, 4)", "(5_000, 4)"),
        ("between=4, pause=2", "between=1, pause=1"),
        ("range(11)", "(0, 3, 9, 10)"),
    ],
    "4": [
        ('"exchange_ipopt", "ipopt", "exchange", "best_of_random", "random"]', '"exchange_ipopt", "random"]'),
        ("len(rows) == 10", "len(rows) == 4"),
        ("repeats=1,", "repeats=1, starts=[10],"),
    ],
    "5": [("arm, runs=30)", "arm, runs=20, starts=1)"), ("shuffled, [150])", "shuffled, [120])")],
    "6": [
        ("range(4, 13)", "(4, 7, 8, 10, 12)"),
        ("{5: -0.28087, 6: -0.29680, 7: -0.19865, 9: -0.13103, 10: -0.14288}", "{7: -0.19865, 10: -0.14288}"),
    ],
    "7": [("starts=60", "starts=10")],
    "9": [("--runs 30 --robust", "--runs 40 --solver random")],
}
OWN_KERNEL = "79"  # they register effects, or change the environment
IN_PROCESS = """
import shlex, subprocess
from click.testing import CliRunner
from IPython.core.magic import register_cell_magic
from doe.cli import main

@register_cell_magic
def sh(line, cell):
    for command in cell.splitlines():
        if command.startswith("armcal"):
            done = CliRunner().invoke(main, shlex.split(command.partition("|")[0])[1:], catch_exceptions=False)
            assert (done.exit_code == 0 or "||" in command) and not done.stderr, done.output
        else:
            subprocess.run(command, shell=True, check=True)
"""

by_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


@pytest.fixture(scope="module")
def shared_kernel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AsyncKernelManager]:
    """A kernel that imports this checkout and leaves nothing in the user's folders; its settings hold for others too.

    The first notebook starts it.
    """
    paths, folder = [str(ROOT), os.environ.get("PYTHONPATH", "")], tmp_path_factory.mktemp("jupyter")
    with pytest.MonkeyPatch.context() as settings:
        settings.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
        settings.setenv("PYTHONWARNINGS", "default")
        settings.setenv("JUPYTER_PLATFORM_DIRS", "1")
        for name in ("JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR", "IPYTHONDIR"):
            settings.setenv(name, str(folder / name.lower()))
        for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
            settings.setenv(name, "1")
        from jupyter_client import AsyncKernelManager

        kernel = AsyncKernelManager(kernel_name="python3")
        yield kernel
        if kernel.has_kernel:
            asyncio.run(kernel.shutdown_kernel(now=True))


def read(path: Path) -> NotebookNode:
    import nbformat

    return nbformat.read(path, as_version=4)


def smaller_form(notebook: NotebookNode, name: str) -> None:
    """Puts the smaller settings into the notebook of this number, before them a cell that empties a shared kernel."""
    for shown, instead in SMALLER.get(name, ()):
        (cell,) = (cell for cell in code_cells(notebook) if shown in cell.source)
        cell.source = cell.source.replace(shown, instead)
    import nbformat

    notebook.cells.insert(0, nbformat.v4.new_code_cell(IN_PROCESS if name in OWN_KERNEL else "%reset -f"))


def execute(path: Path, kernel: AsyncKernelManager | None = None, smaller: bool = False) -> NotebookNode:
    """The notebook with fresh outputs. Raises `CellExecutionError` where a cell fails, an assertion say."""
    from nbclient import NotebookClient

    notebook = read(path)
    if smaller:
        smaller_form(notebook, path.name[0])
    context = {"metadata": {"path": str(path.parent)}}
    client = NotebookClient(notebook, km=kernel, timeout=HANGS, kernel_name="python3", resources=context)
    try:
        client.execute()
    finally:  # sockets that stay open fail a later test
        if kernel and client.kc:
            client.kc.stop_channels()
    return notebook


def code_cells(notebook: NotebookNode) -> list[NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def outputs(notebook: NotebookNode) -> Iterator[NotebookNode]:
    for cell in code_cells(notebook):
        yield from cell.outputs


def test_all_nine_are_here() -> None:
    assert [path.name[0] for path in NOTEBOOKS] == list("123456789")


@pytest.mark.parametrize("smaller", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["smaller", "as it is"])
@by_notebook
# event loop and sockets of jupyter_client, zmq and nbclient: not our code, and different in every version
@pytest.mark.filterwarnings("ignore::DeprecationWarning:(jupyter_client|nbclient|zmq|tornado|asyncio).*")
def test_notebook_runs(path: Path, smaller: bool, shared_kernel: AsyncKernelManager) -> None:
    notebook = execute(path, shared_kernel if smaller and path.name[0] not in OWN_KERNEL else None, smaller)
    complaints = [o.text for o in outputs(notebook) if o.output_type == "stream" and o.name == "stderr"]
    assert not complaints, "a warning in a notebook is a defect"


@by_notebook
def test_notebook_asserts_its_numbers(path: Path) -> None:
    sources = [cell.source for cell in code_cells(read(path))]
    assert sum(len(re.findall(r"^ *assert ", source, re.MULTILINE)) for source in sources) >= 5


@by_notebook
def test_committed_notebook_was_run_from_top_to_bottom(path: Path) -> None:
    import nbformat

    notebook = read(path)
    nbformat.validate(notebook)
    assert [cell.execution_count for cell in code_cells(notebook)] == list(range(1, len(code_cells(notebook)) + 1))
    kinds = {kind for output in outputs(notebook) for kind in output.get("data", {})}
    assert "image/png" in kinds, "a notebook without a picture"
    assert not [o for o in outputs(notebook) if o.output_type == "error" or o.get("name") == "stderr"]


@by_notebook
def test_formulas_need_no_script(path: Path) -> None:
    """An exported page shows LaTeX only with MathJax, which it takes from the network."""
    notebook = read(path)
    shown = [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]
    shown += [output.data["text/markdown"] for output in outputs(notebook) if "text/markdown" in output.get("data", {})]
    assert not re.search(r"\$[^$]+\$|\\\\[\[(]", "\n".join(shown))


@by_notebook
def test_committed_notebook_is_small_and_of_no_machine(path: Path) -> None:
    assert path.stat().st_size < LARGEST
    notebook = read(path)
    assert set(notebook.metadata) <= {"kernelspec", "language_info"}
    assert all(cell.metadata == {} for cell in notebook.cells)
    words = [cell.source for cell in notebook.cells]
    words += [o.get("text") or o.get("data", {}).get("text/plain", "") for o in outputs(notebook)]
    assert not re.search(r"/(home|tmp|root|work|usr|Users|opt)/|[A-Z]:\\|object at 0x", "\n".join(words))
