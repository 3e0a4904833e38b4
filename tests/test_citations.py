"""What is cited exists: every Markdown file, heading and relative link named in code, tests, notebooks and READMEs."""

from __future__ import annotations

import ast
import json
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
KINDS = {".py", ".ipynb", ".md", ".toml", ".j2", ""}
CITATION = re.compile(r"((?:[\w.-]+/)*[\w-]+\.md)(?:,? \"([^\"]+)\")?")
LINK = re.compile(r"\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ +(.+?) *$", re.MULTILINE)
MODULE = re.compile(r"`((?:doe|identification)(?:\.[A-Za-z_]\w*)+)[^`\w]*`")
PATH = re.compile(r"(?<![\w/.-])((?:doe|identification|tests|notebooks)/[\w./-]*\w)")
CODE_BLOCK = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)


def tracked() -> list[Path]:
    """Text files of the repository, new ones included."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")
    return [ROOT / name for name in names if name and Path(name).suffix in KINDS and (ROOT / name).is_file()]


def prose(path: Path) -> str:
    """Text of a file in one line; of a notebook its cells, without outputs; comment signs at line starts dropped."""
    text = path.read_text()
    if path.suffix == ".ipynb":
        text = "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])
    return re.sub(r"\s+", " ", re.sub(r"\n\s*#+ ", " ", text))


def headings(path: Path) -> list[str]:
    """Headings of a Markdown file, those inside code blocks left out."""
    return HEADING.findall(CODE_BLOCK.sub("", path.read_text()))


def anchor(heading: str) -> str:
    """The fragment that forges make of a heading: lower case, punctuation dropped, blanks to hyphens."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


FILES = [path for path in tracked() if path != Path(__file__)]


def wrong_citations(text: str, folder: Path) -> list[str]:
    """Citations `X.md` or `X.md, "Heading"` of a file or heading that the repository does not have."""
    wrong = []
    for name, heading in CITATION.findall(text):
        target = next((place / name for place in (ROOT, folder) if (place / name).is_file()), None)
        if target is None or (heading and heading not in headings(target)):
            wrong.append(f'{name} "{heading}"')
    return wrong


def wrong_links(path: Path) -> list[str]:
    """Relative links of a Markdown file or notebook that lead nowhere."""
    wrong = []
    for link in LINK.findall(prose(path)):
        name, _, fragment = link.partition("#")
        target = path.parent / name if name else path
        if "://" in link or link.startswith(("attachment:", "data:")):
            continue
        if not target.exists() or (fragment and fragment not in map(anchor, headings(target))):
            wrong.append(link)
    return wrong


def test_cited_files_and_headings_exist():
    found = {str(path.relative_to(ROOT)): wrong_citations(prose(path), path.parent) for path in FILES}
    assert {path: wrong for path, wrong in found.items() if wrong} == {}


def test_relative_links_work():
    pages = [path for path in FILES if path.suffix in (".md", ".ipynb")]
    assert {page.name: wrong for page in pages if (wrong := wrong_links(page))} == {}


def exists(dotted: str) -> bool:
    """True for a module, a package, or a name that the module before it defines."""
    module, _, name = dotted.rpartition(".")
    for candidate in (dotted, module):
        path = ROOT / candidate.replace(".", "/")
        source = path.with_suffix(".py") if path.with_suffix(".py").is_file() else path / "__init__.py"
        if source.is_file():
            return candidate == dotted or re.search(rf"\b{name}\b", source.read_text()) is not None
    return False


def test_named_modules_and_paths_exist():
    found = {str(path.relative_to(ROOT)): prose(path) for path in FILES}
    modules = {file: [name for name in MODULE.findall(text) if not exists(name)] for file, text in found.items()}
    named = {file: [name for name in PATH.findall(text) if "/x/" not in name] for file, text in found.items()}  # any x
    paths = {file: [name for name in names if not (ROOT / name).exists()] for file, names in named.items()}
    assert {file: names for file, names in modules.items() if names} == {}
    assert {file: names for file, names in paths.items() if names} == {}


def test_a_wrong_citation_is_found():
    """Also across a line break, as docstrings write them."""
    text = re.sub(r"\s+", " ", 'the bound (doe/README.md,\n    "No such heading"), see NOWHERE.md and doe/README.md.')
    assert wrong_citations(text, ROOT) == ['doe/README.md "No such heading"', 'NOWHERE.md ""']
    assert not exists("doe.bounds.nowhere")


@pytest.mark.parametrize(
    "module", ["identification/gap", "identification/estimation/uncertainty.py", "doe/discrimination"]
)
def test_every_numeric_constant_has_its_reason(module):
    """A comment behind it or directly above it."""
    paths = [ROOT / module] if module.endswith(".py") else sorted((ROOT / module).rglob("*.py"))
    assert paths
    assert {path.name: names for path in paths if (names := without_reason(path.read_text()))} == {}


def without_reason(source: str) -> list[str]:
    """Upper-case names that a module assigns numbers to, without a comment."""
    lines, names = source.splitlines(), []
    for node in ast.parse(source).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            continue
        assigned = [name.id for name in ast.walk(node) if _is_constant(name)]
        numeric = any(isinstance(part, ast.Constant) and type(part.value) in (int, float) for part in ast.walk(node))
        above, here = lines[node.lineno - 2], lines[node.lineno - 1 : node.end_lineno]
        if numeric and not above.startswith("# ") and not any("  # " in line for line in here):
            names += assigned
    return names


def _is_constant(node: ast.AST) -> bool:
    return isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id.isupper()


def test_a_constant_without_reason_is_noticed():
    assert without_reason("A = 1  # two\nB, C = 2.0, [3]\n# above\nD: int = 4\nE = 5\n") == ["B", "C", "E"]
