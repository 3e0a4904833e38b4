"""What files may not do: run code, reach out of their folder, grow without end, or put markup into a page."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from doe.report.page import page
from doe.studies.monte_carlo import Study
from identification import InputError, load_arm
from identification.document import Document, Section, Sheet
from identification.files.first_files import urdf_files
from identification.files.urdf import parse_urdf
from tests.test_house import modules

ROOT = Path(__file__).parents[1]

# module -> what it may use, and why
ALLOWED = {
    "doe.__main__": {"exec"},  # of the empty text
    "doe.jobs": {"multiprocessing", "joblib.externals.loky", "distributed"},  # own child, --cluster alone
    "identification.vectorized": {"exec", "compile"},  # of lines that it writes itself, from a CasADi function
}
DANGEROUS = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "yaml", "subprocess", "socket", "ssl", "ftplib"}
DANGEROUS |= {"http", "urllib", "requests", "httpx", "aiohttp", "multiprocessing", "joblib", "distributed", "xmlrpc"}
DANGEROUS |= {"telnetlib"}
CALLS = {"eval", "exec", "compile", "__import__", "system", "popen"}


def used(tree: ast.Module) -> set[str]:
    """Dangerous modules that are imported, and dangerous built-in calls."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.split(".")[0] in DANGEROUS}
        elif isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] in DANGEROUS:
            found.add(str(node.module))
        elif isinstance(node, ast.Call):
            name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
            own = isinstance(node.func, ast.Name) or name in ("system", "popen")
            found |= {name} & CALLS if own else set()
    return found


def test_no_code_from_files_and_no_network() -> None:
    """No pickle, eval, socket or process but in the places listed, each for its reason."""
    extra = {name: sorted(used(tree) - ALLOWED.get(name, set())) for name, tree in modules().items()}
    assert {name: kinds for name, kinds in extra.items() if kinds and kinds != ["distributed.comm"]} == {}
    code = ast.parse("import pickle\nfrom urllib import request\neval('1')\nos.system('x')")
    assert used(code) == {"pickle", "urllib", "eval", "system"}


def test_no_module_of_the_working_directory_is_run(tmp_path: Path) -> None:
    """Child processes and pools, started where a folder `doe` or `multiprocessing` lies in wait."""
    for name in ("doe", "identification", "multiprocessing", "pickle", "concurrent"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("open('hijacked', 'w').close()\nraise SystemExit(3)\n")
    task = tmp_path / "script.py"
    task.write_text(
        "from os import getcwd\nfrom doe.jobs import call, executor_of\n"
        "if __name__ == '__main__':\n"
        "    assert call(abs, -3, seconds=60.0)[0] == 3\n"
        "    with executor_of(2) as (pool, _):\n        assert pool.submit(abs, -4).result() == 4\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1"}
    done = subprocess.run(
        [sys.executable, task], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "hijacked").exists()


LAUGHS = '<!DOCTYPE robot [<!ENTITY a0 "ha">' + "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 10))


@pytest.mark.parametrize(
    "head",
    [
        f"{LAUGHS}]>",
        '<!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE robot SYSTEM "http://example.org/robot.dtd">',
    ],
)
def test_xml_without_entities(head: str) -> None:
    """A billion laughs, a file, an address: refused before a parser sees them."""
    with pytest.raises(InputError, match="found <!DOCTYPE, allowed: XML without document types and entities"):
        parse_urdf(f'{head}<robot name="&x;"/>', "robot.urdf")


URDF = (
    '<robot name="{name}"><link name="a"/><link name="b"/><joint name="j" type="continuous"><parent link="a"/>'
    '<child link="b"/></joint><link name="{other}"/><joint name="k" type="continuous"><parent link="a"/>'
    '<child link="{other}"/></joint></robot>'
)


def test_names_in_a_robots_file_stay_names(tmp_path: Path) -> None:
    """In the arm file written from it (a line feed would end a comment) and in the steps (markup)."""
    text = URDF.format(name="&lt;script&gt;alert(1)&lt;/script&gt;&#10;x&#127;", other="end&#10;links_mm = [1.0]")
    (tmp_path / "robot.urdf").write_text(text)
    files = urdf_files(tmp_path / "robot.urdf", tip="b") | urdf_files(tmp_path / "robot.urdf")
    assert "<script>" not in files["README.md"]
    assert set(tomllib.loads(files["arm.toml"])) == {
        "name",
        "kind",
        "urdf",
        "base_link",
        "tip_link",
        "measurement",
        "machining",
        "cell",
    }


def test_pages_escape_everything() -> None:
    evil = "<script>alert('x')</script>"
    text = page(Document(evil, [evil], [Section(evil, [evil, Sheet([evil], [[evil]])])]))
    assert evil not in text
    assert text.count("&lt;script&gt;") >= 7


@pytest.mark.parametrize("name", ["../secret", "/etc/passwd", "below/../../secret", "link", "a\\u0000b"])
def test_files_named_in_files_stay_in_their_folder(tmp_path: Path, name: str) -> None:
    """Of an arm file and of a study, by name or by a link; a file below is allowed."""
    folder = tmp_path / "here"
    (folder / "below").mkdir(parents=True)
    (tmp_path / "secret").write_text("secret")
    (folder / "link").symlink_to("../secret")
    (folder / "arm.toml").write_text(f'kind = "spatial"\nurdf = "{name}"\nbase_link = "a"\ntip_link = "b"\n')
    (folder / "below" / "arm.toml").write_text("links_mm = [1.0, 1.0]\n[measurement]\nsigma_mm = 0.1\n")
    with pytest.raises(InputError, match="outside the folder of the arm file, allowed: a file beside it or below"):
        load_arm(folder / "arm.toml")
    for arms, plans in ((f'["{name}"]', '["random"]'), ('["below/arm.toml"]', f'["{name}.csv"]')):
        if plans == '["link.csv"]':
            continue
        (folder / "study.toml").write_text(f"arms = {arms}\nplans = {plans}\nruns = [8]\n")
        with pytest.raises(InputError, match="outside the folder of the study file"):
            Study.load(folder / "study.toml")
    (folder / "study.toml").write_text('arms = ["below/arm.toml"]\nplans = ["random"]\nruns = [8]\n')
    assert len(Study.load(folder / "study.toml").arms) == 1
