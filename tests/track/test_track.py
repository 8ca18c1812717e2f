"""Tracks: closed forms, projection against brute force, Eq. 7 against the world frame, refused input."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import fresnel

from driftjax.core import BadInput
from driftjax.track import check_width, curvilinear_rates, load_track
from driftjax.track.build import corner, from_points, playground
from driftjax.track.load import read_csv

R = 15.0


pose, position = (eqx.filter_jit(lambda track, *at, of=of: getattr(track, of)(*at)) for of in ("pose", "position"))


@eqx.filter_jit
def poses(track, s):
    return jax.vmap(track.pose)(s)


def circle(n=200, radius=R, w=3.0):
    angle = 2 * np.pi * np.arange(n) / n
    return from_points(radius * np.cos(angle), radius * np.sin(angle), w, w, closed=True)


def test_circle_has_its_length_curvature_and_heading():
    track = circle()
    assert float(track.length) == pytest.approx(2 * np.pi * R, rel=1e-7)
    assert float(track.turn) == pytest.approx(2 * np.pi)
    s = np.linspace(-10.0, 250.0, 500)  # before the start and into the third lap
    x, y, psi, kappa = poses(track, s)
    np.testing.assert_allclose(x, R * np.cos(s / R), atol=1e-5)
    np.testing.assert_allclose(y, R * np.sin(s / R), atol=1e-5)
    np.testing.assert_allclose(psi, np.pi / 2 + s / R, atol=1e-5)
    np.testing.assert_allclose(kappa, 1 / R, rtol=2e-4)


def test_corner_is_a_clothoid_an_arc_and_a_clothoid():
    track = corner(45, 8, R, np.pi, 30, 3)
    assert float(track.length) == pytest.approx(45 + 30 + 16 + np.pi * R - 8)
    assert float(track.psi[-1]) == pytest.approx(np.pi)
    x, y, psi, kappa = map(float, pose(track, 53.0))  # end of the ramp: angle L/(2R), Fresnel integrals
    scale = np.sqrt(np.pi * 8 * R)
    sin, cos = fresnel(8 / scale)
    assert (x - 45, y) == pytest.approx((scale * cos, scale * sin), abs=2e-5)
    assert psi == pytest.approx(8 / (2 * R), abs=1e-5) and kappa == pytest.approx(1 / R, rel=2e-2)


def test_open_track_goes_on_straight_and_right_is_the_mirror_of_left():
    left, right = corner(45, 8, R, np.pi, 30, 3), corner(45, 8, R, -np.pi, 30, 3)
    s = jnp.array([-5.0, 60.0, 100.0, float(left.length) + 7.0])
    a, b = poses(left, s), poses(right, s)
    np.testing.assert_allclose(a[0], b[0])
    for left_one, right_one in zip(a[1:], b[1:], strict=True):
        np.testing.assert_allclose(left_one, -right_one, atol=1e-12)
    assert float(a[0][0]) == pytest.approx(-5.0) and float(a[1][0]) == 0.0
    assert float(a[3][-1]) == 0.0 and float(a[0][-1]) == pytest.approx(float(left.x[-1]) - 7.0)


def test_grid_pose_and_curvature_agree():
    track = playground(1.0, 3.0)
    s = np.linspace(0.0, 2 * float(track.length), 777)
    dx, dy, dpsi = np.asarray(jax.jit(jax.vmap(jax.jacfwd(lambda s: jnp.stack(track.pose(s)[:3]))))(s)).T
    _, _, psi, kappa = poses(track, s)
    np.testing.assert_allclose(np.hypot(dx, dy), 1, atol=2e-5)
    np.testing.assert_allclose(np.sin(np.arctan2(dy, dx) - psi), 0, atol=1e-4)
    np.testing.assert_allclose(dpsi, kappa, atol=1.5e-3)  # off by a kink's share of a cell, at the ramps' ends


@pytest.mark.parametrize("scale, hairpin", [(1.0, 15.0), (1 / 15, 1.0)])
def test_playground_closes_with_a_hairpin_and_a_fast_corner(scale, hairpin):
    track = playground(scale, 3.0 * scale)
    gap = np.hypot(track.x[0] - track.x[-1], track.y[0] - track.y[-1])
    assert gap == pytest.approx(float(track.spacing), rel=1e-6)
    assert 1 / float(track.kappa.max()) == pytest.approx(hairpin, rel=1e-3)
    fast = -float(track.kappa.min())  # the only right-hander
    assert 1 / fast == pytest.approx(3 * hairpin, rel=1e-2)


@eqx.filter_jit
def projections(track, x, y, guess):
    return jax.vmap(track.project)(x, y, guess), jax.vmap(track.locate)(x, y)


def test_projection_stays_on_its_leg_of_a_narrow_hairpin():
    track = corner(10, 0.5, 1.5, np.pi, 10, 1.2)  # legs 3.2 m apart
    rng = np.random.default_rng(0)
    s, e = rng.uniform(-1.0, float(track.length) + 1, 400), rng.uniform(-1.1, 1.1, 400)
    x, y = map(np.asarray, jax.jit(jax.vmap(track.position))(s, e))
    guess = s + rng.uniform(-0.4, 0.4, 400)
    (s_near, e_near), (s_all, e_all) = projections(track, x, y, guess)
    np.testing.assert_allclose(s_near, s, atol=1e-5)
    np.testing.assert_allclose(e_near, e, atol=1e-5)
    fine = np.linspace(-1.5, float(track.length) + 1.5, 40001)
    fx, fy, _, _ = (np.asarray(v) for v in poses(track, fine))
    nearest = np.array([np.hypot(fx - px, fy - py).min() for px, py in zip(x, y, strict=True)])
    np.testing.assert_allclose(np.abs(e_all), nearest, atol=1e-5)
    far = (x, y + 3.0 * np.sign(1.6 - y))  # points pushed over to the other leg still project onto their own
    (s_own, e_own), _ = projections(track, *far, guess)
    s_own, e_own = np.asarray(s_own), np.asarray(e_own)
    straight = (s > 0.5) & (s < 9.0)
    np.testing.assert_allclose(s_own[straight], s[straight], atol=1e-5)
    np.testing.assert_allclose(e_own[straight], e[straight] + 3.0, atol=1e-5)


def test_projection_of_a_closed_track_crosses_the_start():
    track = circle()
    x, y = position(track, 1.0, 0.7)
    s, e = eqx.filter_jit(track.project)(x, y, np.asarray(track.length) - 0.5)
    assert (float(s), float(e)) == pytest.approx((float(track.length) + 1.0, 0.7), abs=1e-4)
    assert float(eqx.filter_jit(track.locate)(x, y)[0]) == pytest.approx(1.0, abs=1e-4)


def test_projection_has_the_gradient_of_the_foot_point():
    track = corner(45, 8, R, np.pi, 30, 3)
    x, y = map(float, position(track, 70.0, -1.3))
    foot = eqx.filter_jit(lambda p: jnp.stack(track.project(p[0], p[1], 69.0)))
    gradient = np.asarray(jax.jit(jax.jacfwd(foot))(np.array([x, y])))
    h = 1e-5
    for i, shift in enumerate(np.eye(2) * h):
        ahead, behind = foot(np.array([x, y]) + shift), foot(np.array([x, y]) - shift)
        np.testing.assert_allclose(gradient[:, i], (np.asarray(ahead) - behind) / (2 * h), atol=1e-4)


def test_curvilinear_rates_against_the_world_frame():
    track = corner(5, 8, R, np.pi, 30, 3)
    V = lambda t: 10 + np.sin(t)
    beta, r = lambda t: -0.3 * np.sin(t), lambda t: 0.55 + 0.1 * np.cos(2 * t)
    kappa = jax.jit(lambda s: track.pose(s)[3])

    def world(t, w):
        course = w[2] + beta(t)
        return [V(t) * np.cos(course), V(t) * np.sin(course), r(t)]

    def frame(t, w):
        s, e, theta = w
        return [float(d) for d in curvilinear_rates(V(t), beta(t), r(t), e, theta, kappa(s))]

    drive = lambda rates: solve_ivp(rates, (0, 3.5), [0.0, 0.5, 0.1], rtol=1e-8, atol=1e-9, max_step=0.05).y[:, -1]
    x, y, psi = drive(world)
    s, e, theta = drive(frame)
    np.testing.assert_allclose(position(track, s, e), [x, y], atol=5e-3)
    assert theta + float(pose(track, s)[2]) == pytest.approx(psi, abs=1e-3)


@pytest.mark.parametrize("name", ["sedan_corner", "rc_corner", "sedan_playground", "rc_playground"])
def test_shipped_tracks_fit_their_cars(name):
    track = load_track(name)
    check_width(track, 1.85 if name.startswith("sedan") else 0.19, name)
    assert track.closed == ("playground" in name)


@pytest.mark.parametrize("name, length, folds", [("oval", 290.65, False), ("hairpins", 110.67, True)])
def test_tracks_in_the_layout_of_measured_ones_load_closed_with_their_length(name, length, folds):
    """Points with a comment line, as TUM and ForzaETH publish them; the second has borders that cross in its bends."""
    path = Path(__file__).parent / "tracks" / f"{name}_center.csv"
    track = load_track(path, narrow=True)
    assert track.closed and float(track.length) == pytest.approx(length, rel=3e-3)
    assert abs(float(track.turn)) == pytest.approx(2 * np.pi)
    points = np.loadtxt(path, delimiter=",")[::7, :2]
    _, (_, e) = projections(track, points[:, 0], points[:, 1], np.zeros(len(points)))
    assert np.abs(e).max() < 5e-3  # the spline goes through the points
    if folds:
        with pytest.raises(BadInput, match=r"_center\.csv, row \d+: the inner border folds"):
            load_track(path)
    else:
        assert load_track(path).closed


def write(tmp_path, rows, name="t.csv"):
    path = tmp_path / name
    path.write_text("\n".join(rows) + "\n")
    return path


def ring(n=40, radius=10.0, w="1.0,1.0"):
    angle = 2 * np.pi * np.arange(n) / n
    return [f"{radius * np.cos(a):.6f},{radius * np.sin(a):.6f},{w}" for a in angle]


@pytest.mark.parametrize("head", [[], ["# a comment", "# another"], ["x,y,w_right,w_left"], ["# c", "x,y,w_r,w_l"]])
def test_csv_headers_and_closing(tmp_path, head):
    track = read_csv(write(tmp_path, head + ring()))
    assert track.closed and float(track.length) == pytest.approx(2 * np.pi * 10, rel=1e-4)
    repeated = read_csv(write(tmp_path, head + ring() + ring()[:1]))
    assert repeated.closed and float(repeated.length) == pytest.approx(float(track.length), rel=1e-6)
    assert not read_csv(write(tmp_path, head + ring()[:30])).closed


def test_smoothing_evens_out_noisy_points(tmp_path):
    rng = np.random.default_rng(1)
    angle = 2 * np.pi * np.arange(200) / 200
    x, y = 10 * np.cos(angle) + rng.normal(0, 0.02, 200), 10 * np.sin(angle) + rng.normal(0, 0.02, 200)
    rough = from_points(x, y, 1.0, 1.0, closed=True, narrow=True)
    smooth = from_points(x, y, 1.0, 1.0, closed=True, smoothing=0.028)
    deviation = lambda track: float(np.std(track.kappa))
    assert deviation(smooth) < 0.1 * deviation(rough)


BAD_ROWS = {
    "a word": (5, "1.0,two,1,1", r"t\.csv, row 5: y is 'two'"),
    "nan": (7, "1.0,nan,1,1", r"t\.csv, row 7: y is 'nan'"),
    "negative width": (4, "6.5,7.6,1,-1", r"t\.csv, row 4: w_left is -1"),
    "missing cell": (3, "1.0,2.0,1", r"t\.csv, row 3: has 3 cells"),
    "repeated point": (2, ring()[0], r"t\.csv, row 1: the next point repeats"),
}


@pytest.mark.parametrize("row, text, message", BAD_ROWS.values(), ids=BAD_ROWS)
def test_bad_rows_are_named(tmp_path, row, text, message):
    rows = ring()
    rows[row - 1] = text
    with pytest.raises(BadInput, match=message):
        read_csv(write(tmp_path, rows))


def test_bad_tracks_are_refused(tmp_path):
    with pytest.raises(BadInput, match=r"t\.csv: has 3 points"):
        read_csv(write(tmp_path, ring()[:3]))
    with pytest.raises(BadInput, match=r"t\.csv, row \d+: the inner border folds"):
        read_csv(write(tmp_path, ring(w="1.0,10.5")))
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    eight = [f"{20 * np.sin(a):.5f},{10 * np.sin(2 * a):.5f},1,1" for a in angle]
    with pytest.raises(BadInput, match=r"t\.csv: crosses itself near row \d+ and row \d+"):
        read_csv(write(tmp_path, eight))
    with pytest.raises(BadInput, match="2 m wide, but the car is 2.1 m wide"):
        check_width(read_csv(write(tmp_path, ring())), 2.1, "t.csv")
    with pytest.raises(BadInput, match="no such file"):
        load_track(tmp_path / "none.csv")


def test_bad_yaml_is_refused(tmp_path):
    good = "straight_in: 45.0\nramp: 8.0\nradius: 15.0\nangle_deg: 180.0\nstraight_out: 30.0\nwidth: 3.0"
    path = write(tmp_path, [good, "kind: loop"], "t.yaml")
    with pytest.raises(BadInput, match="'kind' is 'loop'; choose one of corner, playground, csv"):
        load_track(path)
    path = write(tmp_path, [good.replace("8.0", "60.0"), "kind: corner"], "t.yaml")
    with pytest.raises(BadInput, match=r"t\.yaml: ramps of 60\.0 m .* shorten"):
        load_track(path)
    write(tmp_path, ring())
    track = load_track(write(tmp_path, ["kind: csv", "path: t.csv", "closed: false"], "t.yaml"))
    assert not track.closed
