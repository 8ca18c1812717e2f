"""Tyre models: forces from slip and load; tyre property files."""

from driftjax.tyre.curved_pacejka import CurvedPacejka as CurvedPacejka
from driftjax.tyre.magic_formula import MagicFormula as MagicFormula
from driftjax.tyre.magic_formula_2012 import MagicFormula2012 as MagicFormula2012
from driftjax.tyre.magic_formula_2012 import magic_formula as magic_formula
from driftjax.tyre.pacejka import SimplifiedPacejka as SimplifiedPacejka
from driftjax.tyre.tir import TyreFile as TyreFile
from driftjax.tyre.tir import read_tir as read_tir
from driftjax.tyre.tir import write_tir as write_tir
from driftjax.tyre.tir_fit import fit_tir as fit_tir
from driftjax.tyre.tir_tyre import TirTyre as TirTyre
from driftjax.tyre.tir_tyre import nominal_tyre as nominal_tyre
from driftjax.tyre.tir_tyre import plant_tyre as plant_tyre
