"""Slip and load to force."""

from driftjax.tyre.pacejka import SimplifiedPacejka as SimplifiedPacejka
