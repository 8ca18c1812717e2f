"""Measure the MPC against FATROP and IPOPT, solve by solve on one core."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from driftjax.studies.bench.config import PEERS, BenchConfig, Dtype, Solver, missing
from driftjax.studies.bench.drift import HORIZON, SPREAD, TOLERANCE, WEIGHTS, X_REF, Starts, car, config, starts
from driftjax.studies.bench.mpc import TOLERANCES, Kind, Solved, example_gp, mpc_solves
from driftjax.studies.bench.rows import (
    PartResult,
    RecordedCall,
    Row,
    Timing,
    TimingCurve,
    alternate,
    measure_curve,
    timed,
)

if TYPE_CHECKING:
    from driftjax.studies.bench.casadi_mpc import CasadiSolution

NAMES: dict[Kind, str] = {"rti": "real-time iteration", "converged": "converged"}
# FATROP's converged solve over acados' time for each kind, measured where both could be installed
ACADOS: dict[Kind, float] = {"rti": 21.7, "converged": 1.73}
BATCH: dict[Kind, dict[Dtype, float]] = {
    "rti": {"float64": 219.0, "float32": 438.0},
    "converged": {"float64": 13.0, "float32": 26.0},
}
ALONE: dict[Kind, float] = {"rti": 8.7, "converged": 1.73}
GP_SIZE, GP_TARGET = 200, 4.0
WIDE, SAME = 3 * SPREAD, 1e-3  # spread of the wide starts; relative difference of costs at one optimum
QUICK_HORIZON = 4  # the peers' C is compiled in seconds
BATCHES, HORIZONS, GP_SIZES = (1, 4, 16, 64, 256, 1024), (10, 20, 40, 80), (0, 50, 100, 200, 400)


@dataclass(frozen=True)
class SolveCase:
    """A batch of solves of one kind."""

    kind: Kind
    dtype: Dtype
    num: int

    @property
    def what(self) -> str:
        """Return the description in the table."""
        return f"{NAMES[self.kind]}, {'one problem alone' if self.num == 1 else f'batch {self.num}'}, {self.dtype}"

    @property
    def target(self) -> float | None:
        """Return the target speed-up over one converged solve of FATROP."""
        if self.num > 1:
            return BATCH[self.kind][self.dtype]
        return ALONE[self.kind] if self.dtype == "float64" else None


class Peer:
    """CasADi solver that solves all starts one after the other."""

    def __init__(self, solver: Solver, problems: Starts, horizon: int):
        from driftjax.studies.bench.casadi_mpc import CasadiMPC

        self._problems = problems
        self._solver = CasadiMPC(solver, car(), config(horizon), WEIGHTS, X_REF, TOLERANCE)
        self.costs, self.success = np.zeros(len(problems.x)), 0.0

    def solve(self, problems: Starts) -> "list[CasadiSolution]":
        """Solve others."""
        return [self._solver.solve(x, u) for x, u in zip(*problems, strict=True)]

    def run(self) -> float:
        """Return the median time of a solve [s]."""
        answers = self.solve(self._problems)
        self.costs = np.array([one.cost for one in answers])
        self.success = float(np.mean([one.success for one in answers]))
        return float(np.median([one.seconds for one in answers]))


def measure_rows(cfg: BenchConfig) -> PartResult:
    """Measure all rows, and the curves if `cfg.plots`."""
    problems, horizon = starts(cfg.batch), QUICK_HORIZON if cfg.quick else HORIZON
    rows = _rows(cfg, problems, horizon) + [_gp_row(cfg, problems, horizon)]
    return PartResult(rows, _curves(cfg, problems, horizon) if cfg.plots else [])


def _rows(cfg: BenchConfig, problems: Starts, horizon: int) -> list[Row]:
    peers: dict[Solver, Peer] = {} if missing("casadi") else {name: Peer(name, problems, horizon) for name in PEERS}
    cases = [SolveCase(kind, dtype, num)
             for num in dict.fromkeys((cfg.batch, 1)) for kind in NAMES for dtype in cfg.dtype]  # fmt: skip
    mine = {
        case: RecordedCall(mpc_solves(case.kind, starts(case.num), case.dtype, horizon=horizon, threads=cfg.threads))
        for case in cases
    }
    runs: dict[SolveCase | Solver, Callable[[], float]] = {case: timed(call, case.num) for case, call in mine.items()}
    runs |= {name: peer.run for name, peer in peers.items()}
    times = alternate(cfg.repeats, runs)
    wide = {case: _wide_facts(case, cfg, peers, horizon) for case in cases if case.kind == "converged" and case.num > 1}
    return [
        row
        for case, call in mine.items()
        for row in _case_rows(case, _facts(case.kind, call.last, peers) | wide.get(case, {}), peers, times, horizon)
    ]


def _wide_facts(
    case: SolveCase, cfg: BenchConfig, peers: dict[Solver, Peer], horizon: int
) -> dict[str, float | int | str]:
    """Return the share solved from wider starts, and of these the share whose cost is not above that of IPOPT."""
    problems = starts(case.num, WIDE)
    batch = mpc_solves(case.kind, problems, case.dtype, horizon=horizon, threads=cfg.threads)()
    solved = np.asarray(batch.solved)
    facts: dict[str, float | int | str] = {"solved_wide": float(solved.mean())}
    if "ipopt" in peers:
        theirs = np.array([one.cost for one in peers["ipopt"].solve(problems)])
        facts["at_ipopts_wide"] = float(np.mean(np.asarray(batch.cost)[solved] <= (1 + SAME) * theirs[solved]))
    return facts


def _case_rows(
    case: SolveCase,
    facts: dict[str, float | int | str],
    peers: dict[Solver, Peer],
    times: dict[SolveCase | Solver, Timing],
    horizon: int,
) -> list[Row]:
    """Return the rows of one case against FATROP, IPOPT where both converge, and the derived time of acados."""
    facts = facts | {"batch": case.num, "dtype": case.dtype, "horizon": horizon}
    facts["kkt"] = TOLERANCES[case.dtype]
    fatrop, factor = times.get("fatrop"), ACADOS[case.kind]
    against: list[tuple[str, Timing | None, float | None]] = [(PEERS["fatrop"], fatrop, case.target)]
    if case.kind == "converged":
        against.append((PEERS["ipopt"], times.get("ipopt"), None))
    derived = None if fatrop is None else fatrop.over(factor)
    against.append((f"acados, not measured: FATROP / {factor}", derived, None))
    return [
        Row("mpc", case.what, "solve", times[case], name, theirs, "faster", target, missing("casadi"), facts)
        for name, theirs, target in against
    ]


def _facts(kind: Kind, batch: Solved, peers: dict[Solver, Peer]) -> dict[str, float | int | str]:
    """Return the share solved to the tolerance, and the largest relative differences of the optimal costs."""
    solved = np.asarray(batch.solved)
    facts: dict[str, float | int | str] = {"solved": float(solved.mean())}
    for name, peer in peers.items():
        facts[f"solved_{name}"] = peer.success
        if kind == "converged":
            apart = np.abs(np.asarray(batch.cost, float) / peer.costs[: len(solved)] - 1)
            facts[f"cost_difference_{name}"] = float(np.max(apart))  # also of those not solved to the tolerance
    return facts


def _gp_row(cfg: BenchConfig, problems: Starts, horizon: int) -> Row:
    """Measure the cost of a Gaussian process in the dynamics."""
    num = 1 if cfg.quick else GP_SIZE  # a size that is compiled anyway
    solve = partial(mpc_solves, "converged", problems, "float64", horizon=horizon, threads=cfg.threads)
    with_gp, without = RecordedCall(solve(gp=example_gp(num))), solve()
    calls = {"with": timed(with_gp, cfg.batch), "without": timed(without, cfg.batch)}
    times = alternate(cfg.repeats, calls)
    facts = {"solved": float(np.mean(with_gp.last.solved)), "batch": cfg.batch, "dtype": "float64", "points": num}
    what = f"converged, batch {cfg.batch}, with a {num}-point Gaussian process in the dynamics"
    return Row("mpc", what, "solve", times["with"], "without it", times["without"], "costs", GP_TARGET, facts=facts)


def _curves(cfg: BenchConfig, problems: Starts, horizon: int) -> list[TimingCurve]:
    """Measure the time per solve over batch, horizon and size of the Gaussian process."""
    batches, horizons, sizes = ((cfg.batch,), (horizon,), (1,)) if cfg.quick else (BATCHES, HORIZONS, GP_SIZES)
    many, curves = f"batch {cfg.batch}", []
    for kind, name in NAMES.items():
        solve = partial(mpc_solves, kind, dtype="float64", threads=cfg.threads)
        at_once = lambda n, solve=solve: timed(solve(starts(n), horizon=horizon), n)
        ahead = lambda n, solve=solve: timed(solve(problems, horizon=n), cfg.batch)
        curves += [
            _curve(cfg, "mpc_batch", f"driftjax, {name}", "problems side by side", batches, at_once),
            _curve(cfg, "mpc_horizon", f"driftjax, {name}, {many}", "horizon [steps]", horizons, ahead),
        ]
    solve = partial(mpc_solves, "converged", problems, "float64", horizon=horizon, threads=cfg.threads)
    learnt_from = lambda n: timed(solve(gp=example_gp(n) if n else None), cfg.batch)
    of_gp = "points of the Gaussian process"
    curves.append(_curve(cfg, "mpc_gp", f"driftjax, converged, {many}", of_gp, sizes, learnt_from))
    if not missing("casadi") and not cfg.quick:
        alone = lambda n: Peer("fatrop", starts(32), n).run
        curves.append(_curve(cfg, "mpc_horizon", f"{PEERS['fatrop']}, converged", "horizon [steps]", horizons, alone))
    return curves


def _curve(cfg: BenchConfig, figure: str, label: str, size: str, sizes: tuple[int, ...], run: Callable) -> TimingCurve:
    return measure_curve(cfg.repeats, (figure, label, size, "solve"), sizes, run)
