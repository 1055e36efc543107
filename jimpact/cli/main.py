"""The command line. Heavy imports wait until a command runs, and the study was checked.

Ctrl-C ends a command at once, whatever it does: XLA cannot be interrupted by an exception while
it compiles. What is done is told, and what is on the disk is kept.
"""

import contextlib
import gc
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any

BAD_INPUT, FAILURE = 2, 1  # exit codes
INTERRUPTED = 130  # what a shell expects of a program that ctrl-C ended
WORTH_KEEPING = "0"  # seconds of compiling: also single operations, of which there are many
RARELY = 100_000  # new objects until garbage is collected: imports and tracing make many that stay
SHOW_CURSOR = b"\r\n\x1b[?25h"  # which a progress bar had hidden

WELCOME = """\
jimpact: differentiable laws for impacts with several contacts.

  jimpact fit          fit a law to measured velocities (bundled: three balls)
  jimpact compare      every law on one impact, side by side
  jimpact simulate     a whole motion (bundled: Newton's cradle)
  jimpact montecarlo   random gaps, velocities and parameters
  jimpact advise       the simplest law and method that an impact needs
  jimpact chart        how exact and how fast the methods are
  jimpact stability    where they fail
  jimpact laws         what the laws say, and when they are right

Your own data: `jimpact new fit` writes a study, a CSV file and a notebook to
start from; then `jimpact fit my_fit`.

`jimpact COMMAND --help` tells all options, `jimpact --version` the version.
"""


class Call:
    """What the program was asked, and what it has done of it."""

    given: Any = None  # the command with its options, once they are read
    steps: Any = None

    @property
    def name(self) -> str:
        """What messages begin with."""
        return "jimpact" if self.given is None else f"jimpact {self.given.name()}"

    def farewell(self) -> str:
        """What is said to one who interrupts."""
        done = f" after: {'; '.join(self.steps.done)}" if self.steps and self.steps.done else ""
        kept = "" if self.given is None else self.given.kept()
        return f"{self.name}: stopped{done}. {kept}".rstrip()

    def refused(self, reason: Any, code: int) -> int:
        """The exit code, after the reason is told."""
        print(f"{self.name}: {reason}", file=sys.stderr)
        return code


def program() -> int:
    """The entry point of the program `jimpact`; what `main` does, and ctrl-C ends it."""
    gc.set_threshold(RARELY)
    call = Call()
    end_on_interrupt(call.farewell)
    # what is piped or kept in a file has no terminal to ask for its width
    os.environ.setdefault("COLUMNS", str(shutil.get_terminal_size((80, 24)).columns))
    try:
        code = main(call=call)
        sys.stdout.flush()
    except BrokenPipeError:  # whoever read has read enough, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except KeyboardInterrupt:  # where signals cannot be waited for
        print(call.farewell(), file=sys.stderr)
        code = INTERRUPTED
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done; the interpreter may clean up
    return code


def main(arguments: list[str] | None = None, call: Call | None = None) -> int:
    """The exit code: 0; wrong input 2, a method or law that fails 1, ctrl-C 130."""
    arguments = sys.argv[1:] if arguments is None else arguments
    call = call or Call()
    if arguments == ["--version"]:
        from jimpact import __version__

        print(f"jimpact {__version__}")
        return 0
    if not arguments:
        print(WELCOME, end="")
        return 0
    given = call.given = parsed(arguments)
    try:
        given.check()
        if given.light:
            return given.run()
        folder = keep_programs(given.no_cache)
        from jimpact.cli.commands import run
        from jimpact.progress import Steps

        call.steps = Steps(call.name)
        failure = run(given, call.steps, folder)
        return call.refused(failure, FAILURE) if failure else 0
    except BrokenPipeError:
        raise
    except (ValueError, TypeError, OSError, ImportError) as error:
        return call.refused(error, BAD_INPUT)
    except RuntimeError as error:
        return call.refused(error, FAILURE)


def parsed(arguments: list[str]) -> Any:
    """The options of the command that these arguments mean."""
    import functools
    import operator
    from typing import Annotated

    import tyro

    from jimpact.cli.options import COMMANDS

    commands: list[Any] = [Annotated[x, tyro.conf.subcommand(x.name())] for x in COMMANDS]
    return tyro.cli(
        functools.reduce(operator.or_, commands),
        prog="jimpact",
        config=(tyro.conf.FlagCreatePairsOff,),
        description="Impact laws for several simultaneous contacts. --version: the version.",
        args=arguments,
    )


def keep_programs(no_cache: bool) -> str | None:
    """Have JAX keep what it compiles, before it is imported; settings of the user's own stay.

    In the folder `JIMPACT_CACHE` (empty: nowhere), else in the user's cache folder. Returns the
    folder for programs that are kept whole, in which JAX has its own.
    """
    root = os.environ.get("JIMPACT_CACHE")
    if no_cache:
        os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"
    if no_cache or root == "":
        return None
    import platformdirs

    # One for each kind of processor: a home may be shared by machines that differ.
    root = root or platformdirs.user_cache_dir("jimpact")
    folder = os.path.join(root, f"programs-{_processor()}")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", os.path.join(folder, "jax"))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", WORTH_KEEPING)
    return folder


def _processor() -> str:
    import hashlib
    import platform

    kind = platform.machine() + platform.processor()
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as info:
        kind += next((line for line in info if line.startswith(("flags", "Features"))), "")
    return hashlib.sha256(kind.encode()).hexdigest()[:8]


def end_on_interrupt(farewell: Callable[[], str]) -> None:
    """From now on ctrl-C says farewell and ends the process, also amid compiled code.

    A thread waits for the signal: Python's own handlers run only between two instructions of the
    main thread, which a compiler may keep for ten seconds, and an exception raised amid calls of
    XLA is lost or fatal. Where ctrl-C is ignored it stays so.
    """
    if os.name != "posix" or signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        return
    once = threading.Lock()
    listen, tell = os.pipe()
    os.set_blocking(tell, False)

    def end(*_: Any) -> None:
        if once.acquire(blocking=False):
            text = farewell().encode() + b"\n"
            os.write(2, (SHOW_CURSOR if os.isatty(2) else b"") + text)
            os._exit(INTERRUPTED)

    def wait() -> None:
        while os.read(listen, 1)[0] != signal.SIGINT:
            pass
        end()

    signal.signal(signal.SIGINT, end)
    signal.set_wakeup_fd(tell, warn_on_full_buffer=False)
    threading.Thread(target=wait, daemon=True).start()
