"""The house: imports go down only, files stay readable, no other visible top-level name, CI runs the README."""

import ast
import re
import subprocess
import sys
from collections.abc import Collection, Mapping
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from types import ModuleType

import pytest

import identification

ROOT = Path(__file__).parents[1]

# package -> its modules and packages, layer upon layer; a deeper name is a unit of its own
ORDER = {
    "identification": (
        "arrays errors running document vectorized",
        "files kinematics kinematics.frames kinematics.parameters instruments arm cover workspace "
        "information levenberg_marquardt",
        "documents effects measurements files.schema files.arm files.measurement files.first_files",
        "model",
        "simulate",
        "documents.identification estimation inspection.readings inspection",
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
        "discrimination advise",
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
    return module if module in ORDER else max(names, key=len, default="")


@cache
def modules() -> dict[str, ast.Module]:
    """Dotted name -> tree of every module; a package stands for its `__init__`."""
    paths = sorted([*ROOT.glob("doe/**/*.py"), *ROOT.glob("identification/**/*.py")])
    names = (".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in paths)
    return {name: ast.parse(path.read_text()) for name, path in zip(names, paths, strict=True)}


def imports(tree: ast.AST, ours: Collection[str], *, types: bool = False) -> set[str]:
    """Those of `ours` that a module imports, in functions too; with `types` also those for the type checker alone.

    `from package import module` imports the module, not the package, whose `__init__` may import many.
    """
    names, nodes = set[str](), [tree]
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "relative imports are not used here"
            whole = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name in ours else str(node.module) for name in whole}
        elif types or not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):
            nodes += ast.iter_child_nodes(node)
    return names & set(ours)


@cache
def graph() -> dict[str, set[str]]:
    """Module -> modules that it imports when it runs."""
    return {name: imports(tree, modules()) - {name} for name, tree in modules().items()}


def reached(start: Collection[str], links: Mapping[str, set[str]]) -> set[str]:
    """Modules of a set, and all that they import."""
    todo, seen = list(start), set(start)
    while todo:
        new = links[todo.pop()] - seen
        seen |= new
        todo += new
    return seen


def test_imports_go_down_only() -> None:
    """Deferred ones and those of types too; `identification` itself is the table of contents, for everybody else."""
    layer = {name: LAYERS.get(unit(name), -1) for name in modules()}
    wrong = []
    for name, tree in modules().items():
        targets = imports(tree, modules(), types=True)
        if name == "identification":  # whose contents are of all its own layers
            targets = {target for target in targets if target.startswith("doe")}
        wrong += [f"{name} imports {target}" for target in targets if layer[target] > layer[name]]
    assert not wrong
    assert {unit(name) for name in modules()} == {*LAYERS, *ORDER}, "every module has a layer, every layer a module"


def test_no_two_modules_and_no_two_packages_import_each_other() -> None:
    """Neither directly nor by way of others, also within a layer; an import inside a function is an import."""
    units: dict[str, set[str]] = {unit(module): set() for module in graph()}
    for module, targets in graph().items():
        units[unit(module)] |= {unit(target) for target in targets} - {unit(module)}
    for links in (graph(), units):
        TopologicalSorter(links).prepare()  # names a cycle


def test_bounds_import_no_solver() -> None:
    """A certificate trusts nothing that searches for plans: not even by way of another module."""
    bounds = {name for name in graph() if name.startswith("doe.bounds")}
    assert not [name for name in reached(bounds, graph()) if name.startswith("doe.solvers")]


# -- names -------------------------------------------------------------------------------------------------------------
# what `doe` may take from `identification`: these numbers go down only
NAMES, MODULES = 40, 4


def taken(package: str) -> list[tuple[str, str]]:
    """Module and name of every import by name from `identification` in a package, also in functions."""
    nodes = (node for name, tree in modules().items() if unit(name).startswith(package) for node in ast.walk(tree))
    froms = (node for node in nodes if isinstance(node, ast.ImportFrom))
    return [(str(n.module), a.name) for n in froms if f"{n.module}.".startswith("identification.") for a in n.names]


def test_identification_itself_does_not_use_its_table_of_contents() -> None:
    """Through it a module could reach what stands above it."""
    contents = set(identification.__all__)
    assert not [row for row in taken("identification.") if row[0] == "identification" and row[1] in contents]
    assert not [name for name in contents if isinstance(getattr(identification, name), ModuleType)]


def test_the_door_between_the_packages_is_narrow() -> None:
    """Names and modules that `doe` imports from `identification`, a module imported as a whole among them none."""
    rows = taken("doe")
    named = (node for name, tree in modules().items() if name.startswith("doe") for node in ast.walk(tree))
    assert not [n for n in named if isinstance(n, ast.Import) and n.names[0].name.startswith("identification")]
    assert not [row for row in rows if ".".join(row) in modules()]
    assert len({name for _, name in rows}) <= NAMES
    assert len({module for module, _ in rows}) <= MODULES


def test_a_name_has_one_meaning() -> None:
    """Public functions and classes of modules."""
    defined = [
        (node.name, module)
        for module, tree in modules().items()
        for node in tree.body
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")
    ]
    modules_of = {name: {module for each, module in defined if each == name} for name, _ in defined}
    assert {name: where for name, where in modules_of.items() if len(where) > 1} == {}


def test_every_module_has_a_test() -> None:
    """One of its name, or one of its package, which imports it, or a verb that the tests run."""
    commands = " ".join(path.read_text() for path in (ROOT / "tests/doe/cli").rglob("*.py"))
    verbs = {name for name in graph() if name.startswith("doe.cli.") and f'"{name.rpartition(".")[2]}"' in commands}
    lines = re.compile(r"^(?:from [\w.]+ import (?:\([^)]*\)|.*)|import .*)", re.MULTILINE)  # all imports of tests
    tests = {p: ast.parse("\n".join(lines.findall(p.read_text()))) for p in (ROOT / "tests").rglob("test_*.py")}
    left = {name for name in graph() if f"test_{name.rpartition('.')[2]}" not in {path.stem for path in tests}}
    for package in ORDER:
        trees = (tree for path, tree in tests.items() if package in path.parts)
        start = {name for tree in trees for name in imports(tree, graph())} | verbs
        left -= {name for name in reached(start, graph()) if name.startswith(package)}
    packages = {name.rpartition(".")[0] for name in modules()}
    assert {name for name in left if name not in packages and "__" not in name} == set()


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
            "from doe.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass",
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


PLACES = ["doe", "identification", "tests"]


@pytest.mark.parametrize(
    "tool",
    [
        ["ruff", "check", *PLACES],
        ["ruff", "format", "--check", *PLACES],
        ["pyrefly", "check", "--python-interpreter-path", sys.executable],
    ],
    ids=["ruff check", "ruff format", "types"],
)
def test_code_is_clean(tool: list[str]) -> None:
    done = subprocess.run([sys.executable, "-m", *tool], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
