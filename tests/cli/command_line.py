"""The command line, called in this process: `main(arguments)` returns the exit code."""

from jimpact.cli.main import main as main
