"""Roll steer of the front axle: alpha_f + e a_y, delta - e a_y (Gillespie 1992, Ch. 6).

Positive is out of the turn, roll understeer. It comes with the loads, since the lateral acceleration is not known
before; while roll lags, a_y is what it reached.
"""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow


def apply(flow: Flow, p) -> Flow:
    """Turn the front wheels to the outside of the turn, in proportion to the lateral acceleration."""
    turn = p[0] * (flow.ay + flow.ay_lag)
    return flow._replace(u=flow.u._replace(delta=flow.u.delta - turn), alpha_f=flow.alpha_f + turn)


EFFECT = Effect(
    name="roll_steer",
    number=27,
    station="load",
    parameters=(Parameter("e", "rad s^2/m", 0.01, "per_acceleration"),),
    apply=apply,
    source="Gillespie 1992, Ch. 6",
    sentence="the front wheels steer by themselves as the body rolls",
    reads_acceleration=True,
)
