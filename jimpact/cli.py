"""The command line. Heavy imports wait until a command runs."""

import functools
import operator
import sys
from typing import Annotated, Any

import tyro

from jimpact import __version__
from jimpact.options import COMMANDS


def main(arguments: list[str] | None = None) -> int:
    """Entry point; exit code 2 for bad input."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"jimpact {__version__}")
        return 0
    commands: list[Any] = [Annotated[x, tyro.conf.subcommand(x.name())] for x in COMMANDS]
    command: Any = tyro.cli(
        functools.reduce(operator.or_, commands),
        prog="jimpact",
        config=(tyro.conf.FlagCreatePairsOff,),
        description="Differentiable impact laws for several simultaneous contacts. "
        "--version prints the version.",
        args=arguments,
    )
    from jimpact.commands import run

    return run(command)


if __name__ == "__main__":
    sys.exit(main())
