"""The house: imports go down only, files stay readable, no other visible top-level name, CI runs the README."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest

import identification

ROOT = Path(__file__).parents[1]

# layer of every module or package; a deeper name overrides its package
LAYERS = {
    "identification.arrays": 0,
    "identification.errors": 0,
    "identification.running": 0,
    "identification.document": 0,
    "identification.documents.identification": 5,
    "identification.documents.diagnosis": 6,
    "identification.documents": 2,
    "identification.documents.pictures": 6,
    "identification.files": 1,
    "identification.kinematics": 1,
    "identification.kinematics.frames": 1,
    "identification.kinematics.parameters": 1,
    "identification.instruments": 1,
    "identification.arm": 1,
    "identification.workspace": 1,
    "identification.error_curve": 1,
    "identification.newton_ascent": 1,
    "identification.effects": 2,
    "identification.conditions": 2,
    "identification.measurements": 2,
    "identification.files.schema": 2,
    "identification.files.arm": 2,  # knows the effects an arm file names
    "identification.files.measurement": 2,
    "identification.files.first_files": 2,
    "identification.vectorize": 0,
    "identification.model": 3,
    "identification.information": 1,
    "identification.simulate": 4,
    "identification.estimation": 5,
    "identification.inspection.readings": 5,
    "identification.origin": 5,
    "identification.compensate": 6,
    "identification.reuse": 6,
    "identification.workflow": 8,
    "identification.campaign": 9,
    "identification.sessions": 5,
    "identification.validate": 6,
    "identification.gap": 6,
    "identification.for_design": 7,
    "identification.inspection": 5,
    "identification.inspection.inspection": 7,
    "doe.criteria": 11,
    "doe.jobs": 11,
    "doe.problem": 12,
    "doe.plan": 12,
    "doe.bounds": 13,
    "doe.design": 13,
    "doe.solvers": 14,
    "doe.discrimination": 15,
    "doe.cross_check": 15,
    "doe.advise": 15,
    "doe.report": 16,
    "doe.studies": 16,
    "doe.demo": 16,
    "doe.cli": 17,
    "doe.__main__": 17,
}


def layer(module: str) -> int | None:
    """Layer of a module by its longest known prefix; None for other people's modules."""
    if module.split(".")[0] not in ("doe", "identification"):
        return None
    parts = module.split(".")
    for length in range(len(parts), 0, -1):
        if (name := ".".join(parts[:length])) in LAYERS:
            return LAYERS[name]
    return -1 if module in ("doe", "identification") else pytest.fail(f"{module} has no layer in {Path(__file__).name}")


parsed = cache(ast.parse)


def imported(source: str, module: str) -> set[str]:
    """Modules that a source imports, deferred imports too, relative ones resolved; `from package import module` too."""
    names = set()
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = ".".join([*module.split(".")[: -node.level], node.module or ""]) if node.level else node.module
            names.add(base.rstrip("."))
            names |= {f"{base}.{alias.name}" for alias in node.names} & files()
    return names


def modules() -> list[Path]:
    return sorted([*ROOT.glob("doe/**/*.py"), *ROOT.glob("identification/**/*.py")])


def name_of(path: Path) -> str:
    """Dotted name of a module or package."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@cache
def files() -> frozenset[str]:
    """Dotted names of the modules that are no package."""
    return frozenset(name_of(path) for path in modules() if path.stem != "__init__")


def unit(module: str) -> str:
    """The entry of `LAYERS` that a module belongs to: a package, or a module that stands by itself."""
    return max((name for name in LAYERS if f"{module}.".startswith(f"{name}.")), key=len, default=module)


@cache
def graph() -> dict[str, set[str]]:
    """Module -> our modules that it imports, deferred imports too; a package stands for its `__init__`.

    Imports for the type checker alone are none. `from package import module` imports the module, not the package, whose
    `__init__` may import many.
    """
    sources = {name_of(path): path.read_text() for path in modules()}
    return {name: at_run_time(source, set(sources)) - {name} for name, source in sources.items()}


def at_run_time(source: str, ours: set[str]) -> set[str]:
    """Those of `ours` that a source imports when it runs."""
    names, todo = set[str](), list[ast.AST](parsed(source).body)
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            todo += node.orelse
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "relative imports are not used here"
            whole = {alias.name: f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name in ours else str(node.module) for name in whole.values()}
        todo += ast.iter_child_nodes(node)
    return names & ours


def cycles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Groups of nodes that can reach each other: what cannot be put in an order."""
    reach = {node: set(targets) for node, targets in edges.items()}
    for via in reach:
        for targets in reach.values():
            if via in targets:
                targets |= reach[via]
    groups = {frozenset(b for b in reach if b in reach[a] and a in reach[b]) for a in reach if a in reach[a]}
    return sorted(sorted(group) for group in groups)


def test_imports_go_down_only() -> None:
    wrong = []
    for path in modules():
        name = name_of(path)
        if name == "identification":  # the table of contents, for everybody else
            continue
        for target in imported(path.read_text(), name):
            if (other := layer(target)) is not None and other > layer(name):
                wrong.append(f"{name} (layer {layer(name)}) imports {target} (layer {other})")
    assert not wrong


def test_identification_itself_does_not_use_its_table_of_contents() -> None:
    """Through it a module could reach what stands above it."""
    names = set(identification.__all__)
    sources = [path for path in modules() if path.relative_to(ROOT).parts[0] == "identification"]
    nodes = [(path, node) for path in sources for node in ast.walk(parsed(path.read_text()))]
    taken = [(path, node) for path, node in nodes if isinstance(node, ast.ImportFrom)]
    assert not [str(path) for path, node in taken if node.module == "identification" and names & of_import(node)]
    for name in identification.__all__:
        value = getattr(identification, name)
        assert not isinstance(value, ModuleType), f"{name} is a module too"


def of_import(node: ast.ImportFrom) -> set[str]:
    """The names that it imports."""
    return {alias.name for alias in node.names}


# what `doe` may take from `identification`: these numbers go down only, to 40 names from 8 modules
NAMES, MODULES = 121, 18


def test_the_door_between_the_packages_is_narrow() -> None:
    """Names and modules that `doe` imports from `identification`, a module imported as a whole among them none."""
    sources = [path for path in modules() if path.relative_to(ROOT).parts[0] == "doe"]
    nodes = [node for path in sources for node in ast.walk(parsed(path.read_text()))]
    whole = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    taken = [
        node for node in nodes if isinstance(node, ast.ImportFrom) and f"{node.module}.".startswith("identification.")
    ]
    names = {(str(node.module), alias.name) for node in taken for alias in node.names}
    every = {name_of(path) for path in modules()}
    assert not [name for name in whole if name.split(".")[0] == "identification"]
    assert not {f"{module}.{name}" for module, name in names} & every
    assert len({name for _, name in names}) <= NAMES
    assert len({module for module, _ in names}) <= MODULES


def test_layer_test_sees_an_upward_import() -> None:
    source = "def f():\n    from doe.solvers import solve\n"
    assert {layer(name) for name in imported(source, "identification.model")} == {14}


def test_no_two_modules_import_each_other() -> None:
    """Neither directly nor by way of others, in whatever layer; an import inside a function is an import."""
    assert cycles(graph()) == []


def test_no_two_packages_import_each_other() -> None:
    """Within a layer too: all of one package stands below all of the other."""
    edges: dict[str, set[str]] = {}
    for module, targets in graph().items():
        edges.setdefault(unit(module), set()).update({unit(target) for target in targets} - {unit(module)})
    assert cycles(edges) == []


def test_cycle_test_sees_a_deferred_import_and_no_type() -> None:
    ours = {"doe.a", "doe.b", "doe.c", "doe"}
    deferred = "def f():\n    from doe import b\n"
    types = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from doe.c import C\n"
    edges = {"doe.a": at_run_time(deferred + types, ours), "doe.b": {"doe.a"}, "doe.c": {"doe.a"}, "doe": set()}
    assert edges["doe.a"] == {"doe.b"}
    assert cycles(edges) == [["doe.a", "doe.b"]]


def test_every_layer_has_a_module() -> None:
    assert {unit(name_of(path)) for path in modules()} - {"doe", "identification"} == set(LAYERS)


# names of several modules that mean the same in each
SAME = {
    "command": "a verb of the command line",
}


def public_names(source: str) -> set[str]:
    """Functions and classes of a module that others may use."""
    found = {node.name for node in parsed(source).body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    return {name for name in found if not name.startswith("_")}


def test_a_name_has_one_meaning() -> None:
    places: dict[str, list[str]] = {}
    for path in modules():
        for name in public_names(path.read_text()):
            places.setdefault(name, []).append(name_of(path))
    several = {name: where for name, where in places.items() if len(where) > 1}
    same = {name for names in SAME for name in names.split()}
    wrong = {name: where for name, where in several.items() if name not in same}
    assert not wrong, "name each by what it is; names that mean the same are in SAME"
    assert same <= set(several), "no longer in several modules"


def test_bounds_import_no_solver() -> None:
    """A certificate trusts nothing that searches for plans: not even by way of another module."""
    edges, seen = graph(), set[str]()
    todo = [name for name in edges if name.startswith("doe.bounds")]
    while todo:
        seen.add(name := todo.pop())
        todo += edges[name] - seen
    assert not {name for name in seen if name.startswith("doe.solvers")}


def test_no_other_visible_name_at_the_top() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    visible = {line.split("/")[0] for line in listed.splitlines() if not line.startswith(".")}
    assert visible <= {"pyproject.toml", "doe", "identification", "tests", "notebooks", "README.md"}


def test_ci_runs_the_command_of_the_readme() -> None:
    readme = (ROOT / "README.md").read_text()
    block = readme.split("<!-- tests -->")[1].split("<!-- /tests -->")[0]
    assert "pytest" in block
    assert "<!-- tests -->" in (ROOT / ".ci/run").read_text()


def test_help_imports_no_solver() -> None:
    code = (
        "import sys\nfrom doe.cli.main import main\n"
        "try: main(['--help'])\nexcept SystemExit: pass\n"
        "heavy = {'numpy', 'casadi', 'cvxpy', 'clarabel', 'scipy', 'polars', 'matplotlib', 'pydantic', 'rich'}\n"
        "sys.exit(str(sorted(heavy & set(sys.modules))) if heavy & set(sys.modules) else 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "demo" in done.stdout


def test_a_model_starts_without_scipy() -> None:
    """Loading it takes longer than all the rest that every command, worker and notebook starts with."""
    code = "import sys, identification.model\nsys.exit('scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


@pytest.mark.parametrize("tool", [["ruff", "check"], ["ruff", "format", "--check"], ["mypy"]], ids=" ".join)
def test_code_is_clean(tool: list[str]) -> None:
    targets = [] if tool[0] == "mypy" else ["doe", "identification", "tests"]
    done = subprocess.run(
        [sys.executable, "-m", *tool, *targets], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def reached(start: set[str], links: dict[str, set[str]]) -> set[str]:
    """Modules of a set, and all that they import."""
    todo, seen = list(start), set(start)
    while todo:
        new = links[todo.pop()] - seen
        seen |= new
        todo += new
    return seen


def test_every_module_has_a_test() -> None:
    """One of its name in the mirrored place, or one of its package, or a verb that the tests run, which imports it."""
    links = graph()
    tests = {package: list((ROOT / "tests" / package).rglob("test_*.py")) for package in ("doe", "identification")}
    imports = {
        name: {m for path in paths for m in at_run_time(path.read_text(), set(links))} for name, paths in tests.items()
    }
    commands = " ".join(path.read_text() for path in (ROOT / "tests/doe/cli").rglob("*.py"))
    verbs = {name for name in links if name.startswith("doe.cli.") and f'"{name.rpartition(".")[2]}"' in commands}
    covered = {package: reached(start | verbs, links) for package, start in imports.items()}
    wrong = []
    for path in modules():
        place = path.relative_to(ROOT)
        by_name = (ROOT / "tests" / place.parent / f"test_{path.name}").exists()
        if not path.name.startswith("__") and not by_name and name_of(path) not in covered[place.parts[0]]:
            wrong.append(str(place))
    assert not wrong, "no test of its name, and no test of its package imports it"


def test_the_picture_of_the_layers_shows_every_folder() -> None:
    picture = (ROOT / "README.md").read_text().split("## Architecture")[1].split("```")[1]
    folders = {path.relative_to(ROOT).parts[1] for path in modules() if len(path.relative_to(ROOT).parts) > 2}
    assert set(re.findall(r"\b(\w+)/", picture)) == folders
