"""Manoeuvres, campaigns on a car with a known truth, and the file of that truth."""
