"""`jimpact stability`: where methods of integration are right, and where they are not; pictures."""

import sys
from json import dumps
from pathlib import Path

import jax

from jimpact.commands.output import INTERRUPTED, picture_path, save_picture
from jimpact.methods.stability import StabilityMap, stability_map

PICTURE = "jimpact-stability.png"
QUICK_RESOLUTION, QUICK_STEPS = 7, 5_000
FULL_RESOLUTION, FULL_STEPS, FULL_SAMPLES = 9, 5_000, 300


def run(methods: tuple[str, ...] | None, full: bool, out: Path, json: bool) -> int:
    """Run the command with the options of `StabilityCommand`; 2 for bad input, 1 where a method
    broke down, 130 after ctrl-C, told on stderr.
    """
    jax.config.update("jax_enable_x64", True)  # the program's choice; the library sets nothing
    try:
        path = picture_path(out, PICTURE)
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
        pictures = draw(found, path)
    except KeyboardInterrupt:
        print("jimpact stability: stopped.", file=sys.stderr)
        return INTERRUPTED
    except (ValueError, TypeError, OSError) as error:
        print(f"jimpact stability: {error}", file=sys.stderr)
        return 2
    except RuntimeError as error:  # of a method's own code
        print(f"jimpact stability: {error}", file=sys.stderr)
        return 1
    told = [str(picture) for picture in pictures]
    if json:
        print(dumps(found.to_dict() | {"pictures": told}, indent=2))
    else:
        print(f"{found}\n\nPictures: {', '.join(told)}")
    return 0


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
