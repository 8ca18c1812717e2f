"""Tracks as curvilinear frames: build, load, check, project points."""

from driftjax.track.check import check_width as check_width
from driftjax.track.frame import Track as Track
from driftjax.track.frame import curvilinear_rates as curvilinear_rates
from driftjax.track.frame import resample as resample
from driftjax.track.load import load_track as load_track
