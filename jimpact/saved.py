"""Saved results, read again."""

import zipfile
from pathlib import Path
from typing import Any

from jimpact.fits.report import Fit, load_fit
from jimpact.motion.record import Motion, read_motion


def load(path: str | Path) -> Fit[Any] | Motion:
    """Read the fit or the motion that `Fit.save` or `Motion.save` wrote.

    The classes of laws and scenes of a fit are imported by name, so read only files
    that you trust. The file of a motion, or of a batch, does not hold its system and
    law.

    Args:
        path: the file.

    Returns:
        `Fit` or `Motion`.

    Raises:
        FileNotFoundError: no such file. ValueError: neither a fit nor a motion, one of
            another format, a law that cannot be imported, or a motion in double
            precision while JAX is in single precision. (A fit stays in its own
            precision.)

    >>> import pathlib, tempfile, jimpact as ji
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> data = ji.Experiments(
    ...     [[1.0, 0.0], [2.0, 0.0]], [[0.3, 0.7], [0.6, 1.4]], sigma=0.02
    ... )
    >>> fit = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> ji.load(fit.save(folder / "fit.json")).verdict == fit.verdict
    True
    >>> ball, law = ji.System(ji.Column([1.0]), gravity=True), ji.Newton(0.5)
    >>> motion = ji.simulate(ball, law, [1.0], [0.0], 1.0, samples=21)
    >>> loaded = ji.load(motion.save(folder / "ball.npz"))
    >>> both = loaded.then(ji.simulate(ball, law, **loaded.restart(2.0), samples=21))
    >>> len(both.time), [round(float(t), 4) for t in both.event_times()[:3]]
    (41, [0.4516, 0.9032, 1.129])
    """
    path = Path(path)
    is_motion = path.suffix == ".npz" or zipfile.is_zipfile(path)
    if is_motion:
        return read_motion(path)
    return load_fit(path)
