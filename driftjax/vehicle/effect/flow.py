"""The car as a pipeline of stations: the quantities between stations, and the resulting rates."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from driftjax.core import Control, State
from driftjax.core.elementary import arctan2, cos, sin, sincos
from driftjax.tyre import CurvedPacejka, SimplifiedPacejka
from driftjax.vehicle.single_track import V_FLOOR, G, SingleTrack, lateral_share

ROLL_GRIP = 0.04  # grip lost to lateral load transfer at 1 g, which the nominal friction, steady, already holds [-]
CREEP = 0.02  # width of the smooth sign of the forward speed, over sqrt(g L) [-]


class CarParameters(NamedTuple):
    """Parameters of the car after the effects of station `car`."""

    m: Array  # mass [kg]
    Iz: Array  # yaw inertia [kg m^2]
    a: Array  # centre of mass to front axle [m]
    b: Array  # centre of mass to rear axle [m]
    muf: Array  # friction of the front axle [-]
    mur: Array
    Bf: Array  # stiffness factor of the front tyres [1/rad]
    Br: Array
    Cf: Array  # shape factor of the front tyres [-]
    Cr: Array
    ellipse: Array  # square of the friction ellipse's share: 0 none, 1 a circle [-]
    relaxation: Array  # relaxation length of both axles [m]
    roll_lag: Array  # time constant of the lateral load transfer [s]
    curve_f: tuple[Array, ...] = ()  # free form of the front tyres, as in `CurvedPacejka` [-]; empty: the formula's
    curve_r: tuple[Array, ...] = ()

    @property
    def tyre_f(self) -> SimplifiedPacejka | CurvedPacejka:
        """Return the tyre of the front axle."""
        return tyre(self.muf, self.Bf, self.Cf, self.curve_f)

    @property
    def tyre_r(self) -> SimplifiedPacejka | CurvedPacejka:
        """Return the tyre of the rear axle."""
        return tyre(self.mur, self.Br, self.Cr, self.curve_r)

    @property
    def wheelbase(self) -> Array:
        """Return the distance L between the axles [m]."""
        return self.a + self.b

    @property
    def unit_speed(self) -> Array:
        """Return sqrt(g L), the speed of Froude number 1 [m/s]."""
        return jnp.sqrt(G * self.wheelbase)

    @property
    def unit_time(self) -> Array:
        """Return sqrt(L / g) [s]."""
        return jnp.sqrt(self.wheelbase / G)

    @property
    def nominal(self) -> SingleTrack:
        """Return the single track with this car's size and mass; its tyre is the front one."""
        return SingleTrack(self.m, self.Iz, self.a, self.b, SimplifiedPacejka(self.muf, self.Bf, self.Cf))


def tyre(mu: Array, B: Array, C: Array, curve: tuple[Array, ...]) -> SimplifiedPacejka | CurvedPacejka:
    """Return the formula's tyre, or with the parameters `curve` one of free form."""
    return CurvedPacejka(mu, B, C, curve) if curve else SimplifiedPacejka(mu, B, C)


class Place(NamedTuple):
    """Time and place of a sample."""

    t: Array  # since the start of the run [s]
    psi: Array  # heading [rad]
    s: Array  # distance along the lap, as a share of it [-]
    heat: Array  # sliding work of the rear tyres since the start of the run, over weight x 100 sqrt(g L) s [-]


class Aux(NamedTuple):
    """Lagging quantities of a roll-out, constant over one step."""

    slip: Array  # (2,) slip angle that front and rear tyre feel, less the geometric one [rad]
    ay: Array  # lagged lateral acceleration of the roll, less the present one [m/s^2]


class Flow(NamedTuple):
    """All quantities of one instant, filled in from station to station."""

    car: CarParameters
    x: State
    u: Control  # actuator outputs
    place: Place
    alpha_f: Array  # slip angles [rad]
    alpha_r: Array
    ax: Array  # acceleration along the body from the tyre forces at static load [m/s^2]
    ay: Array  # lateral acceleration from the same, left positive [m/s^2]
    ay_lag: Array  # difference to it while roll lags [m/s^2]
    Fzf: Array  # axle loads [N]
    Fzr: Array
    muf: Array  # friction coefficients [-]
    mur: Array
    Fyf: Array  # lateral tyre forces, wheel frame [N]
    Fyr: Array
    Fxf: Array  # longitudinal force of the front axle [N]
    Fxr: Array  # and of the rear [N]
    X: Array  # further force along the body, at the centre of mass [N]
    Y: Array  # further force to the left [N]
    N: Array  # further yaw moment [N m]


def heat_rate(nominal: SingleTrack, x: State) -> Array:
    """Return the sliding power of the nominal rear tyres over weight x 100 sqrt(g L) [1/s], d(`Place.heat`)/dt."""
    across, along = (x.V * share for share in sincos(x.beta))
    alpha_r = arctan2(across - nominal.b * x.r, jnp.maximum(along, V_FLOOR))
    force = jnp.abs(nominal.tyre.lateral(alpha_r, nominal.Fzr))
    unit = 100 * nominal.m * G * jnp.sqrt(G * (nominal.a + nominal.b))
    return force * x.V * jnp.abs(sin(alpha_r)) / unit


def axle_forces(flow: Flow) -> Flow:
    """Return `flow` with the lateral tyre forces at its slip angles, loads and friction."""
    car = flow.car
    front = tyre(flow.muf, car.Bf, car.Cf, car.curve_f).lateral(flow.alpha_f, flow.Fzf)
    rear = tyre(flow.mur, car.Br, car.Cr, car.curve_r).lateral(flow.alpha_r, flow.Fzr)
    left = lambda Fx, mu, Fz: lateral_share(car.ellipse * (Fx / (mu * Fz)) ** 2)
    return flow._replace(Fyf=front * left(flow.Fxf, flow.muf, flow.Fzf), Fyr=rear * left(flow.Fxr, flow.mur, flow.Fzr))


def front_forces(flow: Flow) -> tuple[Array, Array]:
    """Return the force of the front axle, forward and to the left of the body [N]."""
    sin, cos = sincos(flow.u.delta)
    return flow.Fxf * cos - flow.Fyf * sin, flow.Fyf * cos + flow.Fxf * sin


def move_to_front(flow: Flow, force: Array) -> Flow:
    """Return `flow` with this longitudinal force [N] on the front instead of the rear axle."""
    return flow._replace(Fxf=flow.Fxf + force, Fxr=flow.Fxr - force)


def forward_sign(flow: Flow) -> Array:
    """Return the smooth sign of the forward speed, for resistances to rolling [-]."""
    along = flow.x.V * cos(flow.x.beta)
    return along / jnp.sqrt(along**2 + (CREEP * flow.car.unit_speed) ** 2)


def initial_flow(car: CarParameters, x: State, u: Control, place: Place, aux: Aux) -> Flow:
    """Return slip angles, static loads and friction before the effects of the stations after `car`."""
    alpha_f, alpha_r = car.nominal.slip_angles(x, u)
    zero = jnp.zeros_like(x.V)
    return Flow(
        car, x, u, place, alpha_f + aux.slip[0], alpha_r + aux.slip[1], zero, zero, aux.ay,
        car.nominal.Fzf, car.nominal.Fzr, car.muf, car.mur, zero, zero, zero, u.Fxr, zero, zero, zero,
    )  # fmt: skip


def add_accelerations(flow: Flow) -> Flow:
    """Return `flow` with the body accelerations from the tyre forces at present loads, for the load transfer."""
    flow = axle_forces(flow)
    Xf, Yf = front_forces(flow)
    return roll_grip(flow._replace(ax=(flow.Fxr + Xf) / flow.car.m, ay=(Yf + flow.Fyr) / flow.car.m))


def roll_grip(flow: Flow) -> Flow:
    """Return `flow` with the change of grip while the lateral load transfer lags.

    Friction falls by `ROLL_GRIP` (ay/g)^2 (Milliken and Milliken 1995, Ch. 18). The nominal friction is that of steady
    driving and includes this; the difference between the lagged ay and ay remains.
    """
    late = flow.ay_lag * (2 * flow.ay + flow.ay_lag) / G**2
    left = 1 - ROLL_GRIP * late
    return flow._replace(muf=flow.muf * left, mur=flow.mur * left)


def rates(flow: Flow) -> State:
    """Return the time derivative of the state under all forces of `flow` (Newton's law)."""
    car, (Xf, Yf) = flow.car, front_forces(flow)
    N = car.a * Yf - car.b * flow.Fyr
    return car.nominal.accelerate(flow.x, flow.Fxr + Xf + flow.X, Yf + flow.Fyr + flow.Y, N + flow.N)
