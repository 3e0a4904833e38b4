"""Every notebook runs and asserts its own numbers; committed are its outputs, and no traces of a machine.

By default the longest cells have smaller settings, the same assertions though, and all runs in this process, the
commands of notebook 9 too; `-m slow` runs what the reader sees, each notebook in a kernel of its own.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

import pytest

from identification.effects import base

if TYPE_CHECKING:  # deferred: they take more than a second to load, in every process that collects tests
    from nbformat import NotebookNode

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LARGEST = 1_000_000  # bytes of one notebook; a forge shows larger ones slowly or not at all
HANGS = 600  # [s] after which a cell is given up; how long they may take is for the benchmark
SMALLER = {  # notebook -> what the reader sees, and what runs instead of it
    "2": [("range(4, 21)", "(4, 12, 20)")],
    "3": [
        ("tolerance=1e-4, proof=1e-4", "tolerance=1e-2, proof=1e-2"),
        ("starts=20,", "starts=8,"),
        ("(50_000, 4)", "(5_000, 4)"),
        ("animation(plan)", "animation(plan[:3], between=1, pause=1)"),
        ("range(11)", "(0, 3, 9, 10)"),
    ],
    "4": [
        ('"exchange", "ipopt", "best_of_random", "random"]', '"exchange", "random"]'),
        ("len(rows) == 8", "len(rows) == 4"),
        ("repeats=1,", "repeats=1, starts=[60],"),
    ],
    "5": [("arm, runs=30)", "arm, runs=20, starts=1, seed=1)"), ("shuffled, [150])", "shuffled, [60])")],
    "6": [
        ("range(4, 13)", "(4, 8, 10, 12)"),
        ("{5: -0.28087, 7: -0.19865, 9: -0.13103, 10: -0.14288}", "{10: -0.14288}"),
    ],
    "7": [("starts=60", "starts=10"), ("steps: int = 4000", "steps: int = 2000")],
    "9": [("--runs 30 --robust", "--runs 40 --solver random")],
}
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
            subprocess.run(command, shell=True, check=True, stdout=subprocess.DEVNULL)
"""

by_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path: Path) -> NotebookNode:
    import nbformat

    return nbformat.read(path, as_version=4)


def code_cells(notebook: NotebookNode) -> list[NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def outputs(notebook: NotebookNode) -> Iterator[NotebookNode]:
    for cell in code_cells(notebook):
        yield from cell.outputs


def test_all_nine_are_here() -> None:
    assert [path.name[0] for path in NOTEBOOKS] == list("123456789")


@by_notebook
@patch.dict("os.environ")  # notebook 9 changes it
@patch.dict(base._LIBRARY)  # notebook 7 registers an effect
def test_notebook_runs_with_smaller_settings(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from IPython.core.interactiveshell import InteractiveShell
    from IPython.utils.capture import capture_output

    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))  # not the user's
    monkeypatch.setitem(sys.modules, "__main__", sys.modules["__main__"])  # the shell puts its own there
    notebook, shell = read(path), InteractiveShell.instance()
    sys.modules["__main__"] = shell.user_module
    for shown, instead in SMALLER.get(path.name[0], ()):
        (cell,) = (cell for cell in code_cells(notebook) if shown in cell.source)
        cell.source = cell.source.replace(shown, instead)
    monkeypatch.chdir(path.parent)
    shell.reset(new_session=False)
    for source in (IN_PROCESS, *(cell.source for cell in code_cells(notebook))):
        with capture_output() as printed:
            done = shell.run_cell(source.replace("%matplotlib inline", "import matplotlib; matplotlib.use('agg')"))
        done.raise_error()
        assert not printed.stderr, "a warning in a notebook is a defect"


@pytest.mark.slow
@by_notebook
# event loop and sockets of jupyter_client, zmq and nbclient: not our code, and different in every version
@pytest.mark.filterwarnings("ignore::DeprecationWarning:(jupyter_client|nbclient|zmq|tornado|asyncio).*")
def test_notebook_runs_as_it_is(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a kernel that imports this checkout and leaves nothing in the user's folders."""
    from nbclient import NotebookClient

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")])))
    monkeypatch.setenv("PYTHONWARNINGS", "default")
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")
    for name in ("JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR", "IPYTHONDIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    notebook = read(path)
    context = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, timeout=HANGS, kernel_name="python3", resources=context).execute()
    complaints = [o.text for o in outputs(notebook) if o.output_type == "stream" and o.name == "stderr"]
    assert not complaints, "a warning in a notebook is a defect"


@by_notebook
def test_committed_notebook(path: Path) -> None:
    """It asserts its numbers, was run from top to bottom, shows a picture, is small and of no machine."""
    import nbformat

    assert path.stat().st_size < LARGEST
    notebook = read(path)
    nbformat.validate(notebook)
    cells, printed = code_cells(notebook), list(outputs(notebook))
    assert sum(len(re.findall(r"^ *assert ", cell.source, re.MULTILINE)) for cell in cells) >= 5
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert "image/png" in {kind for output in printed for kind in output.get("data", {})}, "without a picture"
    assert not [o for o in printed if o.output_type == "error" or o.get("name") == "stderr"]
    assert set(notebook.metadata) <= {"kernelspec", "language_info"}
    assert all(cell.metadata == {} for cell in notebook.cells)
    words = [cell.source for cell in notebook.cells]
    words += [o.get("text") or o.get("data", {}).get("text/plain", "") for o in printed]
    assert not re.search(r"/(home|tmp|root|work|usr|Users|opt)/|[A-Z]:\\|object at 0x", "\n".join(words))
    # an exported page shows LaTeX only with MathJax, which it takes from the network
    shown = [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]
    shown += [output.data["text/markdown"] for output in printed if "text/markdown" in output.get("data", {})]
    assert not re.search(r"\$[^$]+\$|\\\\[\[(]", "\n".join(shown))
