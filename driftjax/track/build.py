"""Tracks from straights, arcs and clothoid ramps, or through measured points."""

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike

from driftjax.core import BadInput, require
from driftjax.track.check import MIN_POINTS, check_crossing, check_folding
from driftjax.track.frame import Track

NARROWED = 0.9  # of the radius, left as width where a folding border is drawn in [-]
FINE = 16  # quadrature panels per grid cell or spline interval


def from_curvature(knots: ArrayLike, kappa: ArrayLike, width: float, num: int, closed: bool = False) -> Track:
    """Build a track with curvature linear between `knots` (arc lengths [m], from 0): straights, arcs, clothoids.

    Starts at the origin along +x, `width` [m] to either side. psi is exact; x and y by Gauss quadrature.
    """
    knots, kappa = np.asarray(knots, float), np.asarray(kappa, float)
    require(bool(np.all(np.diff(knots) > 0)), "the lengths of a track's parts must be positive.")
    steps = np.diff(knots) * (kappa[1:] + kappa[:-1]) / 2
    psi_knots = np.concatenate([[0.0], np.cumsum(steps)])

    def heading(s):
        i = np.clip(np.searchsorted(knots, s, side="right") - 1, 0, len(knots) - 2)
        d, slope = s - knots[i], (kappa[i + 1] - kappa[i]) / (knots[i + 1] - knots[i])
        return psi_knots[i] + kappa[i] * d + slope * d**2 / 2

    length = knots[-1]
    s = np.linspace(0.0, length, num + 1 if closed else num)
    nodes, weights = leggauss(3)
    fine = np.linspace(0.0, length, FINE * (len(s) - 1) + 1)
    h = fine[1] - fine[0]
    psi = heading(fine[:-1, None] + h * (nodes + 1) / 2)
    xy = [np.concatenate([[0.0], np.cumsum(f(psi) @ weights * h / 2)])[::FINE][: len(s)] for f in (np.cos, np.sin)]
    keep = slice(0, num)
    w = np.full(num, float(width))
    return Track(s[keep], xy[0][keep], xy[1][keep], heading(s)[keep], np.interp(s, knots, kappa)[keep], w, w,
                 length=length, closed=closed)  # fmt: skip


def _turn(ramp: float, radius: float, angle: float) -> list[tuple[float, float]]:
    """Return `(length, end kappa)` of ramp in, arc, ramp out with total turn `angle` (negative: right)."""
    require(ramp > 0 and radius > 0, f"ramp {ramp} and radius {radius} must both be positive, in metres.")
    arc = radius * abs(angle) - ramp
    require(arc > 0, f"ramps of {ramp} m at radius {radius} m turn more than {abs(angle):.3f} rad; shorten them.")
    kappa = float(np.sign(angle)) / radius
    return [(ramp, kappa), (arc, kappa), (ramp, 0.0)]


def _chain(parts: Sequence[tuple[float, float]], width: float, num: int, closed: bool = False) -> Track:
    lengths, kappas = zip(*parts, strict=True)
    return from_curvature(np.concatenate([[0.0], np.cumsum(lengths)]), [0.0, *kappas], width, num, closed)


def corner(
    straight_in: float,
    ramp: float,
    radius: float,
    angle: float,
    straight_out: float,
    width: float,
    num: int = 601,
) -> Track:
    """Build one corner between two straights: lengths in m, `width` to either side.

    Curvature is linear over `ramp`; `angle` [rad] is the total turn, ramps included; negative: right.
    """
    turn = _turn(ramp, radius, angle)
    track = _chain([(straight_in, 0.0), *turn, (straight_out, 0.0)], width, num)
    check_folding(track, "corner")
    check_crossing(track, "corner")
    return track


def playground(scale: float = 1.0, width: float = 3.0, num: int = 1600) -> Track:
    """Build a closed left-hand lap: a hairpin (R 15 m), a fast bend either way (R 45 m), two corners (R 22 m).

    `scale` multiplies all lengths except `width` [m] to either side. The two free straights close the lap exactly.
    """
    require(scale > 0, f"key 'scale' is {scale}; it must be positive.")
    half, fast = np.pi / 2, np.deg2rad(50.0)
    turns = [
        _turn(8, 15, np.pi),
        _turn(12, 45, -fast),
        _turn(12, 45, fast),
        _turn(8, 22, half),
        _turn(8, 22, half),
    ]

    def parts(first: float, last: float) -> list[tuple[float, float]]:
        straights = [first, 45.0, 15.0, 40.0, last]
        joined = [part for straight, turn in zip(straights, turns, strict=True) for part in [(straight, 0.0), *turn]]
        joined.append((30.0, 0.0))  # start and finish line 30 m after the last corner's exit
        return [(scale * length, kappa / scale) for length, kappa in joined]

    def gap(first: float, last: float) -> np.ndarray:
        end = _chain(parts(first, last), width, 2001)
        return np.array([end.x[-1], end.y[-1]])

    start = np.array([50.0, 50.0])  # the gap is linear in the two lengths: one Newton step is exact
    base = gap(*start)
    slopes = np.stack([gap(start[0] + 10, start[1]) - base, gap(start[0], start[1] + 10) - base], axis=1) / 10
    first, last = start - np.linalg.solve(slopes, base)
    track = _chain(parts(first, last), width, num, closed=True)
    check_folding(track, "playground")
    check_crossing(track, "playground")
    return track


def from_points(
    x: ArrayLike,
    y: ArrayLike,
    w_right: ArrayLike,
    w_left: ArrayLike,
    closed: bool,
    *,
    smoothing: float = 0.0,
    narrow: bool = False,
    num: int | None = None,
    source: str = "track",
    rows: ArrayLike | None = None,
) -> Track:
    """Build a track through points in driving order: cubic spline over chord length, even arc-length grid.

    `smoothing` [m]: root-mean-square distance by which the curve may miss the points (0: interpolates).
    `narrow`: where the inner border of a bend folds over itself, as noisy measurements do, draw it in to 0.9
    of the radius instead of raising. A closed track must not repeat its first point. `source` and `rows`
    (row of each point) name the input in errors.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    w_right, w_left = (np.broadcast_to(np.asarray(w, float), x.shape) for w in (w_right, w_left))
    rows = np.arange(1, len(x) + 1) if rows is None else np.asarray(rows)
    if len(x) < MIN_POINTS:
        raise BadInput(f"{source}: has {len(x)} points; a track needs at least {MIN_POINTS}.")
    px, py = (np.append(v, v[0]) if closed else v for v in (x, y))
    chord = np.hypot(np.diff(px), np.diff(py))
    if np.any(bad := chord <= 1e-6 * np.median(chord)):
        raise BadInput(f"{source}, row {rows[np.argmax(bad)]}: the next point repeats it; remove one of the two.")
    at = np.concatenate([[0.0], np.cumsum(chord)])
    curve = _spline(at, px, py, closed, smoothing)
    length, t = _arc_length(curve, at, num or int(np.clip(4 * len(x), 400, 4000)), closed)
    s = np.linspace(0.0, length, len(t), endpoint=not closed)
    (gx, gy), (dx, dy), (ddx, ddy) = (np.asarray(curve(t, order)) for order in (0, 1, 2))
    kappa = (dx * ddy - dy * ddx) / np.hypot(dx, dy) ** 3
    right, left = (np.interp(t, at, np.append(w, w[0]) if closed else w) for w in (w_right, w_left))
    if narrow:
        left = np.minimum(left, NARROWED / np.maximum(kappa, 1e-9))
        right = np.minimum(right, NARROWED / np.maximum(-kappa, 1e-9))
    track = Track(s, gx, gy, np.unwrap(np.arctan2(dy, dx)), kappa, right, left, length=length, closed=closed)
    row_at = rows[np.clip(np.searchsorted(at, t, side="right") - 1, 0, len(rows) - 1)]
    check_folding(track, source, row_at)
    check_crossing(track, source, row_at)
    return track


def _spline(at, px, py, closed: bool, smoothing: float):
    """Return `curve(t, order)`: x and y or their derivatives over chord length."""
    if smoothing > 0:
        knots, _ = scipy.interpolate.splprep([px, py], u=at, per=closed, s=len(px) * smoothing**2)
        return lambda t, order: scipy.interpolate.splev(t, knots, der=order)
    spline = scipy.interpolate.CubicSpline(at, np.stack([px, py], axis=1), bc_type="periodic" if closed else "natural")
    return lambda t, order: spline(t, order).T


def _arc_length(curve, at, num: int, closed: bool):
    """Return the length, and the spline parameters of `num` points evenly spaced along the curve."""
    nodes, weights = leggauss(3)
    fine = np.concatenate([np.linspace(a, b, FINE, endpoint=False) for a, b in zip(at[:-1], at[1:], strict=True)])
    fine = np.append(fine, at[-1])
    h = np.diff(fine)
    inner = fine[:-1, None] + h[:, None] * (nodes + 1) / 2
    dx, dy = curve(inner.ravel(), 1)
    speed = np.hypot(dx, dy).reshape(inner.shape)
    S = np.concatenate([[0.0], np.cumsum(speed @ weights * h / 2)])
    inverse = scipy.interpolate.CubicSpline(S, fine)
    return S[-1], inverse(np.linspace(0.0, S[-1], num, endpoint=not closed))
