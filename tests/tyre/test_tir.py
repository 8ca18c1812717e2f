"""Tyre property files: reading, evaluating, fitting, writing, and as tyre of a car."""

import dataclasses
import random

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from tir_files import tir_file, tir_text
from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
from vehiclemodels.utils.tire_model import (
    formula_lateral,
    formula_lateral_comb,
    formula_longitudinal,
    formula_longitudinal_comb,
)

from driftjax.cli import main
from driftjax.core import BadInput, Control
from driftjax.tyre import MagicFormula2012, SimplifiedPacejka, fit_tir, magic_formula, nominal_tyre, read_tir, write_tir
from driftjax.vehicle import load_plant, load_vehicle, stack_plants

# kappa, tan alpha, Fz, sin gamma, pressure; pure Fx, pure Fy, Fx, Fy of the file of tir_files.py. Computed on
# 2026-11-25 with github.com/BrianN92/Pacejka-tire-model (Apache-2.0) at 732e5a8, mode 111, in which angles stand for
# their tangents
REFERENCE = np.array([
    (0, 0.05, 4000, 0, 200000, 107.80766, -2666.2213, 85.907981, -2666.2213),
    (0.06, 0, 3500, 0, 200000, 3203.3483, -127.92443, 3203.3483, 25.135459),
    (0, -0.12, 5500, 0.04, 200000, 191.19391, 4670.5032, 103.27195, 4670.5032),
    (-0.08, 0, 2500, -0.03, 230000, -2407.4676, -18.767558, -2407.4676, -132.76846),
    (0.05, 0.08, 4000, 0.02, 215000, 3356.841, -3322.3795, 2361.9146, -2886.6978),
    (-0.1, -0.15, 6000, -0.05, 180000, -5957.0815, 5451.9907, -3591.3078, 4700.0845),
    (0.3, 0.4, 3000, 0, 200000, 2743.2232, -2673.9805, 1505.7372, -1973.9569),
    (0.02, -0.03, 4500, 0.06, 220000, 2043.7756, 1433.097, 1935.7056, 1433.8317),
])  # fmt: skip

# kappa, tan alpha, Fz, sin gamma, pressure; Mz. Computed on 2026-11-28 with github.com/NiekvanRossem/TyreDyn at
# 4b10d78, which has one code for 6.1 and 6.2, at high speed, for the coefficients that it uses as the book does
AS_THE_BOOK = {name: 0 for name in "QDZ3 QDZ6 QDZ7 QDZ8 QDZ9 QDZ10 QDZ11 QEZ4 QEZ5".split()}
AS_THE_BOOK |= {"LFZO": 1, "LMUX": 1, "LMUY": 1, "LKY": 0.94, "LYKA": 0.94}
MOMENTS = np.array([
    (0, np.tan(0.05), 4000, 0, 200000, 77.56268024),
    (0, -np.tan(0.12), 5500, np.sin(0.04), 200000, -120.41414222),
    (0, np.tan(0.08), 2500, -np.sin(0.03), 200000, 33.21281829),
    (0, -np.tan(0.03), 4500, np.sin(0.06), 200000, -62.91439548),
])  # fmt: skip
# keys of version 6.2 alone
NEW_IN_62 = "Q_FCY2 -0.4 Q_CAM1 85 Q_CAM2 257 Q_CAM3 0.5 Q_FYS1 -20000 Q_FYS2 -6e4 Q_FYS3 88000 ENV_C1 0".split()


@jax.jit
def evaluated(tyre: MagicFormula2012, kappa, alpha, Fz, gamma, pressure):
    """Pure and combined forces, aligning moment, relaxation lengths."""
    at = tyre.slip(kappa, alpha, Fz, gamma, pressure)
    pure = (tyre.pure_x(at).force, tyre.pure_y(at).force)
    return (*pure, *tyre.forces(at)), tyre.aligning_moment(at), tyre.relaxation_lengths(at)


def test_forces_equal_those_of_an_independent_implementation(tmp_path):
    tyre = magic_formula(read_tir(tir_file(tmp_path)))
    kappa, a, Fz, g, pressure, *reference = REFERENCE.T
    forces, moment, lengths = evaluated(tyre, kappa, np.arctan(a), Fz, np.arcsin(g), pressure)
    np.testing.assert_allclose(forces, reference, rtol=1e-5)  # their Fx takes gamma for its sine
    assert np.isfinite(moment).all()
    at = tyre.slip(kappa, np.arctan(a), Fz, np.arcsin(g), pressure)
    f = Fz / (0.95 * 4000) - 1
    assert lengths[1] == pytest.approx(
        np.abs(np.asarray(tyre.pure_y(at).K))
        / (150000 * (1 + 0.15 * f + 0.01 * f**2) * (1 + 0.04 * (pressure / 2e5 - 1)))
    )


@pytest.mark.parametrize("fittyp", [61, 62])
def test_the_aligning_moment_under_camber_equals_that_of_an_independent_implementation(tmp_path, fittyp):
    tyre = magic_formula(read_tir(tir_file(tmp_path, fittyp, **AS_THE_BOOK)))
    kappa, a, Fz, g, pressure, reference = MOMENTS.T
    _, moment, _ = evaluated(tyre, kappa, np.arctan(a), Fz, np.arcsin(g), pressure)
    np.testing.assert_allclose(moment, reference, rtol=1e-5)  # their moment arm takes gamma for its sine


def test_a_file_of_version_62_has_the_forces_of_61_and_keeps_its_own_keys(tmp_path):
    lines = "".join(f"{k:<24} = {v}\t$ new\n" for k, v in zip(NEW_IN_62[::2], NEW_IN_62[1::2], strict=True))
    text = tir_text(62).replace("[VERTICAL]\n", "[VERTICAL]\n" + lines)
    path = tmp_path / "new.tir"
    path.write_text(text)
    file = read_tir(path)
    write_tir(path, file)
    assert path.read_text() == text
    write_tir(path, file.replaced({"PDY1": 0.8125}))
    again = read_tir(path)
    assert again.version == 62 and lines in path.read_text()
    assert again.values == {**file.values, "PDY1": 0.8125} and again.values["Q_FYS3"] == 88000
    kappa, a, Fz, g, pressure, *_ = REFERENCE.T
    inputs = kappa, np.arctan(a), Fz, np.arcsin(g), pressure
    new, old = (evaluated(magic_formula(one), *inputs) for one in (file, read_tir(tir_file(tmp_path, 61))))
    for one, other in zip(jax.tree.leaves(new), jax.tree.leaves(old), strict=True):
        np.testing.assert_array_equal(one, other)


def test_magic_formula_52_equals_commonroads_subset(tmp_path):
    """Without camber and shifts, at nominal load, where the cornering stiffness is p_Ky1 F_z."""
    tire = parameters_vehicle2().tire
    for name in ("p_hx1", "p_vx1"):
        setattr(tire, name, 0.0)
    scales = {f"L{name}": 1 for name in "FZO CX MUX EX KX HX VX CY MUY EY KY HY VY XAL YKA VYKA".split()}
    zero = {name: 0 for name in "PHX1 PHX2 PVX1 PVX2 PHY1 PHY2 PVY1 PVY2 PEX4 PEY3".split()}
    theirs = {name.upper().replace("_", ""): value for name, value in vars(tire).items()}
    for name in ("PHY1", "PVY1"):
        theirs.pop(name)
    file = read_tir(tir_file(tmp_path, 52, **(scales | zero | theirs | {"PKY2": 1})))
    kappa, alpha = np.meshgrid([-0.2, -0.03, 0.05], [-0.15, 0.02, 0.1])
    kappa, alpha, Fz = kappa.ravel()[:8], alpha.ravel()[:8], 4000.0
    forces, _, _ = evaluated(magic_formula(file), kappa, alpha, np.full(8, Fz), np.zeros(8), np.full(8, 2e5))
    for i in range(8):
        Fx0 = formula_longitudinal(-kappa[i], 0.0, Fz, tire)
        Fy0, mu = formula_lateral(alpha[i], 0.0, Fz, tire)
        Fx = formula_longitudinal_comb(kappa[i], alpha[i], Fx0, tire)
        Fy = formula_lateral_comb(kappa[i], alpha[i], 0.0, mu, Fz, Fy0, tire)
        np.testing.assert_allclose(np.asarray(forces)[:, i], [Fx0, Fy0, Fx, Fy], rtol=1e-7, atol=1e-4)


def test_the_aligning_moment_is_side_force_times_trail_at_small_slip(tmp_path):
    changes = {name: 0 for name in "QHZ1 QHZ2 PHY1 PHY2 PVY1 PVY2 QDZ6 QDZ7 SSZ1 SSZ2 RVY1 RVY2".split()}
    tyre = magic_formula(read_tir(tir_file(tmp_path, **changes)))
    n = len(REFERENCE)
    (_, _, _, Fy), moment, _ = evaluated(
        tyre, np.zeros(n), np.full(n, 1e-5), np.full(n, 3800.0), np.zeros(n), np.full(n, 2e5)
    )
    trail = 0.1 * 1.04 * 0.32  # at nominal load: q_Dz1 lambda_t R_0
    assert np.asarray(moment)[0] == pytest.approx(-trail * float(Fy[0]), rel=1e-4)


def test_a_written_file_keeps_its_lines_and_reads_the_same(tmp_path):
    file = read_tir(tir_file(tmp_path, ADDED=3.5))
    write_tir(tmp_path / "same.tir", file)
    assert (tmp_path / "same.tir").read_text() == tir_text(ADDED=3.5)
    changed = file.replaced({"PDY1": 0.8125, "QBZ11": 0.25})
    write_tir(tmp_path / "other.tir", changed)
    again = read_tir(tmp_path / "other.tir")
    assert again.values == changed.values and again.version == 61
    text = (tmp_path / "other.tir").read_text()
    assert "PDY1                     = 0.8125 $ pdy1" in text and "{radial width}\n 1.0 0.0" in text


def test_a_fit_recovers_coefficients_from_noisy_forces(tmp_path):
    truth = read_tir(tir_file(tmp_path))
    names = ("PCY1", "PDY1", "PEY1", "PKY1", "PDX1", "PKX1")
    first = truth.replaced(
        {name: truth.values[name] * factor for name, factor in zip(names, (1.1, 0.8, 0.5, 0.7, 1.2, 0.8), strict=True)}
    )
    rng, inputs = np.random.default_rng(0), ("kappa", "alpha", "Fz", "gamma", "pressure")
    n = 600
    data = {"alpha": rng.uniform(-0.25, 0.25, n), "kappa": rng.uniform(-0.2, 0.2, n), "Fz": rng.uniform(2000, 6000, n)}
    data |= {"gamma": np.zeros(n), "pressure": np.full(n, 2e5)}
    (_, _, Fx, Fy), _, _ = evaluated(magic_formula(truth), *(data[key] for key in inputs))
    data |= {"Fx": np.asarray(Fx) + 20 * rng.standard_normal(n), "Fy": np.asarray(Fy) + 20 * rng.standard_normal(n)}
    data["Fx"][::7] = np.nan
    fitted = fit_tir(first, data, names)
    for name in set(names) - {"PEY1"}:  # the curvature is hardly seen at these slips
        assert fitted.values[name] == pytest.approx(truth.values[name], rel=0.02)
    (_, _, *again), _, _ = evaluated(magic_formula(fitted), *(data[key] for key in inputs))
    assert np.sqrt(np.mean((np.asarray(again) - [Fx, Fy]) ** 2)) < 4.0  # N, of a noise of 20 N
    with pytest.raises(BadInput, match="'PDY9' is no coefficient"):
        fit_tir(first, data, ("PDY9",))
    with pytest.raises(BadInput, match="need 'Fz' and one of"):
        fit_tir(first, {"Fx": data["Fx"]}, names)


def test_a_vehicle_takes_the_nearest_nominal_tyre(tmp_path):
    file = read_tir(tir_file(tmp_path))
    sedan = dataclasses.asdict(load_vehicle("sedan"))
    keys = {k: v for k, v in sedan.items() if k not in ("mu", "B", "C", "effects", "covariance")}
    path = tmp_path / "car.yaml"
    path.write_text(yaml.safe_dump(keys | {"tyre": "test.tir"}))
    car = load_vehicle(path)
    Fz = sedan["m"] * 9.81 / 4
    assert (car.mu, car.B, car.C) == nominal_tyre(file, Fz)
    alpha = np.linspace(0.01, 0.2, 20)
    tyre, near = magic_formula(file), SimplifiedPacejka(car.mu, car.B, car.C)
    left, right = (
        np.asarray(jax.jit(lambda t, a: t.pure_y(t.slip(0.0, a, Fz)).force)(tyre, s * alpha)) for s in (1, -1)
    )
    assert np.asarray(near.lateral(jnp.asarray(alpha), jnp.asarray(Fz))) == pytest.approx(
        (left - right) / 2, abs=0.03 * Fz
    )
    path.write_text(yaml.safe_dump(keys | {"tyre": "test.tir", "mu": 1.0}))
    with pytest.raises(BadInput, match="keys 'tyre' and 'mu' say the same"):
        load_vehicle(path)
    with pytest.raises(BadInput, match="% off any mu, B and C"):
        nominal_tyre(read_tir(tir_file(tmp_path, PCY1=2.6, PEY1=0)), Fz)
    path.write_text(yaml.safe_dump(keys | {"tyre": "none.tir"}))
    with pytest.raises(BadInput, match="none.tir: no such file"):
        load_vehicle(path)


@pytest.mark.parametrize(
    "change",
    [{"PCY1": 0}, {"FNOMIN": 1e-300}, {"PDY1": 1e308}, {"PDY1": 0, "PDY2": 0}, {"PKY1": 0}, {"PKY1": -1e9}],
    ids=str,
)
def test_a_file_without_the_peak_of_a_tyre_is_refused_as_that_of_a_car(tmp_path, change, capsys):
    tir_file(tmp_path, **change)
    sedan = dataclasses.asdict(load_vehicle("sedan"))
    keys = {k: v for k, v in sedan.items() if k not in ("mu", "B", "C", "effects", "covariance")}
    (tmp_path / "car.yaml").write_text(yaml.safe_dump(keys | {"tyre": "test.tir"}))
    assert main(["export", str(tmp_path / "car.yaml"), "--to", "autoware", "--out", str(tmp_path / "out")]) == 2
    sentence = capsys.readouterr().err
    assert sentence.count("\n") == 1 and "test.tir: its largest side force is " in sentence
    assert (
        "no tyre's; correct its coefficients, such as FNOMIN, PCY1, PDY1, PKY1, or the load." in sentence
        and not (tmp_path / "out").exists()
    )


def test_a_tyre_file_that_cannot_be_written_is_reported(tmp_path):
    file = read_tir(tir_file(tmp_path))
    for path in (tmp_path / "none" / "y.tir", tmp_path):
        with pytest.raises(BadInput, match=r"cannot be written \(.*\); give another path"):
            write_tir(path, file)


ROWS = 40


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"Fz": np.full(ROWS, np.nan)}, "column 'Fz' is nan in row 1; leave such rows out"),
        ({"Fz": 4000.0}, r"column 'Fz' has the shape \(\); give an array"),
        ({"Fz": ["much"] * ROWS}, "column 'Fz' holds what is no number"),
        ({"Fz": np.full(ROWS - 1, 4000.0)}, r"the columns have \[39, 40\] rows"),
        ({"Fy": np.full(ROWS, np.nan)}, "no row has a measured 'Fx', 'Fy' or 'Mz'"),
        ({"Fy": np.full(ROWS, np.inf)}, "column 'Fy' is inf in row 1"),
        ({"Fz": [], "alpha": [], "Fy": []}, "no row has a measured 'Fx', 'Fy' or 'Mz'"),
    ],
)
def test_a_fit_to_what_is_no_measurement_is_refused(tmp_path, data, message):
    alpha = np.linspace(-0.2, 0.2, ROWS)
    measured = {"alpha": alpha, "Fz": np.full(ROWS, 4000.0), "Fy": -2e4 * alpha} | data
    with pytest.raises(BadInput, match=message):
        fit_tir(read_tir(tir_file(tmp_path)), measured, ["PDY1"])


def test_a_plant_takes_the_file_and_mirrors_the_right_wheels(tmp_path):
    tir_file(tmp_path)
    path = tmp_path / "plant.yaml"
    path.write_text("base: sedan\nname: with_tir\nmuf: 0.9\ntyre: test.tir\n")
    plant = load_plant(path).build()
    alpha, kappa, Fz = np.array([0.1, -0.1, 0.05, -0.05]), np.full(4, 0.03), np.full(4, 4000.0)
    Fx, Fy = map(np.asarray, jax.jit(lambda t: t.forces(kappa, alpha, Fz, Fz))(plant.tyre))
    np.testing.assert_allclose(Fy[0], -Fy[1], rtol=1e-12)
    np.testing.assert_allclose(Fx[2], Fx[3], rtol=1e-12)
    assert (Fy * alpha < 0).all() and (Fx > 0).all()
    single = magic_formula(read_tir(tmp_path / "test.tir"))
    cos = np.cos(np.arcsin(0.1))
    theirs = jax.jit(lambda t: t.forces(t.slip(0.03 / cos, np.arcsin(0.1), 4000.0)))(single)
    np.testing.assert_allclose([Fx[0], Fy[0]], 0.9 * np.asarray(theirs), rtol=1e-9)
    after = jax.eval_shape(
        lambda p: p.advance(p.rolling(10.0), Control(jnp.asarray(0.1), jnp.asarray(0.0)), 0.01, 2), plant
    )
    assert after.vx.shape == ()
    with pytest.raises(BadInput, match="tyres are of different kinds"):
        stack_plants([load_plant(path), load_plant("sedan")])
    tir_file(tmp_path, RBX1=0)
    with pytest.raises(BadInput, match="no coefficients of combined slip"):
        load_plant(path).build()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("ANGLE = 'radians'", "ANGLE = 'degrees'"), "ANGLE is in 'degrees'; convert"),
        (("TIME = 'second'", "TIME = 'second'\nPRESSURE = 'bar'"), r"PRESSURE is in 'bar'; convert .*\(pascal\)"),
        (("= 61 $version", "= 94"), "FITTYP is 94; it must be one of"),
        (("PDY1                     = 1.02", "PDY1 = one"), "line .*: PDY1 is 'one'; it needs a number"),
        (("PDY1                     = 1.02", "PDY1 = nan"), "line .*: PDY1 is nan; it needs a finite number"),
        (("PCY1                     = 1.35", "PCY1 ="), "'PCY1' is missing"),
        (("{radial width}", " " * 5000), "line .*: has 5000 characters"),
        (("PDY1                     = 1.02", "PDY1 = 1.02\nPDY1 = 1.03"), "PDY1 stands twice"),
    ],
)
def test_a_wrong_file_is_refused_in_one_sentence(tmp_path, change, message):
    path = tmp_path / "wrong.tir"
    path.write_text(tir_text().replace(*change))
    with pytest.raises(BadInput, match=message):
        read_tir(path)


def test_a_hundred_damaged_files_are_read_or_refused(tmp_path):
    text = tir_text().encode()
    refused = 0
    for seed in range(100):
        rng = random.Random(seed)
        damaged = bytearray(text[: rng.randrange(len(text))] if seed % 4 == 0 else text)
        for _ in range(rng.randrange(1, 40)):
            at = rng.randrange(len(damaged) or 1)
            damaged[at : at + rng.randrange(3)] = rng.randbytes(rng.randrange(4))
        path = tmp_path / "damaged.tir"
        path.write_bytes(bytes(damaged))
        try:
            file = read_tir(path)
        except BadInput as error:
            refused += "damaged.tir" in str(error) and "\n" not in str(error)
            continue
        write_tir(tmp_path / "again.tir", file)
        assert read_tir(tmp_path / "again.tir").values == file.values
        refused += 1
    assert refused == 100


@pytest.mark.slow
def test_a_plant_on_a_property_file_turns_a_little_less_than_without_slip(tmp_path):
    tir_file(tmp_path)
    path = tmp_path / "plant.yaml"
    path.write_text("base: sedan\nname: with_tir\ntyre: test.tir\n")
    plant = load_plant(path).build()
    held = Control(jnp.asarray(0.02), jnp.asarray(0.0))
    after = jax.jit(lambda p: p.advance(p.rolling(12.0), held, 1.5, 1500))(plant)
    assert 0.8 < float(after.r) / (float(after.vx) * 0.02 / 3.05) < 1.1
