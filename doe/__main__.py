"""The command `armcal`, and `python -m doe` where it is not installed as a script."""

import atexit
import os
import signal
import sys
from contextlib import suppress


def run() -> None:
    """The command. Ctrl-C before a verb begins, and after it, ends the process without a word."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from doe.cli import main

    try:
        main(prog_name="armcal")
    except SystemExit as ended:
        if ended.code and isinstance(ended.code, int):
            # without tearing down what is loaded: a C library that a signal met half loaded may abort then
            atexit._run_exitfuncs()
            for stream in filter(None, (sys.stdout, sys.stderr)):
                with suppress(OSError, ValueError):  # closed, or nobody reads it: what there was to say is said
                    stream.flush()
            os._exit(ended.code)
        raise
    finally:
        # if a signal came while a library ran source text, `python -m` would end by SIGINT instead of with our exit
        # code; Python forgets it once other source text has run
        exec("")


if __name__ == "__main__":
    run()
