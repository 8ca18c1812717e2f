"""Effects that are linear in one quantity: gains (1 + p), offsets + p, splits p : 1 - p, first-order lags."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jax import Array

from driftjax.core import Control, lag_step
from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow, move_to_front


@dataclass(frozen=True)
class Gain:
    """Scale the fields of a station's record by 1 + p."""

    fields: tuple[str, ...]

    def change(self, record: Any, p: Array) -> Any:
        """Return the record with the fields changed."""
        return record._replace(**{name: getattr(record, name) * (1 + p) for name in self.fields})

    def __call__(self, record: Any, *context_and_p: Any) -> Any:
        """Apply to the car, the flow or the measured state."""
        return self.change(record, context_and_p[-1][0])


@dataclass(frozen=True)
class Offset(Gain):
    """Shift the fields of a station's record by p."""

    def change(self, record: Any, p: Array) -> Any:
        """Return the record with the fields changed."""
        return record._replace(**{name: getattr(record, name) + p for name in self.fields})


@dataclass(frozen=True)
class OnCommand:
    """Apply a gain or an offset to the command, which has no memory."""

    effect: Gain

    def __call__(self, memory: Any, u: Control, V: Array, dt: Array, p: tuple[Array, ...]) -> tuple[Any, Control]:
        """Return the memory unchanged, and the changed command."""
        return memory, self.effect(u, p)


@dataclass(frozen=True)
class Lag:
    """Let a field of the command lag by the time constant p [s]."""

    field: str

    def __call__(self, memory: Array, u: Control, V: Array, dt: Array, p: tuple[Array, ...]) -> tuple[Array, Control]:
        """Return the lagged value at the end of the step, and the command with the mean over the step."""
        mean, end = lag_step(memory, getattr(u, self.field), p[0], dt)
        return end, u._replace(**{self.field: mean})


@dataclass(frozen=True)
class Split:
    """Move the fraction p of the drive force, or of the brake force, from the rear to the front axle."""

    drive: bool

    def __call__(self, flow: Flow, p: tuple[Array, ...]) -> Flow:
        """Return the flow with F_xf = p F and F_xr = (1 - p) F."""
        return move_to_front(flow, p[0] * (jnp.maximum if self.drive else jnp.minimum)(flow.u.Fxr, 0.0))


def at_rest(dt: float) -> Array:
    """Return the lagged value at rest."""
    return jnp.zeros(())


GRIP = ("friction", "friction_front", "friction_rear")  # gains of the fields muf and mur, which `CarParameters` has too
FRICTION, STIFFNESS, LAG = (-14.0, 10.0), (-5.5, 12.0), (0.0, 12.0)  # bounds in typical sizes

# fmt: off
LINEAR = (
    Effect("friction", 1, "friction", (Parameter("p", "1", 0.06, "1", *FRICTION),), Gain(("muf", "mur")),
           "Pacejka 2012, Sec. 4", "the tyres have another friction than the model's", equation="mu (1 + p)"),
    Effect("friction_front", 2, "friction", (Parameter("p", "1", 0.06, "1", *FRICTION),), Gain(("muf",)),
           "Pacejka 2012, Sec. 4", "the front tyres have another friction than the model's", equation="mu_f (1 + p)"),
    Effect("friction_rear", 3, "friction", (Parameter("p", "1", 0.06, "1", *FRICTION),), Gain(("mur",)),
           "Pacejka 2012, Sec. 4", "the rear tyres have another friction than the model's", equation="mu_r (1 + p)"),
    Effect("stiffness_front", 4, "car", (Parameter("p", "1", 0.15, "1", *STIFFNESS),), Gain(("Bf",)),
           "Pacejka 2012, Sec. 4.3",
           "the front tyres build up their side force with slip faster or slower than the model's",
           equation="B_f (1 + p); the cornering stiffness is B C mu F_z"),
    Effect("stiffness_rear", 5, "car", (Parameter("p", "1", 0.15, "1", *STIFFNESS),), Gain(("Br",)),
           "Pacejka 2012, Sec. 4.3",
           "the rear tyres build up their side force with slip faster or slower than the model's",
           equation="B_r (1 + p); the cornering stiffness is B C mu F_z"),
    Effect("tyre_shape", 6, "car", (Parameter("p", "1", 0.06),), Gain(("Cf", "Cr")), "Pacejka 2012, Sec. 4.3",
           "past its peak the side force of the tyres falls more or less than the model's", equation="C (1 + p)"),
    Effect("relaxation_length", 12, "car", (Parameter("sigma", "m", 0.13, "length", lower=0.0),),
           Offset(("relaxation",)), "Pacejka 2012, Ch. 7", "the tyres need some distance to build up their side force",
           transient=True, equation="sigma alpha_lag_dot + V alpha_lag = V alpha"),
    Effect("drive_gain", 17, "command", (Parameter("p", "1", 0.06, lower=-12.0, upper=15.0),),
           OnCommand(Gain(("Fxr",))), "Rajamani 2012, Ch. 5", "the drive force is another than the one commanded",
           equation="F_xr = F_command (1 + p)"),
    Effect("drive_lag", 18, "command", (Parameter("tau", "s", 0.14, "time", *LAG),), Lag("Fxr"),
           "first-order actuator; Rajamani 2012, Ch. 5", "the drive force lags behind its command", start=at_rest,
           equation="tau F_xr_dot + F_xr = F_command"),
    Effect("mass", 23, "car", (Parameter("p", "1", 0.06),), Gain(("m",)), "Gillespie 1992, Ch. 1",
           "the car is heavier or lighter than the model",
           equation="m (1 + p); the axle loads go with it, the yaw inertia does not"),
    Effect("yaw_inertia", 24, "car", (Parameter("p", "1", 0.15, upper=8.0),), Gain(("Iz",)), "Gillespie 1992, Ch. 1",
           "the car resists turning more or less than the model", equation="I_z (1 + p)"),
    Effect("roll_lag", 26, "car", (Parameter("tau", "s", 0.2, "time", lower=0.0),), Offset(("roll_lag",)),
           "Milliken and Milliken 1995, Ch. 18", "the body takes time to roll, so that the grip follows a turn late",
           transient=True, reads_acceleration=True,
           equation="tau a_roll_dot + a_roll = a_y; grip and `load_transfer_lat` go with a_roll"),
    Effect("steer_offset", 28, "command", (Parameter("p", "rad", 0.02),), OnCommand(Offset(("delta",))),
           "Gillespie 1992, Ch. 8", "the wheels do not point straight ahead when the steering command says so",
           equation="delta = delta_command + p"),
    Effect("steer_gain", 29, "command", (Parameter("p", "1", 0.06, lower=-10.0, upper=10.0),),
           OnCommand(Gain(("delta",))),
           "Gillespie 1992, Ch. 8", "the wheels turn by more or less than the steering command",
           equation="delta = delta_command (1 + p)"),
    Effect("steer_lag", 31, "command", (Parameter("tau", "s", 0.13, "time", *LAG),), Lag("delta"),
           "first-order actuator; Pacejka 2012, Sec. 1.3", "the steering lags behind its command", start=at_rest,
           equation="tau delta_dot + delta = delta_command"),
    Effect("gyro_bias", 39, "sensor", (Parameter("p", "rad/s", 0.01, "yaw_rate"),), Offset(("r",)),
           "Ryu, Rossetter and Gerdes 2002", "the measured yaw rate is off by a constant", kinematic=True,
           equation="r_measured = r + p"),
    Effect("gyro_scale", 40, "sensor", (Parameter("p", "1", 0.03),), Gain(("r",)), "Ryu, Rossetter and Gerdes 2002",
           "the measured yaw rate is off by a factor", kinematic=True, equation="r_measured = r (1 + p)"),
    Effect("sideslip_bias", 41, "sensor", (Parameter("p", "rad", 0.02),), Offset(("beta",)),
           "Ryu, Rossetter and Gerdes 2002", "the measured sideslip is off by a constant", kinematic=True,
           equation="beta_measured = beta + p"),
    Effect("speed_scale", 42, "sensor", (Parameter("p", "1", 0.03),), Gain(("V",)), "Carlson and Gerdes 2005",
           "the measured speed is off by a factor", kinematic=True,
           equation="V_measured = V (1 + p), as of another wheel radius"),
    Effect("drive_split", 45, "slip", (Parameter("p", "1", 0.15, lower=0.0, upper=20 / 3),), Split(drive=True),
           "Milliken and Milliken 1995, Ch. 20", "a part of the drive force is on the front axle",
           equation="F_xf = p F, F_xr = (1 - p) F for F > 0; 0 is a rear-driven car, 1 a front-driven one"),
    Effect("yaw_moment", 46, "force", (Parameter("M", "N m", 0.01, "moment"),), Offset(("N",)), "Gillespie 1992, Ch. 3",
           "a constant moment turns the car, as of a brake that drags on one side", equation="N + M, left positive"),
    Effect("brake_split", 48, "slip", (Parameter("p", "1", 0.25, lower=0.0),), Split(drive=False),
           "Milliken and Milliken 1995, Ch. 20", "a part of the brake force is on the front axle",
           equation="F_xf = p F, F_xr = (1 - p) F for F < 0; 0.6 to 0.75 is common with brakes on all wheels"),
)
# fmt: on
