"""Mutation tests: arithmetic of the mathematics changed, each time in a copy of the tree, and the tests must notice.

`python -m tests.mutation --sample 40` takes 40 mutants of each module at random (seed 0), runs the tests of that module
on each, and prints how many were noticed and which were not. It needs cosmic-ray (`pip install -e '.[mutation]'`).
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).parents[1]
SEED = 0
ESTIMATION = "tests/identification/estimation"
TESTED = {  # module -> tests that must notice
    "identification/information.py": ["tests/identification/test_information.py"],
    "identification/kinematics/chain.py": [
        *("tests/identification/kinematics", "tests/identification/model"),
        *(f"{ESTIMATION}/test_{name}.py" for name in ("estimate", "batch")),
    ],
    "identification/levenberg_marquardt.py": ["tests/identification/test_levenberg_marquardt.py"],
    "identification/estimation/uncertainty.py": [
        *(f"{ESTIMATION}/test_{name}.py" for name in ("uncertainty", "outlying")),
        "tests/identification/gap/test_confirmation.py",
    ],
    "identification/estimation/estimate.py": [f"{ESTIMATION}/test_estimate.py", f"{ESTIMATION}/test_prior.py"],
    "identification/estimation/problem.py": [f"{ESTIMATION}/test_prior.py", f"{ESTIMATION}/test_contradictions.py"],
    "identification/gap/likelihood.py": [
        *("tests/identification/gap/test_likelihood.py", "tests/identification/gap/test_average.py")
    ],
    "identification/gap/search.py": ["tests/identification/gap/test_search.py"],
    "doe/bounds/planar_theorem.py": ["tests/doe/bounds/test_planar_theorem.py"],
    "doe/bounds/certificate.py": [
        *("tests/doe/bounds/test_certificate.py", "tests/doe/bounds/test_column_generation.py")
    ],
    "doe/criteria.py": ["tests/doe/criteria"],
}
# arithmetic for other arithmetic, numbers, comparisons, logic; not what raises at once (shifts), nor annotations
KINDS = re.compile(
    r"core/(Number|ReplaceAnd|ReplaceOr|ReplaceTrue|ReplaceFalse|ReplaceUnary|ZeroIteration|ReplaceBreak|ReplaceContinue"
    r"|ReplaceBinaryOperator_(Add|Sub|Mul|Div|Pow)_(Add|Sub|Mul|Div)"
    r"|ReplaceComparisonOperator_(Lt|LtE|Gt|GtE|Eq|NotEq)_(Lt|LtE|Gt|GtE|Eq|NotEq))"
)
CONFIGURATION = """[cosmic-ray]
module-path = "{module}"
timeout = 120.0
excluded-modules = []
test-command = "{python} -B -m pytest -q -x -p no:cacheprovider {tests}"
[cosmic-ray.distributor]
name = "local"
"""


def noticed(module: str, sample: int) -> tuple[int, list[str]]:
    """How many mutants of a module were tried, and those that its tests let pass."""
    with tempfile.TemporaryDirectory() as folder:
        tree, session = Path(folder) / "tree", str(Path(folder) / "session.sqlite")
        hidden = shutil.ignore_patterns(".*", "__pycache__", "notebooks")
        shutil.copytree(ROOT, tree, ignore=hidden)
        text = CONFIGURATION.format(module=module, python=sys.executable, tests=" ".join(TESTED[module]))
        (tree / "session.toml").write_text(text)
        environment = os.environ | {"PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"}
        cosmic = [sys.executable, "-m", "cosmic_ray.cli"]
        for verb in ("init", "exec"):
            subprocess.run([*cosmic, verb, "session.toml", session], cwd=tree, env=environment, check=True)
            if verb == "init":
                take(session, sample)
        dump = subprocess.run([*cosmic, "dump", session], cwd=tree, check=True, capture_output=True, text=True).stdout
    pairs = [json.loads(line) for line in dump.splitlines()]
    passed = [item["mutations"][0] for item, result in pairs if result and result["test_outcome"] == "survived"]
    return len(pairs), [f"{m['start_pos'][0]}: {m['operator_name'].removeprefix('core/')}" for m in passed]


def take(session: str, sample: int) -> None:
    """Keeps so many of a session's mutants."""
    place = "start_pos_row, start_pos_col, operator_name, occurrence, operator_args"
    with sqlite3.connect(session) as table:
        rows = table.execute(f"select job_id, operator_name from mutation_specs order by {place}").fetchall()
        jobs = [job for job, name in rows if KINDS.match(name)]
        kept = set(random.Random(SEED).sample(jobs, min(sample, len(jobs))))
        dropped = [(job,) for job, _ in rows if job not in kept]
        for name in ("mutation_specs", "work_items"):
            table.executemany(f"delete from {name} where job_id = ?", dropped)


def main() -> None:
    """Prints a row for each module, and the mutants that lived."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sample", type=int, default=40)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("modules", nargs="*", default=list(TESTED))
    options = parser.parse_args()
    print("| module | mutants | noticed |\n|---|---|---|")
    with ThreadPoolExecutor(options.workers) as pool:
        found = pool.map(lambda module: noticed(module, options.sample), options.modules)
        for module, (tried, passed) in zip(options.modules, found, strict=True):
            print(f"| `{module}` | {tried} | {tried - len(passed)} |", flush=True)
            for line in passed:
                print(f"  {module}:{line}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
