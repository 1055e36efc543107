"""From the camera to a fit: velocities at impacts from tracks and bounce times.

>>> import jimpact as ji
>>> shots = ji.tracks.bounce_times([0.0, 0.5, 0.9, 1.22], sigma=0.001)
>>> shots.pre.shape
(2, 1)
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
