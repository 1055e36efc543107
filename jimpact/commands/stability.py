"""`jimpact stability`: where methods of integration are right, and where they are not; pictures."""

from typing import Any

from jimpact import plot
from jimpact.cli import StabilityCommand
from jimpact.commands.output import Answer, picture_path
from jimpact.methods.stability import stability_map

STEPS = 5_000  # of a run
QUICK_RESOLUTION, FULL_RESOLUTION, FULL_SAMPLES = 7, 9, 300
TITLE = "LZB, three equal Hertz balls, e = 0.9 (triangles), one axis changed at a time"


def run(given: StabilityCommand) -> Answer:
    """Map; the picture of single axes, and where there are pairs, one more beside it a method."""
    path = picture_path(given)
    size: dict[str, Any] = {"resolution": QUICK_RESOLUTION}
    if given.full:
        size = {"resolution": FULL_RESOLUTION, "slices": "pairs", "samples": FULL_SAMPLES}
    found = stability_map(given.methods, **size, max_steps=STEPS)
    pictures = {path: plot.stability_map(found, TITLE)}
    for name in found.methods if given.full else ():
        beside = path.with_name(f"{path.stem}-{name.replace('_', '-')}{path.suffix}")
        pictures[beside] = plot.stability_pairs(found, name)
    return Answer("", found.to_dict(), str(found), pictures)
