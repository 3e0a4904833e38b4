"""The command `armcal`, and `python -m doe` where it is not installed as a script."""

import signal


def run() -> None:
    """The command. Ctrl-C before a verb begins, and after it, ends the process without a word."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from doe.cli import main

    try:
        main(prog_name="armcal")
    finally:
        # if a signal came while a library ran source text, `python -m` would end by SIGINT instead of with our exit
        # code; Python forgets it once other source text has run
        exec("")


if __name__ == "__main__":
    run()
