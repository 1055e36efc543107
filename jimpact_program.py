"""What the console script `jimpact` imports first, so that ctrl-C has an answer from the start."""

import signal


def program() -> int:
    """Do what `jimpact.cli` does; until it listens, ctrl-C ends the process without a word."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from jimpact.cli import program as whole

    return whole()
