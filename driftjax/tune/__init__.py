"""Tune weights and switching lead of the drift MPC by gradients through closed-loop laps, or random search."""
