"""Drivers: pure pursuit on normal segments, a drift controller in the corner, and the switch between them."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.control.dither import corner_excitation
from driftjax.control.estimator import Estimate, Estimator
from driftjax.control.lqr import ScheduledLQR
from driftjax.control.mpc import DriftOCP, within_limits
from driftjax.control.mpc_solution import MPCProblem, MPCSolution, acceptable, solve_mpc_batch
from driftjax.control.pursuit import PurePursuit
from driftjax.control.table import ReferenceTable
from driftjax.core import Control, State, as_float, lag_step, require_at_least, require_positive
from driftjax.parallel import vmap_batch
from driftjax.sim import Sensed, where_tree
from driftjax.sim.lap import sensed_on
from driftjax.solve import Options, shift
from driftjax.track import Track

BARRIER = 3.0  # first barrier parameter of every solve, which starts from the reference and not from the last plan
RESTARTS = 2  # attempts with a smaller barrier and a line search at problems without an acceptable plan
ACCEPTABLE = 100.0  # a plan this many tolerances from optimal still drives; the code is kept in the log


@dataclass(frozen=True)
class SwitchConfig:
    """Where the drift controller takes over and hands back; fixed before methods are compared."""

    lead: float = 6.0
    """Distance before the drift section at which the drift controller takes over [m]."""
    trail: float = 4.0
    """Distance after the drift section over which it keeps driving [m]."""
    handover_beta: float = 0.15
    """It also keeps driving, up to three times as far, until the sideslip is below this [rad]."""

    def __post_init__(self) -> None:
        require_at_least(self, 0, "lead", "trail")
        require_positive(self, "handover_beta")


class DriverState(NamedTuple):
    """State of the driver, carried from step to step."""

    command: Float[Array, " 2"]  # last command (delta, Fxr)
    lagged_input: Float[Array, " 2"]  # actuator outputs by the learnt lags
    estimate: Estimate | None  # of the motion, for drivers with an estimator
    good: Float[Array, "N 2"]  # inputs of the last good plan, already shifted: applied where a solve fails
    drifting: Array  # whether the drift controller drove the last step


class Decision(NamedTuple):
    """Command of one step and how it was computed."""

    command: Control
    drifting: Array  # bool
    solved: Array  # bool: the plan applied is this step's own; False: the last good one, shifted
    kkt: Array
    num_steps: Array


class Driver(eqx.Module):
    """Driver of one batch entry; `kind` selects the controller of the drift section."""

    kind: Literal["mpc", "lqr", "pursuit"] = eqx.field(static=True)
    path: Track
    table: ReferenceTable
    pursuit: PurePursuit
    lqr: ScheduledLQR | None  # of that kind only
    ocp: DriftOCP
    options: Options
    lead: Array = eqx.field(converter=as_float)
    trail: Array = eqx.field(converter=as_float)
    handover_beta: Array = eqx.field(converter=as_float)
    estimator: Estimator | None  # None: bare measurements
    dither: Float[Array, " 2"]  # amplitude of the excitation added to the drift MPC's steering [rad] and drive [N]

    @property
    def horizon(self) -> int:
        """Return the horizon of the MPC [steps]."""
        return self.ocp.horizon

    def start(self) -> DriverState:
        """Return the initial state of the driver: commands and actuator outputs are 0."""
        estimate = None if self.estimator is None else self.estimator.start()
        return DriverState(jnp.zeros(2), jnp.zeros(2), estimate, jnp.zeros((self.horizon, 2)), jnp.asarray(False))

    def observe(self, sensed: Sensed, memory: DriverState) -> tuple[Sensed, DriverState]:
        """Return motion and actuator outputs when this step's command will start to act: estimated, or as measured."""
        if self.estimator is None or memory.estimate is None:
            return sensed, memory
        y = jnp.stack([sensed.V, sensed.beta, sensed.r, sensed.x, sensed.y, sensed.psi])
        now = self.estimator.update(memory.estimate, y)
        x, lagged_input = self.estimator.ahead(self.ocp.car, self.ocp.residual, now)
        return sensed_on(self.path, sensed.s, *x), memory._replace(estimate=now, lagged_input=lagged_input)

    def engaged(self, sensed: Sensed, memory: DriverState) -> Array:
        """Evaluate the switch rule: within the drift section widened by lead and trail, longer while still sliding."""
        if self.kind == "pursuit":
            return jnp.asarray(False)
        past = sensed.s - self.table.drift_end
        sliding = memory.drifting & (jnp.abs(sensed.beta) > self.handover_beta) & (past < 3 * self.trail)
        return (sensed.s >= self.table.drift_start - self.lead) & ((past < self.trail) | sliding)

    def after(self, memory: DriverState) -> DriverState:
        """Return the driver state one step later: actuator outputs after the command, or the predicted estimate."""
        if self.estimator is not None and memory.estimate is not None:
            now, car = memory.estimate, self.ocp.car
            return memory._replace(estimate=self.estimator.predict(car, self.ocp.residual, now, memory.command))
        lagged_input = lag_step(memory.lagged_input, memory.command, self.ocp.residual.lags, self.ocp.dt)[1]
        return memory._replace(lagged_input=lagged_input)

    def pursue(self, sensed: Sensed, memory: DriverState) -> Array:
        """Return the command (2,) of pure pursuit within the limits."""
        speed, slope = self.table.row(self.table.speed, sensed.s), self.table.slope(self.table.speed, sensed.s)
        now = (sensed.x, sensed.y, sensed.psi, sensed.V, sensed.r, sensed.s)
        u = self.pursuit(self.path, *now, speed, speed * slope)
        return within_limits(self.ocp, jnp.stack(u)[None], memory.command, share=0.0)[0]

    def stabilise(self, sensed: Sensed, memory: DriverState) -> Array:
        """Return the command (2,) of the LQR around the reference at `s`, within the limits."""
        assert self.lqr is not None, "a driver of this kind has gains"
        motion, (u_ref,) = self.table.reference(sensed.s[None]).states()[0], self.table.inputs(sensed.s[None])
        x = jnp.stack([sensed.V, sensed.beta, sensed.r, sensed.e, sensed.theta])
        x = jnp.concatenate([x, memory.command, memory.lagged_input])
        u = self.lqr(self.ocp, sensed.s, x, jnp.concatenate([motion, u_ref, u_ref]))
        car = self.ocp.car  # beyond the peak of the front tyres more steering does less, which no gain knows
        ahead = car.slip_angles(State(sensed.V, sensed.beta, sensed.r), Control(jnp.zeros(()), u[1]))[0]
        u = u.at[0].set(jnp.clip(u[0], ahead - car.peaks[0], ahead + car.peaks[0]))
        return within_limits(self.ocp, u[None], memory.command, share=0.0)[0]

    def mpc_problem(self, sensed: Sensed, memory: DriverState) -> MPCProblem:
        """Build the drift MPC problem of this step, with the reference as initial guess.

        The guess decides which optimum is found: besides the wanted drift there is often one with the front wheel
        saturated and falling speed, hardly more expensive where the speed weight is small, and a solve warm-started
        from the last one drifts into it.
        """
        x = jnp.stack([sensed.V, sensed.beta, sensed.r, sensed.e, sensed.theta])
        s = self.table.schedule(sensed.s, self.horizon, self.ocp.dt)
        reference, U = self.table.reference(s), self.table.inputs(s[:-1])
        X = reference.states().at[0].set(x)
        options = Options(self.options.tolerance, BARRIER, self.options.max_steps, ACCEPTABLE, RESTARTS)
        return MPCProblem(x, memory.command, memory.lagged_input, reference, X, U, options)

    def excitation(self, s: Array) -> Float[Array, " 2"]:
        """Return the excitation of steering [rad] and drive [N] at arc length `s`."""
        start = self.table.drift_start - self.lead
        return self.dither * corner_excitation((s - start) / (self.table.drift_end - start))

    def apply_solution(
        self, problem: MPCProblem, solution: MPCSolution, sensed: Sensed, memory: DriverState
    ) -> tuple[Decision, DriverState]:
        """Return the command of the drift MPC, excited by the dither; where the solve failed, of the last good plan."""
        solved, plan = acceptable(solution, problem.options), solution.plan
        good = jnp.where(memory.drifting, memory.good, problem.U)  # before the first solve: the reference's
        good = jnp.where(solved, solution.U, within_limits(self.ocp, good, memory.command, share=0.0))
        excited = good[:1] + self.excitation(sensed.s)
        u = within_limits(self.ocp, excited, memory.command, share=0.0)[0]
        decision = Decision(Control(u[0], u[1]), jnp.asarray(True), solved, plan.kkt, plan.num_steps.astype(int))
        return decision, memory._replace(command=u, good=shift(good), drifting=jnp.asarray(True))


def decide(drivers: Driver, sensed: Sensed, memory: DriverState, alive: Array) -> tuple[Control, DriverState, Decision]:
    """Compute one step of the whole batch (leading axis); the MPC runs only while an `alive` entry needs it."""
    sensed, memory = vmap_batch(lambda d, x, m: d.observe(x, m))(drivers, sensed, memory)
    engaged = vmap_batch(lambda d, x, m: d.engaged(x, m))(drivers, sensed, memory) & alive
    pursued = vmap_batch(lambda d, x, m: d.pursue(x, m))(drivers, sensed, memory)
    idle = Decision(
        Control(pursued[:, 0], pursued[:, 1]),
        jnp.zeros_like(engaged),
        jnp.ones_like(engaged),
        jnp.zeros_like(pursued[:, 0]),
        jnp.zeros(engaged.shape, int),
    )
    idle_flag = jnp.zeros_like(engaged)
    resting = memory._replace(command=pursued, drifting=idle_flag)
    if drivers.kind == "pursuit":
        return idle.command, resting, idle  # nothing here uses the actuator outputs

    def drift():
        if drivers.kind == "mpc":
            problem = vmap_batch(lambda d, x, m: d.mpc_problem(x, m))(drivers, sensed, memory)
            solution = solve_mpc_batch(drivers.ocp, problem, engaged)
            return vmap_batch(lambda d, *args: d.apply_solution(*args))(drivers, problem, solution, sensed, memory)
        u = vmap_batch(lambda d, x, m: d.stabilise(x, m))(drivers, sensed, memory)
        decision = idle._replace(command=Control(u[:, 0], u[:, 1]), drifting=jnp.ones_like(engaged))
        return decision, memory._replace(command=u, drifting=jnp.ones_like(engaged))

    drifted = jax.lax.cond(jnp.any(engaged), drift, lambda: (idle, resting))
    decision, memory = where_tree(engaged, drifted, (idle, resting))
    return decision.command, vmap_batch(lambda d, m: d.after(m))(drivers, memory), decision
