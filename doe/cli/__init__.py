"""The command `armcal`: one verb = parse, call one function, print. Solvers are imported inside the verbs only."""

from doe.cli.main import main

__all__ = ["main"]
