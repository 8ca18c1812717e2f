"""The tyre of a property file as tyre of the plant, and the nominal car's tyre nearest to it."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import BadInput, as_float
from driftjax.parallel import call
from driftjax.tyre.magic_formula_2012 import MagicFormula2012, magic_formula, require_combined
from driftjax.tyre.tir import TyreFile

LEFT_WHEELS = (1.0, -1.0, 1.0, -1.0)  # sign of the side; wheels are front left, front right, rear left, rear right
STEEPEST = 0.1  # least cosine of the slip angle at which slips over travelling speed are converted [-]
FITTED = 3.0  # slip angles up to this multiple of the peak's are fitted by the nominal tyre
SAMPLES = 200
WORST = 0.1  # misfit over the peak beyond which a curve has another shape [-]
WIDEST = 0.5  # slip angles searched for the peak [rad]
BOUNDS = np.array([[1e-3, 1e-2, 1.001], [10.0, 1e3, 1.999]])  # of mu, B [1/rad] and C


class TirTyre(eqx.Module):
    """Four tyres of one property file, with the interface of the plant's `MagicFormula`; right ones are mirrored."""

    tyre: MagicFormula2012
    mu: Array = eqx.field(converter=as_float)  # friction over that of the file, one entry per wheel [-]
    side: Array = eqx.field(converter=as_float)  # 1 where a wheel is on the side of the measured one, else -1
    turn: Array = eqx.field(converter=as_float)  # sign that makes the side force of the file oppose the slip

    def _stiffness(self) -> tuple[Array, Array]:
        """Return the lateral stiffness factor, and the longitudinal over the lateral slip stiffness."""
        at = self.tyre.slip(0.0, 0.0, self.tyre.p["FNOMIN"])
        x, y = self.tyre.pure_x(at), self.tyre.pure_y(at)
        return jnp.abs(y.B), jnp.abs(x.K / y.K)

    def saturation(self, kappa: Array, alpha: Array) -> Array:
        """Return the combined slip over about the peak's slip: below 1 the tyre grips, above it slides."""
        B, ratio = self._stiffness()
        return B / 2 * jnp.sqrt((ratio * kappa) ** 2 + alpha**2 + 1e-8)

    def forces(self, kappa: Array, alpha: Array, Fz: Array, Fz0: Array) -> tuple[Array, Array]:
        """Return the longitudinal and lateral force in the wheel frame [N]: driving and left positive.

        `kappa` and `alpha` are over the wheel's travelling speed, as those of the plant; the file's are over its
        forward speed. The static load `Fz0` is not used: the file has its own.
        """
        del Fz0
        cos = jnp.sqrt(jnp.maximum(1 - alpha**2, STEEPEST**2))
        at = self.tyre.slip(kappa / cos, self.side * self.turn * jnp.arctan(alpha / cos), Fz)
        Fx, Fy = self.tyre.forces(at)
        return self.mu * Fx, self.mu * self.side * Fy


def plant_tyre(file: TyreFile, muf: float, mur: float) -> TirTyre:
    """Return the plant's tyres; `muf` and `mur` scale the friction of front and rear."""
    require_combined(file)
    side = np.array(LEFT_WHEELS) * (-1.0 if file.mirrored else 1.0)
    return TirTyre(magic_formula(file), np.array([muf, muf, mur, mur]), side, -np.sign(_signed_stiffness(file)))


def _signed_stiffness(file: TyreFile) -> float:
    return file.values["PKY1"] * file.values["PKY2"] * file.values.get("LKY", 1.0)


def _lateral(tyre: MagicFormula2012, alpha: Array, Fz: Array) -> Array:
    """Return the mean of the side forces at both signs of the slip over the load: mirrored wheels cancel the rest."""
    left, right = (tyre.pure_y(tyre.slip(0.0, sign * alpha, Fz)).force for sign in (1.0, -1.0))
    return (left - right) / (2 * Fz)


def nominal_tyre(file: TyreFile, Fz: float) -> tuple[float, float, float]:
    """Return mu, B [1/rad] and C of mu F_z sin(C arctan(B alpha)) nearest to the file's side force at load `Fz` [N].

    Least squares up to 3 times the slip angle of the peak, the two sides of the tyre alike; C stays above 1. Raises
    `BadInput` where the curve has another shape, more than 10 % of its peak off (root mean square), or no peak of a
    tyre.
    """
    from scipy.optimize import least_squares  # takes a second to load, with every command and worker

    alpha = np.linspace(0.0, WIDEST, SAMPLES + 1)[1:]
    force = np.abs(np.asarray(call(_lateral, magic_formula(file), jnp.asarray(alpha), jnp.asarray(Fz))))
    start = _start(file, alpha, force, Fz)
    peak = alpha[np.argmax(force)]
    fitted = alpha <= min(FITTED * peak, WIDEST)
    x, y = alpha[fitted], force[fitted]
    off = lambda q: q[0] * np.sin(q[2] * np.arctan(q[1] * x)) - y
    fit = least_squares(off, start, bounds=BOUNDS, x_scale=start).x
    misfit = float(np.sqrt(np.mean(off(fit) ** 2)) / y.max())
    if misfit > WORST:
        raise BadInput(f"{file.name}: its side force is {misfit:.0%} off any mu, B and C; give these by hand.")
    return float(fit[0]), float(fit[1]), float(fit[2])


def _start(file: TyreFile, alpha: np.ndarray, force: np.ndarray, Fz: float) -> np.ndarray:
    """Return mu, B and C from the peak and the first slope of the side force over the load (n,)."""
    top = force.max()
    if np.isfinite(top) and BOUNDS[0, 0] <= top <= BOUNDS[1, 0]:
        start = np.array([top, force[0] / alpha[0] / (1.3 * top), 1.3])
        if (BOUNDS[0] <= start).all() and (start <= BOUNDS[1]).all():
            return start
    raise BadInput(
        f"{file.name}: its largest side force is {top:.3g} times the load of {Fz:.4g} N with a first slope of "
        f"{force[0] / alpha[0]:.3g} per rad, which is no tyre's; correct its coefficients, such as FNOMIN, PCY1, PDY1, "
        "PKY1, or the load."
    )
