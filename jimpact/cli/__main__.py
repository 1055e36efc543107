"""`python -m jimpact.cli` is the command `jimpact`."""

from jimpact.cli.main import program

if __name__ == "__main__":
    program()
