"""Fit coefficients of a tyre property file to measured forces."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.optimize import least_squares

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
    """
    require_float64()
    known = (*COEFFICIENTS, *SCALES, "PKY4")
    if unknown := [name for name in names if name not in known]:
        raise BadInput(f"fit: '{unknown[0]}' is no coefficient that can be fitted, such as PDY1.")
    require(len(names) > 0, "fit: no coefficients are named; name one at least, such as PDY1.")
    present = [key for key in OUTPUTS if key in data]
    if "Fz" not in data or not present:
        raise BadInput("fit: the data need 'Fz' and one of 'Fx', 'Fy', 'Mz'.")
    sizes = {len(data[key]) for key in (*INPUTS, *OUTPUTS) if key in data}
    require(len(sizes) == 1, f"fit: the columns have {sorted(sizes)} rows; give the same number in each.")
    (num,) = sizes
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


def _outputs(q: Array, tyre: MagicFormula2012, inputs: Array, names: tuple[str, ...]) -> Array:
    """Return Fx, Fy, Mz (3, n) of the tyre with the coefficients `q`."""
    changed = tyre.p | {name: q[i] for i, name in enumerate(names)}
    tyre = MagicFormula2012(changed, tyre.version)
    at = tyre.slip(*inputs)
    return jnp.stack([*tyre.forces(at), tyre.aligning_moment(at)])


def _slopes(q: Array, tyre: MagicFormula2012, inputs: Array, names: tuple[str, ...]) -> Array:
    return jax.jacfwd(_outputs)(q, tyre, inputs, names)
