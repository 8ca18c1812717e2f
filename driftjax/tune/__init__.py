"""Weights and switching lead of the drift MPC tuned by gradients through closed-loop laps, against random search."""
