"""Files that armcal itself has written: small campaigns of a planar arm, of a spatial one and a ball bar,
made once."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import cache
from pathlib import Path

from click.testing import CliRunner
from hypothesis import strategies as st

from doe.cli import main
from tests.fuzz.texts import mostly_valid, one_in

PLANAR = """links_mm = [260.0, 180.0]
[measurement]
sigma_mm = 0.1
"""
SPATIAL = """kind = "spatial"
[[dh]]
a_mm = 0.0
alpha_deg = 90.0
d_mm = 400.0
[[dh]]
a_mm = -600.0
alpha_deg = 0.0
d_mm = 0.0
[tool]
x_mm = 0.0
y_mm = 60.0
z_mm = 80.0
[measurement]
sigma_mm = 0.1
"""
BAR = '[instrument]\nkind = "distance"\ncenter_mm = [500.0, -200.0, 300.0]\n'
OFFSET = '[calibration]\nvalues = {"joint_offset:2" = 0.3}\n'
ARMS = {  # of each kind the file, and what its truth has besides
    "planar": (PLANAR, "[calibration]\nlength_errors_mm = [0.5, -0.2]\njoint_offsets_deg = [0.1, 0.3]\n"),
    "spatial": (SPATIAL, OFFSET),
    "bar": (SPATIAL + BAR, OFFSET),
}
ECCENTRIC = '[[effects]]\nname = "encoder_eccentricity"\njoint = 2\na_deg = 0.08\nb_deg = 0.02\n'
COMMANDS = {  # what it says with --json, by the file that this becomes
    "design.json": "design arm.toml --runs 40 --starts 1 --seconds 1 --out plan.csv",
    "": "simulate arm.toml plan.csv --truth truth.toml --out data.csv",
    "score.json": "score arm.toml plan.csv",
    "identify.json": "identify arm.toml data.csv --out calibrated.toml",
    "diagnose.json": "diagnose arm.toml data.csv --out extended.toml --force",
    "validate.json": "validate calibrated.toml data.csv",
}


@cache
def every_campaign() -> dict[str, dict[str, str]]:
    """Kind of arm -> name -> text of each file; all by one process of its own, as cases are forks of this one."""
    words = [sys.executable, "-m", __name__]
    found: dict[str, dict[str, str]] = json.loads(subprocess.run(words, capture_output=True, check=True).stdout)
    return found


def made(kind: str) -> dict[str, str]:
    """The files, made here."""
    runner, (arm, values) = CliRunner(), ARMS[kind]
    with runner.isolated_filesystem():
        Path("arm.toml").write_text(arm)
        Path("truth.toml").write_text(arm + values + ECCENTRIC)
        found = {}
        for name, line in COMMANDS.items():
            done = runner.invoke(main, [*line.split(), "--json", "--quiet"], catch_exceptions=False)
            assert done.exit_code == 0, done.stderr
            found[name] = done.stdout
        files = {path.name: path.read_text() for path in sorted(Path().iterdir()) if path.suffix in (".csv", ".toml")}
    return files | {name: text for name, text in found.items() if name}


@st.composite
def campaigns(draw: st.DrawFn, line: frozenset[str]) -> dict[str, str]:
    """The files of one campaign that a command line names, spoilt one in seven; a table of another arm now and then."""
    kind, another = draw(st.permutations(list(ARMS)))[:2]
    files, other = every_campaign()[kind], every_campaign()[another]
    found = {name: draw(mostly_valid(files[name])) for name in sorted(line & files.keys())}
    return {name: other[name] if one_in(draw, 40) else text for name, text in found.items()}


if __name__ == "__main__":
    sys.stdout.write(json.dumps({kind: made(kind) for kind in ARMS}))
