"""Fit coefficients of a tyre property file to measured forces."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import BadInput, require
from driftjax.environment import require_float64
from driftjax.parallel import call
from driftjax.tyre.magic_formula_2012 import COEFFICIENTS, SCALES, MagicFormula2012, magic_formula
from driftjax.tyre.tir import TyreFile

INPUTS = ("kappa", "alpha", "Fz", "gamma", "pressure")
OUTPUTS = ("Fx", "Fy", "Mz")
STEP = 0.1  # least scale of a coefficient in the search


def fit_tir(file: TyreFile, data: Mapping[str, np.ndarray], names: Sequence[str]) -> TyreFile:
    """Return `file` with the coefficients `names` fitted to measured forces by least squares, from its present ones.

    `data` holds arrays (n,): Fz [N] and any of kappa [-], alpha [rad], gamma [rad] (0 where left out) and pressure [Pa]
    (nominal), and of the measured Fx [N], Fy [N] and Mz [N m], NaN where there is none. Each of these counts in its own
    root mean square. The fit is local: with many coefficients begin with a few, such as PCY1, PDY1, PEY1, PKY1.
    Raises `BadInput` for columns that are no such arrays and for data without a measured force.
    """
    from scipy.optimize import least_squares  # takes a second to load, with every command and worker

    require_float64()
    known = (*COEFFICIENTS, *SCALES, "PKY4")
    if unknown := [name for name in names if name not in known]:
        raise BadInput(f"fit: '{unknown[0]}' is no coefficient that can be fitted, such as PDY1.")
    require(len(names) > 0, "fit: no coefficients are named; name one at least, such as PDY1.")
    data = _columns(data)
    num = len(data["Fz"])
    default = {"pressure": file.values.get("NOMPRES", 1e5) or 1e5}
    inputs = jnp.asarray([data.get(key, np.full(num, default.get(key, 0.0))) for key in INPUTS])
    measured = np.asarray([data.get(key, np.full(num, np.nan)) for key in OUTPUTS])
    unit = np.array([np.sqrt(np.nanmean(row**2)) if np.isfinite(row).any() else 1.0 for row in measured])
    keep, tyre = np.isfinite(measured), magic_formula(file)
    start = np.array([float(tyre.p[name]) for name in names])
    scale = np.maximum(np.abs(start), STEP)

    def off(q: np.ndarray) -> np.ndarray:
        predicted = np.asarray(call(_outputs, jnp.asarray(scale * q), tyre, inputs, tuple(names)))
        return (((predicted - measured) / unit[:, None])[keep]) / np.sqrt(keep.sum())

    def slopes(q: np.ndarray) -> np.ndarray:
        J = np.asarray(call(_slopes, jnp.asarray(scale * q), tyre, inputs, tuple(names)))
        return ((J / unit[:, None, None])[keep] * scale) / np.sqrt(keep.sum())

    options: dict[str, Any] = {"jac": slopes, "xtol": 1e-12, "ftol": 1e-12, "gtol": 1e-12}
    fit = least_squares(off, start / scale, **options)
    if not np.isfinite(fit.x).all():
        raise BadInput("fit: the search left the finite numbers; fit fewer coefficients at a time.")
    return file.replaced(dict(zip(names, (scale * fit.x).tolist(), strict=True)))


def _columns(data: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the known columns of `data` as float arrays (n,), checked: inputs finite, outputs finite or NaN."""
    if "Fz" not in data or not any(key in data for key in OUTPUTS):
        raise BadInput("fit: the data need 'Fz' and one of 'Fx', 'Fy', 'Mz'.")
    columns: dict[str, np.ndarray] = {}
    for key in (key for key in (*INPUTS, *OUTPUTS) if key in data):
        try:
            columns[key] = np.asarray(data[key], float)
        except (TypeError, ValueError):
            raise BadInput(f"fit: column '{key}' holds what is no number; give an array of numbers.") from None
        shape = columns[key].shape
        require(len(shape) == 1, f"fit: column '{key}' has the shape {shape}; give an array (n,), one value a row.")
    sizes = {len(column) for column in columns.values()}
    require(len(sizes) == 1, f"fit: the columns have {sorted(sizes)} rows; give the same number in each.")
    for key, column in columns.items():
        bad = np.flatnonzero(~np.isfinite(column) if key in INPUTS else np.isinf(column))
        if len(bad):
            raise BadInput(f"fit: column '{key}' is {column[bad[0]]} in row {bad[0] + 1}; leave such rows out.")
    if not any(np.isfinite(columns[key]).any() for key in OUTPUTS if key in columns):
        raise BadInput("fit: no row has a measured 'Fx', 'Fy' or 'Mz'; give rows with one.")
    return columns


def _outputs(q: Array, tyre: MagicFormula2012, inputs: Array, names: tuple[str, ...]) -> Array:
    """Return Fx, Fy, Mz (3, n) of the tyre with the coefficients `q`."""
    changed = tyre.p | {name: q[i] for i, name in enumerate(names)}
    tyre = MagicFormula2012(changed, tyre.version)
    at = tyre.slip(*inputs)
    return jnp.stack([*tyre.forces(at), tyre.aligning_moment(at)])


def _slopes(q: Array, tyre: MagicFormula2012, inputs: Array, names: tuple[str, ...]) -> Array:
    return jax.jacfwd(_outputs)(q, tyre, inputs, names)
