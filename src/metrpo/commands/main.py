"""The command line: finds the command in the table, runs it and returns its exit code.

Modules that import JAX or MuJoCo are imported where they are used: help must come at once, and JAX reads its
environment variables when imported.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Sequence

from metrpo.commands.attend import say, say_how_to_resume
from metrpo.commands.command_table import handler
from metrpo.commands.parse import parse
from metrpo.console.encoding import print_anywhere
from metrpo.console.interrupt import Stopped
from metrpo.console.progress import mute_broken_output
from metrpo.errors import MetrpoError
from metrpo.run.machine import settle_libraries


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit code: 0, 2 after a wrong input, 130 after Ctrl-C, 143 after SIGTERM."""
    arguments = list(sys.argv[1:] if argv is None else argv) or ["--help"]
    _occupy_standard_files()
    print_anywhere()
    settle_libraries()
    logging.basicConfig(format="metrpo: %(message)s", level=logging.WARNING)
    if arguments == ["--version"]:
        return _version()
    try:
        options = parse(arguments)
        return handler(arguments[0])(options)
    except MetrpoError as error:
        say(f"metrpo: {error}")
        say_how_to_resume(error, arguments)
        return 2
    except KeyboardInterrupt as stopped:
        _end_in_peace(argv)
        say_how_to_resume(stopped, arguments)
        return 130
    except Stopped as stopped:
        _end_in_peace(argv)
        say_how_to_resume(stopped, arguments)
        return 128 + stopped.number
    except BrokenPipeError:  # `metrpo train --help | head`
        return 1
    except SystemExit as end:  # tyro has printed help (0) or what was wrong (2)
        return end.code if isinstance(end.code, int) else 2
    finally:
        mute_broken_output()  # the interpreter flushes once more


def _end_in_peace(argv: Sequence[str] | None) -> None:
    """Where the process ends anyway, one more Ctrl-C would only show a traceback of the interpreter's own end."""
    if argv is None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _occupy_standard_files() -> None:
    # Started with stdout or stderr closed, the next file opened would take its place, and a library's warnings.
    while (handle := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(handle, True)
    os.close(handle)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - as long as the process


def _version() -> int:
    from metrpo.run.files import metrpo_version

    print(f"metrpo {metrpo_version()}")
    return 0
