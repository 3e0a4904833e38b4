"""What ends a verb before its time: Ctrl-C and SIGTERM, wherever they meet the program."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any, NoReturn

from identification import ArmcalError


@contextmanager
def stoppable() -> Iterator[None]:
    """SIGTERM ends a verb as Ctrl-C does: finished rows stay, no process and no half-written file does."""
    came: list[KeyboardInterrupt] = []

    def stop(number: int, _: object) -> NoReturn:
        came.append(KeyboardInterrupt(*([] if number == signal.SIGINT else [signal.Signals(number).name])))
        threading.excepthook = lambda _: None  # of threads whose processes are killed next
        raise came[0]

    with ExitStack() as stack:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                if (before := signal.getsignal(number)) in (signal.SIG_DFL, signal.default_int_handler):
                    stack.callback(signal.signal, number, before)
                    signal.signal(number, stop)
            stack.callback(setattr, sys, "unraisablehook", sys.unraisablehook)
            stack.callback(setattr, threading, "excepthook", threading.excepthook)
            sys.unraisablehook = partial(_lost_no_signal, sys.unraisablehook, came)
        try:
            yield
        except ArmcalError:
            raise
        except Exception:  # what a library in C makes of the signal while it is loaded
            if came:
                raise came[0] from None
            raise


def _lost_no_signal(otherwise: Callable[[Any], object], came: list[KeyboardInterrupt], unraisable: Any) -> None:
    """A signal that met the end of an object, where nothing can be raised, comes again a little later.

    came : signals, after which nothing else that objects say at their end is reported
    """
    if isinstance(unraisable.exc_value, KeyboardInterrupt):
        number = signal.Signals[next(iter(unraisable.exc_value.args), "SIGINT")]
        send: Callable[[int], None] = signal.raise_signal
        if hasattr(signal, "pthread_kill"):  # to the main thread, where it ends a wait too; in the timer's it would not
            send = partial(signal.pthread_kill, threading.main_thread().ident or 0)
        threading.Timer(0.01, send, (number,)).start()
    elif not came:
        otherwise(unraisable)


def stopped_by(error: BaseException) -> str:
    """What ended the work: the user or a signal."""
    return f"stopped by {next(iter(error.args), 'Ctrl-C')}"
