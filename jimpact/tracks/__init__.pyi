"""Public names of `ji.tracks` and where they live."""

from .bounces import bounce_times as bounce_times
from .impacts_in_tracks import find_impacts as find_impacts
from .tables_of_tracks import read as read
from .track import Track as Track, TrackImpact as TrackImpact
