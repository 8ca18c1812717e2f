"""Measured data against the simulation: what is wrong, why, and what mending it gains."""
