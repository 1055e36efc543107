"""When a page was written, and by which code: the last line of pages that scripts of hours write."""

import datetime
import subprocess
from pathlib import Path


def written() -> str:
    """The sentence, with the date and the commit of this clone."""
    command = ["git", "rev-parse", "--short=8", "HEAD"]
    commit = subprocess.run(
        command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
    ).stdout.strip()
    return f"Written on {datetime.date.today():%d %B %Y}, at commit {commit}.\n"
