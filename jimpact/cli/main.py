"""The program `jimpact`. Heavy imports wait until a command runs.

Ctrl-C ends a command at once, whatever it does: XLA cannot be interrupted by an
exception while it compiles. The message says which steps are done and what remains on
the disk.
"""

import contextlib
import gc
import os
import shutil
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from typing import Any

# exit codes
BAD_INPUT = 2
FAILURE = 1
INTERRUPTED = 130  # what a shell expects of a program that ctrl-C ended
# Seconds of compiling from which JAX keeps a program: also single operations, which are
# many.
LEAST_COMPILE_TIME = "0"
# New objects until garbage is collected (Python: 700). Imports and tracing make many
# that live on, and each collection would search them again.
COLLECT_EVERY = 100_000
SHOW_CURSOR = b"\r\n\x1b[?25h"  # which a progress bar had hidden

WELCOME = """\
jimpact: differentiable laws for impacts with several contacts.

  jimpact fit          fit a law to measured velocities (bundled: three balls)
  jimpact compare      every law on one impact, side by side
  jimpact simulate     a whole motion (bundled: Newton's cradle)
  jimpact montecarlo   random gaps, velocities and parameters
  jimpact advise       the simplest law and method that an impact needs
  jimpact chart        how exact and how fast the methods are
  jimpact stability    where the methods fail
  jimpact laws         what each law assumes, and when it is right

Your own data: `jimpact new fit` writes a study, a CSV file and a notebook to
start from; then `jimpact fit my_fit`. From the places that a camera saw:
`jimpact new fit --like ball_track.toml`.

`jimpact COMMAND --help` lists all options, `jimpact --version` the version.
"""


class Call:
    """One call of the program: the command with its options, and its steps."""

    command: Any = None  # until the options are parsed
    steps: Any = None

    def __init__(self) -> None:
        self.warnings: set[str] = set()

    @property
    def name(self) -> str:
        """The words that messages begin with."""
        if self.command is None:
            return "jimpact"
        return f"jimpact {self.command.name()}"

    def interrupt_message(self) -> str:
        """Message after ctrl-C: the steps that are done, and the results that are in
        files.

        Commands that can do so print and draw what is finished first.
        """
        if self.steps and self.steps.done:
            done = f" after: {'; '.join(self.steps.done)}"
        else:
            done = ""
        if self.steps is not None and self.steps.show_finished is not None:
            self.steps.show_finished()
            sys.stdout.flush()
            remains = "What was finished is printed and drawn."
        else:
            if self.command is None:
                remains = ""
            else:
                remains = self.command.remains()
        return f"{self.name}: stopped{done}. {remains}".rstrip()

    def warn(self, message: Any, *_: Any) -> None:
        """Print a warning, once: a file may be read twice. It replaces
        `warnings.showwarning`.
        """
        if str(message) not in self.warnings:
            self.warnings.add(str(message))
            print(f"{self.name}: {message}", file=sys.stderr)

    def fail(self, reason: Any, code: int) -> int:
        """Print the reason of a failure, and return the exit code."""
        print(f"{self.name}: {reason}", file=sys.stderr)
        return code


def program() -> int:
    """The entry point of the program `jimpact`: `main`, which ctrl-C ends at once."""
    gc.set_threshold(COLLECT_EVERY)
    call = Call()
    end_on_interrupt(call.interrupt_message)
    # a pipe or a file has no terminal to ask for its width
    os.environ.setdefault("COLUMNS", str(shutil.get_terminal_size((80, 24)).columns))
    try:
        code = main(call=call)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader stopped reading, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except KeyboardInterrupt:  # where signals cannot be waited for
        print(call.interrupt_message(), file=sys.stderr)
        code = INTERRUPTED
    # all is done; the interpreter may clean up, without looking for garbage in all
    # objects, which takes half as long as importing them
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()
    return code


def main(arguments: list[str] | None = None, call: Call | None = None) -> int:
    """Run the program with `arguments` (None: those of the shell), and return the exit
    code.

    0; wrong input 2, a method or law that fails 1, ctrl-C 130.
    """
    if arguments is None:
        arguments = sys.argv[1:]
    call = call or Call()
    if arguments == ["--version"]:
        from jimpact import __version__

        print(f"jimpact {__version__}")
        return 0
    if not arguments:
        print(WELCOME, end="")
        return 0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = call.warn  # type: ignore[assignment]
            return run_command(call, arguments)
    except BrokenPipeError:
        raise
    except (ValueError, TypeError, OSError, ImportError) as error:
        return call.fail(error, BAD_INPUT)
    except RuntimeError as error:
        return call.fail(error, FAILURE)


def run_command(call: Call, arguments: list[str]) -> int:
    """Parse the arguments, check the options, run the command, and return the exit
    code.
    """
    command = call.command = parse(arguments)
    command.check()
    if command.light:
        return command.run()
    folder = cache_folder(command.no_cache)
    if folder is not None:
        from jimpact.tools.kept_programs import keep_programs

        # a folder that cannot be made: compiled anew
        with contextlib.suppress(OSError):
            keep_programs(folder)
    from jimpact.cli.commands import run
    from jimpact.tools.progress import Steps

    call.steps = Steps(call.name)
    failure = run(command, call.steps)
    if failure:
        return call.fail(failure, FAILURE)
    return 0


def parse(arguments: list[str]) -> Any:
    """Options of the command that the arguments name, an object of its class in
    `options`.
    """
    import functools
    import operator
    from typing import Annotated

    from jimpact.tools.checks import check_word, needed

    tyro = needed("tyro", "pip install tyro")
    from jimpact.cli.options import COMMANDS

    named = {x.name(): x for x in COMMANDS}
    word = arguments[0]
    config = (tyro.conf.FlagCreatePairsOff,)
    if not word.startswith("-"):  # by itself, so that messages name its own help
        check_word("the command", word, named)
        return tyro.cli(
            named[word], prog=f"jimpact {word}", config=config, args=arguments[1:]
        )
    commands: list[Any] = [
        Annotated[x, tyro.conf.subcommand(name)] for name, x in named.items()
    ]
    return tyro.cli(
        functools.reduce(operator.or_, commands),
        prog="jimpact",
        config=config,
        description=(
            "Impact laws for several simultaneous contacts. --version: the version."
        ),
        args=arguments,
    )


def cache_folder(no_cache: bool) -> str | None:
    """The folder of compiled programs, ours and those that JAX keeps of itself; None:
    none, with `no_cache` or where `JIMPACT_CACHE` is empty.

    JAX is told before it is imported; a folder that the user has set for it stays. Ours
    is in the folder `JIMPACT_CACHE`, else in the user's cache folder.
    """
    root = os.environ.get("JIMPACT_CACHE")
    if no_cache or root == "":
        return None
    from jimpact.tools.checks import needed

    platformdirs = needed("platformdirs", "pip install platformdirs")
    # One for each kind of processor: a home may be shared by machines that differ.
    root = root or platformdirs.user_cache_dir("jimpact")
    folder = os.path.join(root, f"programs-{_processor()}")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", folder)
    os.environ.setdefault(
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", LEAST_COMPILE_TIME
    )
    return folder


def _processor() -> str:
    """A short name for this kind of processor."""
    import hashlib

    from jimpact.tools.processor import processor

    return hashlib.sha256(processor().encode()).hexdigest()[:8]


def end_on_interrupt(message: Callable[[], str]) -> None:
    """From now on ctrl-C prints a message and ends the process, also within compiled
    code.

    A thread waits for the signal: Python's own handlers run only between two
    instructions of the main thread, which a compiler may keep for ten seconds, and an
    exception raised within calls of XLA is lost or fatal. Where ctrl-C was ignored it
    remains ignored.
    """
    if os.name != "posix" or signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        return
    once = threading.Lock()
    reading_end, writing_end = os.pipe()
    os.set_blocking(writing_end, False)

    def end(*_: Any) -> None:
        """Print the message and end, once."""
        if once.acquire(blocking=False):
            text = message().encode() + b"\n"
            os.write(2, (SHOW_CURSOR if os.isatty(2) else b"") + text)
            os._exit(INTERRUPTED)

    def wait() -> None:
        """Wait until the pipe delivers the number of an interrupt, then end the
        process.
        """
        while os.read(reading_end, 1)[0] != signal.SIGINT:
            pass
        end()

    signal.signal(signal.SIGINT, end)
    signal.set_wakeup_fd(writing_end, warn_on_full_buffer=False)
    threading.Thread(target=wait, daemon=True).start()
