"""Each notebook takes less than a minute of one core."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
RUN = (
    "import nbformat, sys; from nbclient import NotebookClient; from pathlib import Path; path = Path(sys.argv[1]);"
    "context = {'metadata': {'path': str(path.parent)}};"
    "NotebookClient(nbformat.read(path, 4), kernel_name='python3', resources=context).execute()"
)


@pytest.mark.benchmark
def test_every_notebook_in_a_minute() -> None:
    """Processor time of the kernel and of all it starts, which other work on the machine does not change much."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    environment = {**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    seconds = {}
    for notebook in NOTEBOOKS:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(
            [sys.executable, "-c", RUN, str(notebook)], env=environment, check=True, stderr=subprocess.DEVNULL
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds[notebook.stem] = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        print(f"{notebook.stem:32} {seconds[notebook.stem]:6.1f} s of one core")
    print(f"{'all':32} {sum(seconds.values()):6.1f} s")
    assert max(seconds.values()) < 60.0
