"""What is cited exists: Markdown files, headings, links, modules and paths named in code, tests, notebooks, READMEs."""

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
    paths = [ROOT / name for name in names if name and Path(name).suffix in KINDS]
    return [path for path in paths if path.is_file() and path != Path(__file__)]


def prose(path: Path) -> str:
    """Text of a file in one line; of a notebook its cells, without outputs; comment signs at line starts dropped."""
    text = path.read_text()
    if path.suffix == ".ipynb":
        text = "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])
    return re.sub(r"\s+", " ", re.sub(r"\n\s*#+ ", " ", text))


def headings(path: Path, *, anchors: bool = False) -> list[str]:
    """Headings of a Markdown file, those inside code blocks left out, or the fragments that forges make of them."""
    found = HEADING.findall(CODE_BLOCK.sub("", path.read_text()))
    return [re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in found] if anchors else found


def exists(dotted: str) -> bool:
    """True for a module, a package, or a name that the module before it defines."""
    module, _, name = dotted.rpartition(".")
    for candidate in (dotted, module):
        path = ROOT / candidate.replace(".", "/")
        source = path.with_suffix(".py") if path.with_suffix(".py").is_file() else path / "__init__.py"
        if source.is_file():
            return candidate == dotted or re.search(rf"\b{name}\b", source.read_text()) is not None
    return False


def wrong_citations(text: str, folder: Path) -> list[str]:
    """What a text names that the repository does not have: `X.md`, `X.md, "Heading"`, modules and paths."""
    wrong = [name for name in MODULE.findall(text) if not exists(name)]
    wrong += [name for name in PATH.findall(text) if "/x/" not in name and not (ROOT / name).exists()]  # x: any
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
        if not target.exists() or (fragment and fragment not in headings(target, anchors=True)):
            wrong.append(link)
    return wrong


def test_what_is_cited_exists() -> None:
    """A wrong citation is found also across a line break, as docstrings write them."""
    wrong = {str(path.relative_to(ROOT)): wrong_citations(prose(path), path.parent) for path in tracked()}
    assert {path: names for path, names in wrong.items() if names} == {}
    pages = [path for path in tracked() if path.suffix in (".md", ".ipynb")]
    assert {page.name: links for page in pages if (links := wrong_links(page))} == {}
    text = re.sub(r"\s+", " ", 'the bound (doe/README.md,\n    "No such heading"), see NOWHERE.md and doe/README.md.')
    assert wrong_citations(text, ROOT) == ['doe/README.md "No such heading"', 'NOWHERE.md ""']
    assert wrong_citations("`doe.bounds.nowhere` doe/nowhere.py", ROOT) == ["doe.bounds.nowhere", "doe/nowhere.py"]


def without_reason(source: str) -> list[str]:
    """Upper-case names that a module assigns numbers to, without a comment behind or directly above them."""
    lines, names = source.splitlines(), []
    for node in ast.parse(source).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            continue
        numeric = any(isinstance(part, ast.Constant) and type(part.value) in (int, float) for part in ast.walk(node))
        above, here = lines[node.lineno - 2], lines[node.lineno - 1 : node.end_lineno]
        if numeric and not above.startswith("# ") and not any("  # " in line for line in here):
            stored = [n for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)]
            names += [name.id for name in stored if name.id.isupper()]
    return names


@pytest.mark.parametrize(
    "module", ["identification/gap", "identification/estimation/uncertainty.py", "doe/discrimination"]
)
def test_every_numeric_constant_has_its_reason(module: str) -> None:
    paths = [ROOT / module] if module.endswith(".py") else sorted((ROOT / module).rglob("*.py"))
    assert paths
    assert {path.name: names for path in paths if (names := without_reason(path.read_text()))} == {}
    assert without_reason("A = 1  # two\nB, C = 2.0, [3]\n# above\nD: int = 4\nE = 5\n") == ["B", "C", "E"]
