"""Checks of tracks; each error is one sentence with place and remedy."""

import numpy as np

from driftjax.core import BadInput
from driftjax.track.frame import Track

MIN_POINTS = 5


def _where(track: Track, i: int, rows) -> str:
    return f", row {rows[i]}" if rows is not None else f" at s = {float(track.s[i]):.4g} m"


def check_folding(track: Track, source: str, rows=None) -> None:
    """Raise `BadInput` if the inner border of a bend passes the centre of curvature (kappa w >= 1)."""
    kappa, right, left = (np.asarray(v) for v in (track.kappa, track.w_right, track.w_left))
    fold = np.maximum(kappa * left, -kappa * right)
    if np.any(fold >= 1):
        i = int(np.argmax(fold))
        raise BadInput(
            f"{source}{_where(track, i, rows)}: the inner border folds over itself (radius"
            f" {1 / abs(kappa[i]):.4g} m, width {fold[i] / abs(kappa[i]):.4g} m); correct the width, smooth"
            " the centre line, or load the track with 'narrow'."
        )


def check_crossing(track: Track, source: str, rows=None) -> None:
    """Raise `BadInput` if the centre line crosses itself."""
    stride = max(1, len(track.s) // 1500)
    index = np.arange(0, len(track.s), stride)
    p = np.stack([np.asarray(track.x)[index], np.asarray(track.y)[index]], axis=1)
    if track.closed:
        p = np.concatenate([p, p[:1]])
    a, d = p[:-1], np.diff(p, axis=0)
    cross = lambda u, v: u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    denominator = cross(d[:, None], d[None, :])
    between = a[None, :] - a[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = cross(between, d[None, :]) / denominator
        u = cross(between, d[:, None]) / denominator
    low, high = -1e-9, 1 + 1e-9  # a crossing right at a grid point counts
    apart = np.abs(np.subtract.outer(np.arange(len(d)), np.arange(len(d))))
    apart = np.minimum(apart, len(d) - apart) if track.closed else apart
    hit = (apart > 1) & (denominator != 0) & (t > low) & (t < high) & (u > low) & (u < high)
    if np.any(hit):
        i, j = np.argwhere(hit)[0]
        first, second = (_where(track, int(index[k]), rows).removeprefix(",") for k in sorted((i, j)))
        raise BadInput(f"{source}: crosses itself near{first} and{second}; give a centre line that does not.")


def check_width(track: Track, car_width: float, source: str) -> None:
    """Raise `BadInput` if the track is narrower than a car of `car_width` [m]."""
    total = np.asarray(track.w_right) + np.asarray(track.w_left)
    i = int(np.argmin(total))
    if total[i] <= car_width:
        raise BadInput(
            f"{source}{_where(track, i, None)}: {total[i]:.4g} m wide, but the car is {car_width:.4g} m wide;"
            " widen the track or choose a narrower car."
        )
