"""`jimpact stability`: where methods of integration are right, and where they are not; pictures."""

from pathlib import Path

from jimpact.commands.output import Answer, command, save_picture
from jimpact.methods.stability import StabilityMap, stability_map

QUICK_RESOLUTION, QUICK_STEPS = 7, 5_000
FULL_RESOLUTION, FULL_STEPS, FULL_SAMPLES = 9, 5_000, 300


@command("stability")
def run(methods: tuple[str, ...] | None, full: bool, picture: Path) -> Answer:
    """Map with the options of `StabilityCommand`."""
    if full:
        found = stability_map(
            methods,
            resolution=FULL_RESOLUTION,
            slices="pairs",
            samples=FULL_SAMPLES,
            max_steps=FULL_STEPS,
        )
    else:
        found = stability_map(methods, resolution=QUICK_RESOLUTION, max_steps=QUICK_STEPS)
    written = [str(path) for path in draw(found, picture)]
    text = f"{found}\n\nPictures: {', '.join(written)}"
    return Answer(found.to_dict() | {"pictures": written}, lambda: print(text))


def draw(found: StabilityMap, path: Path) -> list[Path]:
    """Write the picture over single axes to `path`; where the map has pairs, one more a method."""
    from jimpact import plot  # matplotlib, late

    title = "LZB, three equal Hertz balls, e = 0.9 (triangles), one axis changed at a time"
    save_picture(plot.stability_map(found, title), path)
    written = [path]
    if any(len(each.axes) == 2 for each in found.slices[found.methods[0]]):
        for name in found.methods:
            beside = path.with_name(f"{path.stem}-{name.replace('_', '-')}{path.suffix}")
            save_picture(plot.stability_pairs(found, name), beside)
            written.append(beside)
    return written
