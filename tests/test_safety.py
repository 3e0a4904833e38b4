"""What files may not do: run code, reach out of their folder, or grow without end; test_page.py has markup in pages."""

import ast
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from doe.studies.monte_carlo import Study
from identification import InputError, load_arm
from identification.files.first_files import urdf_files
from identification.files.urdf import read_urdf
from tests.test_house import ROOT, modules

# module -> what it may use, and why
ALLOWED = {
    "doe.__main__": {"exec"},  # of the empty text
    "doe.jobs": {"multiprocessing", "joblib.externals.loky", "distributed", "distributed.comm"},  # --cluster alone
    "identification.vectorized": {"exec", "compile"},  # of lines that it writes itself, from a CasADi function
}
DANGEROUS = (
    "pickle marshal shelve dill cloudpickle yaml subprocess socket ssl ftplib http urllib requests httpx aiohttp "
    "multiprocessing joblib distributed xmlrpc telnetlib"
)
BUILT_IN, METHODS = {"eval", "exec", "compile", "__import__"}, {"system", "popen"}


def used(tree: ast.Module) -> set[str]:
    """Dangerous modules that are imported, and dangerous calls."""
    names, dangerous = set[str](), set(DANGEROUS.split())
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names if alias.name.split(".")[0] in dangerous}
        elif isinstance(node, ast.ImportFrom):
            names |= {str(node.module)} if str(node.module).split(".")[0] in dangerous else set()
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            names |= {node.func.id} & (BUILT_IN | METHODS)
        elif isinstance(node, ast.Call):
            names |= {getattr(node.func, "attr", "")} & METHODS
    return names


def test_no_code_from_files_and_no_network() -> None:
    """No pickle, eval, socket or process but in the places listed, each for its reason."""
    extra = {name: used(tree) - ALLOWED.get(name, set()) for name, tree in modules().items()}
    assert {name: kinds for name, kinds in extra.items() if kinds} == {}
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
        "    assert call(abs, -3, seconds=60.0) == 3\n"
        "    with executor_of(2) as (pool, _):\n        assert pool.submit(abs, -4).result() == 4\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1"}
    done = subprocess.run(
        [sys.executable, task], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "hijacked").exists()


LAUGHS = '<!ENTITY a0 "ha">' + "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 10))


@pytest.mark.parametrize(
    "kind", [f"[{LAUGHS}]", '[<!ENTITY x SYSTEM "file:///etc/passwd">]', 'SYSTEM "http://example.org/robot.dtd"']
)
def test_xml_without_entities(kind: str) -> None:
    """A billion laughs, a file, an address: refused before a parser sees them."""
    with pytest.raises(InputError, match="found <!DOCTYPE, allowed: XML without document types and entities"):
        read_urdf("robot.urdf", f'<!DOCTYPE robot {kind}><robot name="&x;"/>')


URDF = (
    '<robot name="&lt;script&gt;alert(1)&lt;/script&gt;&#10;x&#127;"><link name="a"/><link name="b"/>'
    '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint><link name="{0}"/>'
    '<joint name="k" type="continuous"><parent link="a"/><child link="{0}"/></joint></robot>'
)


def test_names_in_a_robots_file_stay_names(tmp_path: Path) -> None:
    """In the arm file written from it (a line feed would end a comment) and in the steps (markup)."""
    (tmp_path / "robot.urdf").write_text(URDF.format("end&#10;links_mm = [1.0]"))
    files = urdf_files(tmp_path / "robot.urdf", tip="b") | urdf_files(tmp_path / "robot.urdf")
    assert "<script>" not in files["README.md"]
    keys = "name kind urdf base_link tip_link measurement machining cell"
    assert set(tomllib.loads(files["arm.toml"])) == set(keys.split())


@pytest.mark.parametrize("name", ["../secret", "/etc/passwd", "below/../../secret", "link", "a\\u0000b"])
def test_files_named_in_files_stay_in_their_folder(tmp_path: Path, name: str) -> None:
    """Of an arm file and of a study, by name or by a link; a file below is allowed."""
    folder = tmp_path / "here"
    (folder / "below").mkdir(parents=True)
    (tmp_path / "secret").write_text("secret")
    for link in ("link", "link.csv"):
        (folder / link).symlink_to("../secret")
    (folder / "arm.toml").write_text(f'kind = "spatial"\nurdf = "{name}"\nbase_link = "a"\ntip_link = "b"\n')
    (folder / "below" / "arm.toml").write_text("links_mm = [100.0, 80.0]\n[measurement]\nsigma_mm = 0.1\n")
    with pytest.raises(InputError, match="outside the folder of the arm file, allowed: a file beside it or below"):
        load_arm(folder / "arm.toml")
    for arm, plan in ((name, "random"), ("below/arm.toml", f"{name}.csv"), ("below/arm.toml", "random")):
        (folder / "study.toml").write_text(f'arms = ["{arm}"]\nplans = ["{plan}"]\nruns = [8]\n')
        if (arm, plan) != ("below/arm.toml", "random"):
            with pytest.raises(InputError, match="outside the folder of the study file"):
                Study.load(folder / "study.toml")
    assert len(Study.load(folder / "study.toml").arms) == 1
