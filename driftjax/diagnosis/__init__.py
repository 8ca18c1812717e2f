"""Diagnose a simulation from measured data: model errors, their causes, and the gain of correcting them."""
