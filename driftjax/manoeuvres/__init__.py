"""Manoeuvres, campaigns of them on a car with a known truth, and the file that keeps that truth."""
