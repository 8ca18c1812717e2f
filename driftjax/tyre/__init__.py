"""Tyre models: forces from slip and load."""

from driftjax.tyre.magic_formula import MagicFormula as MagicFormula
from driftjax.tyre.pacejka import SimplifiedPacejka as SimplifiedPacejka
