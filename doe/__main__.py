"""`python -m doe`: the command `armcal`, where it is not installed as a script."""

from doe.cli import main

main(prog_name="armcal")
