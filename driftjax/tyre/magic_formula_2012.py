"""The Magic Formula 5.2, 6.1 and 6.2 with all its coefficients: forces, aligning moment and relaxation lengths."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from driftjax.core import BadInput
from driftjax.environment import require_float64
from driftjax.tyre.tir import TyreFile

TINY = 1e-6  # keeps quotients of vanishing forces finite [N]
SCALES = ("LFZO LCX LMUX LEX LKX LHX LVX LGAX LCY LMUY LEY LKY LHY LVY LGAY LKYC LKZC LGAZ LTR LRES LXAL LYKA LVYKA LS "
          "LSGKP LSGAL").split()  # fmt: skip
COEFFICIENTS = (
    "PCX1 PDX1 PDX2 PDX3 PEX1 PEX2 PEX3 PEX4 PKX1 PKX2 PKX3 PHX1 PHX2 PVX1 PVX2 PPX1 PPX2 PPX3 PPX4 RBX1 RBX2 RBX3 "
    "RCX1 REX1 REX2 RHX1 PCY1 PDY1 PDY2 PDY3 PEY1 PEY2 PEY3 PEY4 PEY5 PKY1 PKY2 PKY3 PKY5 PKY6 PKY7 PHY1 PHY2 PHY3 "
    "PVY1 PVY2 PVY3 PVY4 PPY1 PPY2 PPY3 PPY4 PPY5 RBY1 RBY2 RBY3 RBY4 RCY1 REY1 REY2 RHY1 RHY2 RVY1 RVY2 RVY3 RVY4 "
    "RVY5 RVY6 QBZ1 QBZ2 QBZ3 QBZ4 QBZ5 QBZ9 QBZ10 QCZ1 QDZ1 QDZ2 QDZ3 QDZ4 QDZ6 QDZ7 QDZ8 QDZ9 QDZ10 QDZ11 QEZ1 QEZ2 "
    "QEZ3 QEZ4 QEZ5 QHZ1 QHZ2 QHZ3 QHZ4 PPZ1 PPZ2 SSZ1 SSZ2 SSZ3 SSZ4 PTX1 PTX2 PTX3 PTY1 PTY2 UNLOADED_RADIUS "
    "LONGITUDINAL_STIFFNESS LATERAL_STIFFNESS PCFX1 PCFX2 PCFX3 PCFY1 PCFY2 PCFY3"
).split()


class Slip(NamedTuple):
    """Slip of a contact patch: arrays of one shape, or broadcast against each other."""

    kappa: Array  # longitudinal slip, driving positive [-]
    alpha: Array  # slip angle with the sign of the lateral velocity [rad]
    Fz: Array  # vertical load [N]
    gamma: Array  # inclination angle [rad]
    pressure: Array  # over nominal pressure, less 1 [-]


class Curve(NamedTuple):
    """D sin(C arctan(B x - E (B x - arctan(B x)))) + V."""

    x: Array
    B: Array
    C: Array
    D: Array
    E: Array
    V: Array
    K: Array  # slope B C D
    mu: Array

    @property
    def force(self) -> Array:
        """Return the force."""
        return self.D * jnp.sin(self.C * jnp.arctan(bent(self.B * self.x, self.E))) + self.V


def bent(x: Array, E: Array) -> Array:
    """Return x - E (x - arctan(x)), the argument of a curve with the curvature E."""
    return x - E * (x - jnp.arctan(x))


class MagicFormula2012(eqx.Module):
    r"""Magic Formula of a tyre property file (Pacejka 2012, Sec. 4.3.2, Eq. 4.E1-4.E78; version 5.2: Pacejka 2002).

    Axes as in the file, usually ISO-W: $F_y < 0$ for $\alpha > 0$. Versions 6.x take $\tan\alpha$ and $\sin\gamma$
    where 5.2 takes the angles. 6.2 has the forces and moments of 6.1; what it adds (Q_CAM1 to Q_CAM3, Q_FYS1 to Q_FYS3,
    Q_FCY2, bottoming) is the loaded radius at a given load (MFeval 4.0, release notes), which is not computed here.
    Left out: turn slip, low speed, friction that falls with speed. Every coefficient is a leaf, so that forces are
    differentiable by them; a leading axis on each is a batch of tyres.
    """

    p: dict[str, Array]
    version: int = eqx.field(static=True)

    def slip(
        self,
        kappa: ArrayLike,
        alpha: ArrayLike,
        Fz: ArrayLike,
        gamma: ArrayLike = 0.0,
        pressure: ArrayLike | None = None,
    ) -> Slip:
        """Return the inputs as arrays; `pressure` [Pa] is the nominal one where left out."""
        k, a, F, g = (jnp.asarray(value, float) for value in (kappa, alpha, Fz, gamma))
        change = jnp.zeros(()) if pressure is None else jnp.asarray(pressure, float) / self.p["NOMPRES"] - 1
        return Slip(k, a, F, g, change)

    def forces(self, at: Slip) -> tuple[Array, Array]:
        """Return longitudinal and lateral force [N] in combined slip."""
        x, y, (Gx, Gy, shift) = self.pure_x(at), self.pure_y(at), self.weights(at)
        return Gx * x.force, Gy * y.force + shift

    def _load(self, at: Slip) -> tuple[Array, Array]:
        """Return the scaled nominal load [N], and the load over it less 1."""
        Fz0 = self.p["LFZO"] * self.p["FNOMIN"]
        return Fz0, at.Fz / Fz0 - 1

    def _angles(self, at: Slip) -> tuple[Array, Array]:
        return (at.alpha, at.gamma) if self.version == 52 else (jnp.tan(at.alpha), jnp.sin(at.gamma))

    def pure_x(self, at: Slip) -> Curve:
        """Return the curve of the longitudinal force in pure longitudinal slip (4.E9-4.E18)."""
        p, (_, f), d = self.p, self._load(at), at.pressure
        gamma = at.gamma * p["LGAX"]
        x = at.kappa + (p["PHX1"] + p["PHX2"] * f) * p["LHX"]
        mu = (
            (p["PDX1"] + p["PDX2"] * f)
            * (1 + p["PPX3"] * d + p["PPX4"] * d**2)
            * (1 - p["PDX3"] * gamma**2)
            * p["LMUX"]
        )
        C, D = p["PCX1"] * p["LCX"], mu * at.Fz
        K = (at.Fz * (p["PKX1"] + p["PKX2"] * f) * jnp.exp(p["PKX3"] * f) * (1 + p["PPX1"] * d + p["PPX2"] * d**2)
             * p["LKX"])  # fmt: skip
        E = (p["PEX1"] + p["PEX2"] * f + p["PEX3"] * f**2) * (1 - p["PEX4"] * jnp.sign(x)) * p["LEX"]
        V = at.Fz * (p["PVX1"] + p["PVX2"] * f) * p["LVX"] * p["LMUX"]
        return Curve(x, K / (C * D + TINY), C, D, E, V, K, mu)

    def pure_y(self, at: Slip) -> Curve:
        """Return the curve of the lateral force in pure side slip (4.E19-4.E30)."""
        p, (Fz0, f), d = self.p, self._load(at), at.pressure
        alpha, gamma = self._angles(at)
        gamma = gamma * p["LGAY"]
        K = (
            p["PKY1"]
            * Fz0
            * (1 + p["PPY1"] * d)
            * (1 - p["PKY3"] * jnp.abs(gamma))
            * p["LKY"]
            * jnp.sin(p["PKY4"] * jnp.arctan(at.Fz / Fz0 / ((p["PKY2"] + p["PKY5"] * gamma**2) * (1 + p["PPY2"] * d))))
        )
        camber = at.Fz * (p["PVY3"] + p["PVY4"] * f) * gamma * p["LKYC"] * p["LMUY"]
        if self.version == 52:
            lean = p["PHY3"] * gamma * p["LKYC"]
        else:
            stiffness = at.Fz * (p["PKY6"] + p["PKY7"] * f) * (1 + p["PPY5"] * d) * p["LKYC"]
            lean = (stiffness * gamma - camber) / (K + TINY * _sign(K))
        x = alpha + (p["PHY1"] + p["PHY2"] * f) * p["LHY"] + lean
        V = at.Fz * (p["PVY1"] + p["PVY2"] * f) * p["LVY"] * p["LMUY"] + camber
        mu = (
            (p["PDY1"] + p["PDY2"] * f)
            * (1 + p["PPY3"] * d + p["PPY4"] * d**2)
            * (1 - p["PDY3"] * gamma**2)
            * p["LMUY"]
        )
        C, D = p["PCY1"] * p["LCY"], mu * at.Fz
        turned = (p["PEY3"] + p["PEY4"] * gamma) * _sign(x)
        E = (p["PEY1"] + p["PEY2"] * f) * (1 + p["PEY5"] * gamma**2 - turned) * p["LEY"]
        return Curve(x, K / (C * D + TINY), C, D, E, V, K, mu)

    def weights(self, at: Slip) -> tuple[Array, Array, Array]:
        """Return the weights of both forces in combined slip, and the lateral force by kappa (4.E50-4.E67)."""
        p, (_, f) = self.p, self._load(at)
        alpha, gamma = self._angles(at)
        weight = lambda x, B, C, E: jnp.cos(C * jnp.arctan(bent(B * x, E)))
        B = (p["RBX1"] + p["RBX3"] * gamma**2) * jnp.cos(jnp.arctan(p["RBX2"] * at.kappa)) * p["LXAL"]
        E = p["REX1"] + p["REX2"] * f
        Gx = weight(alpha + p["RHX1"], B, p["RCX1"], E) / weight(p["RHX1"], B, p["RCX1"], E)
        B = (p["RBY1"] + p["RBY4"] * gamma**2) * jnp.cos(jnp.arctan(p["RBY2"] * (alpha - p["RBY3"]))) * p["LYKA"]
        shift, E = p["RHY1"] + p["RHY2"] * f, p["REY1"] + p["REY2"] * f
        Gy = weight(at.kappa + shift, B, p["RCY1"], E) / weight(shift, B, p["RCY1"], E)
        D = (self.pure_y(at).mu * at.Fz * (p["RVY1"] + p["RVY2"] * f + p["RVY3"] * gamma)
             * jnp.cos(jnp.arctan(p["RVY4"] * alpha)))  # fmt: skip
        return Gx, Gy, D * jnp.sin(p["RVY5"] * jnp.arctan(p["RVY6"] * at.kappa)) * p["LVYKA"]

    def aligning_moment(self, at: Slip) -> Array:
        """Return the aligning moment [N m] in combined slip (4.E31-4.E49, 4.E71-4.E78; b_z4 as in MF-Tyre 6.1.2).

        In 6.x the trail carries the side force of the upright tyre (4.E74), in 5.2 that of the cambered one.
        """
        p, (Fz0, f), d = self.p, self._load(at), at.pressure
        (Fx, Fy), x, y, (_, Gy, _) = self.forces(at), self.pure_x(at), self.pure_y(at), self.weights(at)
        carried = y if self.version == 52 else self.pure_y(at._replace(gamma=jnp.zeros_like(at.gamma)))
        alpha, gamma = self._angles(at)
        gamma, R0, size = gamma * p["LGAZ"], p["UNLOADED_RADIUS"], jnp.abs(gamma)
        lean = 1 + p["QDZ3"] * (gamma if self.version == 52 else size) + p["QDZ4"] * gamma**2
        Ky = y.K + TINY * _sign(y.K)
        equivalent = lambda a: jnp.sqrt(a**2 + (x.K / Ky * at.kappa) ** 2) * _sign(a)
        a_t = alpha + p["QHZ1"] + p["QHZ2"] * f + (p["QHZ3"] + p["QHZ4"] * f) * gamma
        a_r = y.x + y.V / Ky
        B = (
            (p["QBZ1"] + p["QBZ2"] * f + p["QBZ3"] * f**2)
            * (1 + p["QBZ4"] * gamma + p["QBZ5"] * size)
            * p["LKY"]
            / p["LMUY"]
        )
        E = (p["QEZ1"] + p["QEZ2"] * f + p["QEZ3"] * f**2) * (
            1 + (p["QEZ4"] + p["QEZ5"] * gamma) * 2 / jnp.pi * jnp.arctan(B * p["QCZ1"] * a_t))  # fmt: skip
        D = at.Fz * R0 / Fz0 * (p["QDZ1"] + p["QDZ2"] * f) * (1 - p["PPZ1"] * d) * p["LTR"] * lean
        trail = D * jnp.cos(p["QCZ1"] * jnp.arctan(bent(B * equivalent(a_t), E))) * jnp.cos(at.alpha)
        B = p["QBZ9"] * p["LKY"] / p["LMUY"] + p["QBZ10"] * y.B * y.C
        by_camber = (p["QDZ8"] + p["QDZ9"] * f) * (1 + p["PPZ2"] * d) + (p["QDZ10"] + p["QDZ11"] * f) * size
        D = at.Fz * R0 * ((p["QDZ6"] + p["QDZ7"] * f) * p["LRES"] + by_camber * gamma * p["LKZC"]) * p["LMUY"]
        rest = D * jnp.cos(jnp.arctan(B * equivalent(a_r))) * jnp.cos(at.alpha)
        arm = R0 * (p["SSZ1"] + p["SSZ2"] * Fy / Fz0 + (p["SSZ3"] + p["SSZ4"] * f) * gamma) * p["LS"]
        return -trail * Gy * carried.force + rest + arm * Fx

    def relaxation_lengths(self, at: Slip) -> tuple[Array, Array]:
        """Return the longitudinal and lateral relaxation length [m]: 0 where the file does not say.

        5.2: Pacejka 2002, p_T coefficients; 6.x: slip stiffness over the stiffness of the carcass (Pacejka 2012, 7.3).
        """
        p, (Fz0, f), d = self.p, self._load(at), at.pressure
        if self.version == 52:
            long = at.Fz * (p["PTX1"] + p["PTX2"] * f) * jnp.exp(-p["PTX3"] * f) * p["UNLOADED_RADIUS"] / p["FNOMIN"]
            bend = jnp.sin(2 * jnp.arctan(at.Fz / (jnp.where(p["PTY2"] == 0, 1.0, p["PTY2"]) * Fz0)))
            side = p["PTY1"] * bend * (1 - p["PKY3"] * jnp.abs(at.gamma)) * p["UNLOADED_RADIUS"] * p["LFZO"]
            return long * p["LSGKP"], side * p["LSGAL"]
        over = lambda K, c: jnp.where(c == 0, 0.0, jnp.abs(K) / jnp.where(c == 0, 1.0, c))
        c_x = p["LONGITUDINAL_STIFFNESS"] * (1 + p["PCFX1"] * f + p["PCFX2"] * f**2) * (1 + p["PCFX3"] * d)
        c_y = p["LATERAL_STIFFNESS"] * (1 + p["PCFY1"] * f + p["PCFY2"] * f**2) * (1 + p["PCFY3"] * d)
        return over(self.pure_x(at).K, c_x), over(self.pure_y(at).K, c_y)


def _sign(x: Array) -> Array:
    return jnp.where(x < 0, -1.0, 1.0)


def magic_formula(file: TyreFile, values: Mapping[str, float] | None = None) -> MagicFormula2012:
    """Build the tyre of a file, SI; coefficients that it lacks are 0, scale factors 1, and PKY4 is 2.

    `values` replace those of the file, for instance by arrays to differentiate by.
    """
    require_float64()
    written = file.values if values is None else values
    filled = {name: written.get(name, 1.0) for name in SCALES} | {name: written.get(name, 0.0) for name in COEFFICIENTS}
    filled |= {"FNOMIN": written["FNOMIN"], "NOMPRES": written.get("NOMPRES", 1e5) or 1e5}
    filled["PKY4"] = written.get("PKY4", 2.0) if file.version > 52 else 2.0
    return MagicFormula2012({name: jnp.asarray(value, float) for name, value in filled.items()}, file.version)


def require_combined(file: TyreFile) -> None:
    """Raise `BadInput` where a file has no coefficients of combined slip."""
    if not (file.values.get("RBX1") and file.values.get("RBY1")):
        raise BadInput(f"{file.name}: has no coefficients of combined slip (RBX1, RBY1), which a plant needs.")
