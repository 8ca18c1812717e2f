"""Traction limit: F_x = F / (1 + p (F / (mu F_z))^4)^(1/4) on each axle (saturation of the tyre's longitudinal force,
Pacejka 2012, Sec. 4.3; Wong 2008, Sec. 1.4).

At p = 1 no axle transmits more than its friction mu F_z, whatever drive or brake command: beyond that its wheels spin
or lock. At a larger p they transmit less, mu F_z / p^(1/4). The nominal car transmits any force.
"""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow


def apply(flow: Flow, p) -> Flow:
    """Limit the drive or brake force of each axle to its friction."""
    held = lambda F, mu, Fz: F / (1 + p[0] * (F / (mu * Fz)) ** 4) ** 0.25
    return flow._replace(Fxf=held(flow.Fxf, flow.muf, flow.Fzf), Fxr=held(flow.Fxr, flow.mur, flow.Fzr))


EFFECT = Effect(
    name="traction_limit",
    number=47,
    station="friction",
    parameters=(Parameter("p", "1", 1.0, lower=0.0),),
    apply=apply,
    source="Pacejka 2012, Sec. 4.3; Wong 2008, Sec. 1.4",
    sentence="the tyres do not pass on more drive or brake force than their friction allows",
)
