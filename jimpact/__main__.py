"""`python -m jimpact` is the command `jimpact`."""

import sys

from jimpact.cli.main import program

if __name__ == "__main__":
    sys.exit(program())
