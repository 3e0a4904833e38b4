"""IPOPT as the executable that Pyomo calls, from CasADi's wheel: `python ipopt_nl.py problem.nl -AMPL name=value ...`.

No package registry has the executable itself; where one is on the path, that is used instead.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import casadi as ca

SOLVED, LIMITED, INFEASIBLE, FAILED = 0, 400, 200, 500  # AMPL's codes
CODES = {
    "Solve_Succeeded": SOLVED,
    "Solved_To_Acceptable_Level": SOLVED,
    "Maximum_Iterations_Exceeded": LIMITED,
    "Infeasible_Problem_Detected": INFEASIBLE,
}


def option(text: str) -> tuple[str, float | int | str]:
    """`name=value` with the value as a number where it is one."""
    name, value = text.split("=", 1)
    if re.fullmatch(r"[+-]?\d+", value):
        return name, int(value)
    try:
        return name, float(value)
    except ValueError:
        return name, value


def solve(problem: Path, options: dict[str, float | int | str]) -> None:
    """Writes problem.sol."""
    read = ca.NlpBuilder()
    read.import_nl(str(problem))
    x, g = ca.vertcat(*read.x), ca.vertcat(*read.g)
    given = {f"ipopt.{name}": value for name, value in options.items() if name != "halt_on_ampl_error"}
    ipopt = ca.nlpsol("ipopt", "ipopt", {"x": x, "f": read.f, "g": g}, {"print_time": False, **given})
    found = ipopt(x0=read.x_init, lbx=read.x_lb, ubx=read.x_ub, lbg=read.g_lb, ubg=read.g_ub)
    status = ipopt.stats()["return_status"]
    duals, primals = found["lam_g"].full().ravel(), found["x"].full().ravel()
    counts = [len(duals), len(duals), len(primals), len(primals)]
    lines = [f"Ipopt: {status}", "", "Options", 3, 1, 1, 0, *counts, *map(repr, map(float, [*duals, *primals]))]
    problem.with_suffix(".sol").write_text("\n".join(map(str, [*lines, f"objno 0 {CODES.get(status, FAILED)}", ""])))


if __name__ == "__main__":
    if sys.argv[1:] == ["-v"]:
        print("Ipopt 3.14.19 (CasADi)")
    else:
        solve(Path(sys.argv[1]).with_suffix(".nl"), dict(option(text) for text in sys.argv[2:] if "=" in text))
