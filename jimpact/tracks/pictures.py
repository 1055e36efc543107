"""Pictures: a track with its flights and impacts, and what is left of it."""

import numpy as np
from matplotlib.figure import Figure

from jimpact.plot.style import COLOURS, GREY, new_figure, styled
from jimpact.tools.records import counted
from jimpact.tracks.track import Track

_HEIGHT = 2.8  # of a row [in]
_BEYOND = 5.0  # sigmas that the panel of residuals shows, unless flights leave more


@styled(Track)
def track(track: Track, title: str = "") -> Figure:
    """Coordinates over time with the arcs of the flights, above the residuals in sigma.

    Args:
        track: of `ji.tracks.find_impacts`.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else than a track.

    >>> import numpy as np
    >>> import jimpact as ji
    >>> t = np.arange(40) / 100
    >>> figure = ji.plot.track(ji.tracks.find_impacts(t, np.abs(t - 0.2), sigma=0.001))
    >>> len(figure.axes)
    2
    """
    measured = track.coordinates  # (K, n)
    n = measured.shape[1]
    count = len(track.impacts)
    heading = title or counted(count, "impact")
    figure, panels = new_figure(_HEIGHT * n, heading, n, 2, squeeze=False)
    for c, (places, rest) in enumerate(panels):
        colour = COLOURS[c % len(COLOURS)]
        unit = track.units[c].split("/")[0]
        fitted = measured[:, c] - track.residual[:, c] * track.sigma[c]
        places.plot(track.t, measured[:, c], ".", color=GREY)
        for frames in track.flights:
            places.plot(track.t[frames], fitted[frames], color=colour)
            rest.plot(track.t[frames], track.residual[frames, c], ".", color=colour)
        for each in track.impacts:
            for axis in (places, rest):
                axis.axvline(each.time, color=GREY, linestyle=":")
        places.set(xlabel="time [s]", ylabel=f"coordinate {c + 1} [{unit}]")
        rest.set(xlabel="time [s]", ylabel="residual / sigma")
        rest.set_ylim(
            *np.array([-1, 1]) * max(_BEYOND, np.nanmax(np.abs(track.residual[:, c])))
        )
    return figure
