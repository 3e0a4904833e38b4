"""IPOPT as the executable that Pyomo calls, from CasADi's wheel: `python ipopt_nl.py problem.nl -AMPL name=value ...`.

No package registry has the executable itself; where one is on the path, that is used instead.
"""

import sys
from pathlib import Path

import casadi as ca

CODES = {"Solve_Succeeded": 0, "Solved_To_Acceptable_Level": 0, "Infeasible_Problem_Detected": 200}  # AMPL's
CODES["Maximum_Iterations_Exceeded"] = 400


def solve(problem: Path, options: dict[str, int | str]) -> None:
    """Writes problem.sol."""
    read = ca.NlpBuilder()
    read.import_nl(str(problem))
    x, g = ca.vertcat(*read.x), ca.vertcat(*read.g)
    given = {f"ipopt.{name}": value for name, value in options.items() if name != "halt_on_ampl_error"}
    ipopt = ca.nlpsol("ipopt", "ipopt", {"x": x, "f": read.f, "g": g}, {"print_time": False, **given})
    solution = ipopt(x0=read.x_init, lbx=read.x_lb, ubx=read.x_ub, lbg=read.g_lb, ubg=read.g_ub)
    status = ipopt.stats()["return_status"]
    duals, primals = solution["lam_g"].full().ravel(), solution["x"].full().ravel()
    counts = [len(duals), len(duals), len(primals), len(primals)]
    lines = [f"Ipopt: {status}", "", "Options", 3, 1, 1, 0, *counts, *map(repr, map(float, [*duals, *primals]))]
    problem.with_suffix(".sol").write_text("\n".join(map(str, [*lines, f"objno 0 {CODES.get(status, 500)}", ""])))


if __name__ == "__main__":
    if sys.argv[1:] == ["-v"]:
        print("Ipopt 3.14.19 (CasADi)")
    else:
        pairs = (text.split("=", 1) for text in sys.argv[2:] if "=" in text)
        options = {name: int(value) if value.isdigit() else value for name, value in pairs}
        solve(Path(sys.argv[1]).with_suffix(".nl"), options)
