"""Closed-loop simulation: integrators, the closed-loop step, rollouts, metrics and sweeps."""
