"""Mutation tests: arithmetic of the mathematics changed, one place at a time in a copy of the tree, which tests notice.

`python -m tests.mutation --sample 40` takes 40 mutants of each module at random (seed 0), runs the tests of that module
on each, and prints how many were noticed and which were not.
"""

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
SEED, PATIENCE = 0, 300.0  # [s]: tests that take longer notice it
TESTED = {  # module -> tests that must notice, in tests/identification and tests/doe
    "identification/information.py": "test_information.py",
    "identification/kinematics/chain.py": "kinematics model estimation/test_estimate.py",
    "identification/levenberg_marquardt.py": "test_levenberg_marquardt.py",
    "identification/estimation/uncertainty.py": ("estimation/test_uncertainty.py gap/test_confirmation.py"),
    "identification/estimation/__init__.py": "estimation/test_estimate.py estimation/test_prior.py",
    "identification/estimation/problem.py": "estimation/test_prior.py",
    "identification/gap/likelihood.py": "gap/test_likelihood.py gap/test_average.py",
    "identification/gap/search.py": "gap/test_search.py",
    "identification/effects/base.py": "effects model",
    "identification/effects/formulas.py": "effects model ../doe/studies/blind/test_simulator.py",
    **{f"identification/instruments/{k}.py": "instruments test_lengths.py" for k in ("cups", "distance", "probe")},
    "identification/instruments/base.py": "instruments",
    "doe/bounds/planar_theorem.py": "bounds/test_planar_theorem.py",
    "doe/bounds/certificate.py": "bounds/test_certificate.py bounds/test_column_generation.py",
    "doe/criteria.py": "criteria",
}
INSTEAD: dict[type, tuple[type, ...]] = {  # of operators; numbers become larger by one
    ast.Add: (ast.Sub, ast.Mult),
    ast.Sub: (ast.Add, ast.Mult),
    ast.Mult: (ast.Div, ast.Add),
    ast.Div: (ast.Mult,),
    ast.Pow: (ast.Mult,),
    ast.USub: (ast.UAdd,),
    ast.And: (ast.Or,),
    ast.Or: (ast.And,),
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.GtE),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.LtE),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
}


def changes(tree: ast.Module) -> Iterator[tuple[Any, str, Any]]:
    """Node, attribute, and what is there instead, of every change that is tried."""
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp | ast.BoolOp | ast.UnaryOp):
            yield from ((node, "op", operator()) for operator in INSTEAD.get(type(node.op), ()))
        elif isinstance(node, ast.Compare) and len(node.ops) == 1:
            yield from ((node, "ops", [operator()]) for operator in INSTEAD.get(type(node.ops[0]), ()))
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
            yield node, "value", node.value + 1  # type: ignore[operator]


def noticed(module: str, sample: int) -> tuple[int, list[str]]:
    """How many mutants of a module were tried, and those that its tests let pass."""
    tree = ast.parse((ROOT / module).read_text())
    tried = list(changes(tree))
    tried = random.Random(SEED).sample(tried, min(sample, len(tried)))
    tests = [f"tests/{module.partition('/')[0]}/{name}" for name in TESTED[module].split()]
    call = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    passed = []
    with tempfile.TemporaryDirectory() as folder:
        copy = shutil.copytree(ROOT, Path(folder) / "tree", ignore=shutil.ignore_patterns(".*", "__pycache__"))
        environment = os.environ | {"PYTHONPATH": str(copy), "OPENBLAS_NUM_THREADS": "1"}
        for node, name, instead in tried:
            before = getattr(node, name)
            setattr(node, name, instead)
            (copy / module).write_text(ast.unparse(tree))
            try:
                done = subprocess.run(call, cwd=copy, env=environment, capture_output=True, timeout=PATIENCE)
            except subprocess.TimeoutExpired:
                done = None
            if done is not None and done.returncode == 0:
                passed.append(f"{node.lineno}: {ast.unparse(node)}")
            setattr(node, name, before)
    return len(tried), passed


def main() -> None:
    """Prints a row for each module, and the mutants that lived."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sample", type=int, default=40)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("modules", nargs="*", default=list(TESTED))
    options = parser.parse_args()
    print("| module | mutants | noticed |\n|---|---|---|")
    with ThreadPoolExecutor(options.workers) as pool:
        rows = pool.map(lambda module: noticed(module, options.sample), options.modules)
        for module, (tried, passed) in zip(options.modules, rows, strict=True):
            print(f"| `{module}` | {tried} | {tried - len(passed)} |", flush=True)
            print("".join(f"  {module}:{line}\n" for line in passed), end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
