"""The house: imports go down only, files stay readable, no other visible top-level name, CI runs the README."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Collection
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest

import identification

ROOT = Path(__file__).parents[1]

# package -> its modules and packages, layer upon layer; a deeper name is a unit of its own
ORDER = {
    "identification": (
        "arrays errors running document vectorized",
        "files kinematics kinematics.frames kinematics.parameters instruments arm bodies cover workspace error_curve "
        "newton information levenberg_marquardt",
        "documents effects conditions measurements files.schema files.arm files.measurement files.first_files",
        "model",
        "simulate",
        "documents.identification estimation inspection.readings origin sessions inspection",
        "documents.diagnosis documents.pictures compensate reuse validate gap",
        "for_design inspection.inspection",
        "workflow replications",
        "campaign",
    ),
    "doe": (
        "criteria jobs",
        "problem plan",
        "bounds design",
        "solvers",
        "discrimination cross_check advise",
        "report studies demo program",
        "cli __main__",
    ),
}
ABOVE = {"identification": 0, "doe": len(ORDER["identification"])}
LAYERS = {
    f"{package}.{name}": ABOVE[package] + layer
    for package, layers in ORDER.items()
    for layer, names in enumerate(layers)
    for name in names.split()
}


def unit(module: str) -> str:
    """The entry of `LAYERS` that a module belongs to, by its longest known prefix; the two packages are their own."""
    names = (name for name in LAYERS if f"{module}.".startswith(f"{name}."))
    return module if module in ("doe", "identification") else max(names, key=len, default="")


def layer(module: str) -> int:
    assert unit(module), f"{module} has no layer in {Path(__file__).name}"
    return LAYERS.get(unit(module), -1)


@cache
def modules() -> dict[str, ast.Module]:
    """Dotted name -> tree of every module; a package stands for its `__init__`."""
    paths = sorted([*ROOT.glob("doe/**/*.py"), *ROOT.glob("identification/**/*.py")])
    names = (".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in paths)
    return {name: ast.parse(path.read_text()) for name, path in zip(names, paths, strict=True)}


def imports(tree: ast.Module, ours: Collection[str], *, types: bool = False) -> set[str]:
    """Those of `ours` that a module imports, in functions too; with `types` also those for the type checker alone.

    `from package import module` imports the module, not the package, whose `__init__` may import many.
    """
    names, todo = set[str](), list[ast.AST](tree.body)
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test) and not types:
            todo += node.orelse
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "relative imports are not used here"
            whole = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name in ours else str(node.module) for name in whole}
        todo += ast.iter_child_nodes(node)
    return names & set(ours)


@cache
def graph() -> dict[str, set[str]]:
    """Module -> modules that it imports when it runs."""
    return {name: imports(tree, modules()) - {name} for name, tree in modules().items()}


def reached(start: set[str], links: dict[str, set[str]]) -> set[str]:
    """Modules of a set, and all that they import."""
    todo, seen = list(start), set(start)
    while todo:
        new = links[todo.pop()] - seen
        seen |= new
        todo += new
    return seen


def cycles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Groups of nodes that can reach each other: what cannot be put in an order."""
    reach = {node: reached(targets, edges) for node, targets in edges.items()}
    groups = {frozenset(b for b in reach if b in reach[a] and a in reach[b]) for a in reach if a in reach[a]}
    return sorted(sorted(group) for group in groups)


def test_imports_go_down_only() -> None:
    """Deferred ones and those of types too; `identification` itself is the table of contents, for everybody else."""
    wrong = []
    for name, tree in modules().items():
        targets = imports(tree, modules(), types=True)
        if name == "identification":  # whose contents are of all its own layers
            targets = {target for target in targets if target.startswith("doe")}
        wrong += [f"{name} imports {target}" for target in targets if layer(target) > layer(name)]
    assert not wrong


def test_no_two_modules_import_each_other() -> None:
    """Neither directly nor by way of others, in whatever layer; an import inside a function is an import."""
    assert cycles(graph()) == []


def test_no_two_packages_import_each_other() -> None:
    """Within a layer too: all of one package stands below all of the other."""
    edges: dict[str, set[str]] = {unit(module): set() for module in graph()}
    for module, targets in graph().items():
        edges[unit(module)] |= {unit(target) for target in targets} - {unit(module)}
    assert cycles(edges) == []


def test_every_layer_has_a_module() -> None:
    assert {unit(name) for name in modules()} - {"doe", "identification"} == set(LAYERS)


def test_bounds_import_no_solver() -> None:
    """A certificate trusts nothing that searches for plans: not even by way of another module."""
    bounds = {name for name in graph() if name.startswith("doe.bounds")}
    assert not [name for name in reached(bounds, graph()) if name.startswith("doe.solvers")]


# -- names -------------------------------------------------------------------------------------------------------------
@cache
def taken(package: str) -> list[tuple[str, str, str]]:
    """Module, module and name of every import by name from `identification` in a package, also in functions."""
    return [
        (name, str(node.module), alias.name)
        for name, tree in modules().items()
        if f"{name}.".startswith(f"{package}.")
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and f"{node.module}.".startswith("identification.")
        for alias in node.names
    ]


def test_identification_itself_does_not_use_its_table_of_contents() -> None:
    """Through it a module could reach what stands above it."""
    contents = set(identification.__all__)
    assert not [row for row in taken("identification") if row[1] == "identification" and row[2] in contents]
    assert not [name for name in contents if isinstance(getattr(identification, name), ModuleType)]


# what `doe` may take from `identification`: these numbers go down only
NAMES, MODULES = 40, 4


def test_the_door_between_the_packages_is_narrow() -> None:
    """Names and modules that `doe` imports from `identification`, a module imported as a whole among them none."""
    rows = taken("doe")
    named = (node for name, tree in modules().items() if name.startswith("doe") for node in ast.walk(tree))
    assert not [n for n in named if isinstance(n, ast.Import) and n.names[0].name.startswith("identification")]
    assert not [row for row in rows if f"{row[1]}.{row[2]}" in modules()]
    assert len({name for *_, name in rows}) <= NAMES
    assert len({module for _, module, _ in rows}) <= MODULES


def test_a_name_has_one_meaning() -> None:
    """Public functions and classes of modules."""
    places: dict[str, list[str]] = {}
    for module, tree in modules().items():
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(module)
    several = {name: sorted(set(where)) for name, where in places.items() if len(set(where)) > 1}
    assert not several


def test_every_module_has_a_test() -> None:
    """One of its name in the mirrored place, or one of its package, or a verb that the tests run, which imports it."""
    commands = " ".join(path.read_text() for path in (ROOT / "tests/doe/cli").rglob("*.py"))
    verbs = {name for name in graph() if name.startswith("doe.cli.") and f'"{name.rpartition(".")[2]}"' in commands}
    covered = set()
    for package in ("doe", "identification"):
        paths = (ROOT / "tests" / package).rglob("test_*.py")
        start = {name for path in paths for name in imports(ast.parse(path.read_text()), graph())} | verbs
        covered |= {name for name in reached(start, graph()) if name.startswith(package)}
    mirrored = (
        ".".join(path.relative_to(ROOT / "tests").with_suffix("").parts) for path in ROOT.glob("tests/*/**/*.py")
    )
    covered |= {name.replace(".test_", ".") for name in mirrored}
    packages = {name.rpartition(".")[0] for name in modules()}
    assert {name for name in modules() if name not in packages and "__" not in name} <= covered


# -- the repository ----------------------------------------------------------------------------------------------------
def test_no_other_name_at_the_top() -> None:
    """A link .venv least of all (git rm --cached .venv): to merge it would empty the folder of that name."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    visible = {"pyproject.toml", "doe", "identification", "tests", "notebooks", "README.md"}
    assert {line.split("/")[0] for line in listed.splitlines()} <= {*visible, ".ci", ".gitignore"}


def test_ci_runs_the_command_of_the_readme_whose_picture_shows_every_folder() -> None:
    readme = (ROOT / "README.md").read_text()
    assert "pytest" in readme.split("<!-- tests -->")[1].split("<!-- /tests -->")[0]
    assert "<!-- tests -->" in (ROOT / ".ci/run").read_text()
    picture = readme.split("## Architecture")[1].split("```")[1]
    folders = {name.split(".")[1] for name in modules() if name.count(".") > 1}
    assert set(re.findall(r"\b(\w+)/", picture)) == folders


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        (
            "from doe.cli.main import main\ntry: main(['--help'])\nexcept SystemExit: pass",
            "numpy casadi cvxpy clarabel scipy polars matplotlib pydantic rich",
        ),
        ("import identification.model", "scipy"),
    ],
    ids=["help imports no solver", "a model starts without scipy"],
)
def test_what_is_loaded(code: str, absent: str) -> None:
    """Loading takes longer than all the rest that every command, worker and notebook starts with."""
    check = f"\nimport sys\nsys.exit(str(set('{absent}'.split()) & set(sys.modules) or ''))"
    done = subprocess.run([sys.executable, "-c", code + check], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stderr.strip() == ""


# mypy's cycles are few: to look for them takes a quarter of its time
MYPY = "import gc; gc.enable = lambda: None; gc.disable(); from mypy.__main__ import console_entry; console_entry()"
PLACES = ["doe", "identification", "tests"]


@pytest.mark.parametrize(
    "tool",
    [["-m", "ruff", "check", *PLACES], ["-m", "ruff", "format", "--check", *PLACES], ["-c", MYPY]],
    ids=["ruff check", "ruff format", "mypy"],
)
def test_code_is_clean(tool: list[str]) -> None:
    done = subprocess.run([sys.executable, *tool], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
