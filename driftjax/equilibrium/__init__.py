"""Steady states: all of the nominal car, and those of a corrected one, with explicit branch checks."""

from driftjax.equilibrium.branch import Branch as Branch
from driftjax.equilibrium.continuation import continuation as continuation
from driftjax.equilibrium.continuation import solve_steady as solve_steady
from driftjax.equilibrium.decoupled import decoupled_roots as decoupled_roots
from driftjax.equilibrium.decoupled import preference as preference
from driftjax.equilibrium.solve import Equilibrium as Equilibrium
from driftjax.equilibrium.solve import SlipRadius as SlipRadius
from driftjax.equilibrium.solve import SlipSpeed as SlipSpeed
from driftjax.equilibrium.solve import SpeedYaw as SpeedYaw
from driftjax.equilibrium.solve import solve_equilibrium as solve_equilibrium
from driftjax.equilibrium.solve import solve_nominal as solve_nominal
